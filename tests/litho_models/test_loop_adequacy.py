"""Check that the loop does not name an effect that merely resembles the true cause."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from litho_models.effects import get_effect
from litho_models.loop import checking, closing, results
from litho_models.loop.checking import FORM_SHARE, Check, reshaped_gain
from litho_models.loop.closing import Closed
from litho_models.loop.fits import Study, fit_state
from litho_models.loop.judging import judge
from litho_models.loop.model import Twin
from litho_models.loop.search import Cause, Found
from litho_models.models import build_model
from litho_models.scan_terms.grouped import ALL
from tests.litho_models.loop_scans import (
    LEVEL_HEIGHT_UM,
    LEVELS,
    PITCH_UM,
    bare_state,
    planted,
    study_of,
)


def values_of(name: str) -> dict[str, float]:
    effect = get_effect(name)
    return effect.with_values(effect.trials[0])


def share(planted_name: str, fitted_name: str, beside: tuple[str, ...] = (), seed: int = 0) -> float:
    """Return the additional gain that other shapes of the fitted effect would bring, divided by its own gain.

    The effects ``beside`` act on the print but are not fitted.
    """
    effects = [(name, ALL, {"": values_of(name)}) for name in (planted_name, *beside)]
    study = study_of(planted(effects, seed=seed))
    without = bare_state(study)
    state = fit_state(without.twin.with_effect(fitted_name, ALL, {"": values_of(fitted_name)}), study)
    gain = without.mse_nm2 - state.mse_nm2
    assert gain > 0
    return reshaped_gain(without, state) / gain


@pytest.mark.parametrize("name", ["slope-x-power", "curvature-x", "slope-thinning"])
def test_the_formula_of_the_cause_leaves_nothing_of_its_shape(name: str) -> None:
    assert share(name, name) < FORM_SHARE


def test_a_mimic_is_refused() -> None:
    """Check that curvature is refused as the name of a loss on slopes that grows with the height."""
    assert share("height-times-slope-size-x", "curvature-x") > FORM_SHARE


def test_another_missing_cause_does_not_refuse_a_name() -> None:
    assert share("slope-thinning", "slope-thinning", beside=("write-order-memory",)) < FORM_SHARE


def test_the_shapes_of_a_change_are_those_of_its_pixels_whatever_their_size() -> None:
    """Check that the shapes do not depend on the pitch, except for slopes, which are measured per length."""
    rng = np.random.default_rng(0)
    change, prediction, layout = rng.random((3, 48, 40))

    def shapes(pitch_um: float) -> list[np.ndarray]:
        context = SimpleNamespace(pitch_um=pitch_um)
        return checking._shapes(change, prediction, SimpleNamespace(layout_um=layout, context=context))

    coarse, fine = shapes(0.1), shapes(0.004)
    assert all(np.allclose(a, b) for a, b in zip(coarse[:-4], fine[:-4], strict=True))
    assert all(np.allclose(0.1 * a, 0.004 * b) for a, b in zip(coarse[-4:], fine[-4:], strict=True))


def squared(squares_nm2: float) -> dict[str, object]:
    """Return residuals for ten scans. Each scan has one pixel, and the square of its residual is
    ``squares_nm2``.
    """
    return {
        "freed_um": [np.array([1e-3 * squares_nm2**0.5])] * 10,
        "freed_nm2": np.full(10, float(squares_nm2)),
        "mse_nm2": float(squares_nm2),
    }


def twin_at_limits(length: str = "") -> SimpleNamespace:
    """Return a substitute for a fitted model, of which the named length is at a limit of its range."""
    return SimpleNamespace(lengths_at_limits=lambda name: length, slots=())


@pytest.mark.parametrize(
    ("reshaped_nm2", "left_nm2", "length", "said"),
    [
        (1.4, 0.0, "", ""),  # the gain in other shapes is 14 %
        (1.6, 5.0, "", "would add 16 % to its gain"),
        (1.6, 5.4, "", ""),  # missing causes could explain more than three times as much
        # A length at the limit of its range means another effect, however well the form fits.
        (0.0, 0.0, "length_px", "outside the range of this effect: length_px"),
    ],
)
def test_a_name_is_refused_at_the_stated_limits(
    reshaped_nm2: float,
    left_nm2: float,
    length: str,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    study = Study((), np.empty(0))
    cause = Cause("slope-thinning", ALL, (), judge(np.full(10, 100.0), np.full(10, 90.0), study), 0.01, None)
    state = SimpleNamespace(
        **squared(90),
        twin=twin_at_limits(length),
        without=lambda name: leaving(100),
        study=study,
    )
    monkeypatch.setattr(checking, "reshaped_gain", lambda without, state: reshaped_nm2)
    one = Check(state, [cause], [], [], left_nm2, None).of(cause)
    assert one.judgement.gain_nm2 == pytest.approx(10)
    assert said in one.reason
    assert bool(one.reason) is bool(said)


STUDY = Study((), np.empty(0))


def gaining(name: str, gain_nm2: float) -> Cause:
    """Return a cause that reduces a squared error of 100 nm² by this gain in each of ten scans."""
    return Cause(name, ALL, (), judge(np.full(10, 100.0), np.full(10, 100.0 - gain_nm2), STUDY), 0.01, None)


def leaving(squares_nm2: float, without_nm2: float = 100.0) -> SimpleNamespace:
    """Return a model with this squared error in ten scans. If any of its effects is removed, the squared
    error is ``without_nm2``.
    """
    return SimpleNamespace(
        **squared(squares_nm2),
        twin=twin_at_limits(),
        without=lambda name: leaving(without_nm2),
        study=STUDY,
    )


@pytest.mark.parametrize(
    ("table_nm2", "beside_nm2", "falls"), [(21, 70, True), (21, 80, False), (19, 70, False)]
)
def test_a_name_is_refused_if_a_table_gains_twice_as_much_without_it(
    table_nm2: float, beside_nm2: float, falls: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = SimpleNamespace(name="level-table", gain_nm2=table_nm2)
    monkeypatch.setattr(checking, "describe", lambda *state: [table])
    monkeypatch.setattr(checking, "with_effect", lambda state, table, from_here: leaving(70, beside_nm2))
    cause = gaining("dose-exponent", 10)
    reason = Check(leaving(90), [cause], [], [], 0.0, None).beside_table(cause).reason
    assert bool(reason) is falls


def with_base(own: int, effects: int = 0, mse_nm2: float = 100.0) -> SimpleNamespace:
    """Return a model whose base has ``own`` fitted numbers. Its effects have ``effects`` more numbers."""
    return SimpleNamespace(twin=SimpleNamespace(own=own, vector=np.zeros(own + effects)), mse_nm2=mse_nm2)


@pytest.mark.parametrize(
    ("found_on", "knowledge"),
    [
        (["affine-mtf", "blur-table"], "cause"),
        (["affine-mtf"], "description"),
        (["blur-table"], "description"),
    ],
)
def test_a_cause_that_some_base_does_not_need_is_only_described(found_on: list[str], knowledge: str) -> None:
    """Check a smaller and a larger base than the chosen one."""
    cause = replace(gaining("dose-exponent", 10), survives_on=tuple(found_on))
    rivals = {name: with_base(own) for name, own in {"affine-mtf": 7, "blur-table": 14}.items()}
    others = dict.fromkeys(("base", "named", "lawful", "described", "rest", "untestable"))
    closed = Closed(base_name="physics", rivals=rivals, plain=with_base(7), **others)
    found = results._found(closed, cause, {}, 0.1)
    assert (found.knowledge, found.survives_on) == (knowledge, found_on)


def test_a_cause_survives_on_the_bases_that_need_it_beside_everything_found() -> None:
    """Check a blur that one base cannot make and another base contains."""
    blur = {"": {"variance_um2": 0.16}}
    study = study_of(planted([("diffusion-blur", ALL, blur)]))
    final = fit_state(bare_state(study).twin.with_effect("diffusion-blur", ALL, blur), study)
    causes = [gaining("diffusion-blur", 10)]
    facts = {"pitch_um": PITCH_UM, "level_height_um": LEVEL_HEIGHT_UM, "levels": LEVELS}
    for name, sigmas_um in (("sharp", (0.25,)), ("soft", (0.25, 0.4, 0.5))):
        base = build_model("affine-mtf", sigmas_um=sigmas_um, **facts)
        causes = closing._tested_on(name, fit_state(Twin.bare(base), study), final, causes)
    assert [one.survives_on for one in causes] == [("sharp",)]


@pytest.mark.parametrize(
    ("matters", "mses_nm2", "chosen"),
    [
        (True, {"affine-mtf": 97.9, "blur-table": 95.0}, "blur-table"),
        (True, {"affine-mtf": 97.9, "blur-table": 98.1}, "affine-mtf"),
        (True, {"affine-mtf": 98.1, "blur-table": 99.0}, ""),  # less than 2 % better
        (False, {"blur-table": 50.0}, ""),
        (True, {}, ""),
    ],
)
def test_the_next_base_fits_clearly_better_with_the_same_effects(
    matters: bool, mses_nm2: dict[str, float], chosen: str
) -> None:
    left = {name: with_base(7, mse_nm2=mse_nm2) for name, mse_nm2 in mses_nm2.items()}
    found = Found(SimpleNamespace(mse_nm2=100.0, on_base=lambda start: start))
    assert closing._next_base(left, found, lambda state: SimpleNamespace(matters=matters)) == chosen


@pytest.mark.parametrize(("better_nm2", "chosen"), [(98.1, "physics"), (97.9, "blur-table")])
def test_of_equally_good_bases_the_one_with_the_fewest_numbers_is_chosen(
    better_nm2: float, chosen: str
) -> None:
    """Check a base with more numbers, whose squared error is 1.9 % or 2.1 % smaller."""
    models = {
        "affine-mtf": with_base(7, 6),
        "blur-table": with_base(14, 1, better_nm2),
        "physics": with_base(7, 5),
    }
    found = {name: Found(model) for name, model in models.items()}
    assert closing._simplest({name: (own, own, own) for name, own in found.items()}) == chosen


@pytest.mark.parametrize(
    ("gain_nm2", "other", "corrected"),
    [(5.9, "slope-x-power", True), (6.1, "slope-x-power", False), (5.9, "trench-residue", False)],
)
def test_a_small_cause_beside_a_large_law_may_only_correct_it(
    gain_nm2: float, other: str, corrected: bool
) -> None:
    check = Check(leaving(30), [gaining(other, 60)], [], [], 0.0, None)
    assert check._larger(gaining("field-curvature", gain_nm2)) == (other if corrected else "")
