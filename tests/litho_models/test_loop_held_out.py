"""Screening sees residuals of fits that have not seen the scans, and a contest has a gate."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from litho_models.effects import get_effect
from litho_models.loop.fold_fits import FoldFits, predict
from litho_models.loop.parameters import get_vector
from litho_models.twin.prepared import prepare_scans
from litho_models.loop.selection import contest
from litho_models.loop.selection import search as selection
from litho_models.loop.study import State, Study, held_out_residuals
from litho_models.scan_terms import SCAN_TERMS
from tests.litho_models.loop_scans import printed_scans, true_model

FOLD_OF = np.array([0, 1, 2, 0])


def test_scans_are_screened_by_the_fit_that_has_not_seen_them() -> None:
    chain, scans = true_model({}), prepare_scans(printed_scans(count=4, seed=9))
    common = get_vector(chain)
    # Fits that differ in their bias alone, 10 nm from fold to fold.
    per_fold = np.stack([common + 0.01 * (fold + 1) * (np.arange(len(common)) == 4) for fold in range(3)])
    fits = FoldFits(chain, common, per_fold, np.zeros(3), np.eye(len(common)), [])
    state = State(fits, [predict(chain, per_fold[f], scan) for f, scan in zip(FOLD_OF, scans, strict=True)])
    for scan, fold, residual in zip(
        scans, FOLD_OF, held_out_residuals(state, Study(scans, FOLD_OF)), strict=True
    ):
        seen_by_all = scan.height - scan.at_sample(predict(chain, common, scan))
        assert np.allclose(seen_by_all - residual, 0.01 * (fold + 1), atol=1e-6)


@pytest.mark.parametrize("known_um", [0.13, None])
def test_the_tip_enters_a_contest_at_the_radius_that_the_store_found(known_um, monkeypatch) -> None:
    stored = printed_scans(count=4, seed=9)
    # As after `build --tip blind`, but for a first scan that says nothing.
    study = Study(
        prepare_scans([stored[0], *(replace(scan, tip_radius_um=known_um) for scan in stored[1:])]), FOLD_OF
    )
    tried: list[float] = []

    def hold(state: State, candidates, *_: object, **__: object) -> contest.Contest:
        tip = next(effect for effect in candidates if effect.name == "tip-dilation")
        tried.extend(trial["radius_um"] for trial in tip.trials)
        return contest.Contest([])

    monkeypatch.setattr(selection, "hold_contest", hold)
    chain = true_model({})
    nothing = FoldFits(chain, get_vector(chain), np.zeros((3, 1)), np.zeros(3), np.eye(1), [])
    selection.search_effects(State(nothing, []), study, frozenset({"offset"}), exclude={})
    own = [trial["radius_um"] for trial in get_effect("tip-dilation").trials]
    assert tried == own + ([known_um] if known_um else [])


@pytest.mark.parametrize(("gain_nm2", "named"), [(120.0, ["interface-offset"]), (80.0, [])])
def test_after_a_refusal_another_is_named_only_if_it_does_as_much(gain_nm2, named, monkeypatch) -> None:
    """A first candidate that a generic term beats hides no better one, and lets no smaller one in."""
    chain = true_model({})
    fits = FoldFits(chain, get_vector(chain), np.zeros((3, 1)), np.zeros(3), np.eye(1), [])
    state = State(fits, [])
    winners = {"dose-exponent": 100.0, "interface-offset": gain_nm2}

    def hold(state: State, candidates, *_: object, refused=(), **__: object) -> contest.Contest:
        taking_part = [effect for effect in candidates if effect.name in winners]
        screened = [SimpleNamespace(effect=effect) for effect in taking_part]
        left = [effect for effect in taking_part if effect.name not in refused]
        if not left:
            return contest.Contest(screened)
        there = State(replace(fits, chain=chain.with_effects({left[0].name: {}})), [])
        return contest.Contest(screened, winner=(SimpleNamespace(effect=left[0]), there))

    def gain(before: State, after: State, *_: object) -> float:
        return winners[after.fits.chain.names[0]]

    def reason(winner, *_: object) -> str:
        return "a table does the same" if winner[0].effect.name == "dose-exponent" else ""

    monkeypatch.setattr(selection, "hold_contest", hold)
    monkeypatch.setattr(selection, "_gain_nm2", gain)
    monkeypatch.setattr(selection, "rejection_reason", reason)
    study = Study(prepare_scans(printed_scans(count=4, seed=9)), FOLD_OF)
    found = selection.search_effects(state, study, frozenset({"offset"}), exclude={})
    assert found.names == named
    # What was refused is still a suspect, with its reason.
    assert "dose-exponent" in found.last
    assert found.failures["dose-exponent"] == "a table does the same"
    assert ("interface-offset" in found.failures) == (not named)


@pytest.mark.parametrize(
    ("errors", "winner"),
    [
        # Best by the sum of all training sets, but in half of them only.
        (([1.0, 1.0, 9.0, 9.0], [9.0, 9.0, 2.0, 2.0]), "diffusion-blur"),
        (([1.0, 1.0, 1.0, 9.0], [9.0, 9.0, 9.0, 2.0]), "vignetting"),
        (([1.0, 1.0, 1.0, 1.0], [2.0, 2.0, 2.0, 2.0]), "vignetting"),
    ],
)
def test_a_contest_takes_nobody_on_whom_the_training_sets_do_not_agree(errors, winner, monkeypatch) -> None:
    names = ("vignetting", "diffusion-blur")
    screened = [
        SimpleNamespace(effect=get_effect(name), mean_gain_nm2=100.0, projection="full") for name in names
    ]
    entrants = [
        SimpleNamespace(name=s.effect.name, screened=s, state=object(), training_error=np.array(e))
        for s, e in zip(screened, errors, strict=True)
    ]
    passed = SimpleNamespace(confirmation=SimpleNamespace(passed=True, reason=""))
    held_out, from_held_out = [np.zeros(3)], object()
    replaced = {
        "held_out_residuals": lambda *_: held_out,
        # Candidates are screened by what the fits that have not seen a scan leave of it, and by nothing else.
        "measure_directions": lambda _, __, residuals, ___: from_held_out if residuals is held_out else None,
        "screen": lambda directions, _: screened if directions is from_held_out else [],
        "is_eligible": lambda *_: True,
        "shortlist": lambda _, remaining, __: (remaining, []),
        "_fitted": lambda _, entering, __: [e for e in entrants if e.screened in entering],
        # Changes of different shape: nobody stands for anybody else.
        "_changes": lambda _, state, __: [np.eye(2)[[e.state for e in entrants].index(state)]],
        "judged": lambda *_: passed,
    }
    for name, stand_in in replaced.items():
        monkeypatch.setattr(contest, name, stand_in)
    score = SimpleNamespace(mse_nm2=np.array([1000.0]))
    state = SimpleNamespace(fits=None, score=lambda *_: score)
    study = Study([], np.array([0, 1, 2, 3]))
    held = contest.hold_contest(state, [get_effect(name) for name in names], study, frozenset({"offset"}))
    assert held.winner is not None
    assert held.winner[1] is entrants[names.index(winner)].state
    refused = held.failures.get("vignetting", "")
    assert ("the best in only 2 of 4 training sets" in refused) == (winner != "vignetting")


def test_a_scan_term_and_its_effect_say_the_same() -> None:
    for term in SCAN_TERMS.values():
        if term.effect is not None:
            assert get_effect(term.effect).role == term.role
            assert term.lines is not None or get_effect(term.effect).per_scan
