"""A named effect must do better than what does the same without a name.

A table or a kernel that was fitted on the training scans follows whatever its covariate carries. The
effect that is the cause has the right shape with fewer numbers and does better on the scans left out;
one that only resembles the cause does not. And where a large effect has been named, the catalogue's form
of it is not exactly the machine's: what a further effect does must not be what that form leaves over.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.linear import ALL_FREE, without_scan_terms
from litho_models.loop.probes.defects import find_defects
from litho_models.loop.probes.probe import Estimate, Probe
from litho_models.loop.probes.selection import generic_terms
from litho_models.loop.study import State, Study
from litho_models.scan_terms import Terms

# A generic term has to gain this much more: its own estimate is noisy, too.
_BETTER = 1.05
# Beside the generic term an effect that it contains keeps no more than this part of its gain.
_CONTAINED = 0.25
# Of a further effect's gain, what a change named before may do in another shape.
_REMAINDER = 0.5
_RESHAPING_BLURS_UM = (0.2, 0.6)


def generic_rival(before: State, after: State, study: Study) -> str | None:
    """Name of a generic term that contains what the effect does, and gains more on the scans left out.

    Args:
        before, after: the model without and with the effect.
    """
    changes = [new - old for old, new in zip(before.predictions, after.predictions, strict=True)]
    own = freed_changes(before, changes, study)
    defects = find_defects(study.scans, before.predictions)
    for probe in generic_terms(study.scans, before.predictions, defects):
        generic = freed_corrections(probe, probe.held_out(study.fold_of), before, study)
        if gains_nm2(generic).mean() > _BETTER * gains_nm2(own).mean() and _is_contained(own, generic):
            return probe.name
    return None


def remainder_of(named: tuple[State, State], before: State, after: State, study: Study) -> str:
    """Why a further effect may only correct the formula of one named before; empty if not.

    Another shape: the change by the first effect scaled, squared, growing with the height, blurred,
    displaced. If these do half of what the further effect does and leave it no more than half of its
    gain, it may be that error. If they do more than the further effect, the larger part of what is
    missing is there and has no name.

    Args:
        named: the model without and with the effect named before.
        before, after: the model without and with the further effect.
    """
    grams = []
    for at, scan in enumerate(study.scans):
        prediction = before.predictions[at]
        change = named[1].predictions[at] - named[0].predictions[at]
        maps = [*_reshaped(change, prediction, scan.context.pitch_um), after.predictions[at] - prediction]
        columns = [*map(scan.at_sample, maps), scan.height - scan.at_sample(prediction)]
        freed = without_scan_terms(np.column_stack(columns), scan, prediction)
        grams.append(freed.T @ freed)
    gram = np.sum(grams, axis=0)
    both = np.arange(len(gram) - 1)
    alone, reshaped, together = (_gain_of(gram, columns) for columns in (both[-1:], both[:-1], both))
    if reshaped >= _REMAINDER * alone and together - reshaped <= _REMAINDER * alone:
        return "repeats {} in another shape: may only correct its formula"
    return "correcting the formula of {} would gain more" if reshaped >= alone else ""


def _reshaped(change: np.ndarray, prediction: np.ndarray, pitch_um: float) -> list[np.ndarray]:
    blurred = [gaussian_filter(change, sigma_um / pitch_um) for sigma_um in _RESHAPING_BLURS_UM]
    products = [change * prediction, change * change, blurred[0] * prediction]
    return [change, *products, *blurred, *np.gradient(change)]


def _gain_of(gram: np.ndarray, columns: np.ndarray) -> float:
    """What the best combination of these columns takes from the squares of the last one."""
    right = gram[columns, -1]
    return float(right @ np.linalg.lstsq(gram[np.ix_(columns, columns)], right, rcond=1e-10)[0])


def _is_contained(own: Sequence[np.ndarray], generic: Sequence[np.ndarray]) -> bool:
    """Whether the effect, at its best multiple, adds little to the generic term at its best multiple."""
    columns = [np.column_stack([a[:, 0], b]) for a, b in zip(own, generic, strict=True)]
    gram = np.sum([c.T @ c for c in columns], axis=0)
    alone, beside, together = (_gain_of(gram, np.array(which)) for which in ([0], [1], [0, 1]))
    return together - beside <= _CONTAINED * alone


def gains_nm2(freed: Sequence[np.ndarray]) -> np.ndarray:
    """Gain in squared error of the changes as they are, (scans,) nm²."""
    gains = [
        (2 * change @ residual - change @ change) / len(change) for change, residual in (c.T for c in freed)
    ]
    return np.array(gains) * NM_PER_UM**2


def freed_corrections(probe: Probe, estimate: Estimate, state: State, study: Study) -> list[np.ndarray]:
    """What a generic term adds to each scan by the fit that has not seen it, as ``freed_changes``."""
    corrections = [
        probe.correction(estimate.per_fold[fold], scan, prediction)
        for scan, prediction, fold in zip(study.scans, state.predictions, study.fold_of, strict=True)
    ]
    return freed_changes(state, corrections, study)


def freed_changes(
    state: State, changes: Sequence[np.ndarray], study: Study, terms: Terms = ALL_FREE
) -> list[np.ndarray]:
    """Change and residual (n, 2) at the sampled pixels, free of what single scans may add, µm."""
    freed = []
    for scan, prediction, change in zip(study.scans, state.predictions, changes, strict=True):
        columns = np.column_stack([scan.at_sample(change), scan.height - scan.at_sample(prediction)])
        freed.append(without_scan_terms(columns, scan, prediction, terms))
    return freed
