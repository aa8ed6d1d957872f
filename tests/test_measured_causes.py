"""Check that the page on the causes found in the measured prints quotes the committed record."""

from __future__ import annotations

from benchmarks.measured_causes import FOLDER, PAGE, texts
from benchmarks.record import published
from litho_models.evaluation.results import Benchmark
from litho_models.loop.record import CloseLoop


def test_the_page_quotes_the_committed_record():
    for name, text in texts(CloseLoop.read(FOLDER)).items():
        assert published(PAGE, name) == text


def test_the_record_is_of_the_measured_prints_and_its_rows_are_made_alike():
    result = CloseLoop.read(FOLDER)
    assert result.dataset.sha256 == Benchmark.read(FOLDER.parent).dataset.sha256
    scans = {frozenset(row.by_scan_nm) for row in result.errors if row.held_out != "locked"}
    (development,) = scans
    assert not development & set(result.split.lock_box)
    # For every model alike, policy "none" fits no per-scan term, and policy "offset" fits one.
    assert {row.k for row in result.errors if row.policy == "none"} == {0.0}
    assert {row.k for row in result.errors if row.policy == "offset"} == {1.0}


def test_the_page_is_short():
    assert len(PAGE.read_bytes()) <= 8192
