"""Check edge, similarity and phase errors against closed forms, also if some pixels are not scored."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_models.evaluation.tables import metric_table, metric_text, scan_table
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring import metric_registry
from litho_models.scoring.metric_registry import register_metric
from litho_models.scoring.metrics import phase_waves
from litho_models.scoring.records import ModelScores, Prediction
from litho_models.scoring.scores import score_model
from litho_models.scoring.shapes import (
    SSIM_WINDOW_PX,
    edge_placement,
    mid_step_heights_um,
    structural_similarity,
)
from tests.litho_models.prints import make_scan, make_scans

PITCH_UM = 0.1
HEIGHTS_UM = mid_step_heights_um(13, 0.1)


def ramp(shift_px=0.0, degrees=0.0, shape=(120, 140)):
    """Return a plane that rises by 1.2 µm over 100 px in a direction and is displaced in this direction."""
    y, x = np.meshgrid(*(np.arange(n, dtype=float) for n in shape), indexing="ij")
    angle = np.deg2rad(degrees)
    return 0.012 * (x * np.cos(angle) + y * np.sin(angle) - 10 - shift_px)


def test_contours_lie_half_way_between_the_levels():
    assert mid_step_heights_um(4, 0.2) == pytest.approx([0.1, 0.3, 0.5])
    # With a thousand steps of 1 nm, only 24 evenly spaced heights have a contour.
    many = mid_step_heights_um(1001, 0.001)
    assert many[[0, 1, -1]] == pytest.approx([1 / 48, 3 / 48, 47 / 48])


@pytest.mark.parametrize("shift_px", [0.0, 0.13, -0.5, 2.75, 4.9])
@pytest.mark.parametrize("degrees", [0, 90])
def test_the_displacement_of_a_shifted_edge_is_the_shift(shift_px, degrees):
    found = edge_placement(ramp(shift_px, degrees), ramp(0, degrees), HEIGHTS_UM, PITCH_UM)
    # A plane is interpolated exactly. Only heights of 1 µm are rounded, at a slope of 12 nm/px.
    assert found.mean_nm == pytest.approx(100 * abs(shift_px), abs=1e-6)
    assert found.p95_nm == pytest.approx(100 * abs(shift_px), abs=1e-6)
    assert found.matched > 10 * 100
    assert found.unmatched == found.unmatched_expected == 0


def test_an_oblique_edge_is_measured_across_not_along_the_grid():
    found = edge_placement(ramp(1.5, 30), ramp(0, 30), HEIGHTS_UM, PITCH_UM)
    # Along the grid, the displacement would be 173 nm. Where a contour leaves the field, the nearest piece is
    # its last one, which is farther away; this adds less than 1 % on average.
    assert 150 <= found.mean_nm < 151.5
    assert found.p95_nm == pytest.approx(150, abs=1e-6)


def test_an_edge_farther_than_the_search_has_no_partner():
    found = edge_placement(ramp(5.1), ramp(), HEIGHTS_UM, PITCH_UM)
    assert (found.matched, found.mean_nm, found.p95_nm) == (0, None, None)
    assert found.unmatched > 1000
    assert found.unmatched_expected > 1000


def test_the_other_side_of_a_line_is_no_partner():
    x = np.arange(60.0)
    profile = [np.clip(0.6 - 0.2 * np.abs(x - centre), 0, None) for centre in (30.0, 34.0)]
    measured, expected = (np.tile(p, (40, 1)) for p in profile)
    # At 0.3 µm, the measured line falls near where the expected one rises, but 4 px from its partner.
    found = edge_placement(measured, expected, np.array([0.3]), PITCH_UM)
    assert found.mean_nm == pytest.approx(400)


def test_pixels_that_are_not_scored_have_no_contours():
    measured = ramp(1.0)
    measured[:, 40:80] = np.nan
    found = edge_placement(measured, ramp(), HEIGHTS_UM, PITCH_UM)
    whole = edge_placement(ramp(1.0), ramp(), HEIGHTS_UM, PITCH_UM)
    assert found.matched < whole.matched
    assert found.mean_nm == pytest.approx(100, rel=0.02)


def test_flat_maps_have_no_edges():
    flat = np.full((40, 40), 0.6)
    assert edge_placement(flat, flat, HEIGHTS_UM, PITCH_UM) == (None, None, 0, 0, 0)


def test_similarity_is_one_for_equal_maps_and_known_for_a_constant_offset():
    height = 0.6 + 0.2 * np.random.default_rng(0).standard_normal((64, 64))
    assert structural_similarity(height, height) == pytest.approx(1, abs=1e-12)
    # For flat maps, only the means matter: (2ab + c)/(a² + b² + c) with c = (0.01 · 1.2 µm)².
    a, b, c = 0.5, 0.6, 0.012**2
    flat = structural_similarity(np.full((32, 32), a), np.full((32, 32), b))
    assert flat == pytest.approx((2 * a * b + c) / (a * a + b * b + c))


def test_similarity_does_not_look_at_pixels_that_are_not_scored():
    random = np.random.default_rng(1)
    measured, expected = random.uniform(0, 1.2, (2, 64, 64))
    holed = measured.copy()
    holed[:, 40:] = np.nan
    changed = expected.copy()
    changed[:, 40:] += 1.0
    # Windows within the first 40 columns are the same in both maps.
    assert structural_similarity(holed, changed) == structural_similarity(holed, expected)
    assert structural_similarity(np.full((64, 64), np.nan), expected) is None
    small = np.zeros((SSIM_WINDOW_PX, SSIM_WINDOW_PX))
    assert structural_similarity(small, small) == 1


def test_the_paper_s_error_in_waves():
    assert phase_waves(0.0277) == pytest.approx(0.024, abs=5e-5)


def test_the_scores_of_the_truth_with_a_constant_error():
    scan = make_scan(0, 128, noise_um=0.0, datum_um=0.0)
    constant = Prediction(scan.height_um - np.float32(0.05))
    scores = score_model("truth", [scan], [constant], NuisanceProtocol.of_policy("none"))
    # The error is 50 nm. Heights of 1 µm in float32 are accurate to 1e-4 nm.
    assert scores.phase_rms_waves == pytest.approx(0.05 * 0.548 / 0.6328, rel=1e-5)
    free = score_model("truth", [scan], [constant], NuisanceProtocol.of_policy("offset"))
    assert free.phase_rms_waves == pytest.approx(0, abs=1e-6)
    assert free.ssim == pytest.approx(1, abs=1e-6)
    assert free.edge_mean_nm == pytest.approx(0, abs=0.1)
    assert free.edge_matched > 1000
    assert free.scans[0].edge_matched == free.edge_matched
    assert scores.ssim < free.ssim
    assert scores.edge_mean_nm > free.edge_mean_nm


@pytest.fixture
def own_metrics(monkeypatch):
    """Remove the metrics that a test has registered."""
    monkeypatch.setattr(metric_registry, "_MEASUREMENTS", [*metric_registry._MEASUREMENTS])


def test_a_metric_of_one_s_own_is_in_results_tables_and_text(own_metrics):
    register_metric("worst", "nm", lambda scan, z, r: 1000 * np.nanmax(np.abs(r)), "worst is the largest.")
    register_metric("high", "1", lambda scan, z, r: (z > 0.5).sum(), "high counts.", over_scans="sum")
    register_metric("never", "um", lambda scan, z, r: float("nan"), "never is not known.")
    scans = make_scans(3, size_px=64)
    scores = score_model(
        "flat", scans, [Prediction(scan.layout_um) for scan in scans], NuisanceProtocol.of_policy("none")
    )
    rows = [row.metrics for row in scores.scans]
    for scan, row in zip(scans, rows, strict=True):
        error = np.abs(scan.height_um - scan.layout_um)[scan.valid]
        assert row["worst_nm"] == pytest.approx(1000 * error.max())
        assert row["high"] == (scan.layout_um > 0.5).sum()
        assert row["never_um"] is None
    assert scores.metrics["worst_nm"] == pytest.approx(np.mean([row["worst_nm"] for row in rows]))
    assert scores.metrics["high"] == sum(row["high"] for row in rows)
    assert scores.metrics["never_um"] is None
    assert [row["worst_nm"] for row in metric_table([scores])] == [scores.metrics["worst_nm"]]
    assert [row["high"] for row in scan_table([scores])] == [row["high"] for row in rows]
    assert "worst is the largest." in metric_text([scores])
    assert ModelScores.model_validate_json(scores.model_dump_json()) == scores


@pytest.mark.parametrize(
    ("name", "unit", "over_scans"),
    [("ssim", "1", "mean"), ("edge_mean", "nm", "mean"), ("bias", "nm", "mean"), ("transfer", "1", "mean"),
     ("two words", "nm", "mean"), ("good", "n m", "mean"), ("good", "nm", "median")],
)  # fmt: skip
def test_metrics_that_cannot_be_told_apart_are_refused(own_metrics, name, unit, over_scans):
    with pytest.raises(InputError):
        register_metric(name, unit, lambda *scan: 0.0, "", over_scans=over_scans)


def test_a_metric_has_to_be_a_number(own_metrics):
    register_metric("map", "nm", lambda scan, z, r: r, "a map.")
    scan = make_scan(0, 64)
    with pytest.raises(InputError, match="metric map, got a ndarray"):
        score_model("flat", [scan], [Prediction(scan.layout_um)], NuisanceProtocol.of_policy("none"))


def test_an_error_in_a_metric_is_one_line_that_names_it(own_metrics):
    register_metric("broken", "nm", lambda scan, z, r: 1 / 0, "never computed.")
    scan = make_scan(0, 64)
    with pytest.raises(InputError, match=rf"metric broken of {scan.id}, got ZeroDivisionError: division by"):
        score_model("flat", [scan], [Prediction(scan.layout_um)], NuisanceProtocol.of_policy("none"))
