"""Close the loop: from the residual of a model on measured prints to named causes and a better model."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from torch import nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.store.lock_box import locked_ids
from litho_data.store.read import PrintedScan
from litho_models.effects import CATALOGUE, UNTESTABLE, get_effect
from litho_models.effects.chain import EffectChain
from litho_models.loop.findings import LoopConfig, LoopFindings
from litho_models.loop.flexible import carry_over
from litho_models.loop.fold_fits import predict
from litho_models.loop.folded_base import Trainer, same_for_all, train_folds
from litho_models.loop.identifiability import identifiability, profiles
from litho_models.loop.parameters import is_refitted
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.loop.probes import Probed, probe_residual
from litho_models.loop.screening.power import parse_injection, plant
from litho_models.loop.selection.search import search_effects
from litho_models.loop.single_scans.nested_tests import MeasurementTest, measurement_tests
from litho_models.loop.single_scans.observed import observe
from litho_models.loop.structure import covariate_tests, is_structured
from litho_models.loop.study import DATUM_FREE, Score, State, Study, fit_state, names_to_terms, score
from litho_models.models import build_model
from litho_models.scan_terms import Terms
from litho_models.scan_terms.background import learn_background
from litho_models.scoring.records import Prediction
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
    prepared = [scan for scan in prepare_scans(scans) if len(scan.sample) >= 64]
    lock_box = locked_ids(scans) if lock_box is None else list(lock_box)
    development = [scan for scan in prepared if scan.id not in lock_box]
    locked = [scan for scan in prepared if scan.id in lock_box]
    if len(development) < 2:
        raise InputError(
            "scans to close the loop on",
            got=f"{len(development)} usable and not locked",
            wanted="at least 2",
        )
    study = Study(development, _folds(development, config), config.seed, config.loss, report=report)
    first = development[0]
    refitted = is_refitted(base)
    chain = EffectChain(
        copy.deepcopy(base) if refitted else _small_guide(first.stored),
        {},
        full_height_um=first.context.full_height_um,
        pitch_um=first.context.pitch_um,
    )
    report(f"fitting the base model on {len(development)} scans")
    start = fit_state(chain, study)
    untestable = dict(UNTESTABLE) | _untestable(development)
    floor = noise_lower_bound_nm(development, start.predictions)
    study = replace(study, floor_nm2=floor[0] ** 2)
    report("testing what single scans add")
    first_tests = measurement_tests(study, start.predictions)
    terms = DATUM_FREE | names_to_terms(_passed(first_tests))
    search = search_effects(start, study, terms, exclude=untestable)
    guide = search.state
    if not refitted:
        report("training the base model" if trainer else "predicting with the base model as it is")
        folded = (
            train_folds(study.scans, study.fold_of, trainer) if trainer else same_for_all(base, study.scans)
        )
        start, search = carry_over(search, folded, study, terms)
        # What single scans add to the model that is reported, not to the guide.
        first_tests = measurement_tests(study, start.predictions)
    report("testing what is left for structure")
    # Effects that displace a print leave a shift in every scan, which its registration then takes up.
    between = first_tests if search.state is start else measurement_tests(study, search.state.predictions)
    left = covariate_tests(development, search.state.predictions)
    probed = probe_residual(
        search.state,
        study,
        DATUM_FREE | names_to_terms(_passed(between)),
        search=bool(is_structured(left)),
    )
    final = probed.state
    last_tests = measurement_tests(study, final.predictions) if probed.added else between
    accepted = _passed(last_tests)
    planted = []
    for text in config.inject:
        report(f"planting {text}")
        planted += plant(text, guide, study, terms)
    return LoopFindings(
        study=replace(study, background=config.background),
        locked=locked,
        lock_box=lock_box,
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
        locked_scores=_locked_scores(
            locked, start, probed, accepted, replace(study, background=config.background)
        )
        if config.open_lock_box
        else None,
        observed=observe(
            study, final.predictions, DATUM_FREE | names_to_terms(accepted), probed.defects, rounding_um
        ),
        identifiability=identifiability(search.state.fits),
        profiles=profiles(search.state.fits, study.windows),
        untestable=untestable,
        planted=planted,
        config=config,
    )


def _passed(tests: Sequence[MeasurementTest]) -> list[str]:
    return [test.effect.name for test in tests if test.confirmation.passed]


def noise_lower_bound_nm(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray]
) -> tuple[float, float]:
    """Pixel noise from second differences along x, (rms, mean absolute) in nm: blind to correlated noise.

    For white noise of variance s², x[i-1] - 2 x[i] + x[i+1] has variance 6 s². The median over pixels
    keeps edges of the print out; a Gaussian shape is assumed for the conversion.
    """
    variances = []
    for scan, prediction in zip(scans, predictions, strict=True):
        residual = np.where(scan.usable, scan.stored.height_um - prediction, np.nan)
        second = residual[:, 2:] - 2 * residual[:, 1:-1] + residual[:, :-2]
        spread = float(np.nanmedian(np.abs(second))) / 0.6745
        variances.append(spread**2 / 6)
    rms = float(np.sqrt(np.mean(variances))) * NM_PER_UM
    return rms, rms * float(np.sqrt(2 / np.pi))


def _small_guide(scan: PrintedScan) -> nn.Module:
    return build_model(
        "physics", pitch_um=scan.pitch_um, level_height_um=scan.level_height_um, levels=scan.levels
    )


def _folds(scans: Sequence[PreparedScan], config: LoopConfig) -> np.ndarray:
    ids = [scan.id for scan in scans]
    folds = grouped_folds(ids, min(config.folds, len(ids)), config.seed)
    fold = {scan_id: number for number, members in enumerate(folds) for scan_id in members}
    return np.array([fold[scan_id] for scan_id in ids])


def _untestable(scans: Sequence[PreparedScan]) -> dict[str, str]:
    reasons = {}
    one_level = all(scan.stored.mask_level.min() == scan.stored.mask_level.max() for scan in scans)
    for effect in CATALOGUE.values():
        if effect.per_scan:
            continue
        if one_level:
            reasons[effect.name] = "every layout has one level only: nothing in the print varies with it"
        elif "order" in effect.needs and len({scan.context.order for scan in scans}) < 3:
            reasons[effect.name] = "the writing order of the scans is not known"
    return reasons


def _locked_scores(
    locked: Sequence[PreparedScan], start: State, probed: Probed, accepted: Sequence[str], study: Study
) -> tuple[tuple[Score, Score], tuple[Score, Score]] | None:
    """Errors of the locked scans before and after, by the fits to all development scans."""
    if not locked:
        return None

    def before(scan: PreparedScan) -> np.ndarray:
        return predict(start.fits.chain, start.fits.common, scan)

    def after(scan: PreparedScan) -> np.ndarray:
        return probed.apply(scan, predict(probed.state.fits.chain, probed.state.fits.common, scan))

    def scores(of: Callable[[PreparedScan], np.ndarray], terms: Terms) -> tuple[Score, Score]:
        learned = None
        if study.background == "training":
            learned = learn_background([s.stored for s in study.scans], [of(s) for s in study.scans])
        maps = [Prediction.beside(learned, of(scan)).map_um for scan in locked]
        return score(locked, maps, frozenset(), study.blocks), score(locked, maps, terms, study.blocks)

    return scores(before, DATUM_FREE), scores(after, DATUM_FREE | names_to_terms(accepted))
