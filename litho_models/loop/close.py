"""Close the loop: from the residual of a model on measured prints to named causes and a better model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from torch import nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.sending import Known
from litho_data.foundation.workers import HERE, Workers
from litho_data.store.again import StoredScans
from litho_data.store.lock_box import locked_ids
from litho_data.store.read import PrintedScan
from litho_models.effects import get_effect
from litho_models.loop.choice import Choice, choose, passed
from litho_models.loop.equal_terms import scores_elsewhere
from litho_models.loop.explainable import GENERIC_TERMS, Learner, Rest
from litho_models.loop.findings import LoopConfig, LoopFindings, loop_config
from litho_models.loop.folded_base import Trainer
from litho_models.loop.gain_split import split_gain
from litho_models.loop.identifiability import identifiability, profiles
from litho_models.loop.nested import nest
from litho_models.loop.parameters import is_refitted
from litho_models.loop.prepared import by_name, prepare_scans, prepared_again
from litho_models.loop.probes.layout import LAYOUT_FEATURES
from litho_models.loop.screening.power import parse_injection, plant
from litho_models.loop.selection.search import EffectSets
from litho_models.loop.selection.weight import weigh_effects
from litho_models.loop.single_scans.observed import observe
from litho_models.loop.structure import covariate_tests
from litho_models.loop.study import DATUM_FREE, State, Study, deal, names_to_terms, noise_lower_bound_nm


def close_loop(
    scans: Sequence[PrintedScan],
    base: nn.Module,
    config: LoopConfig | None = None,
    *,
    trainer: Trainer | None = None,
    rounding_um: Mapping[str, float] | None = None,
    lock_box: Sequence[str] | None = None,
    cache: Path | None = None,
    workers: Workers = HERE,
    stored: StoredScans | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> LoopFindings:
    """Find what the base model lacks on these scans, add it, and measure the error on held-out scans.

    Args:
        scans: measured prints, all of one pitch and one level height.
        base: simulator; one with few parameters is refitted, another is taken as it is.
        config: settings.
        trainer: makes a fresh base model from scans, for a base with many parameters: it is then
            trained once per fold, and effects are looked for on a Physics model first.
        rounding_um: step of the heights in each scan's raw file, by id, if known.
        lock_box: ids of the locked scans; ``locked_ids`` of ``scans`` if None. Neither the seed nor the
            scans left out of ``scans`` may change it: whoever holds them all says which are locked.
        cache: folder where the finished parts of a nested selection are kept.
        workers: where independent fits, trainings and selections are made.
        stored: where other processes find ``scans``; without it they are sent with each job.
        report: told what happens, a sentence at a time.

    Raises:
        InputError: fewer than two usable scans outside the lock box, an unknown effect among the prior
            hypotheses, or a nested selection for a base that is not refitted.
    """
    config = loop_config(config)
    for name in config.prior_hypotheses:
        get_effect(name)
    for text in config.inject:
        parse_injection(text)
    if config.nested and not is_refitted(base):
        raise InputError(
            "nested selection",
            got="a base that is not fitted here, or has many parameters",
            wanted="one with few parameters, by its name",
            hint="it is fitted anew in every selection: --base physics, for example",
        )
    every = prepare_scans(scans)
    if stored is not None:
        workers = replace(workers, known=Known(partial(prepared_again, stored), by_name(every)))
    prepared = [scan for scan in every if len(scan.sample) >= 64]
    lock_box = locked_ids(scans) if lock_box is None else list(lock_box)
    development = [scan for scan in prepared if scan.id not in lock_box]
    locked = [scan for scan in prepared if scan.id in lock_box]
    if len(development) < 2:
        raise InputError(
            "scans to close the loop on",
            got=f"{len(development)} usable and not locked",
            wanted="at least 2",
        )
    fold_of = deal(development, config.folds, config.seed)
    study = Study(
        development, fold_of, config.seed, config.loss, config.weights, workers=workers, report=report
    )
    choice = choose(study, base, trainer, announce=True)
    final, search = choice.final, choice.search
    terms = DATUM_FREE | names_to_terms(passed(choice.first_tests))
    planted = []
    for text in config.inject:
        report(f"planting {text}")
        planted += plant(text, choice.guide, choice.study, terms)
    report("measuring what could still be learned")
    learner = Learner(choice.study, choice.base.predictions)
    reported = replace(choice.study, background=config.background)
    choice = replace(choice, study=reported)
    fitted = EffectSets(search, choice.base, reported)
    return LoopFindings(
        **vars(choice),
        locked=locked,
        lock_box=lock_box,
        floor_nm=noise_lower_bound_nm(development, final.predictions),
        structure=covariate_tests(development, choice.probed.traced.predictions)
        if choice.probed.added
        else choice.left_by_named,
        explainable=_explainable(choice, learner),
        weights=weigh_effects(search, choice.probed.traced, choice.study, learner, fitted),
        locked_scores=scores_elsewhere(choice, locked) if config.open_lock_box and locked else None,
        observed=observe(choice.study, final.predictions, choice.terms, choice.probed.defects, rounding_um),
        identifiability=identifiability(search.state.fits),
        profiles=profiles(search.state.fits, study.windows),
        gain_steps=split_gain(choice, fitted),
        planted=planted,
        nested=nest(reported, base, config.nested, cache) if config.nested else None,
        config=config,
    )


def _explainable(choice: Choice, learner: Learner) -> dict[str, Rest]:
    """What layout and place still explain: beside the base, after each effect and all terms, and at last."""
    search = choice.search
    stages = {"base": choice.base} | {f"with {name}": after for name, (_, after) in search.steps.items()}
    stages |= {"named effects": search.state, GENERIC_TERMS: choice.probed.traced}
    stages |= {LAYOUT_FEATURES: choice.final}
    rests: dict[str, Rest] = {}
    seen: list[State] = []
    for name, state in stages.items():
        if not any(state is other for other in seen):
            seen.append(state)
            rests[name] = learner.rest(state.predictions)
    return rests
