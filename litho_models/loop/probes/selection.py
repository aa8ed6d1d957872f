"""Add generic terms where no named effect wins: forward selection on held-out scans, against controls."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.defects import Defects, find_defects
from litho_models.loop.probes.displaced import displaced_copy
from litho_models.loop.probes.far import far_response
from litho_models.loop.probes.kernel import missing_kernel
from litho_models.loop.probes.layout import LAYOUT_FEATURES, layout_features
from litho_models.loop.probes.linear import Left
from litho_models.loop.probes.places import position_map, profile
from litho_models.loop.probes.probe import Estimate, Probe
from litho_models.loop.probes.tables import (
    directed_slope_table,
    level_table,
    order_shapes,
    shape_powers,
    slope_table,
)
from litho_models.loop.probes.trend import OrderTrend, order_trends
from litho_models.loop.selection.confirming import SMALLEST_SHARE, Confirmation
from litho_models.loop.study import Score, State, Study
from litho_models.scan_terms import TermPixels, Terms, term_maps

CONTROLS = 199
CONTROL_QUANTILE = 0.95
SMALLEST_AGREEMENT = 0.7


@dataclass(frozen=True)
class ProbeTest:
    """One probe's evidence when last tried; ``control_nm2`` and ``agreement`` are NaN if not reached."""

    name: str
    gain_nm2: float
    control_nm2: float
    agreement: float
    reason: str


@dataclass(frozen=True)
class AddedProbe:
    """A probe taken into the prediction, with its estimate and held-out errors before and after.

    ``anchor``: (k,) amounts of the maps of the probe's ``free`` terms that go with the correction.
    """

    probe: Probe
    estimate: Estimate
    anchor: np.ndarray
    before: Score
    after: Score
    confirmation: Confirmation
    p_control: float


@dataclass(frozen=True)
class Probed:
    """What the probes found.

    ``state`` has the chain's fits and the corrected held-out predictions; ``traced`` has them without the
    features of the layout, which trace the residual to nothing.
    """

    state: State
    traced: State
    added: list[AddedProbe]
    tests: list[ProbeTest]
    defects: Defects
    trends: list[OrderTrend]

    def apply(self, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        """Add the accepted terms, estimated on all development scans, to the prediction of a new scan."""
        for entry in self.added:
            prediction = _corrected(entry.probe, entry.estimate.common, entry.anchor, scan, prediction)
        return prediction


def probe_residual(state: State, study: Study, terms: Terms) -> Probed:
    """Look for what has no name in the residual that the named effects leave.

    Args:
        state: the model after the named effects; ``terms``: scan terms of the scoring.
    """
    defects = find_defects(study.scans, state.predictions)
    trends = order_trends(study.scans, state.predictions, study.seed)
    added: list[AddedProbe] = []
    tests: dict[str, ProbeTest] = {}

    def add_best(names: Sequence[str]) -> bool:
        """Take the best of these terms into the state; whether one passed."""
        nonlocal state
        candidates = list(generic_terms(study.scans, state.predictions, defects, names))
        found = _best(candidates, state, study, terms, tests)
        if found is not None:
            entry, state = found
            added.append(entry)
        return found is not None

    open_names = list(GENERIC)
    while add_best(open_names):
        open_names.remove(added[-1].probe.name)
    traced = state
    add_best(list(_LAST))
    return Probed(state, traced, added, list(tests.values()), defects, trends)


def generic_terms(
    scans: Sequence[PreparedScan],
    predictions: Sequence[np.ndarray],
    defects: Defects,
    names: Iterable[str] | None = None,
) -> Iterator[Probe]:
    """Probes, one by one, measured on the residual of these held-out predictions.

    Args:
        names: those wanted, ``layout-features`` or of ``GENERIC``; all of these by default. One that these
            scans do not allow is left out.
    """
    makers = GENERIC | _LAST
    for name in GENERIC if names is None else names:
        probe = makers[name](scans, predictions, defects.masks)
        if probe is not None:
            yield probe


# Scans, predictions (y, x) µm and masks of defects (y, x) to a probe, or None if they do not allow one.
Maker = Callable[[Sequence[PreparedScan], Sequence[np.ndarray], Sequence[np.ndarray]], Probe | None]


def _on_samples(make: Callable[..., Probe | None], **settings: Any) -> Maker:
    """A maker that is told which of the sampled pixels lie in no defect."""

    def made(
        scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], masks: Sequence[np.ndarray]
    ) -> Probe | None:
        kept = [~mask.reshape(-1)[scan.sample] for mask, scan in zip(masks, scans, strict=True)]
        return make(Left(scans, predictions, kept), **settings)

    return made


GENERIC: dict[str, Maker] = {
    "slope-table": _on_samples(slope_table),
    "axis-slope-table": _on_samples(directed_slope_table, name="axis-slope-table", along=("y", "x")),
    "diagonal-slope-table": _on_samples(
        directed_slope_table, name="diagonal-slope-table", along=("diagonal", "antidiagonal")
    ),
    "shape-powers": _on_samples(shape_powers),
    "position-map": _on_samples(position_map, of="height"),
    "row-profile": _on_samples(profile, along="row", of="height"),
    "column-profile": _on_samples(profile, along="column", of="height"),
    "position-gain-map": _on_samples(position_map, of="gain"),
    "row-gain-profile": _on_samples(profile, along="row", of="gain"),
    "column-gain-profile": _on_samples(profile, along="column", of="gain"),
    "position-shift-map": _on_samples(position_map, of="shift"),
    "row-shift-profile": _on_samples(profile, along="row", of="shift"),
    "column-shift-profile": _on_samples(profile, along="column", of="shift"),
    "missing-kernel": missing_kernel,
    "level-table": _on_samples(level_table),
    "order-shapes": _on_samples(order_shapes),
    "displaced-copy": displaced_copy,
    "far-response": _on_samples(far_response),
}
# No rival of a name: it contains every cause that follows the layout.
_LAST: dict[str, Maker] = {LAYOUT_FEATURES: _on_samples(layout_features)}


def _best(
    candidates: Sequence[Probe],
    state: State,
    study: Study,
    terms: Terms,
    tests: dict[str, ProbeTest],
) -> tuple[AddedProbe, State] | None:
    """The probe with the largest held-out gain that passes every rule, and the state with it.

    Probes are estimated free of each scan's own gain and bow, so they are judged free of them too.
    """
    terms = terms | {"gain", "bow"}
    fold_of = study.fold_of
    before = state.score(study, terms)
    estimates = [(probe, probe.held_out(fold_of)) for probe in candidates]
    for probe, estimate in sorted(estimates, key=lambda e: -e[1].mean_gain_nm2):
        gain = estimate.mean_gain_nm2
        nothing = ProbeTest(probe.name, gain, np.nan, np.nan, "")
        if gain < SMALLEST_SHARE * before.mse_nm2.mean():
            tests[probe.name] = replace(nothing, reason="gain on held-out scans too small to matter")
            continue
        study.report(f"probing with {probe.name}")
        random = np.random.default_rng([study.seed, 7])
        controls = probe.controls(fold_of, random, CONTROLS)
        limit = float(np.quantile(controls, CONTROL_QUANTILE))
        agreement = probe.agreement()
        extended, anchor = _with_probe(state, study, probe, estimate)
        after = extended.score(study, terms)
        confirmation = study.confirm(before, after, counted=False)
        reasons = [confirmation.reason] if confirmation.reason else []
        if gain <= limit:
            reasons.append("gains no more than its control")
        if agreement < SMALLEST_AGREEMENT:
            reasons.append(f"two halves of the scans agree by {agreement:.2f} only")
        tests[probe.name] = ProbeTest(probe.name, gain, limit, agreement, "; ".join(reasons))
        if not reasons:
            p_control = float((1 + (controls >= gain).sum()) / (CONTROLS + 1))
            return AddedProbe(probe, estimate, anchor, before, after, confirmation, p_control), extended
    return None


def with_generic_terms(state: State, study: Study, names: Sequence[str]) -> State:
    """The state with generic terms of these names, estimated one after another on what is left, unjudged."""
    defects = find_defects(study.scans, state.predictions)
    for name in names:
        for probe in generic_terms(study.scans, state.predictions, defects, [name]):
            state, _ = _with_probe(state, study, probe, probe.held_out(study.fold_of))
    return state


def _with_probe(state: State, study: Study, probe: Probe, estimate: Estimate) -> tuple[State, np.ndarray]:
    """The state with the probe, each scan corrected by the fit without it; the anchor of the fit to all."""
    *anchors, common = _anchors(
        probe, np.vstack([estimate.per_fold, estimate.common]), study.scans, state.predictions
    )

    def correct(fold: int, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        return _corrected(probe, estimate.per_fold[fold], anchors[fold], scan, prediction)

    return state.with_correction(correct, study), common


def _corrected(
    probe: Probe, parameters: np.ndarray, anchor: np.ndarray, scan: PreparedScan, prediction: np.ndarray
) -> np.ndarray:
    shared = (anchor @ term_maps(TermPixels(prediction), probe.free)).reshape(prediction.shape)
    return prediction + probe.correction(parameters, scan, prediction) + shared.astype(np.float32)


def _anchors(
    probe: Probe, parameters: np.ndarray, scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray]
) -> np.ndarray:
    """Minus what a correction has of the probe's free terms in the mean over scans, (p, k).

    A probe is estimated free of what every scan may have of these, so it says nothing about what all
    scans share of them; without this it would move height and place at random.

    Args:
        parameters: (p, m), one correction each.
    """
    products: list[tuple[np.ndarray, np.ndarray]] = []
    for scan, prediction in zip(scans, predictions, strict=True):
        columns = term_maps(TermPixels(prediction, at=scan.sample), probe.free) / np.sqrt(len(scan.sample))
        corrections = probe.at_samples(parameters, scan, prediction) / np.sqrt(len(scan.sample))
        products.append((columns @ columns.T, columns @ corrections.T))
    normal, right = (sum(part) for part in zip(*products, strict=True))
    return -np.linalg.lstsq(normal, right, rcond=1e-10)[0].T
