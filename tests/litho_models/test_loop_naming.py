"""Which effects earn a name: small ones beside large ones, and filters near the cause."""

from __future__ import annotations

import numpy as np
import pytest

from litho_models.effects import get_effect
from litho_models.twin.prepared import prepare_scans
from litho_models.loop.selection.confirming import confirm
from litho_models.loop.selection.contest import Added
from litho_models.loop.selection.search import FORM_ERROR, Search, rejection_reason
from litho_models.loop.study import Score, State, Study, fit_state
from tests.litho_models.loop_scans import printed_scans, true_model

FOLDS = np.arange(8) % 4


def added(name: str, before_nm2: float, after_nm2: float) -> Added:
    scores = [Score(np.sqrt(np.full(8, nm2)), np.full(8, nm2), 1.0, []) for nm2 in (before_nm2, after_nm2)]
    confirmation = confirm(scores[0].mse_nm2, scores[1].mse_nm2, scores[0].mae_nm, scores[1].mae_nm)
    return Added(get_effect(name), [], scores[0], scores[1], confirmation, 0.001)


@pytest.fixture(scope="module")
def chosen() -> tuple[Search, State, list]:
    """A search that has named a loss of height on slopes, and a further state that tilts the field."""
    planted = {"slope-thinning": {"along_x_um": 0.3, "along_y_um": 0.1}}
    tilt = {"field-curvature": get_effect("field-curvature").off_values() | {"tilt_x_um": 0.05}}
    scans = prepare_scans(printed_scans(planted | tilt, count=8, size_px=64, seed=4))
    base, first, second = (
        fit_state(true_model(effects), Study(scans, FOLDS)) for effects in ({}, planted, planted | tilt)
    )
    search = Search(base)
    search.add(added("slope-thinning", 2000.0, 1000.0), first, before=base)
    return search, second, scans


@pytest.mark.parametrize(("share", "refused"), [(0.5, True), (2.0, False)])
def test_an_effect_far_smaller_than_one_named_before_gets_no_name(chosen, share, refused) -> None:
    search, state, scans = chosen
    gain = share * FORM_ERROR**2 * 1000.0
    winner = added("field-curvature", 1000.0, 1000.0 - gain)
    reason = rejection_reason((winner, state), search.state, search, Study(scans, FOLDS))
    assert ("small beside slope-thinning" in reason) == refused
    assert bool(reason) == refused


def test_an_effect_that_was_dropped_stands_in_nobodys_way(chosen) -> None:
    search, state, scans = chosen
    winner = added("field-curvature", 1000.0, 999.0)
    without = search.steps["slope-thinning"][0]
    assert "small beside" not in rejection_reason((winner, state), without, search, Study(scans, FOLDS))
