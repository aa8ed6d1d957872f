"""Test the twin: its numbers by group, its derivatives, and fits in which no scan predicts itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from litho_models.effects import get_effect
from litho_models.loop.fits import TwinProblem, fit_state
from litho_models.loop.model import Slot, Twin, Values
from litho_models.loop.prepared import LARGE_PX, prepare_scans
from litho_models.loop.results import clustered_covariance
from litho_models.scan_terms.grouped import ALL
from tests.litho_models.loop_scans import (
    BLUR_UM,
    PITCH_UM,
    bare_state,
    base_model,
    blank_scans,
    planted,
    study_of,
)

THINNING = "slope-thinning"


def thinning(along_x_um: float, exponent: float = 1.0) -> dict[str, float]:
    return get_effect(THINNING).with_values({"along_x_um": along_x_um, "exponent": exponent})


BY_FIELD: Values = {"1": thinning(0.1), "2": thinning(0.2)}


@pytest.fixture(scope="module")
def study():
    return study_of(planted([(THINNING, "field", BY_FIELD)]))


@pytest.fixture(scope="module")
def twin(study) -> Twin:
    return Twin.bare(base_model()).with_effect(THINNING, "field", BY_FIELD)


def test_the_bare_twin_is_the_base(study) -> None:
    scan = study.scans[0]
    bare = Twin.bare(base_model())
    np.testing.assert_allclose(bare.vector, [0.9, 0.03], rtol=1e-6)
    assert bare.names == ()
    blurred = gaussian_filter(scan.layout_um, BLUR_UM / PITCH_UM, mode="nearest", truncate=4)
    np.testing.assert_allclose(bare.height(scan), 0.9 * blurred + 0.03, atol=1e-5)


def test_amplitudes_differ_by_group_and_shapes_do_not(twin: Twin, study) -> None:
    assert twin.slots == [
        Slot(THINNING, "along_x_um", "field", "1"),
        Slot(THINNING, "along_x_um", "field", "2"),
        Slot(THINNING, "along_y_um", "field", "1"),
        Slot(THINNING, "along_y_um", "field", "2"),
        Slot(THINNING, "exponent"),
        Slot(THINNING, "turn_deg"),
    ]
    assert twin.own == 2
    assert twin.values(study.scans[1]) == {THINNING: thinning(0.2)}


def test_a_group_that_was_never_fitted_has_the_mean_of_the_others(twin: Twin, study) -> None:
    elsewhere = replace(study.scans[0], groups={"field": "9"})
    assert twin.values(elsewhere)[THINNING]["along_x_um"] == pytest.approx(0.15)
    one = Twin.bare(base_model()).with_effect(THINNING, ALL, {"": thinning(0.15)})
    np.testing.assert_allclose(twin.height(elsewhere), one.height(elsewhere), atol=1e-6)


def test_a_group_without_scans_has_the_mean_of_the_others(twin: Twin, study) -> None:
    first = [scan for scan in study.scans if scan.groups["field"] == "1"]
    known = twin.known_from(first)
    assert known.values(study.scans[1]) == known.values(study.scans[0]) == {THINNING: thinning(0.1)}
    assert len(known.vector) == len(twin.vector) - 2
    assert np.array_equal(twin.known_from(study.scans).vector, twin.vector)
    elsewhere = replace(study.scans[0], groups={"field": "9"})
    # Without a strength, the effect does nothing.
    assert twin.known_from([elsewhere]).chain(elsewhere).values[THINNING]["along_x_um"] == 0.0


def test_without_groups_every_scan_has_the_mean_strength(twin: Twin, study) -> None:
    plain = twin.ungrouped()
    assert plain.values(study.scans[0]) == plain.values() == twin.values()
    assert plain.values()[THINNING]["along_x_um"] == pytest.approx(0.15)
    assert plain.vector == pytest.approx(np.r_[twin.vector[: twin.own], 0.15, 0.0, 1.0, 0.0])


def test_directions_are_chosen_and_never_fitted(study) -> None:
    lag = {"length_um": 0.2, "direction": -1.0}
    twin = Twin.bare(base_model()).with_effect("galvo-lag", ALL, {"": lag})
    assert twin.slots == [Slot("galvo-lag", "length_um")]
    assert twin.values() == {"galvo-lag": lag}


def test_effects_act_in_their_order_however_they_came_and_leave_no_trace(twin: Twin) -> None:
    blur = get_effect("resampling-blur").with_values({})
    prox = get_effect("long-range-proximity").with_values({})
    more = twin.with_effect("resampling-blur", ALL, {"": blur}).with_effect(
        "long-range-proximity", ALL, {"": prox}
    )
    assert more.names == ("long-range-proximity", THINNING, "resampling-blur")
    back = more.without("resampling-blur").without("long-range-proximity")
    assert (back.effects, back.slots) == (twin.effects, twin.slots)
    assert np.array_equal(back.vector, twin.vector)
    with_first = more.without(THINNING)
    assert with_first.own == 2
    assert THINNING not in {slot.effect for slot in with_first.slots}


def test_effects_off_change_no_prediction(study) -> None:
    scan = study.scans[0]
    bare = Twin.bare(base_model())
    twin = bare.with_effect(THINNING, "field", {"1": thinning(0.0), "2": thinning(0.0)})
    assert np.array_equal(twin.height(scan), bare.height(scan))


def test_moving_the_twin_does_not_move_its_base(twin: Twin, study) -> None:
    before = [p.detach().clone() for p in twin.base.parameters()]
    twin.at(twin.vector + 0.1).height(study.scans[0])
    assert all((a == b).all() for a, b in zip(before, twin.base.parameters(), strict=True))


def test_derivatives_are_difference_quotients_of_the_whole_prediction(twin: Twin, study) -> None:
    """Check all derivatives, including those for numbers of other groups and for effects whose derivatives do
    not need the base to be run.
    """
    twin = twin.with_effect("long-range-proximity", ALL, {"": _typical("long-range-proximity")})
    steps = twin.steps()
    linear = TwinProblem(twin, study.windows).linearise(twin.vector)
    for window, part in zip(study.windows, linear, strict=True):
        here = window.at_sample(twin.height(window))
        np.testing.assert_allclose(part.residual, window.at_sample(window.height_um) - here, atol=1e-12)
        for at, step in enumerate(steps):
            moved = twin.vector.copy()
            moved[at] += step
            there = window.at_sample(twin.at(moved).height(window))
            # The tolerance is the float32 rounding of two heights, divided by the step.
            np.testing.assert_allclose(part.jacobian[at], (there - here) / step, atol=4e-7 / abs(step))


def _typical(name: str) -> dict[str, float]:
    return {key: facts.typical for key, facts in get_effect(name).parameters.items()}


def test_a_step_turns_back_at_the_end_of_a_range(twin: Twin) -> None:
    facts = get_effect(THINNING).parameters
    vector = twin.vector.copy()
    vector[2], vector[3] = facts["along_x_um"].upper, facts["along_x_um"].lower
    ends = twin.at(vector)
    assert ends.steps()[2] < 0 < ends.steps()[3]
    lowest, highest = ends.room()
    assert highest[2] == lowest[3] == 0
    assert list(ends.free()[2:4]) == [False, False]
    assert ends.free()[:2].all()
    # The exponent is not a length, so it cannot outgrow the effect.
    vector[-1] = facts["exponent"].upper
    assert twin.at(vector).lengths_at_limits(THINNING) == ""


@pytest.mark.parametrize(("length_px", "outgrown"), [(8.0, "length_px"), (9.0, ""), (280.0, "length_px")])
def test_a_range_at_its_limit_outgrows_its_effect(length_px: float, outgrown: str) -> None:
    name = "electron-backscatter"
    values = get_effect(name).with_values({"length_px": length_px})
    beam = Twin.bare(base_model()).with_effect(name, ALL, {"": values})
    assert beam.lengths_at_limits(name) == outgrown
    assert beam.lengths_at_limits(THINNING) == ""


def test_strengths_by_group_are_recovered_to_within_their_noise(study) -> None:
    start = {label: thinning(0.12, 1.2) for label in "12"}
    state = fit_state(bare_state(study).twin.with_effect(THINNING, "field", start), study)
    sd = np.sqrt(np.diag(clustered_covariance(state.linear, [scan.id for scan in study.scans])))
    wanted = [0.9, 0.03, 0.1, 0.2, 0.0, 0.0, 1.0]
    for at in (2, 3, 6):
        assert state.twin.vector[at] == pytest.approx(wanted[at], abs=5 * sd[at] + 0.01 * wanted[at])
    # The residual is white noise of 4 nm. Seven terms and an affine displacement per scan are removed.
    assert np.sqrt(state.mse_nm2) == pytest.approx(4.0, rel=0.05)


def test_free_errors_are_those_of_the_fit_that_has_not_seen_the_scan(study) -> None:
    state = bare_state(study)
    for at, scan in enumerate(study.scans):
        fold = study.fold_of[at]
        prediction = state.per_fold[fold].height(scan)
        left = scan.residual(prediction)
        np.testing.assert_allclose(state.held_out_um[at], left, atol=1e-12)
        freed = scan.freed(left, prediction)
        assert state.freed_nm2[at] == pytest.approx(1e6 * np.mean(freed**2))


@pytest.mark.parametrize("by", [ALL, "field", "print"])
def test_a_scan_says_nothing_about_its_own_prediction(by: str) -> None:
    """Check folds of whole prints. The strength of a held-out print comes from the other prints."""
    law = "height-power-2"
    scans = planted()
    changed = [
        replace(s, height_um=s.height_um + np.float32(0.3) * s.layout_um**2) if s.print_id == "2" else s
        for s in scans
    ]
    fold_of = np.array([int(scan.print_id) - 1 for scan in scans])
    found = []
    for own in (scans, changed):
        study = replace(study_of(own), fold_of=fold_of)
        labels = set(study.groups[by])
        values = {label: {"strength": 0.0} for label in labels}
        state = fit_state(Twin.bare(base_model()).with_effect(law, by, values), study)
        found.append(np.stack([state.per_fold[1].height(scan) for scan in study.scans[2:4]]))
    # A fit without a fold starts at the common fit, and stops when a step reduces the error by 1e-4.
    assert np.abs(found[1] - found[0]).max() < 1e-3 * 0.3


def test_a_base_that_is_not_fitted_has_no_numbers(study) -> None:
    base = base_model()
    for parameter in base.parameters():
        parameter.requires_grad_(False)
    twin = Twin.bare(base)
    assert len(twin.vector) == twin.own == 0
    state = fit_state(twin, study)
    assert [len(one.vector) for one in state.per_fold] == [0, 0, 0]
    assert state.mse_nm2 > 16


def test_an_effect_that_is_added_again_is_replaced() -> None:
    name = "slope-thinning"
    usual = get_effect(name).with_values({})
    split = Twin.bare(base_model()).with_effect(name, "print", {"1": usual, "2": usual})
    again = split.with_effect(name, ALL, {"": {**usual, "along_x_um": 0.2}})
    assert {slot.label for slot in again.effects} == {""}
    assert again.values()[name]["along_x_um"] == 0.2


def test_scans_of_the_same_position_in_the_order_stay_together() -> None:
    orders = (0, 4, 4, 9)
    scans = [replace(s, order=order) for s, order in zip(blank_scans(4, 32), orders, strict=True)]
    prepared = prepare_scans(scans)
    assert [one.context.order for one in prepared] == [-0.5, 0.0, 0.0, 0.5]
    assert [one.context.order for one in prepare_scans(scans, prepared)] == [-0.5, 0.0, 0.0, 0.5]


def test_scans_from_elsewhere_have_their_places_in_the_order_of_those_known(study) -> None:
    """Check that new scans get positions in the known printing order, so that a drift continues."""
    stored = [study.scans[3], replace(study.scans[6], order=7)]
    found = prepare_scans(stored, study.scans)
    assert [one.context.order for one in found] == [
        study.scans[3].context.order,
        study.scans[7].context.order,
    ]
    late = prepare_scans([replace(stored[0], order=99)], study.scans)[0]
    assert late.context.order == 0.5
    between = prepare_scans(stored[1:], study.scans[::2])[0]
    assert between.context.order == pytest.approx(
        (study.scans[6].context.order + study.scans[8].context.order) / 2
    )


def test_a_quadrant_without_measured_pixels_is_replaced() -> None:
    stored = blank_scans(1, LARGE_PX)[0]
    valid = np.ones(stored.shape, bool)
    valid[: LARGE_PX // 2, : LARGE_PX // 2] = False
    (scan,) = prepare_scans([replace(stored, valid=valid)])
    assert scan.window.context.origin_px != (0, 0)
    assert scan.window.sample.size > 5000


def test_large_scans_are_fitted_on_quadrants_in_turn() -> None:
    scans = prepare_scans(blank_scans(4, LARGE_PX))
    assert len({scan.window.context.origin_px for scan in scans}) == 4
    for scan in scans:
        y, x = (v.numpy() for v in scan.window.context.centred_um())
        row, column = scan.window.context.origin_px
        full_y, full_x = (v.numpy() for v in scan.context.centred_um())
        # Centres are computed in float32 µm, with a relative error of 2e-6.
        assert np.allclose(y[:, 0], full_y[row : row + len(y), 0], atol=1e-4)
        assert np.allclose(x[0], full_x[0, column : column + x.shape[1]], atol=1e-4)
