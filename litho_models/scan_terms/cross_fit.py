"""Fit the per-scan terms of a scan, such as datum and bow, to pixels that are not scored. Subtract the terms
from the scored pixels.

The datum and the bow of a scan contain no information about the printer, so the error of a model may be
stated after such terms have been subtracted. In this project, all such errors are computed with
``cross_fit``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from litho_data.foundation.errors import InputError
from litho_models.scan_terms.blocks import Blocks, BoolMap, checkerboard, line_cells
from litho_models.scan_terms.lines import axis_along, shrunk_line_offsets
from litho_models.scan_terms.term import (
    FloatMap,
    LineIndex,
    TermPixels,
    Terms,
    chosen_terms,
    term_maps,
)


@dataclass(frozen=True)
class CrossFit:
    """The residual of a scan after its terms have been subtracted.

    Attributes:
        residual_um: measured height minus predicted height minus terms, µm, of shape (ny, nx). It is NaN at
            pixels that are not scored.
        degrees_of_freedom: effective number of fitted terms, averaged over the scored parts of the scan. Line
            offsets are shrunk towards zero, and each of them counts not as a whole term but as its shrinkage
            weight (0 to 1).
    """

    residual_um: FloatMap
    degrees_of_freedom: float


def cross_fit(
    height_um: np.ndarray,
    prediction_um: np.ndarray,
    valid: np.ndarray,
    terms: Terms,
    blocks: Blocks | None = None,
    *,
    scan_line: LineIndex | None = None,
) -> CrossFit:
    """Return the residual of a scan after its terms have been subtracted. The terms are fitted to one part of
    the pixels and subtracted from the other part, which is scored. The two parts then change places, so that
    every valid pixel is scored.

    Args:
        height_um: measured height, µm, of shape (ny, nx). It may be NaN at pixels that are not valid.
        prediction_um: height that the model predicts, µm, of shape (ny, nx).
        valid: mask of the pixels to use, bool, of shape (ny, nx).
        terms: names of terms in the catalogue ``SCAN_TERMS``; see ``POLICIES`` for the usual sets.
        blocks: division of the pixels into fitted and scored pixels. By default, the standard division is
            used.
        scan_line: index of the scan line of each pixel, counted from 0, of shape (ny, nx). If it is None, the
            rows of the array are the scan lines.

    Raises:
        InputError: a term is unknown, the shapes of the arrays differ, the prediction is not finite at a
            valid pixel, or the scan is too small for the terms.
    """
    blocks = blocks or Blocks()
    height, prediction = np.asarray(height_um, np.float64), np.asarray(prediction_um, np.float64)
    if not height.shape == prediction.shape == valid.shape:
        shapes = f"height {height.shape}, prediction {prediction.shape}, valid {valid.shape}"
        raise InputError("shapes of one scan differ", got=shapes, wanted="the same (ny, nx) for all")
    if scan_line is not None and (scan_line.shape != height.shape or scan_line.min() < 0):
        wanted = f"indices from 0, shape {height.shape}"
        raise InputError("scan_line", got=f"shape {scan_line.shape}", wanted=wanted)
    usable = np.asarray(valid, bool) & np.isfinite(height)
    bad = int(np.sum(~np.isfinite(prediction[usable])))
    if bad:
        raise InputError("prediction", got=f"{bad} non-finite pixels", wanted="finite heights")
    difference = height - prediction
    residual = np.full(height.shape, np.nan)
    basis = term_maps(TermPixels(prediction, scan_line), terms).reshape(-1, *height.shape)
    lines = [term.lines(height.shape, scan_line) for term in chosen_terms(terms) if term.lines]
    axes = [axis_along(line) for line in lines]
    cells = line_cells(height.shape, axes, blocks.line_gap_px)
    freedom = []
    for half in checkerboard(height.shape, blocks):
        rest = difference - _fitted(basis, difference, half.calibrate & usable)
        for cell in cells:
            freed, weights = rest, 0.0
            for line, axis in zip(lines, axes, strict=True):
                other = cell.other_side[axis] & usable
                offsets, weight, _ = shrunk_line_offsets(freed, other, line, blocks.block_px)
                freed = freed - offsets[line]
                weights += float(weight.sum())
            scored = half.score & cell.score & usable
            residual[scored] = freed[scored]
            freedom.append(len(basis) + weights)
    return CrossFit(residual, float(np.mean(freedom)))


def fitted_terms(
    height_um: np.ndarray,
    prediction_um: np.ndarray,
    used: BoolMap,
    terms: Terms,
) -> tuple[FloatMap, FloatMap]:
    """Fit smooth terms to the difference between measured and predicted height at all used pixels. Return the
    coefficients, of shape (k,), and the sum of the fitted terms as a map of shape (ny, nx), µm.

    Use this map for training, for pictures and for finding defects. For errors that are reported, use
    ``cross_fit``, which fits the terms to pixels that are not scored.
    """
    basis = term_maps(TermPixels(prediction_um), terms).reshape(-1, *prediction_um.shape)
    coefficients = least_squares(basis[:, used], (height_um - prediction_um)[used])
    return coefficients, np.tensordot(coefficients, basis, axes=1)


def freed_um(height_um: np.ndarray, prediction_um: np.ndarray, used: BoolMap, terms: Terms) -> FloatMap:
    """Return the measured height minus the predicted height minus the terms that ``fitted_terms`` fits, µm.
    The result has shape (ny, nx) and is 0 at unused pixels.
    """
    added = prediction_um + fitted_terms(height_um, prediction_um, used, terms)[1]
    return np.where(used, height_um - added, 0.0)


def least_squares(design: FloatMap, target: FloatMap) -> FloatMap:
    """Fit ``target`` by a weighted sum of the rows of ``design`` with least squares, and return the weights.
    ``design`` has shape (k, n), ``target`` has shape (n, …), and the result has shape (k, …).
    """
    return np.linalg.lstsq(design @ design.T, design @ target, rcond=1e-12)[0].astype(np.float64)


def _fitted(basis: FloatMap, difference: FloatMap, calibrate: BoolMap) -> FloatMap:
    design = basis[:, calibrate]
    if len(basis) and design.shape[1] <= 2 * len(basis):
        raise InputError(
            "too few calibration pixels for the scan terms",
            got=f"{design.shape[1]} pixels for {len(basis)} terms",
            wanted=f"more than {2 * len(basis)}",
            hint="use a larger field, a smaller block_px, or policy 'none'",
        )
    return np.tensordot(least_squares(design, difference[calibrate]), basis, axes=1)
