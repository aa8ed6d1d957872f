"""Fit models that are linear in many features by ridge regression. The scans are processed one at a time, to
limit the memory.
"""

from collections.abc import Sequence

import numpy as np
import torch

from litho_data.commands.progress import progress
from litho_data.store import PrintedScan
from litho_models.fitting.crops import grid_pixels
from litho_models.fitting.least_squares import ABSOLUTE_WIDTH_UM, Linearised, eliminated, orthonormal
from litho_models.layers.gaussian import pad_field
from litho_models.models.features import Features, RandomFeatures
from litho_models.scan_terms import FloatMap, Policy, TermPixels, Terms, least_squares, term_maps
from litho_models.scan_terms.policies import smooth_training_terms

# Strength of the ridge penalty, relative to the mean square of each feature after the per-scan terms are
# removed. The penalty is so small that it affects only combinations of weights that the scans do not
# determine. On the measured prints, all strengths from 1e-6 to 1e-4 give the same result.
RIDGE = 1e-5
# Number of fitted pixels of each scan, which lie on a square grid. Twice as many pixels do not improve the
# predictions of the measured prints. The features of one scan take 94 MB (16,384 pixels × 716 features × 8
# bytes). If the features of all scans together take at most KEPT_BYTES, they are kept in memory; otherwise
# each pass computes them again. The feature maps of one tile need another 0.3 GB.
FITTED_PX = 16_384
TILE_PX = 512
KEPT_BYTES = 2**31
# The first pass minimises squared residuals. The second pass reweights the pixels so that absolute residuals
# are minimised, which reduces the influence of dirt on a print.
PASSES = 2
# Weight of the part of a residual that the per-scan terms can explain. Even with this small weight, the fit
# still determines the datum that all scans have in common.
_TERM_WEIGHT = 1e-3


def fit_ridge(model: Features, scans: Sequence[PrintedScan], policy: Policy) -> None:
    """Fit the weights of ``model`` in place by minimising the mean absolute error. Fixed weights stay as they
    are.

    Args:
        model: the model to fit; ``scans``: training scans.
        policy: name of the set of terms that are fitted to each scan. Line offsets are left out of the fit,
            because they average out over a scan.
    """
    if not model.weights.requires_grad:
        return
    terms = smooth_training_terms(policy)
    if isinstance(model, RandomFeatures):
        seen = [feature_rows(model, scan, grid_pixels(scan, FITTED_PX)) for scan in scans]
        model.standardise([torch.from_numpy(own[: len(model.centre)]) for own in seen])
    solved: FloatMap | None = None
    kept: dict[int, tuple[FloatMap, FloatMap, FloatMap]] = {}
    keeps = 8 * FITTED_PX * model.parameter_count * len(scans) <= KEPT_BYTES
    for _ in range(PASSES):
        size = model.parameter_count
        matrix, right = np.zeros((size, size)), np.zeros(size)
        for number, scan in enumerate(progress(scans, f"fitting {model.name}")):
            rows = kept.get(number) or _rows(model, scan, terms)
            if keeps:
                kept[number] = rows
            design, height, basis = rows
            certainty = np.ones_like(height)
            if solved is not None:
                rest = height - solved @ design
                rest -= least_squares(basis, rest) @ basis if len(basis) else 0.0
                certainty = 1 / np.sqrt(rest**2 + ABSOLUTE_WIDTH_UM**2)
            root = np.sqrt(certainty / certainty.sum())
            own = Linearised(height * root, design * root, orthonormal((basis * root).T).T)
            normal, moment, _ = eliminated(own, _TERM_WEIGHT)
            matrix, right = matrix + normal, right + moment
        solved = _ridge(matrix, right)
    with torch.no_grad():
        model.weights.copy_(torch.as_tensor(solved))


def _ridge(matrix: FloatMap, right: FloatMap) -> FloatMap:
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    return np.linalg.solve(matrix / np.outer(size, size) + RIDGE * np.eye(len(size)), right / size) / size


def _rows(model: Features, scan: PrintedScan, terms: Terms) -> tuple[FloatMap, FloatMap, FloatMap]:
    """Return three arrays for the n fitted pixels of a scan: the k features, of shape (k, n); the measured
    height, µm, of shape (n,); and the m per-scan terms, of shape (m, n).
    """
    at = grid_pixels(scan, FITTED_PX)
    height = scan.height_um.reshape(-1)[at].astype(np.float64)
    return feature_rows(model, scan, at), height, term_maps(TermPixels(scan.exposed_um, at=at), terms)


def feature_rows(model: Features, scan: PrintedScan, at: np.ndarray) -> FloatMap:
    """Return the k features of a scan at n pixels, whose flat indices are in ``at``. The features are
    computed tile by tile. The result has shape (k, n).
    """
    reach = model.reach_px
    layout = pad_field(torch.from_numpy(scan.exposed_um)[None, None], reach, reach)
    place = np.stack(np.divmod(at, scan.shape[1]))
    tile = place // TILE_PX
    found = np.empty((model.parameter_count, len(at)))
    for number in np.unique(tile, axis=1).T:
        inside = np.flatnonzero((number == tile.T).all(axis=1))
        top, left = number * TILE_PX
        side = TILE_PX + 2 * reach
        part = layout[..., top : top + side, left : left + side]
        y, x = place[:, inside] - TILE_PX * number[:, None]
        own = torch.from_numpy(y * (part.shape[-1] - 2 * reach) + x)
        with torch.no_grad():
            found[:, inside] = model.at_pixels(part, own).numpy()
    return found
