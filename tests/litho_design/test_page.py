"""Check that the Python code on the page of this package runs as written, at a smaller size."""

from __future__ import annotations

import re
from pathlib import Path

import litho_design
from litho_design.tasks.design import Design

PAGE = Path(__file__).parents[2] / "docs" / "optics.md"
LONG = '"layout.size_px": 128, "optics.distance_um": 30, "search.start": "gs", "search.iterations": 20'
SHORT = (
    '"layout.size_px": 64, "optics.distance_um": 12, "search.start": "gs", "search.iterations": 2, '
    '"window.yield_draws": 3'
)
# Without judges, no further model prints the design.
SMALLER = {LONG: SHORT, '"designs/ring", settings=settings': '"designs/ring", settings=settings, judges=()'}


def test_the_python_of_the_page_runs_in_one_go(tmp_path, monkeypatch):
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert blocks
    assert all(words in blocks[0] for words in SMALLER)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks:
        for words, smaller in SMALLER.items():
            block = block.replace(words, smaller)
        exec(block, names)
    assert (names["levels"] == names["design"].level.numpy()).all()
    assert names["image"].shape == (64, 64)
    assert isinstance(Design.read("designs/ring"), Design)
    used = set(re.findall(r"litho_design\.(\w+)", "".join(blocks)))
    assert used <= set(litho_design.__all__)
