"""Close the loop: from the residual of a model on measured prints to named causes and a better model."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from torch import nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.store.lock_box import locked_ids
from litho_data.store.read import PrintedScan
from litho_models.effects import CATALOGUE, UNTESTABLE, get_effect
from litho_models.effects.chain import EffectChain
from litho_models.loop.findings import Closed, LoopConfig
from litho_models.loop.fitting import predict
from litho_models.loop.flexible import Trainer, carry_over, same_for_all, train_folds
from litho_models.loop.identifiability import identifiability, profiles
from litho_models.loop.parameters import is_stiff
from litho_models.loop.prepared import Field, prepare_fields
from litho_models.loop.probes import Probed, probe_residual
from litho_models.loop.scoring import DATUM_FREE, Score, names_to_terms, score
from litho_models.loop.screening.power import parse_injection, plant
from litho_models.loop.selection.search import search_effects
from litho_models.loop.single_scans.observed import observe
from litho_models.loop.single_scans.tests import MeasurementTest, measurement_tests
from litho_models.loop.state import State, fit_state
from litho_models.loop.structure import covariate_tests, is_structured
from litho_models.models import build_model
from litho_models.splits.folds import grouped_folds


def close_loop(
    scans: Sequence[PrintedScan],
    base: nn.Module,
    config: LoopConfig | None = None,
    *,
    trainer: Trainer | None = None,
    rounding_um: Mapping[str, float] | None = None,
    lock_box: Sequence[str] | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> Closed:
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
        report: told what happens, a sentence at a time.

    Raises:
        InputError: fewer than two usable scans outside the lock box, or an unknown effect among the prior
            hypotheses.
    """
    config = config or LoopConfig.model_validate({})
    for name in config.prior_hypotheses:
        get_effect(name)
    for text in config.inject:
        parse_injection(text)
    fields = [field for field in prepare_fields(scans) if len(field.sample) >= 64]
    lock_box = locked_ids(scans) if lock_box is None else list(lock_box)
    development = [field for field in fields if field.id not in lock_box]
    locked = [field for field in fields if field.id in lock_box]
    if len(development) < 2:
        raise InputError(
            "scans to close the loop on",
            got=f"{len(development)} usable and not locked",
            wanted="at least 2",
        )
    fold_of = _folds(development, config)
    first = development[0]
    stiff = is_stiff(base)
    chain = EffectChain(
        copy.deepcopy(base) if stiff else _stiff_guide(first.scan),
        {},
        full_height_um=first.context.full_height_um,
        pitch_um=first.context.pitch_um,
    )
    report(f"fitting the base model on {len(development)} scans")
    start = fit_state(chain, development, fold_of)
    untestable = dict(UNTESTABLE) | _untestable(development)
    floor = noise_lower_bound_nm(development, start.predictions)

    def test_single_scans(state: State) -> list[MeasurementTest]:
        return measurement_tests(
            development, state.predictions, fold_of, floor_nm2=floor[0] ** 2, seed=config.seed
        )

    report("testing what single scans add")
    first_tests = test_single_scans(start)
    terms = DATUM_FREE | names_to_terms(_passed(first_tests))
    search = search_effects(
        start,
        development,
        fold_of,
        terms,
        exclude=untestable,
        floor_nm2=floor[0] ** 2,
        seed=config.seed,
        report=report,
    )
    guide = search.state
    if not stiff:
        report("training the base model" if trainer else "predicting with the base model as it is")
        folded = train_folds(development, fold_of, trainer) if trainer else same_for_all(base, development)
        start, search = carry_over(
            search,
            folded,
            development,
            fold_of,
            terms,
            floor_nm2=floor[0] ** 2,
            seed=config.seed,
            report=report,
        )
        # What single scans add to the model that is reported, not to the guide.
        first_tests = test_single_scans(start)
    report("testing what is left for structure")
    # Effects that displace a print leave a shift in every scan, which its registration then takes up.
    between = first_tests if search.state is start else test_single_scans(search.state)
    left = covariate_tests(development, search.state.predictions)
    probed = probe_residual(
        search.state,
        development,
        fold_of,
        DATUM_FREE | names_to_terms(_passed(between)),
        floor_nm2=floor[0] ** 2,
        seed=config.seed,
        search=bool(is_structured(left)),
        report=report,
    )
    final = probed.state
    last_tests = test_single_scans(final) if probed.added else between
    accepted = _passed(last_tests)
    planted = []
    for text in config.inject:
        report(f"planting {text}")
        planted += plant(text, guide, development, fold_of, terms, config.seed)
    return Closed(
        development=development,
        locked=locked,
        lock_box=lock_box,
        fold_of=fold_of,
        base=start,
        final=final,
        search=search,
        probed=probed,
        first_tests=first_tests,
        last_tests=last_tests,
        accepted=accepted,
        floor_nm=noise_lower_bound_nm(development, final.predictions),
        left_by_named=left,
        structure=covariate_tests(development, final.predictions) if probed.added else left,
        locked_scores=_locked_scores(locked, start, probed, accepted, config)
        if config.open_lock_box
        else None,
        observed=observe(
            development,
            final.predictions,
            DATUM_FREE | names_to_terms(accepted),
            probed.defects,
            rounding_um,
            config.seed,
        ),
        identifiability=identifiability(search.state.fits),
        profiles=profiles(search.state.fits, [field.window for field in development]),
        untestable=untestable,
        planted=planted,
        config=config,
    )


def _passed(tests: Sequence[MeasurementTest]) -> list[str]:
    return [test.effect.name for test in tests if test.confirmation.passed]


def noise_lower_bound_nm(fields: Sequence[Field], predictions: Sequence[np.ndarray]) -> tuple[float, float]:
    """Pixel noise from second differences along x, (rms, mean absolute) in nm: blind to correlated noise.

    For white noise of variance s², x[i-1] - 2 x[i] + x[i+1] has variance 6 s². The median over pixels
    keeps edges of the print out; a Gaussian shape is assumed for the conversion.
    """
    variances = []
    for field, prediction in zip(fields, predictions, strict=True):
        residual = np.where(field.usable, field.scan.height_um - prediction, np.nan)
        second = residual[:, 2:] - 2 * residual[:, 1:-1] + residual[:, :-2]
        spread = float(np.nanmedian(np.abs(second))) / 0.6745
        variances.append(spread**2 / 6)
    rms = float(np.sqrt(np.mean(variances))) * NM_PER_UM
    return rms, rms * float(np.sqrt(2 / np.pi))


def _stiff_guide(scan: PrintedScan) -> nn.Module:
    return build_model(
        "physics", pitch_um=scan.pitch_um, level_height_um=scan.level_height_um, levels=scan.levels
    )


def _folds(fields: Sequence[Field], config: LoopConfig) -> np.ndarray:
    ids = [field.id for field in fields]
    folds = grouped_folds(ids, min(config.folds, len(ids)), config.seed)
    fold = {scan_id: number for number, members in enumerate(folds) for scan_id in members}
    return np.array([fold[scan_id] for scan_id in ids])


def _untestable(fields: Sequence[Field]) -> dict[str, str]:
    reasons = {}
    one_level = all(field.scan.mask_level.min() == field.scan.mask_level.max() for field in fields)
    for effect in CATALOGUE.values():
        if effect.per_scan:
            continue
        if one_level:
            reasons[effect.name] = "every layout has one level only: nothing in the print varies with it"
        elif "order" in effect.needs and len({field.context.order for field in fields}) < 3:
            reasons[effect.name] = "the writing order of the scans is not known"
    return reasons


def _locked_scores(
    locked: Sequence[Field], start: State, probed: Probed, accepted: Sequence[str], config: LoopConfig
) -> tuple[tuple[Score, Score], tuple[Score, Score]] | None:
    if not locked:
        return None
    before, after = ([predict(s.fits.chain, s.fits.common, f) for f in locked] for s in (start, probed.state))
    after = [probed.apply(f, p) for f, p in zip(locked, after, strict=True)]
    terms = DATUM_FREE | names_to_terms(accepted)
    return (
        (score(locked, before, frozenset(), config.seed), score(locked, before, DATUM_FREE, config.seed)),
        (score(locked, after, frozenset(), config.seed), score(locked, after, terms, config.seed)),
    )
