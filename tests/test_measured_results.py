"""Check that the pages quote the committed results for the measured prints correctly."""

from __future__ import annotations

import csv
from pathlib import Path
from statistics import median

import pytest

from benchmarks.measured import FOLDER, PAGES, RESULTS, texts
from benchmarks.record import published
from litho_models.evaluation.results import Benchmark
from litho_models.noise.result import NoiseAnalysis


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_the_page_quotes_the_committed_results(page):
    assert published(page, PAGES[page]) == texts(FOLDER)[PAGES[page]]


def test_the_committed_results_are_of_the_published_schemas():
    benchmark = Benchmark.read(FOLDER)
    noise = NoiseAnalysis.read(FOLDER)
    assert benchmark.dataset.sha256 == noise.dataset.sha256
    assert not benchmark.locked_scores
    assert not benchmark.split.lock_box_opened
    assert not set(benchmark.split.lock_box) & set(benchmark.split.scored_ids)
    assert noise.run.n_scans == len(benchmark.split.scored_ids)


def test_the_pages_say_where_the_locked_scans_take_part():
    paper = Benchmark.read(FOLDER / "benchmark_paper_0.json")
    trained_on = {part for fit in paper.fits for part in (*fit.training_ids, *fit.validation_ids)}
    locked = set(paper.split.lock_box)
    for parts in (trained_on, paper.split.scored_ids):
        assert locked & {part.split("/")[0] for part in parts}
    assert paper.split.lock_box_opened
    page = " ".join((FOLDER / "README.md").read_text("utf-8").split())
    assert "The four draws include the locked scans" in page
    assert "4 locked scans belong to no fold and affect no number here" in texts(FOLDER)["benchmark"]


def test_every_result_is_there():
    assert {path.name for path in FOLDER.iterdir()} >= {*RESULTS, "prediction.jpg"}


def test_the_page_on_the_store_quotes_the_uncertainty_of_the_measured_heights():
    page = " ".join((Path(__file__).parents[1] / "docs" / "dataset_store.md").read_text("utf-8").split())
    with (FOLDER / "registration.csv").open(encoding="utf-8") as file:
        scans = list(csv.DictReader(file))

    def middle(name: str) -> str:
        return f"{median(float(scan[name]) for scan in scans):.1f}"

    unclear = sum(float(scan["sigma_levelling_nm"]) == 0 for scan in scans)
    assert f"the median of `sigma_nm` is {middle('sigma_nm')} nm" in page
    assert (
        f"(`sigma_levelling_nm`: {middle('sigma_levelling_nm')}). In {unclear} of the {len(scans)} scans, "
        f"this bow is not significant. Pixels ({middle('sigma_pixel_nm')}), "
        f"lines ({middle('sigma_line_nm')}), resampling ({middle('sigma_resampling_nm')}) and registration "
        f"({middle('sigma_registration_nm')})"
    ) in page
