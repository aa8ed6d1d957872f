"""Check that an export to the authors' pair format preserves data to within half a grey value."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from litho_data.exchange.pairs import SCALES_FILE, export_pairs, import_pairs
from litho_data.foundation.errors import InputError
from litho_data.making.build import build_dataset
from litho_data.provenance.verify import verify
from litho_data.store import open_store
from litho_data.store.partial import PartialStore, Piece
from tests.litho_data.campaigns import write_campaign


def test_a_store_survives_the_format_to_half_a_grey_value(campaign: Path, tmp_path: Path) -> None:
    notes = export_pairs(campaign / "prints.zarr", tmp_path / "pairs")
    result = import_pairs(tmp_path / "pairs", tmp_path / "back.zarr")
    assert result.n_scans == 3
    raised = {note.split(":")[0]: float(re.search(r"by ([\d.]+) nm", note)[1]) / 1e3 for note in notes}
    back = open_store(tmp_path / "back.zarr")
    for scan in open_store(campaign / "prints.zarr").scans():
        other = back.scan(scan.id)
        np.testing.assert_array_equal(other.mask_level, scan.mask_level)
        # The error is at most half of one of 255 steps, plus half of the last digit (0.1 nm) of the note.
        half_step_um = (np.nanmax(scan.height_um) + raised.get(scan.id, 0)) / 255 / 2
        difference = other.height_um - scan.height_um - raised.get(scan.id, 0)
        assert np.abs(difference).max() <= half_step_um + 0.5e-4 + 1e-6
        assert np.abs(difference.mean()) < 0.1 * half_step_um + 0.5e-4  # rounded, not truncated
    assert result.findings == []
    assert verify(tmp_path / "back.zarr").findings == ()


@pytest.fixture(scope="module")
def begun(campaign: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with exported pairs, and with an import of them that was stopped after two fields."""
    folder = tmp_path_factory.mktemp("begun")
    export_pairs(campaign / "prints.zarr", folder / "pairs")
    add, added = PartialStore.add, []

    def add_two(partial: PartialStore, piece: Piece) -> None:
        if len(added) == 2:
            raise KeyboardInterrupt
        added.append(piece.record["id"])
        add(partial, piece)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(PartialStore, "add", add_two)
        with pytest.raises(KeyboardInterrupt):
            import_pairs(folder / "pairs", folder / "mixed.zarr")
    return folder


@pytest.mark.parametrize(
    "other",
    [{"pitch_um": 0.2}, {"level_height_um": 0.2}, {"levels": 14}, {"name": "others"}],
    ids=lambda one: next(iter(one)),
)
def test_an_import_begun_with_other_options_is_not_continued(
    other: dict[str, Any], begun: Path, tmp_path: Path, without_report: None
) -> None:
    """Check this because continuing such an import would mix fields with two pitches in one store."""
    own = shutil.copytree(begun, tmp_path / "own")
    result = import_pairs(own / "pairs", own / "mixed.zarr", **other)
    assert result.reused == 0
    assert not verify(own / "mixed.zarr").findings


def test_an_import_begun_with_the_same_options_is_continued(
    begun: Path, tmp_path: Path, without_report: None
) -> None:
    own = shutil.copytree(begun, tmp_path / "own")
    assert import_pairs(own / "pairs", own / "mixed.zarr").reused == 2


def test_gaps_are_filled_with_a_note(tmp_path: Path, without_report: None) -> None:
    card = write_campaign(tmp_path, count=1)
    scan = tmp_path / "scans" / "P11.txt"
    rows = [line.split() for line in scan.read_text().splitlines()]
    rows[60][60] = "nan"
    scan.write_text("\n".join("\t".join(row) for row in rows))
    build_dataset(card, tmp_path / "prints.zarr")
    gaps = int(np.isnan(open_store(tmp_path / "prints.zarr").scan("P11").height_um).sum())
    assert gaps
    notes = export_pairs(tmp_path / "prints.zarr", tmp_path / "pairs")
    assert [note.split(",")[0] for note in notes if "became" in note] == [
        f"P11: {gaps} unmeasured pixels became 0"
    ]


def test_pixels_that_were_not_measured_stay_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check a frame and a hole that no scan measured, with the masks, without one of them, and without all of
    them, as in the authors' files.
    """
    card = write_campaign(tmp_path, count=2, more='[write]\nsurround = "unknown"\n')
    scan = tmp_path / "scans" / "P12.txt"
    rows = [line.split() for line in scan.read_text().splitlines()]
    rows[60][60] = "nan"
    scan.write_text("\n".join("\t".join(row) for row in rows))
    pairs = tmp_path / "pairs"
    with monkeypatch.context() as quick:
        quick.setattr("litho_data.making.build.write_report", lambda *_: None)
        build_dataset(card, tmp_path / "prints.zarr")
        export_pairs(tmp_path / "prints.zarr", pairs)
        result = import_pairs(pairs, tmp_path / "back.zarr")
    back = open_store(tmp_path / "back.zarr")
    for one in open_store(tmp_path / "prints.zarr").scans():
        assert 0 < one.valid.mean() < 0.9
        np.testing.assert_array_equal(back.scan(one.id).valid, one.valid)
        np.testing.assert_array_equal(np.isfinite(back.scan(one.id).height_um), one.valid)
    assert back.quality["valid_fraction"].max() < 0.9
    assert result.findings == []

    (pairs / "valid" / "P123.tif").unlink()
    with monkeypatch.context() as quick:
        quick.setattr("litho_data.making.build.write_report", lambda *_: None)
        assert import_pairs(pairs, tmp_path / "partly.zarr").unpaired == {"afm/P123.tif": "not in valid/"}

    shutil.rmtree(pairs / "valid")
    capsys.readouterr()
    result = import_pairs(pairs, tmp_path / "bare.zarr")
    assert open_store(tmp_path / "bare.zarr").scan("P12").valid.all()
    assert [(one.scan, one.text[:32]) for one in result.findings] == [
        (scan_id, "all heights along a side are exa") for scan_id in ("P11", "P12")
    ]
    assert capsys.readouterr().err.count("check P") == 2
    assert "were they measured?" in (tmp_path / "bare-report" / "report.html").read_text()


def test_files_are_those_of_the_authors(campaign: Path, tmp_path: Path) -> None:
    export_pairs(campaign / "prints.zarr", tmp_path / "pairs")
    names = {f"{scan}{quadrant}.tif" for scan in ("P11", "P12", "P21") for quadrant in "1234"}
    assert {path.name for path in (tmp_path / "pairs" / "afm").iterdir()} == names
    assert set(json.loads((tmp_path / "pairs" / "src_max_dict.txt").read_text())) == names
    layout = open_store(campaign / "prints.zarr").scan("P11").mask_level
    for quadrant, part in zip(
        "1234", (np.s_[:56, :56], np.s_[:56, 56:], np.s_[56:, :56], np.s_[56:, 56:]), strict=True
    ):
        with tifffile.TiffFile(tmp_path / "pairs" / "mask" / f"P11{quadrant}.tif") as file:
            assert file.pages[0].compression.name == "LZW"
            image = file.pages[0].asarray()
        assert image.dtype == np.uint8
        np.testing.assert_array_equal(image, np.repeat(layout[part][..., None], 3, axis=2))


def test_single_quadrants_stay_fields_of_their_own_and_orphans_are_listed(
    campaign: Path, tmp_path: Path, without_report: None
) -> None:
    pairs = tmp_path / "pairs"
    export_pairs(campaign / "prints.zarr", pairs)
    (pairs / "afm" / "P213.tif").unlink()
    result = import_pairs(pairs, tmp_path / "back.zarr")
    assert open_store(tmp_path / "back.zarr").ids == ["P11", "P12", "P211", "P212", "P214"]
    assert result.unpaired == {"mask/P213.tif": "no height file of this name"}


@pytest.mark.parametrize("name", ["Prüf 1.tif", "-x.tif"])
def test_pairs_whose_name_cannot_be_an_id_are_listed(
    campaign: Path, tmp_path: Path, name: str, without_report: None
) -> None:
    pairs = tmp_path / "pairs"
    export_pairs(campaign / "prints.zarr", pairs)
    for folder in ("mask", "afm", "valid"):
        (pairs / folder / "P111.tif").rename(pairs / folder / name)
    scales = (pairs / SCALES_FILE).read_text()
    (pairs / SCALES_FILE).write_text(scales.replace("P111.tif", name))
    result = import_pairs(pairs, tmp_path / "back.zarr")
    assert open_store(tmp_path / "back.zarr").ids == ["P112", "P113", "P114", "P12", "P21"]
    assert [*result.unpaired] == [f"afm/{name}"]
    assert "only letters, digits" in result.unpaired[f"afm/{name}"]
    with pytest.raises(InputError, match="1 ids cannot be used"):
        import_pairs(pairs, tmp_path / "strict.zarr", strict=True)
    for folder in ("mask", "afm"):
        for one in (pairs / folder).glob("P[12]*"):
            one.unlink()
    with pytest.raises(InputError, match="only letters, digits"):
        import_pairs(pairs, tmp_path / "none.zarr")
    (pairs / "afm" / name).rename(pairs / "afm" / "Pr\n.tif")
    with pytest.raises(InputError, match=r"Pr\\n\.tif', wanted a name of printable characters"):
        import_pairs(pairs, tmp_path / "none.zarr")


def test_a_folder_that_is_not_in_the_pair_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read .*src_max_dict\.txt"):
        import_pairs(tmp_path, tmp_path / "out.zarr")
    (tmp_path / "src_max_dict.txt").write_text("{}")
    with pytest.raises(InputError, match="pairs in"):
        import_pairs(tmp_path, tmp_path / "out.zarr")


@pytest.mark.measured
@pytest.mark.slow
def test_the_authors_pairs_become_whole_fields(
    measured_prints: Path, tmp_path: Path, without_report: None
) -> None:
    result = import_pairs(measured_prints, tmp_path / "authors.zarr", workers=1)
    store = open_store(tmp_path / "authors.zarr")
    assert (result.n_scans, result.skipped, result.findings) == (24, {}, [])
    assert set(store.scan(store.ids[0]).print_id) == {"1"}
    for scan_id in ("FOV11", "FOV72"):
        # The quadrants in mask/ are exact parts of the whole layouts in mask_ug/.
        np.testing.assert_array_equal(
            store.scan(scan_id).mask_level, tifffile.imread(measured_prints / f"mask_ug/{scan_id}.tif")
        )
