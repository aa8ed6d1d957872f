"""Check that tables and bars show the numbers of the record, and that a swapped column is noticed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from litho_data.foundation.results import Record
from litho_data.layouts.statistics import LayoutStatistics
from litho_data.layouts.statistics_report import statistics_page
from litho_data.making import report as of_build
from litho_data.making.gratings import GratingScan
from litho_data.making.result import BuildResult
from litho_data.making.suggest import Suggestion
from litho_data.making.suggest import _write_page as write_suggestion
from litho_data.making.verdict import Finding
from litho_data.reports.page import Page
from litho_data.store.schema import DatasetId
from litho_design.reports.tables import level_table
from litho_design.sheets.read import _write_report as write_sheet
from litho_design.sheets.record import ReadSheet
from litho_models.evaluation.plots import error_bars, line_profiles
from litho_models.evaluation.results import Benchmark
from litho_models.evaluation.wording import benchmark_verdict
from tests.litho_models.prints import make_scan
from tests.tables import require_tables_equal_record

ROOT = Path(__file__).parents[1]
PUBLISHED = ROOT / "docs" / "results" / "neural-lithography"
# All tables that the product writes, listed under the test file that checks their columns.
HELD = {
    "test_tables.py": "gratings left_out findings warnings recipes holograms errors levels",
    "litho_data/test_height_sigma.py": "quality summary uncertainty",
    "litho_data/test_layouts.py": "scans",
    "litho_models/test_next_print.py": "questions order scans",
    "litho_models/test_evaluate.py": "headline metrics scans levels",
    "litho_models/test_benchmark.py": "benchmark pairs lock_box fits policies",
    "litho_models/test_check.py": "figures scans",
    "litho_models/test_noise_results.py": "surfaces print_noise texture steps doses dose_levels calibration "
    "calibration_scans variance spread budget flat_levels",
    "litho_models/test_loop_run.py": "effects strengths explained errors single_scans planted candidates",
    "laws/test_blind_trials.py": "scoreboard",
    "litho_design/test_frozen_printer.py": "width scores window levels distance heights",
    "litho_design/test_first.py": "matrix paired summary",
}
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


def test_the_meaning_of_a_column_stands_behind_its_name(tmp_path: Path) -> None:
    page = Page("Rows", words={"mae_nm": ("error (nm)", "how far off")})
    page.table([Row(scan="P11", mae_nm=1.5)], "All.", "rows.csv")
    assert "<dt>error (nm)</dt><dd>how far off</dd>" in page.write(tmp_path).read_text()


def test_every_table_of_the_product_is_held_by_a_law() -> None:
    files = [file for name in ("data", "models", "design") for file in (ROOT / f"litho_{name}").rglob("*.py")]
    written = re.compile(r'"([a-z_]+?)_?(?:\{[^"]*\})?\.csv"')
    tables = {name for file in files for name in written.findall(file.read_text("utf-8"))}
    assert tables == {name for names in HELD.values() for name in names.split()}
    assert all((ROOT / "tests" / file).is_file() for file in HELD)


def of_gratings(folder: Path) -> list[dict[str, Any]]:
    scans = [
        GratingScan(
            id=name, period_um=1, line_um=2, scale_x=at + 0.3, scale_x_sd=at + 0.4, scale_y=at + 0.5,
            scale_y_sd=at + 0.6, bow_um=at + 0.7, bow_sd_um=at + 0.8, tip_at_most_um=at + 0.9,
            problem=f"of {name}",
        )
        for at, name in enumerate(("P1", "P2"))
    ]  # fmt: skip
    page = Page("Build")
    of_build._gratings(page, scans)
    page.write(folder)
    return [one.model_dump() for one in scans]


def of_a_build(folder: Path) -> list[dict[str, Any]]:
    given: dict[str, Any] = {
        "skipped": {"P1": "torn"},
        "unpaired": {"P2": "no scan"},
        "findings": [Finding(scan="P3", text="turned", weight=1)],
    }
    quality = {"scan": ["P4", "P5", "P6", "P7"], "warning": ["bent", "", "flat", "bent"]}
    page = Page("Build")
    of_build._left_out(page, BuildResult.model_construct(**given))
    of_build._warnings(page, pd.DataFrame(quality))
    page.write(folder)
    return [
        {"id": "P1", "status": "skipped", "reason": "torn"},
        {"id": "P2", "status": "unpaired", "reason": "no scan"},
        {"scan": "P3", "what": "turned"},
        {"warning": "bent", "scan": "P4, P7"},
        {"warning": "flat", "scan": "P6"},
    ]


def of_recipes(folder: Path) -> list[dict[str, Any]]:
    left = {"plane": {"P1": 1.5, "P2": 2.5}, "bow": {"P1": 3.5, "P2": 4.5}}
    write_suggestion(Suggestion("plane", left, {"bow": "moves lines"}, Path("card.toml")), {}, folder)
    return [{"recipe": "plane", **left["plane"]}, {"recipe": "bow", **left["bow"], "warning": "moves lines"}]


def of_a_sheet(folder: Path) -> list[dict[str, Any]]:
    read = ReadSheet(
        sheet_sha256="", dataset=DatasetId(name="made", sha256="0"), model="zoo:pbl", model_nm=9.5,
        own_nm=8.5, corrected_nm=7.5, found=[], verdict="traced", measured_db={"without": 1.5, "with": 2.5},
        expected_db={"without": 3.5, "with": 4.5},
    )  # fmt: skip
    write_sheet(folder, read)
    said = {"expected": (3.5, 4.5), "measured": (1.5, 2.5)}
    arms = ("without the model, dB", "with the model, dB")
    return [
        *({"image": kind, **dict(zip(arms, values, strict=True))} for kind, values in said.items()),
        {"model": "zoo:pbl", "mae_nm": 9.5},
        {"model": "physics, fitted to these prints", "mae_nm": 8.5},
        {"model": "the same model with the effects that the loop found", "mae_nm": 7.5},
    ]


def of_layouts(folder: Path) -> list[dict[str, Any]]:
    shares: dict[str, Any] = {"level_share": [0.5, 0.3, 0.2], "jump_share": [0.6, 0.35, 0.05]}
    bins: dict[str, Any] = {"frequency_per_um": [0.1, 0.2], "power_share": [0.7, 0.3]}
    found = LayoutStatistics(count=1, levels=3, pitch_um=0.1, **shares, **bins)
    np.save(folder / "P1.npy", np.eye(8, dtype=np.uint8))
    statistics_page(found, [folder / "P1.npy"]).write(folder)
    rows = enumerate(zip(*shares.values(), strict=True))
    return [
        {"level or jump": at, "share of pixels": level, "share of pairs": jump} for at, (level, jump) in rows
    ]


def test_graphs_of_layouts_show_shares_by_level_jump_and_frequency(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(Page, "figure", lambda page, figure, caption: shown.append(figure))
    of_layouts(tmp_path)
    levels, jumps, power = shown[-1].axes
    assert [bar.get_height() for bar in levels.patches] == [0.5, 0.3, 0.2]
    assert [bar.get_height() for bar in jumps.patches] == [0.6, 0.35, 0.05]
    assert [[*one] for one in power.lines[0].get_data()] == [[0.1, 0.2], [0.7, 0.3]]


@pytest.mark.parametrize("made", [of_gratings, of_a_build, of_recipes, of_a_sheet, of_layouts])
def test_each_column_of_a_composed_table_is_the_field_that_it_names(
    made: Callable[[Path], list[dict[str, Any]]], tmp_path: Path
) -> None:
    """Check tables whose numbers and names are all different, so that swapped columns are noticed."""
    (tmp_path / "record.json").write_text(json.dumps({"rows": made(tmp_path)}))
    require_tables_equal_record(tmp_path, "record.json", {})


class Row(Record):
    """A row of a report, used to test tables."""

    scan: str
    mae_nm: float


class LongerRow(Row):
    """The row of a report with one more number."""

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
def test_a_figure_in_the_wrong_row_or_column_is_noticed(table: str, tmp_path: Path) -> None:
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


def test_the_best_model_has_the_smallest_error_whatever_the_order_of_the_scores() -> None:
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
