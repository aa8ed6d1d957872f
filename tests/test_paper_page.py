"""The page on the paper: a row for everything that is numbered, and the bound that its command prints."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks import paper_pairs
from benchmarks.record import published
from litho_data.store import PrintedScan

PAGE = Path(__file__).parents[1] / "docs" / "paper.md"
# Display equations of the text and of its appendix; figures and tables are told by a word of each.
EQUATIONS = ["1, 2", "3", "4, 5, 6a–c", "7a, b", "8", "9a, b", "10", "A1, A2", "A3a, b", "A4", "A5", "A6"]
FIGURES = """teaser, chained simulators, bilevel, design pipelines, anatomy, example of the data set, forward
    prediction, hologram: measured, lens: PSF, micrographs, ΔSSIM, PSF profiles, aleatoric, laser power,
    setup, approaches, parameters of PBL, profilometer"""


class Fields:
    """As much of a store as the bound reads."""

    def __init__(self, scans: list[PrintedScan]):
        self._scans = scans

    def scans(self) -> list[PrintedScan]:
        return self._scans


def test_every_equation_figure_and_table_has_a_row() -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    assert [name for name in EQUATIONS if not any(row.startswith(f"| {name} |") for row in rows)] == []
    wanted = [" ".join(name.split()) for name in FIGURES.split(",")]
    assert [name for name in wanted if not any(name in row.split("|")[1] for row in rows)] == []


def test_every_row_names_where_it_is_or_says_why_not() -> None:
    """A file, a test, a command or a page of ours; else a reason in the verdict."""
    # The section behind the tables has one of its own, written by its command.
    lines = PAGE.read_text(encoding="utf-8").split("## 24.35 nm")[0].splitlines()
    heads = {number - 1 for number, line in enumerate(lines) if line.startswith("|---")}
    rows = [line for number, line in enumerate(lines) if line.startswith("| ") and number not in heads]
    assert len(rows) > 40
    for row in rows:
        *_, verdict = row.rstrip(" |").split(" | ")
        reason = re.search(r"nothing to test|cannot be tested: \w|^open$|^as in the equations$", verdict)
        # A file, a test, an option, a command or something to import.
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


def test_the_page_quotes_the_committed_bound() -> None:
    record = json.loads(paper_pairs.RESULT.read_text(encoding="utf-8"))
    assert published(PAGE, paper_pairs.MARK) == paper_pairs.text(record)


def fields(datum_um) -> Fields:
    """24 random layouts of 6 prints at 0.8 of their height, with ``datum_um(number)`` and 10 nm of noise."""
    random = np.random.default_rng(0)
    scans = []
    for number in range(24):
        # Odd numbers are coarse: four pixels by four have one level.
        side, repeated = (16, 4) if number % 2 else (64, 1)
        level = random.integers(0, 13, (side, side), dtype=np.uint8)
        level = level.repeat(repeated, axis=0).repeat(repeated, axis=1)
        height = 0.8 * 0.1 * level + 0.02 + datum_um(number) + 0.01 * random.normal(size=level.shape)
        scans.append(
            PrintedScan(
                id=f"FOV{number}",
                print_id=str(number // 4),
                order=number,
                mask_level=level,
                height_um=height.astype(np.float32),
                valid=np.ones(level.shape, dtype=bool),
                pitch_um=0.1,
                level_height_um=0.1,
                levels=13,
                scan_to_layout=np.eye(3),
            )
        )
    return Fields(scans)


def test_the_bound_is_the_mean_size_of_the_planted_datums() -> None:
    assert paper_pairs.bounds(fields(lambda _: 0.0))[0]["gain"] == pytest.approx(0.8, abs=0.005)  # type: ignore[arg-type]
    # Two scans up, two down: the map has an offset of its own, and coarse and fine ones have the same mean.
    datums = [0.03 * (-1) ** (number // 2) for number in range(24)]
    for found in paper_pairs.bounds(fields(datums.__getitem__)):  # type: ignore[arg-type]
        # Half a percent of gain on means of layouts, and 10 nm over 1024 pixels, are far below the datums.
        # Seven terms from 20 scans of 30 nm say something about another by chance: 30 nm · √(7 / 20).
        allowed = 1 if found["terms"] == paper_pairs.AFFINE else 18
        assert found["datum_size"]["mean_nm"] == pytest.approx(30, abs=allowed)
        assert found["mae"]["mean_nm"] >= found["datum_size"]["mean_nm"]
        # Gaussian of 10 nm: 0.798 of it.
        assert found["mae_datum_freed"]["mean_nm"] == pytest.approx(7.98, abs=0.4)


def test_a_print_is_predicted_by_a_fit_to_the_others() -> None:
    all_of_them, others, _ = paper_pairs.bounds(fields(lambda number: 0.03 * (number < 4)))  # type: ignore[arg-type]
    # One print of six lies 30 nm higher: it takes a sixth of that along where it is fitted.
    assert all_of_them["datum_of_prints_nm"]["0"] == pytest.approx(25, abs=1)
    assert others["datum_of_prints_nm"]["0"] == pytest.approx(30, abs=1)
    assert others["datum_of_prints_nm"]["5"] == pytest.approx(-6, abs=1)


def test_a_zero_that_follows_the_layout_is_no_bound_for_a_model_that_sees_it() -> None:
    affine, _, seven = paper_pairs.bounds(fields(lambda number: 0.03 * (-1) ** number))  # type: ignore[arg-type]
    assert affine["datum_size"]["mean_nm"] == pytest.approx(30, abs=0.5)
    # Slopes of coarse layouts are smaller, by more than they scatter within a field.
    assert seven["datum_size"]["mean_nm"] < 10
