"""Check that the page on noise quotes the committed results of virtual prints, and that these are right."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pandas as pd
import pytest

from benchmarks import virtual_noise
from benchmarks.record import published
from litho_data.virtual_fab.settings import Noise
from litho_models.noise import NoiseAnalysis
from litho_models.noise.calibration import ScanCalibration
from litho_models.noise.report import _covered, write_noise_report
from tests.tables import require_tables_equal_record


@pytest.mark.parametrize("mark", ["dose matrix", "planted roughness"])
def test_the_page_quotes_the_committed_results(mark):
    assert published(virtual_noise.PAGE, mark) == virtual_noise.texts(virtual_noise.FOLDER)[mark]


def test_doses_and_roughness_agree_with_what_was_planted():
    doses = NoiseAnalysis.read(virtual_noise.FOLDER / virtual_noise.DOSES)
    assert doses.dose.recommended_dose == 1.0
    gains = [row.height_gain for row in doses.dose.rows]
    assert gains == sorted(gains)
    found = NoiseAnalysis.read(virtual_noise.FOLDER / virtual_noise.REFERENCES)
    # From 30,000 pixels, σ is known to 1 %. The model error of `features` adds about as much.
    assert found.budget.floor.at("full").rmse_nm == pytest.approx(Noise().roughness_nm, rel=0.02)


@pytest.mark.parametrize("name", ["references", "dose-matrix"])
def test_every_column_of_a_table_is_the_field_that_it_names(name: str, tmp_path: Path) -> None:
    result = NoiseAnalysis.read(virtual_noise.FOLDER / name)
    write_noise_report(result, [], tmp_path)
    result.write(tmp_path)
    coverages = {"σ": "name"} | {f"coverage_{share}": "" for share in (50, 68, 80, 90, 95)}
    named = {"calibration.csv": coverages, "calibration_scans.csv": coverages}
    require_tables_equal_record(tmp_path, NoiseAnalysis.FILE_NAME, named, pivoted=["variance.csv"])
    if result.spread is not None:
        fitted = result.spread.variance
        shown = dict(pd.read_csv(tmp_path / "variance.csv").itertuples(index=False))
        assert shown == pytest.approx(dict(zip(fitted.covariates, fitted.coefficients, strict=True)))


def test_each_coverage_stands_under_its_level() -> None:
    scan = ScanCalibration(
        scan="P11", nll=1.0, crps_nm=2.0, coverage=[0.4, 0.7], standardised_rms=1.1, ence=0.1, ause=0.5
    )
    stated = SimpleNamespace(name="constant", levels=[0.5, 0.9])
    (row,) = _covered(cast(Any, stated), [scan])
    assert (row["σ"], row["coverage_50"], row["coverage_90"]) == ("constant", 0.4, 0.7)
