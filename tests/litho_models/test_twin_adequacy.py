"""A name that only resembles the cause is refused by the shape of what it leaves."""

from __future__ import annotations

import pytest

from litho_models.effects import get_effect
from litho_models.scan_terms.groups import ALL
from litho_models.twin.adequacy import reshaped_gain
from litho_models.twin.closing import FORM_SHARE
from litho_models.twin.fits import fit_state
from tests.litho_models.twin_scans import bare_state, planted, study_of


def values_of(name: str) -> dict[str, float]:
    effect = get_effect(name)
    return effect.with_values(effect.trials[0])


def share(planted_name: str, fitted_name: str, beside: tuple[str, ...] = (), seed: int = 0) -> float:
    """What the fitted change takes in other shapes, of its own gain; ``beside``: printed, but not fitted."""
    effects = [(name, ALL, {"": values_of(name)}) for name in (planted_name, *beside)]
    study = study_of(planted(effects, seed=seed))
    without = bare_state(study)
    state = fit_state(without.twin.with_effect(fitted_name, ALL, {"": values_of(fitted_name)}), study)
    gain = without.mse_nm2 - state.mse_nm2
    assert gain > 0
    return reshaped_gain(without, state, study) / gain


@pytest.mark.parametrize("name", ["slope-x-power-1", "curvature-x", "slope-thinning"])
def test_the_formula_of_the_cause_leaves_nothing_of_its_shape(name: str) -> None:
    assert share(name, name) < FORM_SHARE


def test_a_mimic_is_refused() -> None:
    """A loss along the slope is taken for one along its cube."""
    assert share("slope-x-power-1", "slope-x-power-3") > FORM_SHARE


def test_a_cause_that_is_missing_beside_it_does_not_refuse_a_name() -> None:
    assert share("slope-thinning", "slope-thinning", beside=("write-order-memory",)) < FORM_SHARE
