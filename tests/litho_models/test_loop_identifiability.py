"""What the scans say about the fitted numbers: conditioning and profiles."""

from __future__ import annotations

import numpy as np
import pytest

from litho_models.effects import get_effect
from litho_models.fitting.least_squares import eliminated
from litho_models.loop.fold_fits import TERM_WEIGHT
from litho_models.loop.identifiability import PROFILE_POINTS, identifiability, profiles
from litho_models.loop.parameters import effect_slots, get_vector
from litho_models.twin.prepared import prepare_scans
from litho_models.loop.study import Study, fit_state
from tests.litho_models.loop_scans import printed_scans, true_model

FOLDS = np.arange(8) % 4


def fitted(planted: dict, effects: dict):
    scans = prepare_scans(printed_scans(planted, count=8, size_px=64, seed=4))
    return fit_state(true_model(effects), Study(scans, FOLDS)).fits, scans


def test_the_profile_of_a_linear_amplitude_is_the_parabola_of_its_information() -> None:
    planted = {"slope-thinning": {"along_x_um": 0.3, "along_y_um": 0.1}}
    fits, scans = fitted(planted, planted)
    found = {one.parameter: one for one in profiles(fits, scans)}
    normal = np.sum([eliminated(part, TERM_WEIGHT)[0] for part in fits.linear], axis=0)
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    count = sum(len(scan.sample) for scan in scans)
    slot = effect_slots(fits.chain)["slope-thinning", "along_x_um"]
    one = found["along_x_um"]
    squares = count * (one.rmse_nm / 1e3) ** 2
    middle = PROFILE_POINTS // 2
    rise = (one.held - one.fitted) ** 2 / inverse[slot, slot]
    assert one.held[middle] == pytest.approx(one.fitted)
    # The base is not linear: within three standard errors its curvature changes the rise by some per cent.
    assert squares - squares[middle] == pytest.approx(rise, rel=0.1, abs=0.02 * rise.max())
    assert fits.common == pytest.approx(get_vector(fits.chain)), "the fit is left as it was"


def test_two_blurs_are_known_together_only() -> None:
    blurs = {"diffusion-blur": {"variance_um2": 0.02}, "resampling-blur": {"variance_um2": 0.02}}
    alike, _ = fitted(blurs, blurs)
    curved = {"field-curvature": get_effect("field-curvature").off_values() | {"tilt_x_um": 0.1}}
    apart, _ = fitted(curved, curved)
    together, alone = identifiability(alike), identifiability(apart)
    assert together is not None
    assert alone is not None
    names = [name for name in together.inflation if "blur" in name]
    assert len(names) == 2
    assert min(together.inflation[name] for name in names) > 10
    assert together.condition > 3 * alone.condition
    assert alone.inflation["field-curvature: tilt_x_um"] == pytest.approx(1, abs=0.3)


def test_without_fitted_numbers_there_is_nothing_to_tell() -> None:
    fits, scans = fitted({}, {})
    for parameter in fits.chain.base.parameters():
        parameter.requires_grad = False
    frozen = fit_state(fits.chain, Study(scans, FOLDS)).fits
    assert identifiability(frozen) is None
    assert profiles(frozen, scans) == []


def test_a_single_number_has_a_profile_though_nothing_else_is_fitted() -> None:
    planted = {"vertical-shrinkage": {"fraction": 0.1}}
    scans = prepare_scans(printed_scans(planted, count=8, size_px=64, seed=4))
    chain = true_model(planted)
    for parameter in chain.base.parameters():
        parameter.requires_grad = False
    (one,) = profiles(fit_state(chain, Study(scans, FOLDS)).fits, scans)
    assert one.rmse_nm.argmin() == PROFILE_POINTS // 2
