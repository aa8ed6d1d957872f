"""Check the arguments that `masks` and `simulate` pass on; the work is done and tested elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter
from typer.testing import CliRunner

from litho_data.cli.layouts import masks, simulate
from litho_data.commands.app import new_app
from litho_data.foundation.errors import InputError
from litho_data.making.build import build_dataset
from litho_data.store import open_store
from litho_data.virtual_fab import KNOBS, Truth
from litho_data.virtual_fab.settings import PRESETS


@pytest.fixture(scope="module")
def app():
    app = new_app("layouts")
    app.command()(masks)
    app.command()(simulate)
    return app


def run(app, *arguments: str):
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def test_layouts_are_made_and_printed(app, tmp_path):
    assert (
        run(
            app, "masks", "--out", tmp_path / "m", "--pattern", "dose-matrix", "--count", 3, "--size-px", 150
        ).exit_code
        == 0
    )
    card = tmp_path / "m" / "card.toml"
    found = run(app, "simulate", "--out", tmp_path / "s", "--layouts", card, "--knob", "z-gain=0.02@4")
    assert found.exit_code == 0
    truth = Truth.read(tmp_path / "s" / "truth")
    assert [scan.dose for scan in truth.scans] == pytest.approx([0.7, 1.0, 1.3])
    assert [(knob.name, knob.strength, knob.seed) for knob in truth.knobs] == [("z-gain", 0.02, 4)]


@pytest.mark.slow
def test_a_dose_matrix_becomes_heights_against_dose(app, tmp_path, without_report):
    made = run(
        app, "masks", "--out", tmp_path / "m", "--pattern", "dose-matrix", "--count", 3, "--size-px", 192
    )
    printed = run(app, "simulate", "--out", tmp_path / "s", "--layouts", tmp_path / "m" / "card.toml")
    assert made.exit_code == printed.exit_code == 0
    result = build_dataset(tmp_path / "s" / "raw" / "card.toml", tmp_path / "s.zarr", strict=True)
    assert (result.n_scans, result.n_references) == (3, 0)
    scans = open_store(tmp_path / "s.zarr").scans()
    assert [scan.dose for scan in scans] == pytest.approx([0.7, 1.0, 1.3])
    fill, previous = {}, 0.0
    for scan in scans:
        even = maximum_filter(scan.mask_level, 21) == minimum_filter(scan.mask_level, 21)
        heights_um = {
            int(level): scan.height_um[even & scan.valid & (scan.mask_level == level)]
            for level in np.unique(scan.mask_level[even])
        }
        # The three treads are 38 px wide. Without 10 px at each edge, 18 px by 96 px remain.
        assert min(values.size for values in heights_um.values()) > 1000
        assert {0, 6, 12} <= set(heights_um)
        # The spread is due to the roughness of 15.9 nm, and to shrinkage that depends on the surroundings
        # within 2 µm. Pixels beyond an edge would increase it.
        assert max(values.std() for values in heights_um.values()) < 0.05
        step_um = float(heights_um[12].mean() - heights_um[0].mean())
        fill[scan.dose] = step_um
        assert step_um > previous
        previous = step_um
    # With two-photon absorption and a threshold, heights grow by a larger factor than the dose, 1.3 / 0.7.
    assert fill[scans[-1].dose] > 1.3 / 0.7 * fill[scans[0].dose]


def test_presets_are_overruled_by_what_is_stated(app, tmp_path):
    run(
        app,
        "simulate",
        "--out",
        tmp_path / "s",
        "--preset",
        "demo",
        "--count",
        1,
        "--size-px",
        64,
        "--noise",
        "off",
    )
    truth = Truth.read(tmp_path / "s" / "truth")
    assert len(truth.scans) == 1
    assert truth.scans[0].floor_rmse_nm == 0
    assert {f"{knob.name}={knob.strength:g}" for knob in truth.knobs} == set(PRESETS["demo"].knobs)


def test_lists_need_no_output_folder(app):
    assert all(name in run(app, "simulate", "--list-knobs").stdout for name in KNOBS)
    assert "siemens-star" in run(app, "masks", "--list-patterns").stdout


def test_bad_input_is_one_clear_error(app, tmp_path):
    with pytest.raises(InputError, match="vignetting"):
        run(app, "simulate", "--out", tmp_path / "s", "--knob", "vignet=1")
    with pytest.raises(InputError, match="preset"):
        run(app, "simulate", "--out", tmp_path / "s", "--preset", "gigantic")
    with pytest.raises(InputError, match="level_height_um = nan"):
        run(app, "masks", "--out", tmp_path / "m", "--count", 1, "--size-px", 64, "--level-height-um", "nan")
    with pytest.raises(InputError, match="seed of knob z-gain"):
        run(app, "simulate", "--out", tmp_path / "s", "--knob", "z-gain=0.1@-1")
    with pytest.raises(InputError, match="write field"):
        run(app, "simulate", "--out", tmp_path / "s", "--count", 1, "--write-field-um", "nan")
    assert not list(tmp_path.iterdir())


def test_options_that_a_card_already_fixes_are_refused(app, tmp_path):
    run(app, "masks", "--out", tmp_path / "m", "--count", 1, "--size-px", 64)
    card = ("--layouts", tmp_path / "m" / "card.toml")
    for option in (("--count", 3), ("--size-px", 64), ("--write-field-um", 100)):
        with pytest.raises(InputError, match="given with --layouts"):
            run(app, "simulate", "--out", tmp_path / "s", *card, *option)
    with pytest.raises(InputError, match="reference prints cannot be added"):
        run(app, "simulate", "--out", tmp_path / "s", *card, "--references")


@pytest.mark.parametrize(
    "option",
    [
        ("--noise", "off"),
        ("--microscope", "aligned"),
        ("--references",),
        ("--stitch-field-um", 50),
        ("--write-field-um", 100),
        ("--layouts", "card.toml"),
    ],
)
def test_options_that_would_do_nothing_are_refused(app, tmp_path, option):
    for kind in (("--preset", "e-beam"), ("--preset", "projection"), ("--plan", "plan", "--fab", "fab")):
        with pytest.raises(InputError, match=rf"options given with .*, got {option[0]}, wanted only --out"):
            run(app, "simulate", "--out", tmp_path / "s", *kind, *option)
    with pytest.raises(InputError, match="given with --plan, got --preset, wanted"):
        run(app, "simulate", "--out", tmp_path / "s", "--plan", "p", "--fab", "f", "--preset", "e-beam")
    assert not list(tmp_path.iterdir())


def test_a_set_of_layouts_starts_at_the_size_that_its_statistics_need(app, tmp_path):
    words = ("masks", "--out", tmp_path / "m", "--count", 1, "--size-px")
    refused = run(app, *words, 63)
    assert refused.exit_code == 2
    assert "--size-px" in refused.output
    assert run(app, *words, 64).exit_code == 0


def test_every_knob_is_in_the_documentation():
    page = (Path(__file__).parents[2] / "docs" / "virtual_fab.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in KNOBS)
