"""Level a scan with the help of its layout. The slope and the bow of the printed structure are kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field
from scipy import ndimage

from litho_data.foundation import YX, Array, InputError, Shape
from litho_data.level.operation import operation
from litho_data.level.polynomial import Degree, Terms, evaluate, polynomial_terms
from litho_data.level.selection import Levelled, subtract
from litho_data.register.geometry import apply_transform, lattice
from litho_data.register.topography import smooth_measured

if TYPE_CHECKING:
    from litho_data.register.bend import Bend

# Eigenvalues of the normal matrix below this share of the largest eigenvalue are lost in rounding errors, so
# they are raised to this share. The background may nevertheless be well determined. For example, if all
# pixels between two knots have the same level, only the heights at these knots are undetermined.
_SINGULAR = 1e-9
# A background is refused if its error due to noise is larger than this number times the error in a fit
# without a layout.
_MOST_LOSS = 1000.0
# The height as a function of the level has one knot per level, but at most this number of intervals between
# knots.
_MOST_INTERVALS = 64
_ROWS_AT_ONCE = 64
_BLURS_PX = (0.0, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
_LEAST_INSIDE = 0.25


@operation("layout-aware")
def level_layout_aware(
    z: Array,
    chosen: Array,
    *,
    layout_level: Array,
    blur_px: Annotated[float, Field(ge=0)] | None = None,
    x_degree: Degree = 1,
    y_degree: Degree = 1,
    total_degree: Degree | None = 1,
) -> Levelled:
    """Fit the background and the printed structure together, and subtract only the background.

    The least-squares model is z = sum_pq c_pq x^p y^q + g(blurred level). The function g is the height as a
    function of the level. It is piecewise linear, and its value at every level is fitted. If there are more
    than 65 levels, its values at 65 evenly spaced levels are fitted. A polynomial fit without g would treat
    the slope of the printed structure as background. The datum (the unknown zero height of the scan) is part
    of g. The subtracted polynomial therefore has no free constant term, and its mean over the fitted pixels
    is zero.

    Args:
        z: heights in any unit, shape (ny, nx).
        layout_level: level of the layout under each pixel of the scan, shape (ny, nx), NaN outside the
            layout; see ``layout_in_scan_frame``.
        blur_px: sigma, in pixels, of the Gaussian that blurs the layout as printing does. By default, a few
            values are tried, and the value with the best fit is used. Pixels within two sigma of the layout's
            edge are not fitted, because their height depends on what surrounds the layout.
        x_degree, y_degree, total_degree: as in ``level_polynomial``; by default a plane.

    Raises:
        InputError: the degrees allow only a constant background; the layout has another shape than the scan
            or does not overlap with it; or the layout cannot be separated from the background, because both
            have the same form, such as a ramp.
    """
    if layout_level.shape != z.shape:
        raise InputError("layout in the scan's frame: shape", got=layout_level.shape, wanted=z.shape)
    terms = tuple(term for term in polynomial_terms(x_degree, y_degree, total_degree) if term != (0, 0))
    if not terms:
        raise InputError("degree of the layout-aware background", got=0, wanted="1 or more")
    blurs = _BLURS_PX if blur_px is None else (blur_px,)
    known = np.isfinite(layout_level)
    fitted = chosen & _inside(known, 2 * blurs[-1])
    if not fitted.any():
        raise InputError(
            "the layout covers no measured pixel of the scan", wanted="a layout in the scan's frame"
        )
    level = np.asarray(layout_level, dtype=float)
    fits = [
        _joint_fit(z, np.where(known, smooth_measured(level, blur), np.nan), fitted, terms) for blur in blurs
    ]
    surface = evaluate(min(fits, key=lambda fit: fit[1])[0], z.shape)
    return subtract(z, surface - surface[fitted].mean())


def _inside(known: Array, border_px: float) -> Array:
    """Select the pixels at which ``known`` is true, except pixels within ``border_px`` of a pixel at which it
    is false. If at most a quarter of the known pixels would be left, select all of them.
    """
    if known.all():
        return known
    inner = ndimage.distance_transform_edt(known) > border_px
    return inner if inner.sum() > _LEAST_INSIDE * known.sum() else known


def layout_in_scan_frame(
    layout_level: Array,
    scan_to_layout: Array,
    scan_shape: Shape,
    scan_pitch_um: YX,
    layout_pitch_um: float,
    bend_um: Bend | None = None,
) -> Array:
    """Return the level of the layout pixel under each pixel of a scan; NaN outside the layout.

    Args:
        layout_level: levels of the layout, shape (ny, nx).
        scan_to_layout: 3 x 3 matrix that maps homogeneous coordinates (x_um, y_um, 1) in the scan's frame to
            those in the layout's frame.
        bend_um: bend of the scan; coordinates are corrected for it before ``scan_to_layout`` is applied.

    Returns:
        A float64 array of shape ``scan_shape``. Each value is the level of the nearest layout pixel, because
        levels are labels and must not be interpolated.
    """
    points_um = lattice(
        *((np.arange(n) + 0.5) * pitch for n, pitch in zip(scan_shape, scan_pitch_um, strict=True))
    )
    if bend_um is not None:
        points_um = bend_um.straighten(points_um)
    column, row = np.floor(apply_transform(scan_to_layout, points_um).T / layout_pitch_um).astype(int)
    inside = (row >= 0) & (row < layout_level.shape[0]) & (column >= 0) & (column < layout_level.shape[1])
    levels = np.full(len(points_um), np.nan)
    levels[inside] = layout_level[row[inside], column[inside]]
    return levels.reshape(scan_shape)


def level_hats(level: Array, top: int) -> Array:
    """Evaluate hat functions at the given levels. A continuous function of the level that is linear between
    the knots is a weighted sum of hat functions.

    Each hat is 1 at its own knot and 0 at all others. There is one knot per level from 0 to ``top``, or 65
    evenly spaced knots if there are more levels.

    Args:
        level: levels, which need not be integers, shape (n,).
        top: position of the highest knot, at least as high as the highest level.

    Returns:
        An array of shape (knots, n).
    """
    step = max(1.0, top / _MOST_INTERVALS)
    knots = step * np.arange(min(top, _MOST_INTERVALS) + 1)
    return np.stack([np.clip(1 - np.abs(level - knot) / step, 0.0, None) for knot in knots])


def _joint_fit(z: Array, blurred: Array, fitted: Array, terms: Terms) -> tuple[Array, float]:
    """Fit background and structure together. Return the Legendre coefficients of the background and a score.
    The score is the sum of squares that the fit explains, with a negative sign, so the best fit has the
    lowest score.
    """
    normal, right = _normal_equations(z, blurred, fitted, terms)
    used = np.diag(normal) > 0
    normal, right = normal[np.ix_(used, used)], right[used]
    scale = 1 / np.sqrt(np.diag(normal))
    values, directions = np.linalg.eigh(normal * np.outer(scale, scale))
    values = np.maximum(values, _SINGULAR * values[-1])
    loss = np.sqrt((directions[: len(terms)] ** 2 / values).sum(axis=1).max())
    if loss > _MOST_LOSS:
        raise InputError(
            "the layout cannot be told from the background",
            got=f"an error {loss:.1g} times as large as without a layout",
            wanted="a lower degree or a layout with independent structure",
        )
    solution = scale * (directions @ ((directions.T @ (scale * right)) / values))
    coefficients = np.zeros((max(q for _, q in terms) + 1, max(p for p, _ in terms) + 1))
    for (p, q), value in zip(terms, solution, strict=False):
        coefficients[q, p] = value
    return coefficients, -float(right @ solution)


def _normal_equations(z: Array, blurred: Array, fitted: Array, terms: Terms) -> tuple[Array, Array]:
    """Return the matrix and the right-hand side of the normal equations of the joint fit. They are summed
    over strips of rows, so that the whole design matrix is never in memory.
    """
    x, y = (np.linspace(-1.0, 1.0, n) for n in (z.shape[1], z.shape[0]))
    basis_x = np.polynomial.legendre.legvander(x, max(p for p, _ in terms))
    basis_y = np.polynomial.legendre.legvander(y, max(q for _, q in terms))
    top = max(int(np.ceil(np.nanmax(blurred))), 0)
    size = len(terms) + len(level_hats(np.zeros(1), top))
    normal, right = np.zeros((size, size)), np.zeros(size)
    for start in range(0, z.shape[0], _ROWS_AT_ONCE):
        strip = slice(start, start + _ROWS_AT_ONCE)
        inside = fitted[strip]
        columns = [np.multiply.outer(basis_y[strip, q], basis_x[:, p])[inside] for p, q in terms]
        level = blurred[strip][inside]
        design = np.concatenate([np.stack(columns), level_hats(level, top)])
        normal += design @ design.T
        right += design @ z[strip][inside]
    return normal, right
