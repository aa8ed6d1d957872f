"""Test ridge regressions on many features against the closed form. Scan terms and tiles must have no
influence.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from litho_models.fitting import TrainingConfig, fit, ridge
from litho_models.models import build_model
from litho_models.models.features import RandomFeatures
from litho_models.prediction.tiles import predict_scan
from tests.litho_models.prints import make_scan, make_scans

pytestmark = pytest.mark.numerics

NARROW = {
    "sigmas_um": (0.0, 0.1, 0.3, 0.6),
    "slope_sigmas_um": (0.15,),
    "shifts_um": (0.2,),
    "streak_sigmas_um": (),
    "steep_sigmas_um": (),
    "steep_widths_um": (),
}


def fitted(name: str, scans, policy="full", **fields):
    model = build_model(name, **NARROW | fields)
    ridge.fit_ridge(model, scans, policy)
    return model.eval()


def error_nm(model, scan, height_um) -> float:
    return 1000 * float(np.abs(predict_scan(model, scan) - height_um).mean())


@pytest.mark.parametrize("name", ["features", "random-features"])
def test_fixed_weights_are_not_fitted(name):
    fixed = fitted(name, make_scans(1, 32), fixed=("weights",))
    start = build_model(name, **NARROW).state_dict()
    assert all(torch.equal(value, start[key]) for key, value in fixed.state_dict().items())


@pytest.mark.parametrize("name", ["features", "random-features"])
def test_a_print_made_of_its_features_is_found_through_datum_bow_and_blobs(name):
    known = build_model("features", **NARROW)
    torch.manual_seed(1)
    with torch.no_grad():
        known.weights.copy_(0.05 * torch.randn_like(known.weights))
        known.weights[0] = 1.0
    scans = make_scans(4)
    rows = np.linspace(-1, 1, 96)[:, None]
    printed = []
    for number, scan in enumerate(scans):
        added = 0.05 * (-1) ** number + 0.02 * number * (rows**2 - np.mean(rows**2))
        height = predict_scan(known, scan) + added
        # A blob of 1 µm covers 0.2 % of the pixels. In plain least squares, it would change the weights.
        height[10:14, 20:24] += 1.0
        printed.append(replace(scan, height_um=height.astype(np.float32)))
    model = fitted(name, printed, units=32) if name == "random-features" else fitted(name, printed)
    unseen = make_scan(20)
    # The fit is exact except for the ridge of 1e-5 and blobs with a weight of 0.002 µm / 1 µm.
    assert error_nm(model, unseen, predict_scan(known, unseen)) < 1.0


def test_a_bead_on_slopes_along_x_is_seen():
    scans = make_scans(6, noise_um=0.0, datum_um=0.0)
    bead = [np.abs(np.gradient(gaussian_filter(scan.layout_um, 2.0), axis=1)) for scan in scans]
    beaded = [
        replace(scan, height_um=scan.height_um + one.astype(np.float32))
        for scan, one in zip(scans, bead, strict=True)
    ]
    truth = beaded[-1].height_um
    errors = {
        name: error_nm(fit(name, beaded[:-1], TrainingConfig(nuisance="offset")).model, beaded[-1], truth)
        for name in ("linear", "features")
    }
    # The bead is 12 nm high on average. Squared slopes describe it only roughly.
    assert errors["features"] < 0.25 * errors["linear"]


def test_steep_surroundings_along_x_are_seen():
    scans = make_scans(6, noise_um=0.0, datum_um=0.0)
    around = [
        gaussian_filter(np.abs(np.gradient(gaussian_filter(s.layout_um, 2), axis=1)), 10) for s in scans
    ]
    lowered = [
        replace(scan, height_um=scan.height_um - 2 * one.astype(np.float32))
        for scan, one in zip(scans, around, strict=True)
    ]
    wide = {"steep_sigmas_um": (0.2,), "steep_widths_um": (1.0,)}
    errors = []
    for fields in ({}, wide):
        model = fitted("features", lowered[:-1], policy="offset", **fields)
        errors.append(error_nm(model, lowered[-1], lowered[-1].height_um))
    # Except at the edge, the feature equals the planted change, so little of the change remains.
    assert errors[1] < 0.5 * errors[0]


def test_rows_that_do_not_fit_are_made_again_and_give_the_same_weights(monkeypatch):
    scans = make_scans(3)
    kept = fitted("features", scans)
    monkeypatch.setattr(ridge, "KEPT_BYTES", 0)
    assert torch.equal(fitted("features", scans).weights, kept.weights)


def test_weights_do_not_depend_on_the_tiles_that_features_are_made_in(monkeypatch):
    scans = make_scans(2)
    whole = fitted("random-features", scans, units=8)
    monkeypatch.setattr(ridge, "TILE_PX", 40)
    tiled = fitted("random-features", scans, units=8)
    # Features in float32 have rounding errors of 1e-7, which the ridge of 1e-5 amplifies at most 100 times.
    assert error_nm(whole, scans[0], predict_scan(tiled, scans[0])) < 0.1


def test_random_features_are_the_same_for_a_seed_and_others_for_another():
    one, same, other = (build_model("random-features", seed=seed, units=16) for seed in (3, 3, 4))
    assert isinstance(one, RandomFeatures)
    assert torch.equal(one.directions, same.directions)
    assert not torch.equal(one.directions, other.directions)
    assert ((one.directions != 0).sum(dim=1) == one.config.inputs).all()
