"""Run the three commands and the packages with typical user mistakes, on small inputs."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import shlex
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

# Make torch appear to be missing, as it is after `pip install litholoop` without extras.
NO_TORCH = "litho-models zoo list"
# The mistakes, grouped by theme. Each is a command line or a Python statement.
MISTAKES: dict[str, dict[str, str]] = {
    "Words of the command line": {
        "a command misspelt": "litho-models trian prints.zarr --model pbl --out new",
        "an option misspelt": "litho-models train prints.zarr --modle pbl --out new",
        "an option that is missing": "litho-data build raw/card.toml",
        "an argument that is missing": "litho-models predict zoo:pbl --out height.gsf",
        "one word too many": "litho-models zoo list all",
        "one number where two are wanted": "litho-data inspect raw/scans/P11.txt --unit m --size-um 8",
        "a word where a number is wanted": "litho-data build raw/card.toml --out new.zarr --workers two",
        "a number out of range": "litho-models benchmark prints.zarr --folds 1 --out new",
        "a choice misspelt": "litho-models evaluate printer prints.zarr --policy ofset --out new",
        "a format that there is not": "litho-data export prints.zarr --format tiff",
        "half of what belongs together": "litho-data simulate --plan empty --out new",
        "two ways to say the same": "litho-models noise prints.zarr --flat raw/scans/P11.txt --out new",
        "nothing to work on": "litho-models noise --out new",
        "an extra that was not installed": NO_TORCH,
    },
    "Files and folders": {
        "a card that is not there": "litho-data build nowhere.toml --out new.zarr",
        "a folder in place of its card": "litho-data build raw --out new.zarr",
        "a picture in place of a card": "litho-data build raw/layouts/P11.tif --out new.zarr",
        "raw files that lie elsewhere": "litho-data build raw/card.toml --data-dir empty --out new.zarr",
        "a store that is not there": "litho-models train nowhere.zarr --model pbl --out new",
        "the raw folder in place of its store": "litho-models train raw --model pbl --out new",
        "model and store swapped": "litho-models evaluate prints.zarr printer --out new",
        "layout and model swapped": "litho-models predict layout.npy printer --out height.gsf",
        "an empty folder in place of a model": "litho-models evaluate empty prints.zarr --out new",
        "a run that was not frozen": "litho-models evaluate run prints.zarr --out new",
        "a model of the zoo without its prefix": "litho-design hoe --model pbl --out new",
        "a result of another command": "litho-design export run --out new",
        "a loop that was never closed": "litho-models next-print run --out new",
        "a benchmark that was never made": "litho-models noise prints.zarr --residuals run --out new",
        "a checkpoint that was damaged": "litho-models train prints.zarr --model pbl --out broken",
        "an ending that is no format": "litho-models export printer --out model.pt",
        "a picture that is not there": "litho-design hoe --model printer --target nowhere.png --out new",
        "an empty folder of objects": "litho-design lens --model none --task computational "
        "--objects empty --out new",
    },
    "What `--out` names": {
        "a file": "litho-models evaluate printer prints.zarr --out notes.txt",
        "a folder with something else": "litho-models train prints.zarr --model affine --out thesis",
        "the dataset itself": "litho-models train prints.zarr --model affine --out prints.zarr",
        "the result of another command": "litho-models evaluate printer prints.zarr --out run",
        "another run of the same command": "litho-models train prints.zarr --model affine --out run",
        "another design": "litho-design hoe --model printer --size-px 64 --out design",
        "another set of layouts": "litho-data masks --count 1 --size-px 64 --seed 5 --out set",
        "another run of the fab": "litho-data simulate --count 1 --size-px 64 --seed 5 --out fab",
        "the current folder": "litho-data masks --out .",
        "a folder with measured scans": "litho-data simulate --out raw",
        "no store": "litho-data build raw/card.toml --out thesis",
    },
    "Names": {
        "a model misspelt": "litho-models train prints.zarr --model psyhics --out new",
        "a model of the zoo misspelt": "litho-models zoo show pbll",
        "an effect misspelt": "litho-models close-loop prints.zarr --inject diffusion-blurr=0.1 --out new",
        "an effect without its amount": "litho-models close-loop prints.zarr --inject z-gain --out new",
        "a knob misspelt": "litho-data simulate --knob laser-drif=0.05 --out new",
        "a preset misspelt": "litho-data simulate --preset demmo --out new",
        "a pattern misspelt": "litho-data masks --pattern siemens --out new",
        "a dataset misspelt": "litho-data fetch neural-lithografy",
        "a setting misspelt": "litho-design hoe --model printer --set loss.eficiency_weight=1 --out new",
        "a target misspelt": "litho-design hoe --model printer --target rings --out new",
        "two arms of one name": "litho-design compare --models a=printer,a=none --out new",
        "one model twice": "litho-models benchmark prints.zarr --models affine,affine --out new",
    },
    "Prints that do not fit": {
        "the unit is missing": "litho-data inspect raw/scans/P11.txt --picture P11.png",
        "a unit that there is not": "litho-data inspect raw/scans/P11.txt --unit furlong",
        "nanometres said of metres": "litho-data build other-unit/card.toml --out new.zarr",
        "one size for a field of two sides": "litho-data build one-size/card.toml --out new.zarr",
        "a scan without its layout": "litho-data build lost/card.toml --strict --out new.zarr",
        "layouts of the wrong pitch": "litho-data build other-pitch/card.toml --out new.zarr",
        "the store of another printer": "litho-models evaluate printer other.zarr --out new",
        "prints of two printers in one loop": "litho-models close-loop prints.zarr other.zarr --out new",
        "more levels than the printer has": "litho-models predict printer deep.npy --out height.gsf",
        "a scan in place of a layout": "litho-models predict printer raw/scans/P11.txt --out height.gsf",
        "prints compared with themselves": "litho-models check printer prints.zarr --reference prints.zarr "
        "--out new",
    },
    "Optics that cannot be": {
        "a negative wavelength": "litho-design hoe --model printer --wavelength-um -0.6 --out new",
        "a wavelength in nanometres": "litho-design hoe --model none --wavelength-um 633 --size-px 64 "
        "--out new",
        "another pitch than the printer's": "litho-design hoe --model printer --pitch-um 0.2 --out new",
        "more levels than were calibrated": "litho-design hoe --model printer --levels 64 --out new",
        "a lens that its pixels cannot sample": "litho-design lens --model none --pitch-um 1 --size-px 64 "
        "--set layout.cell_um=1 --distance-um 20 --iterations 1 --out new",
        "a focus inside the spread of focus": "litho-design lens --model printer --distance-um 5 --out new",
        "an element larger than any memory": "litho-design correct lens --model none "
        "--size-px 9999999 --out new",
        "a photograph without its pixel": "litho-design score design --camera raw/layouts/P11.tif --out new",
        "a GPU that is not there": "litho-design hoe --model printer --device cuda:7 --out new",
        "a negative base": "litho-design export design --format stl --pedestal-um -1 --out new",
    },
    "Numbers that cannot be": {
        "a base higher than the sky": "litho-design export design --format stl --pedestal-um 1e300 --out new",
        "a pixel that is no number": "litho-design export layout.npy --pitch-um nan --out new",
        "a level of no height": "litho-design export layout.npy --level-height-um 0 --out new",
        "a scan without end": "litho-design export design --format gwl --gwl-speed 1e300 --out new",
        "levels without end": "litho-design hoe --model none --level-height-um 1e300 --out new",
        "gains of any size": "litho-design hoe --model none --gain-sd 1e15 --out new",
        "steps without end": "litho-design hoe --model none --learning-rate 1e300 --out new",
        "an effect beyond what it can be": "litho-models close-loop prints.zarr "
        "--inject diffusion-blur=1e300 --out new",
        "a spot beyond its bound": "litho-models close-loop prints.zarr --base physics "
        "--set sigma_optical_um=1e15 --out new",
        "a pixel that the scans state": "litho-models train prints.zarr --model affine --set pitch_um=0.2 "
        "--out new",
        "write fields without end": "litho-data simulate --stitch-field-um inf --out new",
        "an alarm more often than not": "litho-models check printer prints.zarr --reference other.zarr "
        "--false-alarms nan --out new",
        "heights in a picture of numbers": "litho-data inspect raw/scans/P11.txt --full-scale-um inf",
        "a microscope without scale": "litho-design score design --scan raw/scans/P11.txt --scan-unit m "
        "--scan-size-um 1e300 --out new",
    },
    "Python": {
        "levels in place of heights": 'litho_models.load_frozen("printer").predict(np.zeros((9, 9), int))',
        "a list in place of an array": 'litho_models.load_frozen("printer").predict([[0.1]])',
        "heights in nanometres": 'litho_models.load_frozen("printer").predict(np.full((9, 9), 700.0))',
        "a model that is not there": 'litho_models.load_frozen("nowhere")',
        "arguments swapped": 'litho_models.train("identity", "prints.zarr", "new")',
        "a name in place of a list": 'litho_models.benchmark("prints.zarr", "new", models="affine")',
        "a training setting misspelt": 'litho_models.train("prints.zarr", "pbl", "new", '
        'settings={"stepz": 9})',
        "a setting of the loop out of range": 'litho_models.close_loop("prints.zarr", "new", folds=1)',
        "a scan that the store has not": 'litho_data.open_store("prints.zarr").scan("P0F9")',
        "a field of the optics misspelt": "litho_design.hologram_settings("
        'changes={"optics.wavelenght_um": 0.5})',
        "settings of another task": 'litho_design.design_lens("none", "new", '
        "settings=litho_design.hologram_settings())",
        "the name of a task in place of its class": 'litho_design.design("hologram", "none", "new")',
        "a target of another size": 'litho_design.design_hologram(np.zeros((9, 9)), "none", "new")',
        "a file in place of weights": 'litho_models.model_of_authors("weights.pt")',
    },
}


def build_world() -> None:
    """Write the files that the mistakes need (raw prints, stores, models, results) to the current folder."""
    from litho_data import open_store, simulate
    from litho_data.foundation.begun import BEGUN
    from litho_data.layouts import write_layout_set
    from litho_design import design_hologram, hologram_settings
    from litho_models import build_model, save_frozen, train
    from litho_models.fitting.runs import TrainingRun, training_config
    from tests.litho_data.campaigns import write_campaign
    from tests.litho_models.prints import make_scans, write_store

    here = Path.cwd()
    card = write_campaign(here / "raw", 1)
    text = card.read_text("utf-8")
    for name, old, new in (
        ("one-size", "size_um = [12.8, 12.8]", "size_um = 12.8"),
        ("other-unit", 'unit = "m"', 'unit = "nm"'),
        ("other-pitch", "pitch_um = 0.1", "pitch_um = 0.2"),
        ("lost", "", ""),
    ):
        shutil.copytree("raw", name)
        assert old in text
        Path(name, "card.toml").write_text(text.replace(old, new), "utf-8")
    shutil.copy("raw/scans/P11.txt", "lost/scans/P12.txt")
    with warnings.catch_warnings():
        # xarray warns about strings in this store, because it was not written by our build command.
        warnings.simplefilter("ignore")
        scans = make_scans(3, 32)
        write_store(here / "prints.zarr", scans)
        write_store(here / "other.zarr", [replace(scan, pitch_um=0.2) for scan in scans], name="other")
    save_frozen(build_model("identity"), "printer")
    train("prints.zarr", "identity", "run")
    write_layout_set("set", count=1, size_px=64)
    simulate("fab", count=1, size_px=64)
    small = {"layout.size_px": 32, "optics.distance_um": 10, "search.iterations": 1}
    small |= {"search.polish_rounds": 0, "window.yield_draws": 2}
    settings = hologram_settings(changes=small)
    design_hologram("text", "printer", "design", settings=settings, announce=False)
    Path("broken/checkpoint").mkdir(parents=True)
    store = open_store("prints.zarr")
    begun: dict[str, Any] = {"record": TrainingRun.FILE_NAME, "model": "pbl", "lock_box": store.locked_ids}
    begun |= {"dataset": store.dataset_id.model_dump()}
    begun |= {
        "config": training_config("fast", "pbl", {"variant": "default", "seed": 0}).model_dump(mode="json")
    }
    Path("broken", BEGUN).write_text(json.dumps(begun), "utf-8")
    Path("broken/checkpoint/state.json").write_text('{"key":', "utf-8")
    for name in ("empty", "thesis"):
        Path(name).mkdir()
    Path("thesis/chapter1.tex").write_text("Years of work.\n", "utf-8")
    Path("notes.txt").write_text("to do\n", "utf-8")
    random = np.random.default_rng(0)
    np.save("layout.npy", random.integers(0, 13, (32, 32)).astype(np.uint8))
    np.save("deep.npy", random.integers(0, 64, (32, 32)).astype(np.uint8))


@contextlib.contextmanager
def world() -> Iterator[Path]:
    """Make a folder with all files that the mistakes need, and make it the current folder for the tests."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        os.chdir(folder)
        try:
            build_world()
            yield Path(folder)
        finally:
            os.chdir(before)


def answer(mistake: str) -> tuple[int | str, str]:
    """Return the exit code and stderr of a command, or the name and message of a statement's exception."""
    if not mistake.startswith("litho-"):
        import litho_data
        import litho_design
        import litho_models

        names = {"litho_data": litho_data, "litho_models": litho_models, "litho_design": litho_design}
        try:
            exec(mistake, {**names, "np": np})
        except Exception as error:
            return type(error).__name__, str(error)
        return "nothing", ""
    words = shlex.split(mistake)
    package = words[0].replace("-", "_")
    main = importlib.import_module(f"{package}.cli.app" if package == "litho_data" else f"{package}.cli").main
    told = io.StringIO()
    with (
        patch.object(sys, "argv", words),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(told),
        patch("importlib.util.find_spec", return_value=None)
        if mistake == NO_TORCH
        else contextlib.nullcontext(),
    ):
        try:
            main()
        except SystemExit as stop:
            return stop.code if isinstance(stop.code, int) else 1, told.getvalue()
    return 0, told.getvalue()
