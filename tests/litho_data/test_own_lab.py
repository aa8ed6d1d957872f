"""Check that a new lab gets a correct first dataset if it follows the page, and a warning if it does not."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from litho_data.cards.card import load_card
from litho_data.cli.app import app
from litho_data.foundation.errors import InputError
from litho_data.level import Recipe
from litho_data.making.build import build_dataset
from litho_data.making.result import BuildResult, report_folder
from litho_data.making.suggest import RECIPES, left_by_layout, suggest_recipe
from litho_data.making.verdict import verdict_of
from litho_data.register.refine import interior_of
from litho_data.store import open_store
from tests.litho_data import afm_files
from tests.litho_data.campaigns import height_of, layout_of, write_campaign
from tests.litho_data.lab import IDS, LEVEL_HEIGHT_UM, MIRRORED, RIM_PX, errors_nm, write_lab

BOW = f"[process]\nlevel = {'bow.toml'!r}\n"
# The line jitter of 6 nm and the noise give a mean absolute error of 4.8 nm. A limit of 8 nm leaves room for
# levelling errors.
MOST_NM = 8.0
FEW = ("A1", "A2", "B1")


def lab(folder: Path, ids: tuple[str, ...] = IDS, **changed: str) -> Path:
    card = write_lab(folder / "lab", 112, ids, **changed)
    (card.parent / "bow.toml").write_text(RECIPES["plane and bow"])
    return card


def first_box(card: Path) -> str:
    html = (card.parent / "prints-report" / "report.html").read_text(encoding="utf-8")
    found = re.search(r'class="verdict"[^>]*>(.*?)</', html, re.DOTALL)
    assert found
    return found[1]


def test_following_the_page_gives_true_heights(tmp_path: Path) -> None:
    # These five have the five formats. A3 has the format of B2.
    card = lab(tmp_path, tuple(one for one in IDS if one != "A3"))
    found = suggest_recipe(card, tmp_path / "levelling")
    assert found.recipe == "plane and bow"
    # The heights that the layout does not explain are small compared with a level.
    assert max(found.left_nm["plane and bow"].values()) < 1e3 * LEVEL_HEIGHT_UM / 2
    # Row alignment would mistake parts of the print for line offsets.
    assert set(found.warned) >= {"lines, then plane and bow", "plane and bow, then lines"}
    assert (tmp_path / "levelling" / "report.html").is_file()
    assert load_card(found.card).process.level == "card.recipe.toml"
    out = card.parent / "prints.zarr"
    build = CliRunner().invoke(app, ["build", str(found.card), "--out", str(out)])
    assert build.exit_code == 0
    store = open_store(out)
    assert len(store) == 5
    errors = errors_nm(store)
    assert max(errors.values()) < MOST_NM, errors
    built = BuildResult.read(report_folder(out))
    assert first_box(card) == verdict_of(built.findings, 5)
    assert first_box(card).split("—")[1].strip().startswith(f"{MIRRORED}: a mirror image of its layout")
    assert f"check {MIRRORED}: a mirror image" in build.stderr
    # Level 0 of these prints is two levels higher than the substrate.
    assert "check all scans: their outermost pixels deviate" in build.stderr
    scan = store.scan("B3")
    assert (scan.surround, scan.instrument) == ("substrate", "Cypher")
    # The stored field includes a rim of substrate, for which the scan provides measured heights.
    rim = np.ones(scan.shape, bool)
    rim[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX] = False
    assert not scan.mask_level[rim].any()
    assert scan.mask_level[~rim].any(axis=None)
    assert scan.valid[rim].mean() > 0.9


def test_pixels_whose_surroundings_are_unknown_are_left_out(tmp_path: Path) -> None:
    card = write_campaign(tmp_path, 1, more='[write]\nsurround = "unknown"')
    build_dataset(card, tmp_path / "prints.zarr")
    scan = open_store(tmp_path / "prints.zarr").scan("P11")
    assert scan.surround == "unknown"
    np.testing.assert_array_equal(scan.valid, interior_of(scan.shape))


def other_unit(card: Path) -> None:
    table = card.parent / "scans.csv"
    table.write_text(table.read_text().replace("A1;nm", "A1;um"))


def other_layout(card: Path) -> None:
    one, other = (card.parent / "layouts" / f"{name}.tif" for name in ("A1", "B1"))
    kept = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(kept)


def align_rows(card: Path) -> None:
    (card.parent / "bow.toml").write_text('[[step]]\nop = "align-rows"\n')


@pytest.mark.parametrize(
    ("changed", "change", "said"),
    [
        (
            {"pitch_um": "0.14"},
            None,
            r"all scans: the scale of the scans is -6\.\d % off.*0\.14 should be 0\.1(49|5)",
        ),
        (
            {"level_height_um": "0.8"},
            None,
            r"all scans: the prints rise by 0\.1\d* µm.*level_height_um = 0\.8",
        ),
        ({}, other_unit, r"height per level is .* times that of the others: is its unit"),
        ({}, other_layout, r"A1: it shows the layout of B1.*B1: skipped: registration failed"),
        ({}, align_rows, r"lines were shifted by up to .*part of the print may be removed"),
    ],
)
def test_a_wrong_card_is_named_in_the_first_box_and_in_the_terminal(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, str],
    change: Callable[[Path], None] | None,
    said: str,
    without_report: None,
) -> None:
    # Two scans are enough, unless the mistake concerns one scan that differs from the others.
    ids = FEW if change in (other_unit, other_layout) else FEW[::2]
    card = lab(tmp_path, ids, **{"more": BOW} | changed)
    if change is not None:
        change(card)
    result = build_dataset(card, card.parent / "prints.zarr")
    assert re.search(said, verdict_of(result.findings, result.n_scans))
    assert re.search(said.split(".*")[0], capsys.readouterr().err.replace("check ", ""))


def test_a_level_height_that_no_print_has_is_refused(tmp_path: Path) -> None:
    card = lab(tmp_path, FEW[:2], level_height_um="80", more=BOW)
    with pytest.raises(InputError, match=r"level_height_um, got 80 µm, but the prints rise by 0\.\d+ µm"):
        build_dataset(card, card.parent / "prints.zarr")
    assert not list(card.parent.glob("*.zarr"))


@pytest.mark.parametrize(
    ("first", "last"),
    [
        ("", ""),
        ("", "[process]\nregistration = 'ladder'\n"),
        ("", "[ process ]   # how\ntip = 0.01\nlevel = 'old.toml'\n\n[ids]\nprint = '(?P<print>.)1'\n"),
        ("process.registration = 'ladder'\n", ""),
        ("process.level = 'old.toml'\nprocess.tip = 0.01  # µm\n", ""),
        ("", BOW),
    ],
)
def test_a_suggested_card_keeps_all_other_entries(tmp_path: Path, first: str, last: str) -> None:
    from litho_data.making.suggest import _write_card

    card = tmp_path / "card.toml"
    card.write_text(
        f'name = "p"\n{first}'
        '[layout]\nfiles = "l/{id}.tif"\npitch_um = 0.1\nlevel_height_um = 0.1\nlevels = 5\n'
        f'[scan]\nfiles = "s/{{id}}.gwy"\n{last}',
        encoding="utf-8",
    )
    before, after = load_card(card), load_card(_write_card(card, "plane"))
    assert after.process.level == "card.recipe.toml"
    assert Recipe.from_toml(tmp_path / "card.recipe.toml").step[0].op == "layout-aware"
    level = {"level": after.process.level}
    assert after == before.model_copy(update={"process": before.process.model_copy(update=level)})


@pytest.mark.parametrize(
    "text", ["process = {registration = 'affine'}\n", 'citation = """\nlevel = 1\n[process]\n"""\n']
)
def test_a_suggested_card_that_would_say_something_else_is_not_written(tmp_path: Path, text: str) -> None:
    from litho_data.making.suggest import _write_card

    card = tmp_path / "card.toml"
    card.write_text(text)
    with pytest.raises(InputError, match=r"table process, got no line.* the best recipe is 'plane'"):
        _write_card(card, "plane")
    assert [*tmp_path.iterdir()] == [card]


def test_recipes_are_compared_without_the_pixels_that_the_file_masks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = write_campaign(tmp_path, count=1)
    text = card.read_text().replace("{id}.txt", "{id}.gwy").replace('format = "text-matrix"', "")
    card.write_text(text)
    monkeypatch.setattr(afm_files, "SIZE_UM", (12.8, 12.8))
    height_um = height_of(layout_of(0), 0)
    dust = np.zeros(height_um.shape, bool)
    dust[90:110, 90:110] = True
    left = []
    for dust_um in (0.0, 1.0):
        channels = {"Height": (1e-6 * (height_um + dust_um * dust), "m")}
        afm_files.write_gwy(tmp_path / "scans" / "P11.gwy", channels, dust)
        left.append(suggest_recipe(card, tmp_path / "levelling").left_nm["plane"]["P11"])
    assert left[1] == pytest.approx(left[0], rel=0.1)


def test_the_residual_of_the_layout_is_noise_tilt_and_lost_print() -> None:
    rng = np.random.default_rng(0)
    level = np.repeat(np.repeat(rng.integers(0, 6, (16, 16)), 8, 0), 8, 1).astype(float)
    from scipy import ndimage

    print_um = LEVEL_HEIGHT_UM * ndimage.gaussian_filter(level, 1.5)
    noise = 0.004 * rng.standard_normal(level.shape)
    # The residual of white noise is its standard deviation, which 7000 pixels give to 1 %. The fit has only
    # six parameters.
    assert left_by_layout(print_um + noise, level) == pytest.approx(0.004, rel=0.05)
    tilt = 0.1 * np.linspace(-1, 1, 128)
    assert left_by_layout(print_um + noise + tilt, level) > 0.04
    rows = np.median(print_um, axis=1, keepdims=True)
    assert left_by_layout(print_um + noise - rows, level) > 0.02
