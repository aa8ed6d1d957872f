"""List the open questions of a closed loop (a finished search for causes), with all information that is
needed to plan an experiment.

Effects that look the same become rivals (competing explanations). A rival is the corrected model with one of
these effects, refitted to all scans. If it is unknown whether the printer or the microscope causes an effect,
the effect becomes two rivals: in one of them, the effect rotates with the print, and in the other it rotates
with the scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from litho_data.layouts.statistics import layout_statistics
from litho_data.roughness.noise import robust_sd
from litho_data.store import PrintedScan
from litho_data.store.schema import DatasetId
from litho_models.effects import get_effect
from litho_models.effects.registry import TIP
from litho_models.fitting.least_squares import eliminated_sum
from litho_models.fitting.runs import level_share
from litho_models.loop.closing import Closed
from litho_models.loop.fits import RULES, Study
from litho_models.loop.learner import Learner
from litho_models.loop.model import Twin
from litho_models.loop.record import ScanFinding
from litho_models.loop.results import clustered_covariance, independent
from litho_models.loop.screening import WORTH_FITTING, Screened
from litho_models.loop.search import Cause, separating
from litho_models.planning.questions import (
    Kind,
    NoiseSpectrum,
    OpenQuestions,
    Owner,
    Question,
    Rival,
    fit_rivals,
    left_nm,
    noise_spectrum,
)
from litho_models.scan_terms import line_terms, terms_of_effect
from litho_models.scan_terms.grouped import ALL

# Largest number of effects that may become rivals in one question. It is limited because every pair of rivals
# is compared on every layout.
_MOST_MEMBERS = 3
# ``_SMALLEST_PX``: smallest side of a layout whose spectrum is measured. ``_POWER_KNOWN``: fraction of the
# spectral power that lies below the cut-off frequency.
_SMALLEST_PX, _POWER_KNOWN = 64, 0.95
_OF_PLACE = ("vignetting", "field-curvature")


def open_questions(closed: Closed, dataset: DatasetId, single_scans: Sequence[ScanFinding]) -> OpenQuestions:
    """Return all open questions, each with its fitted rivals if it has any. The first questions are about
    causes and laws that were found. Then come questions about unconfirmed effects, about per-scan terms and
    about missing facts.

    Args:
        closed: the loop that left these questions.
        dataset: the dataset on which the loop was closed.
        single_scans: findings of this loop about per-scan terms.
    """
    scans = closed.study.scans
    maps = closed.final.maps_um(scans)
    left = [*map(left_nm, scans, maps)]
    noise = noise_spectrum(left)
    asked = [_of_cause(closed, cause, left, noise) for cause in closed.traced]
    asked.append(_of_suspects(closed, maps))
    for one in single_scans:
        terms = terms_of_effect(one.name)
        if one.seen and terms and (one.role == "undetermined" or one.confusable_with):
            sizes = {parameter: spread.value for parameter, spread in one.spread.items()}
            asked.append(_question("lines" if line_terms(terms) else "per-scan", [one.name], sizes=sizes))
    write = scans[0].write or {}
    # Effects that could not be tested because a fact about the prints is missing, each with the reason.
    unplaced = "the position of the prints in the write field is not known"
    missing = dict.fromkeys(() if "field_um" in write else _OF_PLACE, unplaced) | closed.untestable
    asked += [_question("fact", [one], text=why) for one, why in missing.items()]
    return OpenQuestions(
        dataset=dataset,
        noise=noise,
        level_share=level_share(scans),
        cutoff_per_um=_cutoff_per_um(scans),
        write_field_um=write.get("field_um"),
        slow_axis=scans[0].context.slow_axis,
        surround=write.get("surround"),
        instrument=scans[0].seen_by,
        questions=[*filter(None, asked)],
    )


def _cutoff_per_um(scans: Sequence[PrintedScan]) -> float:
    """Return the frequency, cycles/µm, below which 95 % of the spectral power of the layouts lies. Layouts
    of a single level have no power. If all layouts are of this kind, return 0.
    """
    first, layouts = scans[0], [scan.mask_level for scan in scans if np.ptp(scan.mask_level)]
    if not layouts:
        return 0.0
    if min(min(level.shape) for level in layouts) < _SMALLEST_PX:
        return 0.05 / first.pitch_um
    known = layout_statistics(layouts, levels=first.levels, pitch_um=first.pitch_um)
    return known.frequency_per_um[int(np.searchsorted(np.cumsum(known.power_share), _POWER_KNOWN))]


def _of_cause(
    closed: Closed, cause: Cause, left: Sequence[np.ndarray], noise: NoiseSpectrum
) -> Question | None:
    """Return the open question about a cause. The question is which effect of a set of similar effects is
    present, or whether the printer or the microscope causes the effect. Return None if both are already
    known. ``left`` and ``noise`` are as for ``_spread``.
    """
    twin = closed.final.twin.ungrouped()
    if not cause.alike and len(_owners(cause.name, twin.values()[cause.name])) == 1:
        return None
    # If another effect replaces the cause, its fit starts from the values that screening found before any
    # cause was added to the model.
    first = {**closed.lawful.first, **closed.named.first}
    others = cause.alike[: _MOST_MEMBERS - 1]
    twins = {cause.name: twin} | {one: _with(twin.without(cause.name), first[one]) for one in others}
    return _question(
        "set" if others else "role",
        [*twins],
        rivals=_rivals(closed.study, twins),
        spread=_spread(closed, cause.name, left, noise),
        form_nm=[*closed.rests.values()][-1].most_nm,
    )


def _of_suspects(closed: Closed, maps: Sequence[np.ndarray]) -> Question | None:
    """Return the question of which unconfirmed effect, if any, explains the residual. An effect is
    unconfirmed if it is significant in screening, but held-out scans did not confirm it or a later check
    rejected it. Return None if no effect is unconfirmed. Also return None if only one effect is unconfirmed
    and the catalogue states whether the printer or the microscope causes it.

    ``maps`` contains the predicted height of each scan, µm, of shape (ny, nx).
    """
    named, twin = closed.named, closed.final.twin.ungrouped()
    least = WORTH_FITTING * 0.01 * named.state.mse_nm2
    unconfirmed = (
        one
        for name, one in named.last.items()
        if name in named.refused and name not in twin.names and one.allowed and one.gain_nm2 >= least
    )
    standing = sorted(unconfirmed, key=lambda one: -one.gain_nm2)[:_MOST_MEMBERS]
    twins = {one.name: _with(twin, one) for one in standing}
    if len(twins) < 2 and not any(get_effect(name).role == "undetermined" for name in twins):
        return None
    rivals = _rivals(closed.study, twins)
    # The loop has estimated the error in the form of the model only for the model without these effects.
    # Here, this error is estimated for every model with one of the effects, and the smallest estimate is
    # used.
    learner = Learner(closed.study, maps)
    heights = ([*map(rival.twin(twin).height, closed.study.scans)] for rival in rivals)
    form_nm = min(learner.rest(one).most_nm for one in heights)
    return _question("suspects", [*twins], rivals=rivals, form_nm=form_nm)


def _rivals(study: Study, twins: Mapping[str, Twin]) -> list[Rival]:
    """Fit the model of each effect to all scans. Return the fitted models as rivals."""
    study.report(f"fitting the rivals {', '.join(twins)}")
    windows, units = study.windows, independent(study.scans)
    stands_for = sum(w.usable.sum() for w in windows) / sum(len(w.sample) for w in windows)
    rivals = []
    for name, fit in fit_rivals(twins, windows).items():
        fitted = twins[name].at(fit.vector)
        effects, free = fitted.values(), fitted.free()[:, None]
        linear = [replace(part, jacobian=part.jacobian * free) for part in fit.linear]
        information = stands_for * eliminated_sum(fit.linear, RULES.term_weight)[0]
        rivals += [
            Rival(
                effect=name,
                owner=owner,
                effects=effects,
                vector=fit.vector.tolist(),
                information=information.tolist(),
                covariance=clustered_covariance(linear, units).tolist(),
            )
            for owner in _owners(name, effects[name])
        ]
    return rivals


def _spread(closed: Closed, name: str, left: Sequence[np.ndarray], noise: NoiseSpectrum) -> float:
    """Return the relative standard deviation, over scans, of the evidence for an effect, i.e. of the decrease
    of the squared error. The part that noise causes is subtracted in quadrature, and the result is at most 1.

    Let d be the change that the effect makes to the prediction of a scan, and a the multiple of d that fits
    the scan best. The squared errors of the scan without and with the effect differ by |d|² (2 a - 1) plus
    noise, where a is 1 on average. The relative spread of this difference is therefore twice the spread of a.
    If the strength differs between groups of scans, d contains these differences, so they do not contribute
    to the spread.

    Args:
        closed: the loop.
        name: name of the effect.
        left: residual of each scan with the effect, nm, as returned by ``left_nm``.
        noise: spectrum of the noise in these residuals.
    """
    scans = closed.study.scans
    without = closed.final.without(name).maps_um(scans)
    multiples, own = [], []
    for before, after in zip(map(left_nm, scans, without), left, strict=True):
        change = np.nan_to_num(before - after)
        if size := (change**2).sum():
            multiples.append(np.nansum(change * before) / size)
            own.append(float(noise.variance(torch.from_numpy(change))) / size**2)
    # The spread is estimated robustly (from the median absolute deviation), because a scan may have a defect.
    spread = robust_sd(np.array(multiples))
    return min(2 * float(np.sqrt(max(spread**2 - np.median(own), 0.0))), 1.0)


def _with(twin: Twin, one: Screened) -> Twin:
    return twin.with_effect(one.name, ALL, one.start()).ungrouped()


def _owners(name: str, values: Mapping[str, float]) -> list[Owner | None]:
    """Return the possible sources of an effect. If scans of one orientation cannot show whether the printer
    or the microscope is the source, the list contains both. Otherwise, it contains only None, which stands
    for the source that the catalogue states.

    The source is also unknown for an asymmetric tip, because a tip that is blunter along one axis and a print
    whose flanks are wider along this axis give similar scans.
    """
    uneven = name == TIP and values["along"] != values["across"]
    return ["printer", "microscope"] if uneven or get_effect(name).role == "undetermined" else [None]


def _question(kind: Kind, names: Sequence[str], text: str = "", **known: Any) -> Question:
    """Make a question about the named effects, with its text. The argument ``text`` is used only for the kind
    ``fact``. It states which fact is missing, and the question is about a single effect.
    """
    first, *others = [get_effect(name).title for name in names]
    if kind == "lines":
        text = "whether the line offsets come from the printer or from the microscope"
    elif kind == "fact":
        text = f"{first}: {text}"
    elif others:
        text = f"which effect is present: {', '.join([first, *others[:-1]])} or {others[-1]}"
    else:
        text = f"{first}: caused by the printer or by the microscope"
    name = " or ".join(names) if kind == "suspects" else names[0]
    return Question(name=name, kind=kind, text=text, experiment=separating(names), **known)
