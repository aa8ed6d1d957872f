"""Check that the learner measures how much the predictions lack, and that it finds nothing if they lack
nothing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from litho_data.foundation.units import NM_PER_UM
from litho_models.fitting.ridge import feature_rows
from litho_models.loop import learner as module
from litho_models.loop.fits import Study
from litho_models.loop.learner import Learner, Rest
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans, sample_border_px
from litho_models.models import build_model
from tests.litho_models.loop_scans import base_model, planted, study_of

NOISE_UM = 0.006
Change = Callable[[PreparedScan, np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def scene() -> tuple[Study, list[np.ndarray], Learner]:
    """Return a study, the heights of its scans without noise, and a learner for them."""
    study = study_of(planted(size_px=96, noise_um=NOISE_UM), folds=5)
    twin = Twin.bare(base_model())
    predictions = [twin.height(scan) for scan in study.scans]
    return study, predictions, Learner(study, predictions)


@pytest.fixture(scope="module")
def rest_without(scene) -> Callable[[Change | None], Rest]:
    """Return a function that runs the learner on predictions. They lack the change that is passed; if it is
    None, they lack nothing.
    """
    study, predictions, learner = scene

    @functools.cache
    def found(change: Change | None) -> Rest:
        return learner.rest(predictions if change is None else changed(study, predictions, change))

    return found


def changed(study: Study, predictions: list[np.ndarray], change: Change) -> list[np.ndarray]:
    """Return the predictions after removing from them a change that the scans contain."""
    return [p - change(f, p).astype(np.float32) for f, p in zip(study.scans, predictions, strict=True)]


def bead(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """Return a bead of a few nanometres on slopes along x. The bead is proportional to the height."""
    return 0.02 * prediction * np.abs(np.gradient(prediction, scan.pitch_um, axis=1))


def later(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """Return a change that is proportional to slopes along y and occurs only in the second half of the
    scans.
    """
    return 0.03 * (scan.context.order > 0) * np.abs(np.gradient(prediction, scan.pitch_um, axis=0))


def placed(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    ny, nx = prediction.shape
    y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
    return 0.01 * prediction * np.sin(3 * x + 1) * np.cos(3.5 * y)


def displaced(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """Return the change due to a displacement along y. The displacement is 0.1 µm at the upper right, and
    fades away from there.
    """
    ny, nx = prediction.shape
    y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
    return 0.1 * np.exp(-2 * (y + 0.4) ** 2 - 2 * (x - 0.4) ** 2) * np.gradient(prediction, 0.1, axis=0)


def test_where_nothing_is_missing_nothing_can_be_learned(rest_without) -> None:
    rest = rest_without(None)
    assert not rest.matters
    assert rest.mean_nm2 < 0.01 * rest.squares_nm2.mean()


@pytest.mark.parametrize("change", [bead, later, placed, displaced])
def test_the_learner_measures_the_size_of_changes_by_layout_order_or_place(rest_without, change) -> None:
    rest, true = rest_without(change), rest_without(None)
    there = float((rest.squares_nm2 - true.squares_nm2).mean())
    assert rest.matters
    assert rest.limits_nm2[0] <= rest.mean_nm2 <= rest.limits_nm2[1]
    # Allow a fifth for the scatter of 200 coefficients from 64,000 pixels and for the ridge.
    assert 0.8 * there < rest.mean_nm2 < 1.05 * there


def test_a_scan_is_judged_by_a_ridge_that_has_not_seen_it(scene, rest_without) -> None:
    study, predictions, learner = scene
    # Only one scan has this pattern, so the other scans cannot teach anything about it.
    alone = list(predictions)
    alone[0] = alone[0] - bead(study.scans[0], alone[0])
    found = learner.rest(alone)
    assert found.gains_nm2[0] < 0.05 * (found.squares_nm2[0] - rest_without(None).squares_nm2[0])


def test_two_folds_are_enough(scene, rest_without) -> None:
    """Check two folds. In this case, the weight of the ridge is chosen on individual scans of the other
    fold.
    """
    study, predictions, _ = scene
    halves = Learner(replace(study, fold_of=np.arange(10) % 2), predictions)
    lacking = changed(study, predictions, bead)
    assert halves.rest(lacking).mean_nm2 == pytest.approx(rest_without(bead).mean_nm2, rel=0.1)


def test_only_height_slopes_and_surroundings_may_depend_on_the_order(scene) -> None:
    """Check these features, because the learner finds them by their index in a default model."""
    scan = scene[0].scans[0]
    rows = feature_rows(build_model("features"), scan, scan.sample)
    layout, pitch = scan.layout_um / 1.2, scan.pitch_um
    height, near = (gaussian_filter(layout, sigma / pitch, mode="nearest") for sigma in (0.3, 1.6))
    slopes = [np.abs(slope) for slope in np.gradient(height, pitch)]
    for number, expected in zip(module._VARYING, (height, *slopes, near), strict=True):
        # Features are in float32, with a Gaussian truncated at four standard deviations.
        np.testing.assert_allclose(rows[number], scan.at_sample(expected), rtol=0, atol=1e-3)


def test_rows_are_thinned_where_they_would_not_fit(scene, rest_without, monkeypatch) -> None:
    study, predictions, _ = scene
    lacking = changed(study, predictions, bead)
    pixels = sum(len(scan.sample) for scan in study.scans)
    monkeypatch.setattr(module, "_KEPT_BYTES", 4 * 320 * pixels // 2)
    thinned = Learner(study, predictions)
    assert sum(rows.nbytes for rows, *_ in thinned._parts) <= 4 * 320 * pixels // 2
    # With half of the pixels, the result is nearly the same.
    assert thinned.rest(lacking).mean_nm2 == pytest.approx(rest_without(bead).mean_nm2, rel=0.15)


def test_a_shift_of_the_registration_is_nothing_to_learn(scene) -> None:
    study, predictions, learner = scene
    assert not learner.rest(changed(study, predictions, lambda f, p: 0.1 * np.gradient(p, axis=1))).matters


def test_the_squared_error_is_that_of_the_residual_without_what_a_scan_adds(scene, rest_without) -> None:
    study, predictions, _ = scene
    tilted = [
        replace(scan, height_um=scan.height_um + 1e-3 * np.arange(scan.shape[1]) + 0.02 * at)
        for at, scan in enumerate(study.scans)
    ]
    plain = rest_without(None)
    moved = Learner(replace(study, scans=prepare_scans(tilted)), predictions).rest(predictions)
    assert moved.squares_nm2 == pytest.approx(plain.squares_nm2, rel=1e-6)
    # The residual is white noise.
    assert np.sqrt(plain.squares_nm2.mean()) == pytest.approx(NOISE_UM * NM_PER_UM, rel=0.03)


def test_the_error_of_the_form_is_the_upper_end_of_what_could_be_learned() -> None:
    gains = np.array([8.0, 10.0, 9.0, 11.0, 10.0, 12.0])
    some = Rest(gains, np.full(6, 100.0))
    assert math.sqrt(10.0) < some.most_nm == pytest.approx(math.sqrt(some.limits_nm2[1]))
    assert Rest(-gains, np.full(6, 100.0)).most_nm == 0.0
    # With too few scans for a confidence interval, the mean is used.
    assert Rest(gains[:2], np.full(2, 100.0)).most_nm == pytest.approx(3.0)


@pytest.mark.parametrize("size", [40, 41])
def test_splines_of_an_axis_are_the_same_from_both_ends_and_constant_beyond_what_is_sampled(
    size: int,
) -> None:
    splines, border = module._splines(size), sample_border_px(size)
    np.testing.assert_allclose(splines[::-1, ::-1], splines, atol=1e-12)
    np.testing.assert_allclose(splines.sum(axis=0), 1)
    for ends in (slice(0, border + 1), slice(size - 1 - border, size)):
        assert np.ptp(splines[:, ends], axis=1).max() < 1e-12
    assert np.ptp(splines[:, border : border + 2], axis=1).max() > 0
