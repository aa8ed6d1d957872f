"""A named effect must do better than a generic term that does the same without a name.

A table or a kernel that was fitted on the training scans follows whatever its covariate carries. The
effect that is the cause has the right shape with fewer numbers and does better on the scans left out;
one that only resembles the cause does not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_models.loop.fields import Field
from litho_models.loop.linear import without_scan_terms
from litho_models.loop.probes.defects import find_defects
from litho_models.loop.probes.selection import generic_terms
from litho_models.loop.state import State
from litho_models.metrics import NM_PER_UM

# A generic term has to gain this much more: its own estimate is noisy, too.
_BETTER = 1.05
# Beside the generic term an effect that it contains keeps no more than this part of its gain.
_CONTAINED = 0.25


def generic_rival(before: State, after: State, fields: Sequence[Field], fold_of: np.ndarray) -> str | None:
    """Name of a generic term that contains what the effect does, and gains more on the scans left out.

    Args:
        before, after: the model without and with the effect.
        fields: development scans; ``fold_of``: fold that holds each out.
    """
    changes = [new - old for old, new in zip(before.predictions, after.predictions, strict=True)]
    own = _freed(before, changes, fields)
    defects = find_defects(fields, before.predictions)
    for probe in generic_terms(fields, before.predictions, defects):
        estimate = probe.held_out(fold_of)
        corrections = [
            probe.correction(estimate.per_fold[fold], field, prediction)
            for field, prediction, fold in zip(fields, before.predictions, fold_of, strict=True)
        ]
        generic = _freed(before, corrections, fields)
        if _gain(generic) > _BETTER * _gain(own) and _is_contained(own, generic):
            return probe.name
    return None


def _is_contained(own: Sequence[np.ndarray], generic: Sequence[np.ndarray]) -> bool:
    """Whether the effect, at its best multiple, adds little to the generic term at its best multiple."""
    columns = [np.column_stack([a[:, 0], b]) for a, b in zip(own, generic, strict=True)]
    gram = sum((c.T @ c for c in columns), np.zeros((3, 3)))
    right = gram[:2, 2]
    alone = right**2 / np.diag(gram)[:2]
    together = right @ np.linalg.lstsq(gram[:2, :2], right, rcond=1e-12)[0]
    return bool(together - alone[1] <= _CONTAINED * alone[0])


def _gain(freed: Sequence[np.ndarray]) -> float:
    """Mean gain in squared error of the changes as they are, nm²."""
    gains = [
        (2 * change @ residual - change @ change) / len(change) for change, residual in (c.T for c in freed)
    ]
    return float(np.mean(gains)) * NM_PER_UM**2


def _freed(state: State, changes: Sequence[np.ndarray], fields: Sequence[Field]) -> list[np.ndarray]:
    """Change and residual (n, 2) at the sampled pixels, free of what single scans may add, µm."""
    freed = []
    for field, prediction, change in zip(fields, state.predictions, changes, strict=True):
        columns = np.column_stack([field.at_sample(change), field.height - field.at_sample(prediction)])
        freed.append(without_scan_terms(columns, field, prediction, gain=True))
    return freed
