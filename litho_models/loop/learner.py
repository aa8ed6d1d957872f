"""Use a cross-validated ridge regression to estimate how much of a residual could still be learned.

The ridge regression uses features of layout and position. It names no cause and is not part of any model. It
shows whether the residual has structure that could be learned, and by how much the error would then decrease.
This decrease can be compared with the decrease that a cause achieves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline

from litho_data.foundation import NM_PER_UM, Array
from litho_models.fitting.fit import common_geometry
from litho_models.fitting.least_squares import gram, orthonormal
from litho_models.fitting.ridge import feature_rows
from litho_models.loop.fits import Study
from litho_models.loop.judging import SMALLEST_SHARE
from litho_models.loop.prepared import ALL_FREE, PreparedScan, sample_border_px
from litho_models.models.features import Features, RandomFeaturesConfig
from litho_models.scan_terms.grouped import ALL, Block, Products
from litho_models.scoring.statistics import interval

# Memory limit for the values of the features. If there are so many scans that it would be exceeded, fewer
# pixels of each scan are used.
_KEPT_BYTES = 512 * 2**20
# Indices of the features whose strength may depend on the writing order or the dose: the height, |∂y| and
# |∂x| of the layout blurred with σ = 0.3 µm, and the layout blurred with σ = 1.6 µm (the surroundings).
_VARYING = (18, 21, 22, 7)
# The ridge regression chooses one of these strengths of its regularisation. A strength of w pulls the weights
# of the features to zero as strongly as w scans would.
_SHRINKINGS = (100.0, 10.0, 1.0, 1e-1, 1e-2, 1e-3)


@dataclass(frozen=True)
class Rest:
    """The part of a residual that the ridge regression explains on held-out scans.

    Attributes:
        gains_nm2: squared error that the ridge regression removes from each held-out scan, of shape (scans,).
        squares_nm2: squared error of each scan without the ridge regression, of shape (scans,). The errors in
            both arrays are computed after the free terms of each scan have been projected out.
    """

    gains_nm2: Array
    squares_nm2: Array

    @property
    def mean_nm2(self) -> float:
        return float(self.gains_nm2.mean())

    @cached_property
    def limits_nm2(self) -> tuple[float, float]:
        """Return the limits of the 95 % confidence interval of the mean of ``gains_nm2``. With fewer than six
        scans, there is no such interval, and the result is 0 and the mean.
        """
        return interval(self.gains_nm2.tolist()) or (0.0, self.mean_nm2)

    @property
    def most_nm(self) -> float:
        """Return an upper bound on the rms error that inexact formulas of the model cause, nm. The bound is
        the square root of the upper end of ``limits_nm2``.
        """
        return float(np.sqrt(max(self.limits_nm2[1], 0.0)))

    @property
    def matters(self) -> bool:
        """Return whether a relevant part of the residual can be learned. This is the case if the ridge
        regression explains more than 1 % of the squared error and both ``limits_nm2`` lie above zero.
        """
        return self.mean_nm2 > SMALLEST_SHARE * float(self.squares_nm2.mean()) and self.limits_nm2[0] > 0


class Learner:
    """A ridge regression on features of the scans of a study. The features are computed once and can then be
    used to explain any number of residuals.

    Args:
        study: the scans with their folds.
        predictions: predicted height of each scan, µm, of shape (ny, nx). It is used to compute the maps of
            the free terms (such as the gain).
    """

    def __init__(self, study: Study, predictions: Sequence[Array]):
        self._fold_of = study.fold_of
        # These are the layout features that the models of the zoo use for such scans.
        model = Features(RandomFeaturesConfig.of_variant(**common_geometry(study.scans)))
        pixels = sum(len(scan.sample) for scan in study.scans)
        self._every = -(-pixels * 4 * 360 // _KEPT_BYTES)
        # The facts about each scan are its position in the writing order and the deviation of its dose from
        # nominal. A dependence on one of these facts can be learned only if the scans have at least three
        # different values of it.
        facts = np.array([(scan.context.order, scan.context.dose - 1.0) for scan in study.scans])
        varied = facts[:, [len(np.unique(own)) >= 3 for own in facts.T]]
        # For each scan: its features, the orthonormal basis of its free terms, the inner products of the
        # features without the free terms, and the scan itself.
        self._parts = []
        for scan, own, values in zip(study.scans, predictions, varied, strict=True):
            rows = self._rows(model, scan, values)
            basis = orthonormal(scan.terms_at_sample(own, ALL_FREE)[:, :: self._every].T)
            inner = gram(rows.T.astype(np.float64), basis) / len(basis)
            self._parts.append((rows, basis, inner, scan))

    def rest(self, predictions: Sequence[Array]) -> Rest:
        """Explain the residual of each scan (measured minus predicted height) by a ridge regression that is
        fitted to the scans of other folds. Return the part that the regression explains.

        Args:
            predictions: predicted height of each scan, µm, of shape (ny, nx), by a model that was fitted
                without the fold of this scan.
        """
        products = []
        for own, (rows, basis, inner, scan) in zip(predictions, self._parts, strict=True):
            residual = scan.residual(own)[:: self._every]
            residual -= basis @ (basis.T @ residual)
            whole = np.pad(inner, [(1, 0), (1, 0)])
            whole[0, 0] = np.mean(residual**2)
            whole[0, 1:] = whole[1:, 0] = rows @ residual / len(residual)
            products.append(whole)
        grams = np.stack(products)
        left = _held_out(grams, self._fold_of) * NM_PER_UM**2
        squares = grams[:, 0, 0] * NM_PER_UM**2
        return Rest(squares - left, squares)

    def _rows(self, model: Features, scan: PreparedScan, varied: Array) -> Array:
        """Return the m features at n pixels of a scan: the features of layout and position, some of their
        products, and products of some features with the writing order and the dose. The result is float32
        of shape (m, n).

        The features of position are the 25 products of five splines along y and five splines along x.
        """
        at, (ny, nx) = scan.sample[:: self._every], scan.shape
        y, x = np.divmod(at, nx)
        of_place = (_splines(ny)[:, None, y] * _splines(nx)[None, :, x]).reshape(-1, len(at))
        of_layout = feature_rows(model, scan, at)
        varying = np.stack([*of_layout[list(_VARYING)], of_layout[_VARYING[0]] ** 2])
        # Products of the height, ∂y and ∂x with the position represent a gain and a displacement that depend
        # on the position.
        columns = [of_layout, of_place, *(of_place * of_layout[one] for one in (18, 19, 20))]
        for value in varied:
            columns += [value * varying, *((value > step) * varying for step in (-0.25, 0.0, 0.25))]
        return np.concatenate(columns).astype(np.float32)


def _held_out(grams: Array, fold_of: Array) -> Array:
    """Return the mean squared residual that the ridge regression leaves in each scan. For each scan, the
    regression is fitted, and its regularisation is chosen, without the scans of the same fold. If only one
    scan is left for the fit, the strengths of the regularisation cannot be compared, and the first of them is
    used. The result has shape (scans,).
    """
    left, products = np.empty(len(grams)), Products.ungrouped(grams)
    columns = tuple(range(1, grams.shape[1]))
    blocks = [Block(columns, ALL, shrinking) for shrinking in _SHRINKINGS]
    for fold in np.unique(fold_of):
        own, rest = np.flatnonzero(fold_of == fold), np.flatnonzero(fold_of != fold)
        inner, inner_of = Products.ungrouped(grams[rest]), fold_of[rest]
        if len(set(inner_of)) == 1:
            inner_of = rest
        block = min(blocks, key=lambda one: float(inner.held_out([one], inner_of).sum()))
        left[own] = products.squares([block], products.strengths([block], rest), own)
    return left


def _splines(size: int) -> Array:
    """Return five cubic splines along an axis with ``size`` pixels. Their sum is 1 at every pixel, and their
    knots divide the part of the axis that is used for fits. The result has shape (5, size).

    Outside this part, the splines are constant, because the fit has no pixels there that could determine
    them.
    """
    first = sample_border_px(size)
    position = np.interp(np.arange(size), [first, size - 1 - first], [-1.0, 1.0])
    knots = [-1.0] * 4 + [0.0] + [1.0] * 4
    return BSpline.design_matrix(position, knots, 3).toarray().T
