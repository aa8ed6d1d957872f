"""Pixels count by their uncertainty where asked, in every kind of training."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_models.fitting import TrainingConfig, fit
from litho_models.fitting.fit import common_geometry, run_key
from litho_models.fitting.least_squares import Linearised
from litho_models.fitting.pixel_weights import Weighted, pixel_weights
from litho_models.models import build_model
from tests.litho_models.prints import make_scans

GOOD_UM, BAD_UM = 0.002, 0.1


@pytest.fixture(scope="module")
def scans() -> list[PrintedScan]:
    """Prints whose right half was measured fifty times worse, with outliers of one sign, and says so."""
    found = []
    for number, scan in enumerate(make_scans(4, size_px=96, noise_um=GOOD_UM, datum_um=0.0)):
        spoilt = np.arange(96) >= 48
        error = np.random.default_rng(number).gamma(1.0, BAD_UM, scan.shape)
        # The error grows with the layout: an unweighted fit takes it for a part of the print.
        height = np.where(spoilt, scan.height_um + error * scan.layout_um, scan.height_um)
        sigma = np.where(spoilt, BAD_UM, GOOD_UM) * np.ones(scan.shape)
        found.append(
            replace(scan, height_um=height.astype(np.float32), height_sigma_um=sigma.astype(np.float32))
        )
    return found


def _half(scans: list[PrintedScan]) -> list[PrintedScan]:
    """The same scans, their spoilt half not measured."""
    return [replace(scan, valid=scan.valid & (np.arange(96) < 48)) for scan in scans]


def _vector(model_name: str, scans: list[PrintedScan], **settings: object) -> np.ndarray:
    model = fit(model_name, scans, TrainingConfig(nuisance="none", **settings))
    return np.concatenate([p.detach().numpy().ravel() for p in model.parameters()])


@pytest.mark.parametrize("name", ["affine", "features"])
def test_a_fit_believes_pixels_by_their_uncertainty(scans, name):
    uniform, weighted = _vector(name, scans), _vector(name, scans, weights="sigma")
    alone = _vector(name, _half(scans))
    # Weights are 1 / 50 for the spoilt half: what remains of its pull is that share, with room for the noise.
    assert np.abs(weighted - alone).max() < 0.1 * np.abs(uniform - alone).max()


@pytest.mark.parametrize("loss", ["absolute", "squares"])
def test_what_a_scan_may_add_is_weighted_as_its_residual_is(loss):
    random = np.random.default_rng(0)
    part = Linearised(random.normal(size=50), random.normal(size=(3, 50)), random.normal(size=(2, 50)))
    weight = random.uniform(0.1, 2.0, 50)
    problem = SimpleNamespace(linearise=lambda vector: [part], residuals=lambda vector: [part.residual])
    weighted = Weighted(problem, [weight], loss)
    (found,) = weighted.linearise(np.zeros(3))
    np.testing.assert_array_equal(weighted.residuals(np.zeros(3)), [weight * part.residual])
    np.testing.assert_array_equal(found.residual, weight * part.residual)
    np.testing.assert_array_equal(found.jacobian, weight * part.jacobian)
    # The same span: with both together there is no third direction, and each has two.
    basis = weight * part.basis
    assert np.linalg.matrix_rank(np.concatenate([found.basis, basis])) == len(found.basis) == 2
    if loss == "squares":
        np.testing.assert_allclose(found.basis @ found.basis.T, np.eye(2), atol=1e-12)


def test_weights_have_mean_one_and_are_zero_where_nothing_is_measured(scans):
    valid = scans[0].valid.copy()
    valid[:10] = False
    weights = pixel_weights(replace(scans[0], valid=valid), "sigma")
    assert weights[valid].mean() == pytest.approx(1, rel=1e-6)
    assert not weights[~valid].any()
    # In proportion to 1 / σ.
    assert weights[20, 10] / weights[20, 80] == pytest.approx(BAD_UM / GOOD_UM, rel=1e-5)


def test_a_store_without_uncertainty_is_refused_in_one_line(scans):
    bare = [replace(scan, height_sigma_um=None) for scan in scans]
    with pytest.raises(InputError, match="no height_sigma_um in the store"):
        fit("affine", bare, TrainingConfig(weights="sigma"))


def test_a_fit_with_weights_is_kept_apart(scans):
    model = build_model("affine", **common_geometry(scans))
    sigma = TrainingConfig(weights="sigma")
    assert run_key(model, scans, sigma) != run_key(model, scans, TrainingConfig())
    doubled = [replace(scan, height_sigma_um=scan.height_sigma_um**2) for scan in scans]
    assert run_key(model, scans, sigma) != run_key(model, doubled, sigma)
