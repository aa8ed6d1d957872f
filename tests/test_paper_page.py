"""Check that the page on the paper has a row for every numbered equation, figure and table of the paper."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "paper.md"
# The display equations of the paper and its appendix. Figures and tables are identified by a few words.
EQUATIONS = ["1, 2", "3", "4, 5, 6a–c", "7a, b", "8", "9a, b", "10", "A1, A2", "A3a, b", "A4", "A5", "A6"]
FIGURES = """teaser, chained simulators, bilevel, design pipelines, anatomy, example of the data set, forward
    prediction, hologram: measured, lens: PSF, micrographs, ΔSSIM, PSF profiles, aleatoric, laser power,
    setup, approaches, parameters of PBL, profilometer"""
DISCUSSION = """limits the optimisation, no guarantee, calibrating the optics, Hopkins, proximity correction,
    SEM, grid search, e-beam, neural fields, depth from defocus"""
AUTHORS = PAGE.with_name("from_the_authors_code.md")
CARD = PAGE.parents[1] / "datasets" / "neural-lithography.toml"
# The authors' Python files in the commit from which the card fetches the data.
THEIR_FILES = """cuda_config data/__init__ data/afm_dataio litho/learned_litho litho/net/__init__
    litho/net/fno litho/net/simple_conv main_fwd_litho_training main_inv_holo_optim main_inv_lens_optim
    param/__init__ param/param_fwd_litho param/param_inv_design_holography param/param_inv_design_imaging
    task/doe task/free_space_fwd task/propagator task/reconstruction trainer/__init__
    trainer/fwd_learned_litho_trainer trainer/mbo_holo trainer/mbo_lens utils/__init__
    utils/general_utils utils/gumbel_max_pytorch utils/visualize_utils"""


def test_every_equation_figure_and_table_has_a_row() -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    assert [name for name in EQUATIONS if not any(row.startswith(f"| {name} |") for row in rows)] == []
    wanted = [" ".join(name.split()) for name in f"{FIGURES},{DISCUSSION}".split(",")]
    assert [name for name in wanted if not any(name in row.split("|")[1] for row in rows)] == []


def test_every_row_names_where_it_is_or_says_why_not() -> None:
    """Check that each row names a file, test, command or page of this project, or gives a reason."""
    lines = PAGE.read_text(encoding="utf-8").split("## 24.35 nm")[0].splitlines()
    heads = {number - 1 for number, line in enumerate(lines) if line.startswith("|---")}
    rows = [line for number, line in enumerate(lines) if line.startswith("| ") and number not in heads]
    assert len(rows) > 40
    for row in rows:
        *_, verdict = row.rstrip(" |").split(" | ")
        reason = re.search(r"nothing to test|cannot be tested: \w|^open$|^as in the equations$", verdict)
        # This matches a link, a file, a test, an option, a command or an importable name.
        named = re.search(r"\]\(|`[\w/]+\.py`|`test_\w+`|`--\w|`litho-\w|`litho_\w", row)
        assert reason or named, row


def test_tests_and_files_that_the_page_names_exist() -> None:
    root = PAGE.parents[1]
    text = PAGE.read_text(encoding="utf-8")
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (root / "tests").rglob("test_*.py"))
    for name in re.findall(r"`(test_\w+)`", text):
        assert f"def {name}(" in tests, name
    for name in re.findall(r"`([\w/]+\.py)`", text):
        assert (root / name).exists() or name in tests or list((root / "tests").rglob(Path(name).name)), name


def test_the_page_on_the_authors_code_names_files_of_the_commit_that_the_card_fetches() -> None:
    text = AUTHORS.read_text(encoding="utf-8")
    (commit,) = re.findall(r"commit `([0-9a-f]{7})`", text)
    assert f"/{commit}" in tomllib.loads(CARD.read_text("utf-8"))["source"]["url"]
    cells = [line.split(" | ")[0] for line in text.splitlines() if line.startswith("| ")]
    named = {name for cell in cells for name in re.findall(r"`([\w/]+)\.py`", cell)}
    named |= set(re.findall(r"# (main_\w+)\.py", text))
    assert len(named) > 10
    assert named <= set(THEIR_FILES.split())
