"""Run from card to export on a second machine with a different pitch, field, microscope and levels."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from typer.testing import CliRunner

import litho_data
import litho_design
import litho_models
from litho_data.virtual_fab.settings import PRESETS

MACHINE = PRESETS["second-printer"].printer
LAYOUT = ("--pitch-um", 0.2, "--level-height-um", 0.02, "--levels", 64, "--set", "layout.cell_um=0.2")


def run(command, *words):
    """Run one command as a user would and return its output."""
    app = importlib.import_module(f"{command.replace('-', '_')}.cli.app").app
    done = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Make a folder with prints, their dataset, a model, a design, and the design's files for the printer."""
    folder = tmp_path_factory.mktemp("second")
    run("litho-data", "simulate", "--preset", "second-printer", "--count", 2, "--out", folder / "fab")
    run("litho-data", "build", folder / "fab" / "raw" / "card.toml", "--out", folder / "prints.zarr")
    run("litho-models", "train", folder / "prints.zarr", "--model", "affine-mtf", "--out", folder / "run")
    run("litho-models", "freeze", folder / "run", "--out", folder / "printer")
    small = ("--size-px", 64, "--distance-um", 60, "--iterations", 3, "--set", "search.polish_rounds=1")
    run(
        *("litho-design", "hoe", "--model", folder / "printer", *LAYOUT, *small),
        *("--set", "window.yield_draws=2", "--out", folder / "design"),
    )
    run("litho-design", "export", folder / "design", "--format", "tiff", "--out", folder / "files")
    return folder


def test_the_dataset_has_the_machine_of_its_card(made):
    store = litho_data.open_store(made / "prints.zarr")
    assert (store.pitch_um, store.level_height_um, store.levels) == (0.2, 0.02, 64)
    assert {scan.shape for scan in store.scans()} == {(128, 192)}
    assert max(int(scan.mask_level.max()) for scan in store.scans()) == 63


def test_the_model_is_calibrated_for_it_and_beats_the_nominal_heights(made):
    model = litho_models.load_frozen(made / "printer")
    assert model.card["pitch_um"] == MACHINE.pitch_um
    assert model.card["levels"] == MACHINE.levels
    assert model.card["calibrated_range_um"][1] == pytest.approx(MACHINE.full_height_um)
    scan = litho_data.open_store(made / "prints.zarr").scans()[0]
    errors = [
        # Errors without the datum, which a scan does not measure.
        np.nanstd(np.where(scan.valid, scan.height_um - height, np.nan))
        for height in (model.predict(scan.layout_um), scan.layout_um)
    ]
    # The nominal heights are wrong mainly because they ignore the threshold and the blur of the spot.
    assert errors[0] < 0.5 * errors[1]


def test_the_design_goes_to_the_printer_and_comes_back(made):
    record = litho_design.load_design(made / "design").record
    assert (record.layout.pitch_um, record.layout.levels) == (MACHINE.pitch_um, MACHINE.levels)
    levels = np.load(made / "design" / "layout_level.npy")
    assert levels.shape == (64, 64)
    file = next(path for path in (made / "files").iterdir() if path.suffix.startswith(".tif"))
    np.testing.assert_array_equal(litho_design.import_levels(file)[0], levels)
