"""Check that screening predicts the gain of a later fit with one strength, or with one strength per group."""

from __future__ import annotations

import numpy as np
import pytest

from litho_models.effects import get_effect
from litho_models.effects.effect import Effect, Parameter
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.joint_fit import JointFit
from litho_models.loop.screening import PERMUTATIONS, Screened, Screening, Trial, trials_of
from litho_models.scan_terms.grouped import ALL
from tests.litho_models.loop_scans import bare_state, planted, study_of

LAW = "height-times-slope-x"
EFFECTS = [get_effect(name) for name in (LAW, "height-power-2", "rising-slope-y", "place-map")]


def screened(by: str, *strengths: float) -> tuple[Study, State, dict[tuple[str, str], Screened], Screening]:
    labels = [""] if by == ALL else [str(k + 1) for k in range(len(strengths))]
    values = {label: {"strength": one} for label, one in zip(labels, strengths, strict=True)}
    study = study_of(planted([(LAW, by, values)]))
    state = bare_state(study)
    screening = Screening(state, EFFECTS)
    found = {(one.name, one.by): one for one in screening.candidates}
    return study, state, found, screening


@pytest.fixture(scope="module")
def in_half():
    return screened("field", 0.0, 0.04)


@pytest.fixture(scope="module")
def in_all():
    return screened(ALL, 0.04)


@pytest.mark.parametrize("by", [ALL, "field"])
def test_a_linear_candidate_promises_what_its_fit_gains(in_half, by: str) -> None:
    study, state, found, _ = in_half
    one = found[LAW, by]
    fitted = fit_state(state.twin.with_effect(LAW, by, one.start()), study)
    gains = state.freed_nm2 - fitted.freed_nm2
    np.testing.assert_allclose(one.gain_nm2, gains.mean(), rtol=0.05)
    assert np.corrcoef(one.gains_nm2, gains)[0, 1] > 0.95


def test_a_strength_in_half_of_the_scans_is_found_with_its_grouping(in_half) -> None:
    study, _, found, screening = in_half
    one = found[LAW, "field"]
    assert set(study.groups) >= {ALL, "field", "print"}
    assert max((own for own in found.values() if own.name == LAW), key=lambda own: own.gain_nm2).by == "field"
    assert one.gain_nm2 > 1.5 * found[LAW, ALL].gain_nm2
    strengths = {label: values["strength"] for label, values in one.start().items()}
    assert strengths["2"] == pytest.approx(0.04, rel=0.05)
    assert abs(strengths["1"]) < 0.1 * 0.04
    # Of the 252 ways to choose five of ten scans, the two that equal the fields are not counted.
    (standing,) = [one for one in screening.standing() if one.name == LAW]
    assert standing.by == "field"
    assert standing.group_p is not None
    assert 1 / (1 + PERMUTATIONS) <= standing.group_p <= 1 / (1 + 0.95 * PERMUTATIONS)


def test_a_blur_in_half_of_the_scans_is_found() -> None:
    values = {"1": {"variance_um2": 0.0}, "2": {"variance_um2": 0.04}}
    study = study_of(planted([("defocus", "field", values)]))
    state = bare_state(study)
    screening = Screening(state, [get_effect("defocus")])
    found = {one.by: one for one in screening.candidates}
    fitted = fit_state(state.twin.with_effect("defocus", "field", found["field"].start()), study)
    gain_nm2 = state.mse_nm2 - fitted.mse_nm2
    # The base has already absorbed part of the blur.
    np.testing.assert_allclose(found["field"].gain_nm2, gain_nm2, rtol=0.3)
    assert found[ALL].gain_nm2 < 0.5 * gain_nm2
    assert [one.by for one in screening.standing()] == ["field"]


def test_a_group_that_would_need_a_negative_blur_has_none() -> None:
    """Check the normal equations of one parameter of the base and one strength in each of two groups."""
    effect = get_effect("defocus")
    trial = Trial(effect, effect.trials[:1], [2])
    grams = np.array([[[9.0, 0.0, right], [0.0, 1.0, 1.0], [right, 1.0, 2.0]] for right in (-2.0, 4.0)])
    fit = JointFit(grams, 1)
    # Without bounds, p + 2 s = -2, p + 2 t = 4 and 2 p + s + t = 0. With s = 0, p + 2 t = 4 and 2 p + t = 0.
    np.testing.assert_allclose(fit.strengths()[:, 0], [-1 / 2, 5 / 2], rtol=1e-4)
    np.testing.assert_allclose(trial.strengths(fit)[:, 0], [0, 8 / 3], rtol=1e-4)


def test_a_strength_in_all_scans_gains_nothing_by_group(in_all) -> None:
    _, _, found, screening = in_all
    one = found[LAW, ALL]
    assert one.start()[""]["strength"] == pytest.approx(0.04, rel=0.05)
    # Of the 2^10 sets of signs, only the observed set has all signs alike.
    assert one.family_p <= 4 / 2**10
    for (name, by), other in found.items():
        if name == LAW and by != ALL:
            assert other.gain_nm2 < 1.02 * one.gain_nm2
            assert screening.best_grouping([other]) is None


def test_a_candidate_is_wholly_like_itself_and_its_opposite(in_all) -> None:
    _, _, found, screening = in_all
    one, other = found[LAW, ALL], found["height-power-2", ALL]
    assert screening.cosine(one, one) == pytest.approx(1)
    assert screening.cosine(one, other) == pytest.approx(screening.cosine(other, one))
    assert abs(screening.cosine(one, other)) < 0.5


def test_a_change_that_the_base_can_make_is_no_candidate(in_all) -> None:
    """Check vertical shrinkage, which the gains of the base and of each scan can already imitate."""
    _, state, _, _ = in_all
    found = Screening(state, [get_effect("vertical-shrinkage")]).common
    assert found["vertical-shrinkage"].retained < 1e-5


def test_a_tip_that_would_have_to_narrow_is_contradicted() -> None:
    """Check a loss of height on slopes along both axes. A blunt tip would add height there."""
    name = "slope-thinning"
    thinned = get_effect(name).with_values({"along_x_um": 0.1, "along_y_um": 0.1})
    study = study_of(planted([(name, ALL, {"": thinned})]))
    effects = [get_effect("tip-dilation"), get_effect(name)]
    found = Screening(bare_state(study), effects).common
    assert not found["tip-dilation"].allowed
    assert found[name].allowed
    assert found[name].gain_nm2 > found["tip-dilation"].gain_nm2


def _effect():
    return Effect(
        name="made",
        title="made",
        stage="development",
        role="process",
        acts_on="height",
        parameters={
            "a": Parameter("1", 0.0, 1.0, 0.1),
            "b": Parameter("1", -1.0, 2.0, 1.1, null=1.0),
            "length_um": Parameter("µm", 0.1, 5.0, 1.0, kind="shape"),
        },
        apply=lambda height, values, context: height,
        trials=(
            {"a": 0.1, "length_um": 0.5},
            {"b": 1.2, "length_um": 0.5},
            {"a": 0.4, "length_um": 0.5},
            {"a": 0.1},
        ),
    )


def test_trials_of_one_shape_and_size_are_fitted_together() -> None:
    trials = trials_of([_effect()], 3)
    a, b, larger, bare = _effect().trials
    assert [one.sets for one in trials] == [(a, b), (larger,), (bare,)]
    assert [one.columns for one in trials] == [[3, 4], [5], [6]]


def test_multiples_count_from_the_null_and_stay_in_range() -> None:
    trial = Trial(_effect(), _effect().trials[:2], [])
    assert trial.steps(np.array([2.0, 3.0])) == pytest.approx([0.2, 0.6])
    assert trial.reach(np.array([2.0, 3.0])) == 1
    # Here a would be 2, which is twice its upper bound.
    assert trial.reach(np.array([20.0, 1.0])) == pytest.approx(0.5)
    # Here b would be 3, but its upper bound is 2.
    assert trial.reach(np.array([1.0, 10.0])) == pytest.approx(0.5)


def test_an_impossible_sign_is_allowed_only_for_a_relatively_small_strength() -> None:
    trial = Trial(_effect(), _effect().trials[:2], [])
    assert trial.allowed(np.array([1.0, 1.0]))
    assert not trial.allowed(np.array([-1.0, 0.0]))
    assert not trial.allowed(np.array([-1.0, 1.0]))
    # Groups are judged one by one.
    assert trial.allowed(np.array([[-1.0, 0.0], [10.0, 0.0]])).tolist() == [False, True]
    assert trial.allowed(np.array([-0.1, 1.0]))
    # b may have either sign.
    assert trial.allowed(np.array([1.0, -1.0]))
