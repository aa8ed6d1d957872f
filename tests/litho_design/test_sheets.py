"""Test sheets of prints with the virtual fab as the lab: the files, and the results from its scans."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from litho_data import open_store
from litho_data.cards.card import load_card
from litho_data.foundation.errors import InputError
from litho_data.readers.text_matrix import write_text_matrix
from litho_data.virtual_fab import Fab, Job, Microscope, Noise, Printer, scan_job
from litho_data.virtual_fab.knobs import KnobBoard
from litho_design import hologram_settings, import_levels
from litho_design.judging.gap import design_folder
from litho_design.sheets import read
from litho_design.sheets.new import PAGE, new_sheet
from litho_design.sheets.read import read_sheet, sheet_text
from litho_design.sheets.record import ARMS, HOLOGRAM, SCANS_OF_HOLOGRAMS, Sheet
from litho_models import load_frozen
from tests.litho_models.loop_scans import search_little

SIZE_PX, LAYOUTS = 128, 4
SMALL = {
    "layout.size_px": SIZE_PX,
    "optics.distance_um": 15,
    "search.iterations": 2,
    "search.polish_rounds": 0,
    "window.yield_draws": 4,
}


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sheets") / "sheet"
    settings = hologram_settings(changes=SMALL)
    told = {"format": "png16", "layouts": LAYOUTS, "announce": False}
    new_sheet(folder, model="zoo:physics", settings=settings, **told)
    return folder


def print_and_scan(sheet: Path) -> None:
    """Print and scan all fields as a lab would."""
    fab = Fab(Printer(), Microscope(), Noise(), KnobBoard((), 0), 5)
    record = Sheet.read(sheet)
    for folder in ("scans", SCANS_OF_HOLOGRAMS):
        (sheet / folder).mkdir()
    for field in record.fields:
        level = _levels(sheet, field.file) if field.file else np.zeros((SIZE_PX, SIZE_PX), np.uint8)
        place = SCANS_OF_HOLOGRAMS if field.id in ARMS else "scans"
        job = Job(id=field.id, level=level, index=field.order, order=field.order / len(record.fields) - 0.5)
        scan = scan_job(fab, job)
        write_text_matrix(sheet / place / f"{field.id}.txt", scan.height_um)
    card = sheet / "card.toml"
    sizes = f"size_um = [{scan.frame.size_um[0]}, {scan.frame.size_um[1]}]"
    card.write_text(re.sub(r"size_um = .*", sizes, card.read_text("utf-8")), encoding="utf-8")


def _levels(sheet: Path, file: str) -> np.ndarray:
    return import_levels(sheet / file)[0]


def test_a_lab_gets_every_file_and_instructions(sheet):
    record, page = Sheet.read(sheet), (sheet / PAGE).read_text(encoding="utf-8")
    assert [one.id for one in record.fields[:3]] == ["substrate", "flat", "steps"]
    assert [one.id for one in record.fields[-2:]] == list(ARMS)
    for field in record.fields:
        assert f"| {field.order} | {field.id} |" in page
        if field.file:
            assert field.file in page
            # The files for the printer contain the layouts that the card names.
            assert _levels(sheet, field.file).shape == (SIZE_PX, SIZE_PX)
    levels = {arm: np.load(design_folder(sheet / HOLOGRAM, arm, 0) / "layout_level.npy") for arm in ARMS}
    for arm in ARMS:
        printed = _levels(sheet, f"to-printer/hologram-{arm}/layout.png")
        np.testing.assert_array_equal(printed, levels[arm])
    assert not np.array_equal(*levels.values())
    assert load_card(sheet / "card.toml").layout.levels == record.levels == 13


def test_scans_of_a_sheet_give_a_model_a_loop_and_a_comparison(sheet, tmp_path, monkeypatch):
    # A base and a search that take little time are enough to test the steps.
    monkeypatch.setattr(read, "_BASE", "affine-mtf")
    search_little(monkeypatch, ["vertical-shrinkage"])
    with pytest.raises(InputError, match=r"without.*none.*hologram-scans"):
        read_sheet(sheet, tmp_path / "answer")
    assert not (tmp_path / "answer").exists()
    print_and_scan(sheet)
    result = read_sheet(sheet, tmp_path / "answer")
    # Witnesses, including empty ones, are stored but not used for training.
    store = open_store(tmp_path / "answer" / "prints.zarr")
    assert len(store.scans()) == LAYOUTS
    assert store.references() == {"flat": "flat", "steps": "steps", "substrate": "substrate"}
    printer = load_frozen(tmp_path / "answer" / "printer")
    assert printer.card["levels"] == 13
    # The noise of the fab is some nm, and the model of the design was trained on another printer.
    assert 1 < result.own_nm < result.model_nm
    assert result.measured_db["with"] == pytest.approx(result.expected_db["with"], abs=6)
    assert f"{result.measured_db['with']:.1f} instead of" in sheet_text(result)
    assert sheet_text(result) in (tmp_path / "answer" / "report.html").read_text(encoding="utf-8")
