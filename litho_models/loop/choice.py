"""Everything that is chosen on a set of scans: named effects, generic terms, what single scans add."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import nn

from litho_data.foundation.commands import say_estimate
from litho_data.store import PrintedScan
from litho_models.effects import CATALOGUE, UNTESTABLE
from litho_models.effects.chain import EffectChain
from litho_models.loop.fold_fits import predict
from litho_models.loop.folded_base import FoldedBase, Trainer, same_for_all, train_folds
from litho_models.loop.parameters import effect_slots, is_refitted
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes import Probed, probe_residual
from litho_models.loop.selection.contest import Entrant, judged
from litho_models.loop.selection.search import Search, search_effects
from litho_models.loop.single_scans.nested_tests import MeasurementTest, measurement_tests
from litho_models.loop.structure import CovariateTest, covariate_tests
from litho_models.loop.study import (
    DATUM_FREE,
    State,
    Study,
    fit_state,
    names_to_terms,
    noise_lower_bound_nm,
)
from litho_models.models import build_model
from litho_models.scan_terms import Terms

# What a run takes in fits of its base: 26 on four small scans, 39 on the measured prints.
_BASE_FITS = 35


@dataclass(frozen=True)
class Choice:
    """What was chosen on the scans of a study, and the models before and after.

    Attributes:
        study: the scans that it was chosen on, their folds and how they are judged.
        base: fitted state before; ``search``: the named effects, and how it got there.
        guide: the state on which effects were looked for; for a network, that of a small model.
        probed: generic terms where no named effect won.
        first_tests, last_tests: measurement tests before and after the process effects.
        left_by_named: covariate tests on what the named effects leave.
        untestable: effect to reason.
    """

    study: Study
    base: State
    guide: State
    search: Search
    probed: Probed
    first_tests: list[MeasurementTest]
    last_tests: list[MeasurementTest]
    left_by_named: list[CovariateTest]
    untestable: dict[str, str]

    @property
    def final(self) -> State:
        """The model with everything that was added."""
        return self.probed.state

    @property
    def accepted(self) -> list[str]:
        """Measurement effects in force at the end."""
        return passed(self.last_tests)

    @property
    def terms(self) -> Terms:
        """The datum and the terms of the accepted measurement effects."""
        return DATUM_FREE | names_to_terms(self.accepted)

    def before(self, scan: PreparedScan) -> np.ndarray:
        """The base model's prediction (y, x), µm, of a scan that was not chosen on."""
        return predict(self.base.fits.chain, self.base.fits.common, scan)

    def after(self, scan: PreparedScan) -> np.ndarray:
        """The final model's prediction (y, x), µm, of a scan that was not chosen on."""
        fits = self.final.fits
        return self.probed.apply(scan, predict(fits.chain, fits.common, scan))


def choose(
    study: Study, base: nn.Module, trainer: Trainer | None = None, *, announce: bool = False
) -> Choice:
    """Find what the base model lacks on the scans of a study.

    Args:
        study: scans and folds.
        base: simulator; one with few parameters is refitted, another is taken as it is.
        trainer: makes a fresh base model from scans: it is then trained once per fold, and effects are
            looked for on a Physics model first.
        announce: say how long a run takes, as soon as the fit of the base tells.
    """
    first, report = study.scans[0], study.report
    refitted = is_refitted(base)
    chain = EffectChain(
        copy.deepcopy(base) if refitted else _small_guide(first.stored),
        {},
        full_height_um=first.context.full_height_um,
        pitch_um=first.context.pitch_um,
    )
    report(f"fitting the base model on {len(study.scans)} scans")
    started = time.monotonic()
    start = fit_state(chain, study)
    if announce:
        say_estimate("closing the loop", _BASE_FITS * (time.monotonic() - started))
    untestable = dict(UNTESTABLE) | _untestable(study.scans)
    study = replace(study, floor_nm2=noise_lower_bound_nm(study.scans, start.predictions)[0] ** 2)
    report("testing what single scans add")
    first_tests = measurement_tests(study, start.predictions)
    terms = DATUM_FREE | names_to_terms(passed(first_tests))
    search = search_effects(start, study, terms, exclude=untestable)
    guide = search.state
    if not refitted:
        report("training the base model" if trainer else "predicting with the base model as it is")
        folded = (
            train_folds(study.scans, study.fold_of, trainer, study.workers)
            if trainer
            else same_for_all(base, study.scans)
        )
        start, search = _carry_over(search, folded, study, terms)
        # What single scans add to the model that is reported, not to the guide.
        first_tests = measurement_tests(study, start.predictions)
    report("testing what is left for structure")
    # Effects that displace a print leave a shift in every scan, which its registration then takes up.
    between = first_tests if search.state is start else measurement_tests(study, search.state.predictions)
    left = covariate_tests(study.scans, search.state.predictions)
    probed = probe_residual(search.state, study, DATUM_FREE | names_to_terms(passed(between)))
    return Choice(
        study=study,
        base=start,
        guide=guide,
        search=search,
        probed=probed,
        first_tests=first_tests,
        last_tests=measurement_tests(study, probed.state.predictions) if probed.added else between,
        left_by_named=left,
        untestable=untestable,
    )


def passed(tests: Sequence[MeasurementTest]) -> list[str]:
    """Names of the confirmed measurement effects."""
    return [test.effect.name for test in tests if test.confirmation.passed]


def _small_guide(scan: PrintedScan) -> nn.Module:
    return build_model(
        "physics", pitch_um=scan.pitch_um, level_height_um=scan.level_height_um, levels=scan.levels
    )


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


def _carry_over(
    found: Search,
    base: FoldedBase,
    study: Study,
    terms: Terms,
) -> tuple[State, Search]:
    """Try the effects found on the small model on the network; returns its bare state and the search.

    A network absorbs effects into its weights, so candidates are screened on a small model; here each effect
    found there must also lower the network's held-out error, otherwise the network carries it.
    """
    guide = found.state.fits.chain
    bare = fit_state(
        EffectChain(base, {}, full_height_um=guide.full_height_um, pitch_um=guide.pitch_um), study
    )
    carried = Search(
        bare, first=found.first, last=found.last, failures=dict(found.failures), dropped=dict(found.dropped)
    )
    for entry in found.added:
        name = entry.effect.name
        study.report(f"trying {name} on the network")
        slots, common = effect_slots(guide), found.state.fits.common
        values = guide.values()[name] | {
            parameter: float(common[slot]) for (owner, parameter), slot in slots.items() if owner == name
        }
        chain = carried.state.fits.chain
        extended = fit_state(chain.with_effects({**chain.values(), name: values}), study)
        entrant = Entrant(found.first[name], extended)
        added = judged(carried.state, entrant, entry.confusable_with, study, terms)
        if added.confirmation.passed:
            carried.state = extended
            # It was screened where the small model chose it, after the effects added before it.
            carried.added.append(replace(added, p_screen=entry.p_screen))
        else:
            reason = added.confirmation.reason
            carried.absorbed[name] = f"confirmed on the small model, not on this one: {reason}"
    return bare, carried
