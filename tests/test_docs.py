"""Check the documentation: its links and anchors, the site's list of pages, and the code of the tutorials."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import pytest

from tests.test_capabilities import ANYWHERE, commands

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
_FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
# Replacements that make a tutorial run fast in the test. Each replaced text must occur in the tutorial.
SMALLER = {
    "datasets": {"count=6, size_px=160": "count=2, size_px=128", "(16.8, 16.8)": "(13.6, 13.6)"},
    "models": {
        "count=8": "count=4",
        # There are too few scans for a confidence interval.
        "scores.mae_datum_free_ci95_nm": "scores.mae_datum_free_ci95_nm or (0.0, 0.0)",
        '("affine", "linear", "physics"), folds=2': '("identity", "affine"), folds=2',
        '"physics", "run"': '"affine", "run"',
    },
    "optics": {
        '"layout.size_px": 192, "optics.distance_um": 18, "search.iterations": 30': '"layout.size_px": 64, '
        '"optics.distance_um": 12, "search.iterations": 2, '
        '"search.polish_rounds": 0, "window.yield_draws": 4',
        # One further model is enough, the one that judges the designs afterwards.
        "model, name, settings=settings": 'model, name, settings=settings, judges=["zoo:pbl"]',
    },
    "gallery": {
        "count=4": "count=2",
        '"layout.size_px": 160, "optics.distance_um": 15, "search.iterations": 20': '"layout.size_px": 64, '
        '"optics.distance_um": 12, "search.iterations": 2, "window.yield_draws": 4',
    },
}


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub and the site make from the headings of a page."""
    text = _FENCED.sub("", page.read_text("utf-8"))
    found = set()
    for title in re.findall(r"^#+ (.+)$", text, re.MULTILINE):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", title).strip().lower()
        found.add(re.sub(r"[^\w\- ]", "", words).replace(" ", "-"))
    return found


def broken(page: Path) -> list[str]:
    """Return the links of a page that lead to a missing file or anchor."""
    found = []
    for link in re.findall(r"\]\(([^)\s]+)\)", _FENCED.sub("", page.read_text("utf-8"))):
        if re.match(r"https?:|mailto:", link):
            continue
        place, _, anchor = link.partition("#")
        target = (page.parent / place) if place else page
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            found.append(link)
    return found


def test_links_and_anchors_lead_somewhere():
    assert {page.relative_to(ROOT).as_posix(): bad for page in PAGES if (bad := broken(page))} == {}


def test_a_broken_link_and_a_wrong_anchor_are_found(tmp_path):
    (tmp_path / "a.md").write_text(
        "# One thing\n[x](a.md#one-thing) [y](a.md#other) [z](b.md) [w](#one-thing)"
    )
    assert broken(tmp_path / "a.md") == ["a.md#other", "b.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_an_empty_line_separates_a_list_from_the_text_before_it(page):
    """Check that there is an empty line before each list. The site's Markdown needs it, but GitHub's does
    not.
    """
    text = _FENCED.sub("", page.read_text("utf-8"))
    assert re.findall(r"^(?![-*|#<]|\d+\. | |$).*\n(?:[-*]|\d+\.) .*$", text, re.MULTILINE) == []
    # This finds a second paragraph of a list item that is directly followed by the next item.
    assert re.findall(r"\n\n {4,}(?![-*]|\d+\. ).*(?:\n .*)*\n(?:[-*]|\d+\.) .*", text) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_cell_ends_in_braces(page):
    """Check that no table cell ends in braces. The site's Markdown would drop them as attributes."""
    assert re.findall(r"^\|.* \{[^`|\n]*\} *\|.*$", page.read_text("utf-8"), re.MULTILINE) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_further_lines_of_a_list_item_are_indented_by_four_spaces(page):
    """Check the indentation. With fewer than four spaces, the site's Markdown would end the list there."""
    text = _FENCED.sub("", page.read_text("utf-8"))
    assert re.findall(r"\n\n {1,3}(\S.*)", text) == []


def test_every_page_is_on_the_site():
    nav = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    named = re.findall(r": (\S+\.md)$", nav, re.MULTILINE)
    written = {page.relative_to(DOCS).as_posix() for page in PAGES[1:]}
    assert {name for name in named if not name.startswith("reference/")} == written
    assert len(named) == len(set(named))


def misspelt(text: str, known: dict[str, set[str]]) -> list[str]:
    """Return the command lines of a text that use a command or an option that does not exist."""
    lines = re.findall(r"^(?:torchrun .*? )?(litho-(?:data|models|design) .*)$", text, re.MULTILINE)
    lines += re.findall(r"`(litho-(?:data|models|design) [^`]*)`", text)
    found = []
    for line in (line.partition("#")[0] for line in lines):
        words = line.split()
        name = next((name for n in (3, 2) if (name := " ".join(words[:n])) in known), "")
        options = set(re.findall(r"(?<!\S)--[a-z][\w-]*", line))
        if not name or options - known[name] - ANYWHERE:
            found.append(line)
    return found


def test_commands_and_options_of_the_pages_exist():
    known = commands()
    texts = {page.name: page.read_text("utf-8").replace("\\\n", " ") for page in PAGES}
    assert {name: lines for name, text in texts.items() if (lines := misspelt(text, known))} == {}
    wrong = "litho-data bild x\nlitho-data build x --out y\n`litho-data build x --oot y`"
    assert misspelt(wrong, known) == ["litho-data bild x", "litho-data build x --oot y"]


@pytest.fixture(scope="module")
def renderer():
    spec = importlib.util.spec_from_file_location("render", DOCS / "tutorials" / "render.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", SMALLER)
def test_a_tutorial_runs_and_its_page_shows_its_code(renderer, name, tmp_path, monkeypatch):
    script = (DOCS / "tutorials" / f"{name}.py").read_text("utf-8")
    cells = renderer.cells(script)
    page = (DOCS / "tutorials" / f"{name}.md").read_text("utf-8")
    shown = re.findall(r"^```python\n(.*?)\n```", page, re.MULTILINE | re.DOTALL)
    assert shown == [text for kind, text in cells if kind == "code"]
    assert all(text in page for kind, text in cells if kind == "markdown")
    for words, smaller in SMALLER[name].items():
        assert words in script
        script = script.replace(words, smaller)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    ran = [renderer.run_cell(text, names) for kind, text in renderer.cells(script) if kind == "code"]
    # The page shows the output below each cell that printed any. The numbers of this smaller run differ.
    outputs = re.findall(r"^```text\n(.*?)\n```", page, re.MULTILINE | re.DOTALL)
    assert len(outputs) == len([said for said, _ in ran if said])
    assert page.count("](" + name + "-") == len([value for _, value in ran if hasattr(value, "savefig")]) > 0


@pytest.mark.parametrize("name", SMALLER)
def test_a_notebook_is_its_tutorial_after_one_cell_that_installs(renderer, name):
    folder = DOCS / "tutorials"
    made = json.loads((folder / f"{name}.ipynb").read_text("utf-8"))
    first, *others = [(cell["cell_type"], "".join(cell["source"])) for cell in made["cells"]]
    assert others == renderer.cells((folder / f"{name}.py").read_text("utf-8"))
    assert "%pip install" in first[1]
    # Format 4.5 requires that every cell has a unique id and every code cell has outputs and a count.
    ids = [cell["id"] for cell in made["cells"]]
    assert (made["nbformat"], made["nbformat_minor"], len(set(ids))) == (4, 5, len(ids))
    for cell in made["cells"]:
        asked = {"cell_type", "id", "metadata", "source"}
        assert set(cell) == asked | ({"outputs", "execution_count"} if cell["cell_type"] == "code" else set())


def test_the_gallery_has_twelve_pictures_of_ten_lines_each(renderer):
    cells = renderer.cells((DOCS / "tutorials" / "gallery.py").read_text("utf-8"))
    titles = [text for kind, text in cells if kind == "markdown" and re.match(r"## \d+\. ", text)]
    assert [int(re.findall(r"\d+", title)[0]) for title in titles] == [*range(1, 13)]
    lines = [sum(bool(line) for line in text.splitlines()) for kind, text in cells[2:] if kind == "code"]
    assert len(lines) == 12
    assert max(lines) <= 10
    page = (DOCS / "tutorials" / "gallery.md").read_text("utf-8")
    shown = re.findall(r"\]\((gallery-\d+\.jpg)\)", page)
    assert shown == [f"gallery-{number}.jpg" for number in range(1, 13)]
    assert all((DOCS / "tutorials" / name).stat().st_size > 5_000 for name in shown)


SHORT = [page for page in PAGES if "**In short" in page.read_text("utf-8")]


def figures(text: str) -> set[str]:
    return {one.replace(",", "") for one in re.findall(r"\d+(?:,\d{3})*(?:\.\d+)?", text)}


def not_said_again(text: str, linked: str) -> set[str]:
    """Return the numbers of a page's short answer that occur nowhere else on the page or on linked pages."""
    short, _, rest = text.partition("**In short")[2].partition("\n\n")
    found = figures(f"{rest} {linked}")
    rounded = {f"{float(one):.{places}f}" for one in found for places in (1, 2)}
    return figures(re.sub(r"\]\([^)]*\)", "]", short)) - found - rounded


@pytest.mark.parametrize("page", SHORT, ids=lambda page: page.name)
def test_the_short_answer_has_no_figure_of_its_own(page):
    """Check the numbers of the short answer at the top, because it is written by hand and may be outdated."""
    text = page.read_text("utf-8")
    links = re.findall(r"\]\(([\w./-]+\.md)", text.partition("**In short")[2].partition("\n\n")[0])
    linked = "".join((page.parent / link).read_text("utf-8") for link in links)
    assert not_said_again(text, linked) == set()


def test_a_figure_that_only_the_short_answer_has_is_found():
    assert not_said_again("**In short:** 18.53 nm of 20 scans.\n\nNoise, 18.53 nm.", "of 21 scans") == {"20"}
