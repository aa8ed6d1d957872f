"""Check the README: it is short, its links exist, and a smaller version of its Python code runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import litho_data
import litho_design
import litho_models
from tests.test_capabilities import names_in_file

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text("utf-8")
# Replacements that make the code run fast in the test. Each replaced text must occur on the page.
SMALLER = {
    "count=12, size_px=256": "count=2, size_px=128",
    '"layout.size_px": 256': '"search.iterations": 2, "search.polish_rounds": 0, '
    '"window.yield_draws": 5, "layout.size_px": 64',
}
# The commands in the README, on the site's first page and in the tutorials, each with the test that runs it.
WHEEL = "tests/test_packaging.py::test_the_wheel_designs_a_hologram_from_an_empty_folder"
RUN_BY = {
    "make demo": "tests/test_demo.py::test_the_demo_runs_from_an_empty_home_to_its_answer_and_its_page",
    "make test": ".ci/run",
    "make setup && . .venv/bin/activate": ".ci/run",
    "make docs": "tests/test_site.py::test_every_page_of_the_site_is_sound_on_every_screen",
    "litho-design first --out first": WHEEL,
    "pip install '.[design]'": WHEEL,
    "pip install .": "tests/test_packaging.py::test_litho_data_makes_and_builds_prints_without_the_extras",
}


def test_every_command_of_the_first_pages_is_run_by_a_test():
    pages = [ROOT / "README.md", ROOT / "docs" / "README.md", *(ROOT / "docs" / "tutorials").glob("*.md")]
    text = "".join(page.read_text("utf-8") for page in pages)
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = [
        line.partition("#")[0].strip() for kind, block in blocks if not kind for line in block.splitlines()
    ]
    given = {*lines, *re.findall(r"`((?:make|pip|litho-\w+) [^`]+)`", text)}
    assert given == set(RUN_BY)
    for command, place in RUN_BY.items():
        file, _, test = place.partition("::")
        if test:
            assert test in names_in_file(file)
        else:
            assert command.split(" &&")[0] in (ROOT / file).read_text("utf-8")


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
