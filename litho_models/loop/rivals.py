"""A named effect must do better than a generic term that does the same without a name.

A table or a kernel that was fitted on the training scans follows whatever its covariate carries. The
effect that is the cause has the right shape with fewer numbers and does better on the scans left out;
one that only resembles the cause does not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_models.loop.fields import Field
from litho_models.loop.linear import nuisance_columns, orthonormal, pooled_cosine
from litho_models.loop.probes.defects import find_defects
from litho_models.loop.probes.selection import generic_terms
from litho_models.loop.screening import SAME_COSINE
from litho_models.loop.state import State
from litho_models.metrics import NM_PER_UM

# A generic term has to gain this much more: its own estimate is noisy, too.
_BETTER = 1.05


def generic_rival(before: State, after: State, fields: Sequence[Field], fold_of: np.ndarray) -> str | None:
    """Name of a generic term that changes the prediction as the effect does, and gains more held out.

    Args:
        before, after: the model without and with the effect.
        fields: development scans; ``fold_of``: fold that holds each out.
    """
    changes = [new - old for old, new in zip(before.predictions, after.predictions, strict=True)]
    own, own_gain = _freed(before, changes, fields)
    defects = find_defects(fields, before.predictions)
    for probe in generic_terms(fields, before.predictions, defects):
        estimate = probe.held_out(fold_of)
        corrections = [
            probe.correction(estimate.per_fold[fold], field, prediction)
            for field, prediction, fold in zip(fields, before.predictions, fold_of, strict=True)
        ]
        generic, gain = _freed(before, corrections, fields)
        if gain > _BETTER * own_gain and pooled_cosine(own, generic) >= SAME_COSINE:
            return probe.name
    return None


def _freed(
    state: State, changes: Sequence[np.ndarray], fields: Sequence[Field]
) -> tuple[list[np.ndarray], float]:
    """Changes (n,) at the sampled pixels free of what single scans may add, and their mean gain, nm²."""
    freed, gains = [], []
    for field, prediction, change in zip(fields, state.predictions, changes, strict=True):
        columns = np.stack(
            [field.at_sample(change), field.height - field.at_sample(prediction)], axis=1
        ).astype(np.float64)
        basis = orthonormal(nuisance_columns(field, prediction, gain=True))
        columns -= basis @ (basis.T @ columns)
        own, residual = columns.T
        freed.append(own)
        gains.append(float(2 * own @ residual - own @ own) / len(own) * NM_PER_UM**2)
    return freed, float(np.mean(gains))
