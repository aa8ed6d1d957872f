"""Linear algebra of the loop: projections on per-scan terms, Gram matrices, damped normal equations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import lsq_linear

from litho_models.loop.prepared import Field

# Weight left to the per-scan terms in a fit: enough to fix what only they carry (the common datum),
# too little to let one scan's datum or bow pull the parameters of the process.
COMMON_WEIGHT = 1e-3
# Squared size below which a combination of unit columns is round-off.
_SMALLEST_EIGENVALUE = 1e-10
_WEAKEST_INFLUENCE = 1e-8


def nuisance_columns(
    field: Field, prediction: np.ndarray, *, gain: bool, bow: bool = True, warp: bool = True
) -> np.ndarray:
    """Per-scan terms at the sampled pixels: (n, k) of 1, x, y, x², xy, y², prediction, warp.

    Args:
        field: the scan.
        prediction: predicted height map (y, x), µm.
        gain: include the prediction itself.
        bow: include x, y, x², xy, y².
        warp: include dH/dy and dH/dx, alone and times y and x: the registration's affine error.
    """
    y, x = field.position
    columns = [np.ones_like(y)]
    if bow:
        columns += [x, y, x * x, x * y, y * y]
    if gain:
        columns.append(field.at_sample(prediction))
    if warp:
        for slope in np.gradient(prediction):
            sampled = field.at_sample(slope)
            columns += [sampled, sampled * y, sampled * x]
    return np.stack(columns, axis=1)


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis (n, k') of the span of the columns; columns without content are dropped."""
    if not columns.shape[1]:
        return columns
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    sizes, directions = np.linalg.eigh(scaled.T @ scaled)
    kept = sizes > _SMALLEST_EIGENVALUE * max(sizes.max(), np.finfo(float).tiny)
    return scaled @ (directions[:, kept] / np.sqrt(sizes[kept]))


def gram(columns: np.ndarray, basis: np.ndarray, weight_in_basis: float = 0.0) -> np.ndarray:
    """Inner products (m, m) of the columns (n, m), the part inside the basis weighted down."""
    return columns.T @ columns - (1 - weight_in_basis) * gram_inside(columns, basis)


def gram_inside(columns: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Inner products (m, m) of the columns' parts inside an orthonormal basis (n, k)."""
    inside = basis.T @ columns
    return inside.T @ inside


def without_scan_terms(
    columns: np.ndarray, field: Field, prediction: np.ndarray, *, gain: bool
) -> np.ndarray:
    """Columns (n,) or (n, m) at the sampled pixels, freed of what a single scan may add."""
    basis = orthonormal(nuisance_columns(field, prediction, gain=gain))
    return columns - basis @ (basis.T @ columns)


def pooled_cosine(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> float:
    """Cosine between two sets of vectors, their inner products summed over the sets."""
    inner, own, other = (
        sum(float(x @ y) for x, y in zip(*pair, strict=True)) for pair in ((a, b), (a, a), (b, b))
    )
    return inner / max(np.sqrt(own * other), np.finfo(float).tiny)


def solve_damped(
    normal: np.ndarray,
    right: np.ndarray,
    damping: float,
    bounds: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Minimise x·A·x / 2 - b·x + damping x·diag(A)·x / 2 inside a box; robust against idle parameters.

    A step that is cut to its bounds afterwards would leave the other parameters where only the uncut
    step was best, and a fit whose optimum lies on a bound would creep; inside the box they follow.

    Args:
        normal, right: A (p, p), positive semi-definite, and b (p,).
        damping: relative to the diagonal.
        bounds: lowest and highest x, (p,) each; none by default.
    """
    diagonal = np.diag(normal).copy()
    floor = max(_WEAKEST_INFLUENCE * diagonal.max(), np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(diagonal, floor))
    scaled = normal / np.outer(scale, scale) + damping * np.eye(len(normal))
    step = np.linalg.lstsq(scaled, right / scale, rcond=1e-9)[0] / scale
    if bounds is None or ((step >= bounds[0]) & (step <= bounds[1])).all():
        return step
    factor = np.linalg.cholesky(scaled + _SMALLEST_EIGENVALUE * np.eye(len(normal)))
    target = np.linalg.solve(factor, right / scale)
    # lsq_linear wants room between the bounds; a parameter without any stays where it is.
    room = np.maximum(bounds[1] - bounds[0], 1e-12)
    box = (bounds[0] * scale, (bounds[0] + room) * scale)
    return lsq_linear(factor.T, target, box, method="bvls").x / scale
