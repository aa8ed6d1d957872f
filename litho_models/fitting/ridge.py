"""Fit models that are linear in many features by ridge regression, with one scan in memory at a time."""

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

# Strength of the ridge relative to the mean square of each feature, after the terms of the scans are removed.
# It affects only weights that the scans cannot distinguish. On the measured prints, all values from 1e-6 to
# 1e-4 give the same result.
RIDGE = 1e-5
# Number of fitted pixels of each scan, on a square grid. Twice as many do not improve the predictions of the
# measured prints. The rows of a scan (16,384 × 8 B × 716 features: 94 MB) are kept if those of all scans take
# at most KEPT_BYTES; otherwise each pass computes them again. The maps of one tile need another 0.3 GB.
FITTED_PX = 16_384
TILE_PX = 512
KEPT_BYTES = 2**31
# The first pass minimises squares. The second reweights them to absolute values, so that blobs have little
# influence.
PASSES = 2
# Weight of the part of a residual that scan terms can explain. It determines the common datum.
_TERM_WEIGHT = 1e-3


def fit_ridge(model: Features, scans: Sequence[PrintedScan], policy: Policy) -> None:
    """Fit the weights of ``model`` in place, minimising the mean absolute error.

    Args:
        model: the model; ``scans``: training scans.
        policy: terms that are fitted to each scan. Line offsets are left out, because they average out.
    """
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
    """Return features (k, n), measured height (n,) µm and the scan's own terms (m, n) at the fitted
    pixels.
    """
    at = grid_pixels(scan, FITTED_PX)
    height = scan.height_um.reshape(-1)[at].astype(np.float64)
    return feature_rows(model, scan, at), height, term_maps(TermPixels(scan.layout_um, at=at), terms)


def feature_rows(model: Features, scan: PrintedScan, at: np.ndarray) -> FloatMap:
    """Return features (k, n) at flat indices ``at`` of a scan, computed tile by tile."""
    reach = model.reach_px
    layout = pad_field(torch.from_numpy(scan.layout_um)[None, None], reach, reach)
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
