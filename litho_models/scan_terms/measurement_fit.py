"""Learn the measurement model. Its parts are changes that several scans have in common. The module chooses
the parts and fits their coefficients.

A part is, for example, a background or a displacement that is the same in all scans of a group. Parts are
chosen by cross-validation within the given scans.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from litho_data.store import PrintedScan
from litho_data.store.lock_box import drawing_key
from litho_models.scan_terms.background import Pair, of_usual_size
from litho_models.scan_terms.blocks import thinned
from litho_models.scan_terms.cross_fit import least_squares
from litho_models.scan_terms.grouped import ALL, Block, Products, groupings
from litho_models.scan_terms.measurement import (
    LEVELLED,
    Levelling,
    MeasurementModel,
    Shared,
    SharedPart,
    polynomial_count,
    polynomials,
)
from litho_models.scan_terms.term import FloatMap

_HIGHEST, _LATERAL = 11, 3
# The polynomial degrees to try for each kind of part: for parts that are the same in all scans, and for parts
# whose coefficients differ by group. In a field of 54 µm, a background of degree 11 varies over lengths down
# to 9 µm.
_FOR_ALL: dict[Shared, list[int]] = {
    "background": [2, 4, _HIGHEST],
    "shift-x": [_LATERAL],
    "shift-y": [_LATERAL],
}
_FOR_GROUPS: dict[Shared, list[int]] = {**_FOR_ALL, "background": [3, _HIGHEST], "gain": [0]}
# Weights to try for the prior that pulls the coefficients of every group towards zero. A prior with the
# weight w weighs as much as w scans. The ideal weight is the variance within groups divided by the variance
# between groups.
_SHRINKING = (0.3, 1.0, 3.0)
# A part is added only if the squared error on held-out scans falls by more than ``_LEAST_Z`` standard errors
# of the decrease, and by more than the fraction ``_LEAST_SHARE`` of the squared error.
_LEAST_Z, _LEAST_SHARE = 0.5, 0.003
_SAMPLED_PX = 16384
# Each round linearises the displacements. The second round linearises them at the displacements that the
# first round has found.
_ROUNDS = 2
_INNER_FOLDS = 5


def learn_measurement(
    scans: Sequence[PrintedScan],
    predictions_um: Sequence[np.ndarray],
    *,
    seed: int = 0,
    like: MeasurementModel | None = None,
) -> MeasurementModel:
    """Learn the measurement model from the differences between the given scans and the predicted heights of
    their prints.

    Parts are added one at a time, as long as each part lowers the cross-validated squared error by more than
    0.3 % and by more than half the standard error of this decrease. If the fields of the scans differ in
    size, only the scans with the most frequent field size are used. For electron micrographs of films, the
    returned model has no parts.

    Args:
        scans: the scans from which the model is learned.
        predictions_um: predicted height of the print of each scan, µm, of shape (ny, nx).
        seed: seed that assigns the scans to the folds of the cross-validation.
        like: an earlier measurement model. If it is given, its levelling and parts are used, and only the
            coefficients of these parts are fitted again.
    """
    usual_um, pairs = of_usual_size(scans, predictions_um)
    if scans[0].seen_by == "sem":
        return MeasurementModel(levelling="none", parts=[], field_um=usual_um, scans=0)
    levelling = like.levelling if like else _best_levelling(pairs)
    model = MeasurementModel(levelling=levelling, parts=[], field_um=usual_um, scans=len(pairs))
    groups = groupings([scan for scan, _ in pairs], by_order=False)
    chosen = like.parts if like else None
    for _ in range(_ROUNDS):
        products = Products(np.stack([_gram(*pair, model) for pair in pairs]), groups)
        if chosen is None:
            chosen = _chosen(products, _deal([scan.id for scan, _ in pairs], seed))
        model = model.model_copy(update={"parts": _fitted(products, chosen)})
        if not chosen:
            break
    return model


def _chosen(products: Products, fold_of: np.ndarray) -> list[SharedPart]:
    """Choose the parts of the measurement model by cross-validation. ``fold_of`` contains the fold number of
    each scan and has shape (scans,).
    """
    chosen: list[SharedPart] = []
    if len(fold_of) < 2:
        return chosen
    left = products.held_out([], fold_of)
    while offers := _offers(products.groups, chosen):
        tried = (products.held_out([*map(_block, (*chosen, one))], fold_of) for one in offers)
        best, rest = min(zip(offers, tried, strict=True), key=lambda pair: pair[1].mean())
        gain = left - rest
        error = gain.std(ddof=1) / np.sqrt(len(gain))
        if gain.mean() <= max(_LEAST_Z * error, _LEAST_SHARE * left.mean()):
            break
        chosen.append(best)
        left = rest
    return chosen


def _offers(groups: Iterable[str], chosen: Sequence[SharedPart]) -> list[SharedPart]:
    taken = {(part.what, part.by) for part in chosen}
    return [
        SharedPart(what=what, by=by, degree=degree, shrinking=shrinking, coefficients={})
        for by in groups
        for what, degrees in (_FOR_ALL if by == ALL else _FOR_GROUPS).items()
        if (what, by) not in taken
        for degree in degrees
        for shrinking in (_SHRINKING[:1] if by == ALL else _SHRINKING)
    ]


def _fitted(products: Products, chosen: Sequence[SharedPart]) -> list[SharedPart]:
    """Fit the coefficients of the chosen parts."""
    fitted = products.strengths([*map(_block, chosen)], np.arange(len(products.grams)))
    return [
        part.model_copy(update={"coefficients": {label: own.tolist() for label, own in strengths.items()}})
        for part, strengths in zip(chosen, fitted, strict=True)
    ]


def _gram(scan: PrintedScan, prediction_um: np.ndarray, model: MeasurementModel) -> FloatMap:
    """Return the inner products, divided by the number of pixels, between the residual of a scan and the m
    columns (regressors) of all parts that may be tried. Index 0 stands for the residual. The result has shape
    (1 + m, 1 + m).

    The values are taken at a thinned set of pixels, and the mean of the residual and of each column is
    subtracted. The columns are computed by linearisation at the current measurement model.

    The contribution of the parts that are already in ``model`` is added back to the residual, to first order.
    Each round therefore fits the full coefficients and not corrections to them. As a result, the prior
    shrinks the coefficients only once, however many rounds there are.
    """
    at = thinned(scan.usable, _SAMPLED_PX)
    seen = model.displaced_um(scan, prediction_um)
    slope_y, slope_x = np.array(np.gradient(seen, scan.pitch_um))[:, at]
    shapes = polynomials(scan.shape, _HIGHEST)[:, at]
    lateral = shapes[: polynomial_count(_LATERAL)]
    moved = np.stack([*lateral * slope_x, *lateral * slope_y, seen[at]])
    # The background is added after levelling, so the columns of the background are not levelled.
    surface = shapes[[0, *LEVELLED[model.levelling]]]
    moved -= least_squares(surface, moved.T).T @ surface
    residual = (scan.height_um - model.expected_um(scan, prediction_um))[at]
    rows = np.stack([residual, *shapes[1:], *moved])
    for part in model.parts_of(scan):
        rows[0] += part.of(scan) @ rows[list(_block(part).columns)]
    rows -= rows.mean(axis=1, keepdims=True)
    return rows @ rows.T / rows.shape[1]


def _block(part: SharedPart) -> Block:
    """Return the block of a part: its columns in the result of ``_gram``, its grouping and its prior."""
    surface, lateral = polynomial_count(_HIGHEST), polynomial_count(_LATERAL)
    starts = {
        "background": 1,
        "shift-x": surface,
        "shift-y": surface + lateral,
        "gain": surface + 2 * lateral,
    }
    start, count = starts[part.what], polynomial_count(part.degree) - (part.what == "background")
    return Block(tuple(range(start, start + count)), part.by, part.shrinking)


def _best_levelling(pairs: Sequence[Pair]) -> Levelling:
    """Choose the levelling with which the predictions fit the scans best. The bow and tilt that all scans
    share are first removed.
    """
    rests = []
    for scan, prediction in pairs:
        at = thinned(scan.usable, _SAMPLED_PX)
        shapes = polynomials(scan.shape, 2)[:, at]
        height, expected = (one[at].astype(np.float64) for one in (scan.height_um, prediction))
        surfaces = (shapes[[0, *own]] for own in LEVELLED.values())
        seen = [expected - least_squares(surface, expected) @ surface for surface in surfaces]
        rests.append(least_squares(shapes, (height - seen).T))
    # Legendre polynomials are nearly orthogonal over a field, so the squared error that a levelling leaves is
    # a weighted sum of the variances of the polynomial coefficients over the scans.
    weights = np.mean(polynomials(pairs[0][0].shape, 2) ** 2, axis=(1, 2))
    left = weights[1:] @ np.var(rests, axis=0)[1:]
    return [*LEVELLED][left.argmin()]


def _deal(ids: Sequence[str], seed: int) -> np.ndarray:
    """Return the number of the inner fold of each scan. The scans are dealt to the folds in the order of a
    hash of their ids.
    """
    keys = [drawing_key(scan_id, seed) for scan_id in ids]
    return np.argsort(np.argsort(keys)) % min(_INNER_FOLDS, len(ids))
