"""Check that the search finds every planted effect with its grouping, and no other effect."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from litho_models.effects import CATALOGUE, get_effect
from litho_models.loop.closing import _in_model
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.judging import CONFIRM_P, FEWEST_SCANS, judge, judge_states, told_apart
from litho_models.loop.model import Twin, Values
from litho_models.loop.search import (
    Found,
    describe,
    same_change,
    search,
    separating,
    untestable,
)
from litho_models.models import build_model
from litho_models.scan_terms.grouped import ALL
from litho_models.scoring.statistics import one_sided_flip_p
from tests.litho_models.loop_scans import bare_state, planted, study_of

CANDIDATES = [
    get_effect(name)
    for name in ("slope-thinning", "long-range-proximity", "write-order-memory", "trench-residue")
]
THINNING, MEMORY = "slope-thinning", "write-order-memory"


def thinning(along_x_um: float) -> dict[str, float]:
    return get_effect(THINNING).with_values({"along_x_um": along_x_um, "exponent": 1.0})


def memory(strength: float) -> dict[str, float]:
    return {"strength": strength, "length_um": 3.0, "direction": 1.0}


def found_in(*effects: tuple[str, str, Values], **facts: int) -> Found:
    study = study_of(planted(effects, **facts))
    return search(Found(bare_state(study)), CANDIDATES)


def added(found: Found) -> dict[str, str]:
    return {cause.name: cause.by for cause in found.causes}


@pytest.fixture(scope="module")
def in_all_scans() -> Found:
    """Return what a search finds where all scans have the same loss on slopes."""
    return found_in((THINNING, ALL, {"": thinning(0.2)}))


def test_a_cause_in_half_of_the_scans_is_found_with_its_grouping() -> None:
    found = found_in((THINNING, "field", {"1": thinning(0.0), "2": thinning(0.2)}))
    assert added(found) == {THINNING: "field"}
    cause = found.causes[0]
    # Half of the scans gain nothing. The cause is not refused, because its labels tell which scans gain.
    assert cause.group_p is not None
    assert cause.group_p < 0.05
    assert cause.judgement.improved[0] >= 5
    first, second = (found.state.twin.values(scan)[THINNING] for scan in found.state.study.scans[:2])
    assert second["along_x_um"] == pytest.approx(0.2, rel=0.1)
    assert first["along_x_um"] < 0.02
    assert np.sqrt(found.state.mse_nm2) == pytest.approx(4.0, rel=0.06)


@pytest.mark.parametrize("needed", [True, False])
def test_a_search_keeps_of_its_first_causes_what_it_needs(needed: bool, in_all_scans: Found) -> None:
    """Check a search that starts from a cause that another base lacked. The present base either lacks it too,
    or does not.
    """
    lacking = [(MEMORY, ALL, {"": memory(0.3)}), (THINNING, ALL, {"": thinning(0.2)})][: 1 + needed]
    start = bare_state(study_of(planted(lacking, seed=1)))
    found = search(Found(in_all_scans.state.on_base(start), [*in_all_scans.causes]), CANDIDATES)
    assert added(found) == {name: ALL for name, *_ in lacking}
    if not needed:
        assert found.refused[THINNING]


def test_a_cause_in_all_scans_is_found_with_one_strength(in_all_scans: Found) -> None:
    assert added(in_all_scans) == {THINNING: ALL}
    (cause,) = in_all_scans.causes
    assert cause.group_p is None
    assert cause.family_p <= 0.05
    assert cause.judgement.improved == (10, 10)


def test_a_loss_along_a_diagonal_is_the_cause_with_its_direction() -> None:
    found = found_in((THINNING, ALL, {"": {**thinning(0.2), "turn_deg": 35.0}}))
    assert added(found) == {THINNING: ALL}
    values = found.state.twin.values()[THINNING]
    # A frame rotated by 35° equals one rotated by -55° with its axes swapped.
    assert values["along_x_um"] == pytest.approx(0.2, rel=0.1)
    assert values["turn_deg"] == pytest.approx(35, abs=3)


def test_what_only_a_table_describes_enters_the_corrected_model() -> None:
    table = get_effect("level-table")
    strengths = {name: 0.03 * (-1) ** number for number, name in enumerate(table.amplitudes)}
    study = study_of(planted([("level-table", ALL, {"": strengths})]))
    state = bare_state(study)
    found = _in_model(state, describe(state, [table], 1))
    assert added(found) == {"level-table": ALL}
    assert state.mse_nm2 > 2 * found.state.mse_nm2
    # The residual is the noise.
    assert np.sqrt(found.state.mse_nm2) == pytest.approx(4.0, rel=0.06)
    assert _in_model(state, []).state is state


def test_two_causes_are_found_together_each_with_its_grouping() -> None:
    found = found_in(
        (MEMORY, ALL, {"": memory(0.1)}), (THINNING, "field", {"1": thinning(0.05), "2": thinning(0.2)})
    )
    assert added(found) == {MEMORY: ALL, THINNING: "field"}
    assert np.sqrt(found.state.mse_nm2) == pytest.approx(4.0, rel=0.06)
    for name in (MEMORY, THINNING):
        assert found.last[name].name == found.first[name].name == name


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_found_in_noise(seed: int) -> None:
    found = found_in(seed=seed)
    assert found.causes == []
    assert found.state.twin.names == ()
    assert set(found.first) == {effect.name for effect in CANDIDATES}


def test_too_few_scans_confirm_nothing_and_the_reason_says_so() -> None:
    found = found_in((THINNING, ALL, {"": thinning(0.2)}), count=FEWEST_SCANS - 2)
    assert found.causes == []
    assert found.refused[THINNING].startswith(f"{FEWEST_SCANS - 2} scans are too few")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "values", "beside"),
    [
        # One diagonal is 0.3 µm wider, in quadrature. More than half of this is plain blur.
        ("elliptical-psf", {"shear_um2": 0.09}, ["diffusion-blur", "galvo-lag"]),
        # Unlike shrinkage, a loss of height at the foot lowers every place by the same amount.
        ("interface-offset", {"depth_um": 0.25}, ["vertical-shrinkage", "height-saturation"]),
        # Each scan may have its own row offsets, which could hide the cause.
        (
            "hatch-ripple",
            {"cosine_um": 0.006, "sine_um": 0.004, "frequency_per_um": 0.31},
            ["slope-thinning"],
        ),
        # Bare places are not tilted with the print. A tilt of the microscope would tilt them too.
        ("field-curvature", {"tilt_x_um": 0.06, "tilt_y_um": -0.04}, ["vignetting"]),
    ],
)
def test_a_cause_that_another_resembles_is_found(
    name: str, values: dict[str, float], beside: list[str]
) -> None:
    """Check causes on a Physics base. Its blur, gain and saturation are fitted together with the cause."""
    base = build_model("physics", sigma_diffusion_init_um=0.3, alpha_init=2.0, eta_init=0.4)
    effect = get_effect(name)
    scans = planted(
        [(name, ALL, {"": effect.with_values(values)})], base=base, count=FEWEST_SCANS, size_px=64
    )
    study = study_of(scans)
    start = fit_state(Twin.bare(build_model("physics")), study)
    found = search(Found(start), [effect, *map(get_effect, beside)])
    assert added(found) == {name: ALL}
    assert found.causes[0].alike == ()


def test_no_more_effects_than_asked_for() -> None:
    study = study_of(planted([(THINNING, ALL, {"": thinning(0.15)})]))
    assert search(Found(bare_state(study)), CANDIDATES, most=0).causes == []


def test_a_change_is_the_same_as_itself_scaled_and_no_other() -> None:
    study = study_of(planted([(THINNING, ALL, {"": thinning(0.15)}), (MEMORY, ALL, {"": memory(0.1)})]))
    bare = bare_state(study)
    one = fit_state(bare.twin.with_effect(THINNING, ALL, {"": thinning(0.1)}), study)
    other = fit_state(bare.twin.with_effect(MEMORY, ALL, {"": memory(0.05)}), study)
    half = replace(
        one, held_out_um=[(a + b) / 2 for a, b in zip(bare.held_out_um, one.held_out_um, strict=True)]
    )
    assert same_change(bare, one, half)
    assert same_change(bare, other, one) is same_change(bare, one, other) is False


# The judgement of single causes, tested with given numbers

STUDY = Study((), np.empty(0))


def test_a_gain_in_all_scans_is_confirmed_and_one_in_half_only_by_group() -> None:
    before = np.full(10, 100.0)
    assert judge(before, np.full(10, 90.0), STUDY).reason() == ""
    half = judge(before, before - 20.0 * (np.arange(10) % 2), STUDY)
    # All five gains are positive, which is one of 2^5 arrangements of signs.
    assert half.p == pytest.approx(2**-5)
    assert half.reason()
    assert not half.reason("field")
    assert half.improved == (5, 10)


def test_a_common_strength_too_large_for_some_scans_is_evidence_all_the_same() -> None:
    """Check a cause in all scans. Its strength is 0.4 times as large in three of the scans, and the mean
    strength makes these scans worse.
    """
    strengths = np.where(np.arange(10) < 3, 0.4, 1.0)
    noise = np.random.default_rng(0).normal(size=(10, 50_000))
    change = np.random.default_rng(1).normal(size=50_000)

    def state(common: float) -> State:
        left_um = 1e-3 * (noise + (strengths[:, None] - common) * change)
        return State(STUDY, Twin.bare(build_model("affine")), [], [], [*left_um], [*left_um])

    judged = judge_states(state(0.0), state(strengths.mean()))
    assert judged.improved == (7, 10)
    assert one_sided_flip_p(judged.gains_nm2) > CONFIRM_P
    assert judged.p == pytest.approx(2**-10)
    # The gain of a scan is s² - (s - m)² for its strength s and the mean strength m, plus noise.
    gains = strengths**2 - (strengths - strengths.mean()) ** 2
    np.testing.assert_allclose(judged.gains_nm2, gains, atol=4 * 2 / 50_000**0.5)
    assert not judged.reason()


def test_the_reason_says_what_is_missing() -> None:
    before = np.full(10, 100.0)
    signs = np.where(np.arange(10) % 2, 1.0, -1.0)
    assert judge(before[:7], before[:7] - 50, STUDY).reason().startswith("7 scans are too few: at least 8")
    assert judge(before, before - 10 * signs, STUDY).reason().startswith("only 5 of 10 held-out")
    assert judge(before, before - 0.1, STUDY).reason() == "the gain of 0.10 % is too small to matter"
    assert judge(before, before - 10, STUDY).reason() == ""
    # Five scans gain 36 and five lose 10, so the mean gain is 13 with a standard error of 7.
    torn = judge(before, before - np.array([36.0, -10.0] * 5), STUDY)
    assert torn.low_nm2 < 0 < torn.gain_nm2
    includes_zero = "the confidence interval of the gain on held-out scans includes zero"
    assert replace(torn, p=0.0).reason() == includes_zero


def test_a_gain_matters_from_two_percent_of_the_squared_error() -> None:
    before = np.full(8, 400.0)
    assert judge(before, before - 8.1, STUDY).reason() == ""
    assert "too small to matter" in judge(before, before - 7.9, STUDY).reason()


def leaving(squares_nm2: np.ndarray) -> SimpleNamespace:
    """Return a model with these squared errors."""
    return SimpleNamespace(freed_nm2=squares_nm2, mse_nm2=squares_nm2.mean(), study=STUDY)


def test_a_rival_is_told_apart_by_a_quarter_of_the_gain_in_all_scans() -> None:
    before, best = leaving(np.full(10, 100.0)), leaving(np.full(10, 60.0))
    assert told_apart(before, best, leaving(np.full(10, 71.0)))
    assert not told_apart(before, best, leaving(np.full(10, 69.0)))
    mixed = best.freed_nm2 + np.where(np.arange(10) % 3, 20.0, -20.0)
    assert judge(mixed, best.freed_nm2, STUDY).p > CONFIRM_P
    assert not told_apart(before, best, leaving(mixed))


def test_what_scans_cannot_test_is_said_before_any_fit() -> None:
    scans = planted()
    flat = [replace(scan, mask_level=np.full_like(scan.mask_level, 3)) for scan in scans]
    assert set(untestable(study_of(flat))) == {name for name, one in CATALOGUE.items() if not one.per_scan}
    unordered = [replace(scan, order=0) for scan in scans]
    needing = {name for name, one in CATALOGUE.items() if "order" in one.needs and not one.per_scan}
    assert set(untestable(study_of(unordered))) == needing
    assert needing
    # An effect of the order cannot be told from a difference between two groups of scans.
    halves = [replace(scan, order=number // 5) for number, scan in enumerate(scans)]
    reasons = untestable(study_of(halves))
    assert set(reasons) == needing
    assert set(reasons.values()) == {"the scans have only two positions in the writing order"}
    by_light = [replace(scan, seen_by="confocal") for scan in scans]
    assert set(untestable(study_of(by_light))) == {"tip-dilation", "feedback-lag"}
    for tested in (scans, [flat[0], *scans[1:]]):
        assert untestable(study_of(tested)) == {}


def test_an_experiment_that_separates_a_set_is_named_once() -> None:
    text = get_effect(THINNING).separating
    assert separating([THINNING, THINNING]) == text
    assert separating([THINNING, MEMORY]) == f"{text}; {get_effect(MEMORY).separating}"
