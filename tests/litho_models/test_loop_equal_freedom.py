"""Whose the gain is, and whether it lasts where the choice was made without the scans it is judged on."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_models.effects import get_effect
from litho_models.loop import LoopConfig, close_loop, nested
from litho_models.loop.choice import Choice
from litho_models.loop.gain_split import GainStep, split_gain
from litho_models.loop.nested import Nested, nest
from litho_models.twin.prepared import prepare_scans
from litho_models.loop.probes.selection import with_generic_terms
from litho_models.loop.selection.search import EffectSets, Search
from litho_models.loop.study import DATUM_FREE, Study, deal, fit_state
from litho_models.models import build_model
from tests.litho_models.loop_scans import printed_scans, true_model

PLANTED = {"vignetting": {"strength": 0.2}}


def accepting(*names: str) -> list:
    return [SimpleNamespace(effect=get_effect(n), confirmation=SimpleNamespace(passed=True)) for n in names]


@pytest.fixture(scope="module")
def split() -> tuple[Choice, dict[str, GainStep]]:
    """One effect and two generic terms on a base that is right otherwise; a gain at first, a bow at last."""
    random, scans = np.random.default_rng(3), []
    for scan in printed_scans(PLANTED, count=6, size_px=96, seed=1):
        across = 0.01 * np.sin(np.linspace(0, 3 * np.pi, scan.shape[0]))[:, None]
        height = scan.height_um * (1 + 0.03 * random.normal()) + 0.05 * (scan.mask_level == 6) + across
        scans.append(replace(scan, height_um=height.astype(np.float32)))
    study = Study(prepare_scans(scans), np.arange(6) % 3)
    chain = true_model({})
    chain.base.requires_grad_(False)
    base, named = (fit_state(chain.with_effects(own), study) for own in ({}, PLANTED))
    search = Search(named, added=[SimpleNamespace(effect=get_effect("vignetting"))])
    search.steps["vignetting"] = base, named
    probes = ["row-profile", "level-table"]
    final = with_generic_terms(named, study, probes)
    probed = SimpleNamespace(
        state=final, added=[SimpleNamespace(probe=SimpleNamespace(name=p)) for p in probes]
    )
    first, last = accepting("datum-offset", "z-gain"), accepting("datum-offset", "z-gain", "tilt-bow")
    choice = Choice(study, base, named, search, probed, first, last, [], {})
    steps = split_gain(choice, EffectSets(search, base, study))
    return choice, {step.name: step for step in steps}


def test_the_steps_sum_to_the_whole_in_the_order_added(split) -> None:
    choice, steps = split
    assert list(steps) == ["z-gain", "vignetting", "row-profile", "level-table", "tilt-bow"]
    assert [step.k for step in steps.values()] == [2, 2, 2, 2, 7]
    before, k1, after = (
        state.score(choice.study, terms).mean_mae_nm
        for state, terms in (
            (choice.base, DATUM_FREE),
            (choice.final, DATUM_FREE),
            (choice.final, choice.terms),
        )
    )
    assert sum(step.in_order_nm for step in steps.values()) == pytest.approx(before - after, abs=1e-9)
    assert sum(step.in_order_k1_nm for step in steps.values()) == pytest.approx(before - k1, abs=1e-9)


def test_single_scans_gain_nothing_at_equal_terms_and_what_was_planted_gains_in_any_order(split) -> None:
    _, steps = split
    for name in ("z-gain", "tilt-bow"):
        assert steps[name].in_order_k1_nm == steps[name].left_out_k1_nm == 0
    assert steps["z-gain"].in_order_nm > 1
    own = steps["vignetting"]
    assert min(own.in_order_nm, own.in_order_k1_nm, own.left_out_nm, own.left_out_k1_nm) > 1


def test_what_is_left_out_is_missing_from_the_final_set_and_the_rest_estimated_anew(split) -> None:
    choice, steps = split
    without = {
        "vignetting": with_generic_terms(choice.base, choice.study, ["row-profile", "level-table"]),
        "row-profile": with_generic_terms(choice.search.state, choice.study, ["level-table"]),
        # The last one added: without it stands what was there before it.
        "level-table": with_generic_terms(choice.search.state, choice.study, ["row-profile"]),
    }
    for name, state in without.items():
        for terms, lost in (
            (DATUM_FREE, steps[name].left_out_k1_nm),
            (choice.terms, steps[name].left_out_nm),
        ):
            worse, final = (s.score(choice.study, terms).mean_mae_nm for s in (state, choice.final))
            assert lost == pytest.approx(worse - final, abs=1e-9)
    assert steps["level-table"].left_out_k1_nm == pytest.approx(steps["level-table"].in_order_k1_nm, abs=1e-9)


@pytest.fixture(scope="module")
def chosen_anew(tmp_path_factory) -> tuple[Nested, Study, list[set[str]]]:
    """A selection without each of three prints; and of each selection the prints that it was made on."""
    scans = prepare_scans(printed_scans(PLANTED, count=12, seed=1))
    study = Study(scans, deal(scans, 3, 0))
    base, seen = build_model("physics", sigma_diffusion_init_um=0.4), []
    cache, choose = tmp_path_factory.mktemp("cache"), nested.choose
    with pytest.MonkeyPatch.context() as patch:

        def watched(inner: Study, model) -> Choice:
            seen.append({scan.stored.print_id for scan in inner.scans})
            return choose(inner, model)

        patch.setattr(nested, "choose", watched)
        first = nest(study, base, "prints", cache)
        # The second time everything is kept.
        again = nest(study, base, "prints", cache)
    for name in first.scores:
        for a, b in zip(first.scores[name], again.scores[name], strict=True):
            assert (a.mae_nm == b.mae_nm).all()
    assert len(seen) == len(first.parts) == 3
    return first, study, seen


@pytest.mark.slow
def test_nothing_is_chosen_on_the_print_that_it_is_judged_on(chosen_anew) -> None:
    found, study, seen = chosen_anew
    held_out = [{scan.stored.print_id for scan in part.scans} for part in found.parts]
    assert held_out == [{"0"}, {"1"}, {"2"}]
    assert all(own.isdisjoint(others) for own, others in zip(held_out, seen, strict=True))
    assert sorted(scan.id for part in found.parts for scan in part.scans) == [s.id for s in study.scans]


@pytest.mark.slow
def test_a_planted_effect_is_chosen_in_every_selection_and_its_gain_lasts(chosen_anew) -> None:
    found, study, _ = chosen_anew
    assert all(part.named == ["vignetting"] for part in found.parts)
    before, after = found.scores["offset"]
    assert (after.mae_nm < 0.8 * before.mae_nm).all()
    # As good as the true model: eight scans pin the parameters down to a few percent of the error.
    truth = true_model(PLANTED)
    ideal = study.score([truth(s.layout, s.context)[0, 0].detach().numpy() for s in study.scans], DATUM_FREE)
    assert after.mean_mae_nm < 1.1 * ideal.mean_mae_nm


def test_a_base_that_is_not_fitted_here_has_no_nested_selection() -> None:
    trained = true_model({}).requires_grad_(False)
    with pytest.raises(InputError, match="nested selection"):
        close_loop(printed_scans(count=4), trained, LoopConfig(nested="prints"))
