"""Tables and bars show the figures of the record, and the law that says so sees a swapped column."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from litho_data.foundation.results import Record
from litho_data.reports.page import Page
from litho_design.reports.tables import level_table
from litho_models.evaluation.plots import error_bars, line_profiles
from litho_models.evaluation.results import Benchmark
from litho_models.evaluation.wording import benchmark_verdict
from tests.litho_models.prints import make_scan
from tests.tables import require_tables_equal_record

PUBLISHED = Path(__file__).parents[1] / "docs" / "results" / "neural-lithography"
RECORD = {
    "name": "prints",
    "rows": [
        {"scan": "P11", "mae_nm": 1.5, "ci95_nm": [1.04, 2.0], "by": {"x": 3.0}},
        {"scan": "P12", "mae_nm": 2.5, "ci95_nm": None, "by": {"x": 4.0}},
    ],
}
TABLES = {
    "name,scan,mae_nm,ci95_nm\nprints,P11,1.5,1.04 … 2.00\nprints,P12,2.5,–\n": "",
    "scan,x\nP11,3.0\nP12,4.0\n": "",
    "scan,error\nP11,1.5\n": "are no fields",
    "scan,mae_nm\nP11,2.5\n": "row 0",
    "scan,x\nP11,3.0\nP12,3.0\n": "row 1",
    "scan,ci95_nm\nP11,1.05 … 2.00\n": "row 0",
    ",scan\n0,P11\n1,P12\n": "without a name",
}


class Row(Record):
    """A row of a report."""

    scan: str
    mae_nm: float


class LongerRow(Row):
    """The same with one figure more."""

    tallest_um: float


def test_a_further_field_of_a_record_is_a_further_column_of_its_table(tmp_path: Path) -> None:
    for number, row in enumerate(
        (Row(scan="P11", mae_nm=1.5), LongerRow(scan="P11", mae_nm=1.5, tallest_um=7.125))
    ):
        page = Page("Rows")
        page.table([row], "All.", f"{number}.csv", digits=3)
        text = page.write(tmp_path).read_text()
        assert ("tallest (µm)" in text) == ("7.125" in text) == (number == 1)
    assert (tmp_path / "0.csv").read_text() == "scan,mae_nm\nP11,1.5\n"
    assert (tmp_path / "1.csv").read_text() == "scan,mae_nm,tallest_um\nP11,1.5,7.125\n"


@pytest.mark.parametrize("table", TABLES)
def test_a_figure_in_another_row_or_column_is_seen(table: str, tmp_path: Path) -> None:
    (tmp_path / "record.json").write_text(json.dumps(RECORD))
    (tmp_path / "table.csv").write_text(table)
    if not TABLES[table]:
        require_tables_equal_record(tmp_path, "record.json", {})
        return
    with pytest.raises(AssertionError, match=TABLES[table]):
        require_tables_equal_record(tmp_path, "record.json", {})
    require_tables_equal_record(tmp_path, "record.json", {}, pivoted=("table.csv",))


def test_waves_of_a_level_count_from_the_printed_level_0() -> None:
    design: Any = SimpleNamespace(
        stroke=SimpleNamespace(printed_height_um=[0.2, 0.3, 0.5]),
        layout=SimpleNamespace(level_height_um=0.15),
        optics=SimpleNamespace(wave_height_um=0.5),
    )
    table = level_table(design)
    assert list(table["level"]) == [0, 1, 2]
    assert table["nominal_um"] == pytest.approx([0, 0.15, 0.3])
    assert table["printed_um"] == [0.2, 0.3, 0.5]
    assert table["printed_waves"] == pytest.approx([0, 0.2, 0.6])


def test_the_best_model_is_that_of_the_smallest_error_in_whatever_order_they_are_given() -> None:
    record = Benchmark.read(PUBLISHED / "benchmark.json")
    best, second, *_ = ordered = sorted(record.scores, key=lambda one: one.mae_datum_free_nm)
    for scores in (ordered, ordered[::-1]):
        verdict = benchmark_verdict(record.model_copy(update={"scores": scores}))
        assert verdict.startswith(f"{best.model} is best")
        assert f"{second.model} is next with {second.mae_datum_free_nm:.2f} nm" in verdict


@pytest.mark.pictures
def test_profiles_show_layout_measurement_and_models_of_one_row():
    scan = make_scan(0, 32)
    residual = 0.1 * np.random.default_rng(0).normal(size=scan.shape)
    (axes,) = line_profiles(scan, {"affine": residual}).axes
    shown = {"layout": scan.layout_um, "measured": scan.height_um, "affine": scan.height_um - residual}
    assert [line.get_label() for line in axes.lines] == [*shown]
    for line, field in zip(axes.lines, shown.values(), strict=True):
        assert line.get_linewidth() > 0
        np.testing.assert_allclose(line.get_ydata(), field[16])
        np.testing.assert_allclose(line.get_xdata(), (np.arange(32) + 0.5) * scan.pitch_um)


@pytest.mark.pictures
def test_the_interval_at_a_bar_is_that_of_its_error() -> None:
    scores = Benchmark.read(PUBLISHED / "benchmark.json").scores
    (axes,) = error_bars(scores, None, False).axes
    bars, intervals = (
        [one for one in axes.containers if type(one).__name__ == name]
        for name in ("BarContainer", "ErrorbarContainer")
    )
    for kind, drawn, shown in zip(("mae_abs", "leading"), bars, intervals, strict=True):
        assert [one.get_width() for one in drawn] == [getattr(one, f"{kind}_nm") for one in scores]
        (lines,) = shown.lines[2]
        ends = np.array([segment[:, 0] for segment in lines.get_segments()])
        np.testing.assert_allclose(ends, [getattr(one, f"{kind}_ci95_nm") for one in scores], rtol=1e-12)
