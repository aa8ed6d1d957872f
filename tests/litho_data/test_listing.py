"""Check that files are paired by id, that unpaired files are listed, and that paths out of the folder are
refused.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from litho_data.cards import listing
from litho_data.cards.listing import list_fields
from litho_data.cards.tables import read_table
from litho_data.foundation.errors import InputError
from tests.litho_data.campaigns import card_text


def folder_with(tmp_path: Path, files: list[str], **card: str) -> Path:
    tmp_path.mkdir(parents=True, exist_ok=True)
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "card.toml").write_text(card_text(**card), encoding="utf-8")
    return tmp_path / "card.toml"


PAIRS = ["layouts/P11.tif", "layouts/P12.tif", "scans/P11.txt", "scans/P12.txt"]


def test_ids_are_those_with_both_files(tmp_path: Path) -> None:
    files = [*PAIRS, "layouts/P13.tif", "scans/P14.txt", "layouts/.P15.tif", "scans/deeper/P16.txt"]
    listing = list_fields(folder_with(tmp_path, files))
    assert [(one.id, one.print_id, one.order) for one in listing.fields] == [("P11", "1", 0), ("P12", "1", 1)]
    assert listing.unpaired == {"P13": "no file scans/P13.txt", "P14": "no file layouts/P14.tif"}
    assert not listing.refused
    assert "the fields were written in the order of their sorted ids" in listing.assumptions


def test_an_id_of_another_form_is_refused_with_a_reason(tmp_path: Path) -> None:
    listing = list_fields(folder_with(tmp_path, [*PAIRS, "layouts/Q1.tif", "scans/Q1.txt"]))
    assert not listing.unpaired
    assert "does not match" in listing.refused["Q1"]


@pytest.mark.parametrize("end", [" ", "."])
def test_a_name_that_no_store_accepts_is_refused_with_a_reason(tmp_path: Path, end: str) -> None:
    files = [f"{kind}/{name}.{suffix}" for kind, suffix in (("layouts", "tif"), ("scans", "txt"))
             for name in ("P11", f"P11{end}", f"P0{end}1")]  # fmt: skip
    card = folder_with(tmp_path, files)
    card.write_text(card.read_text().replace(r"P(?P<print>\d)\d", "P(?P<print>..?)1.?"))
    listing = list_fields(card)
    assert [one.id for one in listing.fields] == ["P11"]
    assert "of the id" in listing.refused[f"P11{end}"]
    assert f"of the name of the print '0{end}'" in listing.refused[f"P0{end}1"]


def test_a_file_name_that_is_not_utf8_is_one_line(tmp_path: Path) -> None:
    card = folder_with(tmp_path, PAIRS)
    (tmp_path / "scans" / os.fsdecode(b"Pr\xfcfung.txt")).touch()
    with pytest.raises(InputError, match=r"scans/Pr\\xfcfung.txt.*UTF-8.*rename"):
        list_fields(card)


def test_a_link_that_leads_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    card = folder_with(tmp_path / "data", PAIRS)
    (tmp_path / "secret.txt").write_text("1 2")
    scan = tmp_path / "data" / "scans" / "P12.txt"
    scan.unlink()
    scan.symlink_to(tmp_path / "secret.txt")
    (tmp_path / "data" / "layouts" / "P13.tif").symlink_to(tmp_path / "data" / "layouts" / "P11.tif")
    (tmp_path / "data" / "scans" / "P13.txt").touch()
    listing = list_fields(card)
    assert [one.id for one in listing.fields] == ["P11", "P13"]
    assert listing.refused == {"P12": "P12.txt is a link that leads out of the data folder"}


def test_the_table_gives_order_position_dose_and_use(tmp_path: Path) -> None:
    card = folder_with(tmp_path, [*PAIRS, "scans/bare.txt"], more='table = "scans.csv"')
    table = "id,order,field_x_um,dose,use\nP11,7,-20.5,1.1,\nP12,3,,,dataset\nbare,9,,,substrate\n"
    (tmp_path / "scans.csv").write_text(table, encoding="utf-8")
    listing = list_fields(card)
    by_id = {one.id: one for one in listing.fields}
    assert by_id["P11"].order == 7
    assert by_id["P11"].columns == {"field_x_um": -20.5, "dose": 1.1}
    assert by_id["P12"].columns == {}
    assert by_id["bare"].use == "substrate"
    assert by_id["bare"].layout is None


def test_a_micrograph_is_no_reference(tmp_path: Path) -> None:
    card = folder_with(tmp_path, [*PAIRS, "scans/bare.txt"], more='table = "scans.csv"')
    heights = 'format = "text-matrix"\nunit = "m"\n'
    card.write_text(card.read_text().replace(heights, 'instrument = "sem"\n'), encoding="utf-8")
    (tmp_path / "scans.csv").write_text("id,use\nP11,\nP12,flat\nbare,substrate\n", encoding="utf-8")
    listing = list_fields(card)
    assert [one.id for one in listing.fields] == ["P11"]
    assert "use = flat" in listing.refused["P12"]
    assert "use = substrate, but a reference is a scan of heights" in listing.refused["bare"]


def test_a_scan_without_its_order_is_left_aside_where_others_have_theirs(tmp_path: Path) -> None:
    """Check that a scan without an order is not given an arbitrary place in the order of writing."""
    card = folder_with(tmp_path, PAIRS, more='table = "scans.csv"')
    (tmp_path / "scans.csv").write_text("id,order\nP12,4\n", encoding="utf-8")
    listing = list_fields(card)
    assert [(one.id, one.order) for one in listing.fields] == [("P12", 4)]
    assert listing.refused == {"P11": "not in scans.csv, which sets the order"}
    # If the table states no order for any scan, all scans are kept and sorted by id.
    (tmp_path / "scans.csv").write_text("id,dose\nP12,1.5\n", encoding="utf-8")
    assert [(one.id, one.order) for one in list_fields(card).fields] == [("P11", 0), ("P12", 1)]


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("id,order\n../P11,1\n", r"line 2: id, got '\.\./P11'.*without a path"),
        ("id,order\nP11,1\nP11,2\n", "each id once"),
        ("id,order\nP11,first\n", "whole number"),
        ("id,dose\nP11,high\n", "dose.*a number"),
        ("id,dose\nP11,nan\n", "dose.*a number"),
        *(
            (f"id,dose\nP11,{dose}\n", "dose.*a number from 0.001 to 1000")
            for dose in ("-1", "0", "inf", "1e9")
        ),
        *((f"id,field_x_um\nP11,{place}\n", "field_x_um.*a number from") for place in ("1e308", "-1e9", "x")),
        ("id,order\nP11," + "9" * 5000 + "\n", "whole number"),
        ("id,use\nP11,training\n", "dataset | flat"),
        ("id,speed\nP11,3\n", "columns of"),
        ("order\n1\n", "columns of"),
        ("id,dose\nP11,1,2\n", "more cells"),
    ],
)
def test_a_wrong_table_is_named(tmp_path: Path, table: str, expected: str) -> None:
    card = folder_with(tmp_path, PAIRS, more='table = "scans.csv"')
    (tmp_path / "scans.csv").write_text(table, encoding="utf-8")
    with pytest.raises(InputError, match=expected):
        list_fields(card)


def test_full_scales_are_metres_by_id_or_file_name(tmp_path: Path) -> None:
    card = folder_with(tmp_path, PAIRS)
    text = card.read_text(encoding="utf-8").replace('unit = "m"', 'full_scale_file = "max.json"')
    card.write_text(text, encoding="utf-8")
    (tmp_path / "max.json").write_text(json.dumps({"P11": 1e-6, "P12.txt": 2e-6}), encoding="utf-8")
    assert [one.full_scale_um for one in list_fields(card).fields] == pytest.approx([1.0, 2.0])
    (tmp_path / "max.json").write_text(json.dumps({"P11": 1e-6}), encoding="utf-8")
    assert "no full scale" in list_fields(card).refused["P12"]
    (tmp_path / "max.json").write_text(json.dumps({"P11": -1}), encoding="utf-8")
    with pytest.raises(InputError, match=r"P11.*positive"):
        list_fields(card)


def test_the_data_folder_is_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = folder_with(tmp_path / "cards", [])
    folder_with(tmp_path / "data" / "test-prints", PAIRS)
    monkeypatch.setenv("LITHO_DATA_DIR", str(tmp_path / "data"))
    assert list_fields(card).data_dir == (tmp_path / "data" / "test-prints").resolve()
    monkeypatch.delenv("LITHO_DATA_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(InputError, match="files of card"):
        list_fields(card)
    assert len(list_fields(card, data_dir=tmp_path / "data" / "test-prints").fields) == 2


def test_a_folder_without_any_pair_is_refused(tmp_path: Path) -> None:
    card = folder_with(tmp_path, ["layouts/P11.tif", "scans/P12.txt"])
    with pytest.raises(InputError, match=r"no field to build.*P11: no file scans/P11\.txt"):
        list_fields(card)


def test_an_expression_that_takes_too_long_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listing, "_LONGEST_S", 0.5)
    with pytest.raises(InputError, match="nested repetitions"):
        listing.prints_of(["a" * 40], "(?P<print>(a+)+)b")
    ids = ["A1", "B22", "c3", "ÄÖ4"]
    expected = ["A", "B", None, None]
    monkeypatch.setattr(listing, "_LONGEST_S", 30)
    assert listing.prints_of(ids, r"(?P<print>[A-Z])\d+") == expected
    assert listing.prints_of(ids, r"(?P<print>[A-Z])\d") == ["A", None, None, None]
    assert listing.prints_of(ids, r"(?P<print>\w+)\d") == ["A", "B2", "c", "ÄÖ"]
    assert listing.prints_of(ids, None) == ids


@pytest.mark.parametrize(
    ("scans", "layouts"),
    [("scans/{id}.*", "layouts/{id}.*"), ('["scans/{id}.txt", "scans/{id}.gwy"]', "layouts/{id}.tif")],
)
def test_patterns_of_several_formats(tmp_path: Path, scans: str, layouts: str) -> None:
    files = ["layouts/P11.tif", "layouts/P12.tif", "scans/P11.txt", "scans/P12.gwy", "scans/P13.gwy"]
    card = folder_with(tmp_path, files)
    text = card.read_text().replace('"scans/{id}.txt"', scans if scans[0] == "[" else f'"{scans}"')
    card.write_text(text.replace("layouts/{id}.tif", layouts))
    listing = list_fields(card)
    assert [one.scan.name for one in listing.fields] == ["P11.txt", "P12.gwy"]
    assert listing.unpaired["P13"] == f"no file {layouts.replace('{id}', 'P13')}"
    (tmp_path / "scans" / "P11.gwy").touch()
    listing = list_fields(card)
    assert [one.id for one in listing.fields] == ["P12"]
    assert "several files: P11." in listing.refused["P11"]


@pytest.mark.parametrize("code", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_table_as_spreadsheets_of_any_language_write_it(tmp_path: Path, separator: str, code: str) -> None:
    card = folder_with(tmp_path, PAIRS, more='table = "scans.csv"')
    rows = [
        "id;dose;unit;size_um;format;channel;fast_axis;instrument;surround",
        "P11;1,25;nm;27,5;auto;Höhe;y;Gerät 1;substrate",
        "P12;0,75;;54 x 27,5;;;;;",
    ]
    text = "\r\n".join(rows).replace(";", separator)
    (tmp_path / "scans.csv").write_bytes(text.encode(code))
    one, other = list_fields(card).fields
    assert one.columns == {"dose": 1.25, "instrument": "Gerät 1", "surround": "substrate"}
    says = {"unit": "nm", "size_um": (27.5, 27.5), "format": "auto", "channel": "Höhe", "fast_axis": "y"}
    assert one.read == says
    assert (other.columns, other.read) == ({"dose": 0.75}, {"size_um": (54.0, 27.5)})


@pytest.mark.parametrize("row", ["P11;1,5;2;b", "P11;2;1,5;b", "P11;1,5;0,5;a, b", "P11;;1,5;"])
@pytest.mark.parametrize("separator", [";", "\t"])
def test_quotation_marks_around_all_cells_change_no_table(tmp_path: Path, separator: str, row: str) -> None:
    cells = [line.split(";") for line in ("id;dose;field_x_um;instrument", row)]
    tables = []
    for mark in ("", '"'):
        lines = (separator.join(f"{mark}{cell}{mark}" for cell in line) for line in cells)
        (tmp_path / "scans.csv").write_text("\n".join(lines))
        tables.append(read_table(tmp_path / "scans.csv"))
    assert tables[0] == tables[1] != {}


@pytest.mark.parametrize(
    ("cell", "message"),
    [("unit\nP11,V", "unit, got 'V'"), ("size_um\nP11,0", "size_um"), ("format\nP11,xls", "format"),
     ("fast_axis\nP11,z", "fast_axis"), ("surround\nP11,air", "surround")],
)  # fmt: skip
def test_the_entries_of_a_table_about_a_file_are_checked(tmp_path: Path, cell: str, message: str) -> None:
    card = folder_with(tmp_path, PAIRS, more='table = "scans.csv"')
    (tmp_path / "scans.csv").write_text(f"id,{cell}\n")
    with pytest.raises(InputError, match=message):
        list_fields(card)
