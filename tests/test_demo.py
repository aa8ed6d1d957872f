"""Check the demo: its index page has six cards, each with a picture and a link to a page."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import litho_data
import litho_design
import litho_models
from examples.demo_story import CORRECTED, FAB, tell
from litho_data.reports.page import Page
from tests.figures import undrawn
from tests.litho_models.prints import make_scans, write_store

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "neural-lithography"


@pytest.mark.pictures
def test_the_story_has_six_cards_with_pictures_and_links(tmp_path):
    knobs = ["slope-thinning-x=0.3", "write-order-memory=0.15"]
    litho_data.simulate(tmp_path / "fab", count=1, size_px=64, knobs=knobs)
    write_store(tmp_path / "store.zarr", make_scans(2, 32))
    for name, result in (("close-loop", "causes/close_loop.json"), ("benchmark", "benchmark.json")):
        (tmp_path / name).mkdir()
        shutil.copy(RESULTS / result, tmp_path / name)
    model = litho_models.save_frozen(litho_models.build_model("identity"), tmp_path / "printer")
    small = {"layout.size_px": 32, "optics.distance_um": 10, "search.iterations": 1}
    settings = litho_design.hologram_settings(
        changes={**small, "search.polish_rounds": 0, "window.yield_draws": 2}
    )
    with undrawn():
        litho_design.compare(
            settings,
            {"none": "none", CORRECTED: str(model)},
            tmp_path / "compare",
            judges={FAB: str(tmp_path / "fab" / "truth")},
            seeds=(0,),
            announce=False,
        )
    page = Page("demo")
    answer = tell(page, tmp_path)
    text = page.write(tmp_path, "index.html").read_text("utf-8")
    assert re.findall(r"<h2[^>]*>\s*(\d)\. ", text) == list("123456")
    assert text.count("<figure") == 6
    # This uses the result for the measured prints, in which slope-thinning is one of the effects found.
    assert "2 effects were hidden in the prints, and the loop found 1 of them" in answer
    assert answer in text
    assert "Planted and not found: write-order-memory" in text
    for link in re.findall(r'href="(compare/[^"]+)"', text):
        assert (tmp_path / link).is_file()


@pytest.mark.long
def test_the_demo_runs_from_an_empty_home_to_its_answer_and_its_page(tmp_path):
    """Check the command that ``make demo`` runs."""
    recipe = re.search(
        r"^demo:.*\n\t\$\(BIN\)/python (-m examples\.demo --out) ", (ROOT / "Makefile").read_text(), re.M
    )
    command = [sys.executable, *recipe[1].split(), str(tmp_path / "runs")]
    home = {"HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=os.environ | home, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    answer, last = done.stdout.strip().splitlines()[-2:]
    assert re.search(
        r"the error changed from [\d.]+ to [\d.]+ nm .* the corrected model reaches [\d.]+ dB", answer
    )
    page = Path(re.fullmatch(r"done in [\d.]+ min; open (.+)", last)[1])
    assert answer in page.read_text("utf-8")
