"""The pages quote the committed results of the measured run, figure by figure."""

from __future__ import annotations

import csv
from pathlib import Path
from statistics import median

import pytest

from benchmarks.measured import FOLDER, PAGES, RESULTS, texts
from benchmarks.measured_loop import loop_table
from benchmarks.record import published
from litho_models.evaluation.results import Benchmark
from litho_models.loop.result.record import CloseLoop
from litho_models.noise.result import NoiseAnalysis


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_the_page_quotes_the_committed_results(page):
    assert published(page, PAGES[page]) == texts(FOLDER)[PAGES[page]]


def test_the_committed_results_are_of_the_published_schemas():
    loop = CloseLoop.read(FOLDER)
    benchmark = Benchmark.read(FOLDER)
    noise = NoiseAnalysis.read(FOLDER)
    assert loop.dataset.sha256 == benchmark.dataset.sha256 == noise.dataset.sha256
    # The locked scans were opened for a table of their own; the others' figures are without them.
    assert loop.locked_before is not None
    assert loop.locked_after is not None
    assert not benchmark.locked_scores
    assert not benchmark.split.lock_box_opened
    assert not set(loop.split.lock_box) & set(benchmark.split.scored_ids)
    assert noise.run.n_scans == len(benchmark.split.scored_ids)


def test_the_pages_say_where_the_locked_scans_take_part():
    paper = Benchmark.read(FOLDER / "benchmark_paper_0.json")
    trained_on = {part for fit in paper.fits for part in (*fit.training_ids, *fit.validation_ids)}
    locked = set(paper.split.lock_box)
    for parts in (trained_on, paper.split.scored_ids):
        assert locked & {part.split("/")[0] for part in parts}
    assert paper.split.lock_box_opened
    page = (FOLDER / "README.md").read_text("utf-8")
    assert "These draws include the locked scans" in page
    assert "4 locked scans are in no fold and in no figure of this table" in texts(FOLDER)["benchmark"]


def test_only_what_the_loop_on_physics_confirms_is_said_to_be_found_there():
    network = CloseLoop.read(FOLDER / "close_loop_pbl.json").model_dump(mode="json")
    physics = CloseLoop.read(FOLDER).model_dump(mode="json")
    screened = network["candidates"][0]
    network["candidates"] = [
        {**screened, "name": name, "verdict": "absorbed"} for name in ("a", "b", "c", "d")
    ]
    found = physics["effects"][0]
    physics["effects"] = [
        {**found, "name": "a", "verdict": "confusable", "confusable_with": ["b"]},
        {**found, "name": "c", "verdict": "traced-to-covariate", "confusable_with": []},
    ]
    physics["candidates"] = [
        {**screened, "name": "c", "verdict": "traced-to-covariate", "reason": "near the cause"},
        {**screened, "name": "d", "verdict": "below-noise", "reason": "a table does the same"},
    ]
    said = loop_table(network, physics)
    assert "Found on Physics and already carried by the network: a, b.\n" in said
    assert "c. The loop on Physics itself calls it traced-to-covariate: near the cause." in said
    assert "d. The loop on Physics itself calls it below-noise: a table does the same." in said


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
        f"(`sigma_levelling_nm`: {middle('sigma_levelling_nm')}; {unclear} of the {len(scans)} show no clear "
        f"surface); pixels and lines ({middle('sigma_pixel_nm')}, {middle('sigma_line_nm')}), resampling "
        f"({middle('sigma_resampling_nm')}) and registration ({middle('sigma_registration_nm')})"
    ) in page
