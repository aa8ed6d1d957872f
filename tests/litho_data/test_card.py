"""Check that every wrong key or value of a card is reported together with what is expected."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import pytest

from litho_data.cards.card import check_card, load_card
from litho_data.cards.fetch import known_cards
from litho_data.foundation.errors import InputError
from tests.litho_data.campaigns import card_text

GOOD: dict[str, Any] = tomllib.loads(card_text())


def changed(key: str, value: object) -> dict[str, Any]:
    """Return a valid card with one key changed, or removed if the value is None."""
    card = copy.deepcopy(GOOD)
    *tables, last = key.split(".")
    table = card
    for name in tables:
        table = table.setdefault(name, {})
    if value is None:
        del table[last]
    else:
        table[last] = value
    return card


def test_defaults_are_those_of_the_contract() -> None:
    card = check_card(GOOD, "card")
    assert card.process.registration == "affine"
    assert card.process.level is None
    assert card.write is None
    assert card.scan.size_um == (12.8, 12.8)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("scan.colour", "red", r"key, got 'scan\.colour', wanted files, format, unit"),
        ("colour", 1, r"key, got 'colour', wanted name"),
        ("write.speed", 1, r"key, got 'write\.speed', wanted slow_axis"),
        ("scan.unit", "furlong", r"scan\.unit = 'furlong'.*m, mm, µm"),
        ("scan.unit", "A", r"scan\.unit = 'A'"),
        ("scan.files", [], r"scan\.files.*at least one pattern"),
        ("scan.files", ["scans/{id}.txt", "scans/a.gwy"], r"scan\.files.*\{id\}"),
        ("scan.missing", [True, "x"], r"scan\.missing"),
        ("write.surround", "air", r"write\.surround.*'substrate', 'continues' or 'unknown'"),
        ("scan.size_um", [54.0, -1.0], r"scan\.size_um\.1 = -1\.0.*a number from"),
        ("layout.pitch_um", 0.0, r"layout\.pitch_um = 0\.0.*a number from"),
        ("layout.pitch_um", -0.1, r"layout\.pitch_um = -0\.1.*a number from"),
        ("layout.pitch_um", float("inf"), r"layout\.pitch_um = inf.*a number from"),
        ("layout.pitch_um", True, r"layout\.pitch_um"),
        ("layout.pitch_um", None, r"layout\.pitch_um.*nothing"),
        ("layout.levels", 1, r"layout\.levels.*greater than or equal to 2"),
        ("layout.files", "layouts/a.tif", r"layout\.files.*\{id\}"),
        ("layout.files", "../raw/{id}.tif", r"layout\.files.*inside the data folder"),
        ("scan.files", "/raw/{id}.txt", r"scan\.files.*inside the data folder"),
        ("scan.files", "..\\raw\\{id}.txt", r"scan\.files.*inside the data folder"),
        ("scan.format", "bmp", r"scan\.format.*text-matrix"),
        ("scan.full_scale_file", "max.txt", r"either unit or full_scale_file"),
        ("ids.print", "P(", r"ids\.print.*regular expression"),
        ("ids.print", "P.*", r"ids\.print.*named print"),
        ("ids.table", "../table.csv", r"ids\.table.*inside"),
        ("process.registration", "rigid", r"process\.registration.*affine"),
        ("source", {"url": "file:///x", "registry": "a"}, r"source\.url"),
        ("name", "../x", r"name"),
        ("name", "x" * 201, r"name"),
        ("scan.files", "a\0{id}", r"scan\.files.*printable"),
        ("scan.unit", "m" * 5000, r"scan\.unit = 'm{79}…: "),
        ("grating", {"period_um": 2.0, "uncertainty_um": 1e308}, r"grating\.uncertainty_um"),
        ("grating", {"period_um": 2.0, "uncertainty_um": True}, r"grating\.uncertainty_um"),
        ("grating", {"period_um": 2.0, "uncertainty_um": float("nan")}, r"grating\.uncertainty_um"),
        *(
            (key, before + path + after, rf"{key.replace('.', '[.]')}.*inside the data folder")
            for key, after in (
                ("layout.files", "/{id}.tif"),
                ("scan.files", "/{id}.txt"),
                ("scan.full_scale_file", "/max.txt"),
                ("process.level", "/recipe.toml"),
                ("ids.table", "/scans.csv"),
            )
            for before in ("", "a/")
            for path in ("a/../../b", "b/..", "..\\b")
        ),
    ],
)
def test_a_wrong_card_is_named(key: str, value: object, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        check_card(changed(key, value), "card")


def test_a_missing_card_and_a_card_that_is_not_toml_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        load_card(tmp_path / "absent.toml")
    (tmp_path / "bad.toml").write_text("name = ", encoding="utf-8")
    with pytest.raises(InputError, match=r"cannot read .*bad\.toml"):
        load_card(tmp_path / "bad.toml")


def test_the_cards_of_the_project_are_good() -> None:
    cards = known_cards()
    assert "neural-lithography" in cards
    for name, path in cards.items():
        assert load_card(path).name == name
