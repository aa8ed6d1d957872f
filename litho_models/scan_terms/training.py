"""Scan terms that are fitted together with a model, on all of a scan's pixels: for training only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_data.store import PrintedScan
from litho_models.scan_terms.blocks import Blocks
from litho_models.scan_terms.cross_fit import fitted_terms
from litho_models.scan_terms.lines import shrunk_line_offsets
from litho_models.scan_terms.policies import Policy, policy_terms
from litho_models.scan_terms.term import TermPixels, Terms, line_terms, row_index, term_maps

# Their mean over scans belongs to the process: what all scans have of them is no term of single ones.
PINNED: Terms = frozenset({"offset", "gain"})


def training_terms(policy: Policy, free_gain: bool = False) -> Terms:
    """The terms of a policy that are fitted with a model: all, without the gain unless it is free.

    A scan's gain is partly what the layout does to the height over long distances; a model whose
    scans may each choose their gain does not learn that.
    """
    return policy_terms(policy) - (frozenset() if free_gain else {"gain"})


def smooth_training_terms(policy: Policy, free_gain: bool = False) -> Terms:
    """Those without offsets of lines, which average out over a scan and cannot move a small model."""
    terms = training_terms(policy, free_gain)
    return terms - {term.name for term in line_terms(terms)}


def estimate_scan_terms(
    scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], terms: Terms
) -> list[np.ndarray]:
    """What each scan adds to the model's height, float32 (ny, nx) µm, fitted on all its valid pixels.

    For training only: a reported error takes its terms from ``cross_fit``.
    """
    fitted = [
        fitted_terms(scan.height_um, prediction, scan.usable, terms)[0]
        for scan, prediction in zip(scans, predictions_um, strict=True)
    ]
    coefficients = np.array(fitted)
    # The catalogue begins with offset and gain, one map each.
    pinned = len(PINNED & terms)
    coefficients[:, :pinned] -= coefficients[:, :pinned].mean(axis=0)
    maps = []
    for scan, prediction, own in zip(scans, predictions_um, coefficients, strict=True):
        basis = term_maps(TermPixels(prediction), terms).reshape(-1, *scan.shape)
        smooth = np.tensordot(own, basis, axes=1)
        if line_terms(terms):
            rows = row_index(scan.shape)
            residual = np.where(scan.usable, scan.height_um - prediction - smooth, 0.0)
            smooth = smooth + shrunk_line_offsets(residual, scan.usable, rows, Blocks().block_px)[0][rows]
        maps.append(smooth.astype(np.float32))
    return maps
