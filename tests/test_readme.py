"""The project's page: short, its Python runs as it stands (smaller), its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import litho_data
import litho_design
import litho_models

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text("utf-8")
# What is made small for the test; each must be there, so that the page cannot drift away from it.
SMALLER = {
    "count=12, size_px=256": "count=3, size_px=128",
    '"layout.size_px": 256': '"search.iterations": 2, "search.polish_rounds": 0, '
    '"window.yield_draws": 5, "layout.size_px": 64',
}


def test_the_page_is_short():
    assert 4000 <= len(TEXT.encode()) <= 6144


@pytest.mark.parametrize("page", ["README.md", "docs/results/neural-lithography/README.md"])
def test_its_links_lead_somewhere(page):
    text = (ROOT / page).read_text("utf-8")
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", text)]
    missing = [link for link in links if link and not (ROOT / page).parent.joinpath(link).exists()]
    assert links
    assert not missing


def test_its_python_runs_and_uses_public_names_only(tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    assert len([line for line in code.splitlines() if line and not line.startswith("#")]) <= 15
    for package in (litho_data, litho_models, litho_design):
        used = set(re.findall(rf"\b{package.__name__}\.(\w+)", code))
        assert used
        assert used <= set(package.__all__)
    for words, smaller in SMALLER.items():
        assert words in code
        code = code.replace(words, smaller)
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    said = capsys.readouterr().out
    assert re.search(r"error on new prints: \d+\.\d nm", said)
    assert re.search(r"image of the hologram: \d+\.\d dB", said)
    assert list((tmp_path / "to-printer").glob("*.png"))
