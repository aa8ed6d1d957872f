"""Remove polynomial backgrounds, fitted by least squares as in Gwyddion, or by a robust fit."""

from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.polynomial import legendre
from pydantic import Field

from litho_data.foundation import Array, InputError, Shape
from litho_data.level.operation import operation
from litho_data.level.selection import Levelled, subtract

Degree = Annotated[int, Field(ge=0, le=11)]
Terms = tuple[tuple[int, int], ...]

# If the ratio of the smallest to the largest eigenvalue of the normal matrix is below this limit, the
# smallest eigenvalue is nothing but rounding error, so the fit is not determined.
_SINGULAR = 1e-12
_WELL_CONDITIONED = 1e3
# Widths of Huber's and Tukey's weight functions in units of the noise. With these widths, the robust fits
# have 95 % of the efficiency of least squares under Gaussian noise (Holland and Welsch 1977,
# doi:10.1080/03610927708827533).
_HUBER, _TUKEY = 1.345, 4.685
_MAD_TO_SIGMA = 1.4826
_MAX_ROUNDS = 200
# The robust fit ends when the surface changes by less than this, in units of the noise.
_SETTLED = 1e-7


@operation("polynomial")
def level_polynomial(
    z: Array,
    chosen: Array,
    *,
    x_degree: Degree = 3,
    y_degree: Degree = 3,
    total_degree: Degree | None = None,
) -> Levelled:
    """Subtract the least-squares polynomial, including its constant term.

    The mean of the fitted pixels becomes zero. Without ``total_degree``, the terms are x^p y^q with p <=
    x_degree and q <= y_degree (Gwyddion's independent degrees). With ``total_degree``, the terms are those
    with p + q <= total_degree (Gwyddion's limited total degree), and ``x_degree`` and ``y_degree`` are
    ignored.

    Args:
        z: heights in any unit, shape (ny, nx).

    Raises:
        InputError: a degree is outside 0..11, or the selected pixels do not determine all terms.
    """
    terms = polynomial_terms(x_degree, y_degree, total_degree)
    return subtract(z, evaluate(fit_terms(z, chosen, terms), z.shape))


@operation("robust")
def level_robust(
    z: Array,
    chosen: Array,
    *,
    x_degree: Degree = 1,
    y_degree: Degree = 1,
    total_degree: Degree | None = 1,
) -> Levelled:
    """Subtract a robustly fitted polynomial, including its constant term, so that the main surface lies at
    zero.

    The polynomial is fitted by iteratively reweighted least squares. Residuals are measured in units of
    1.4826 times their median absolute deviation (MAD). The weights are Tukey's biweight, which gives features
    far from the surface no weight. The iteration starts from a fit with Huber's weights, because Huber's loss
    has a single minimum.

    Args:
        z: heights in any unit, shape (ny, nx).
        x_degree, y_degree, total_degree: as in ``level_polynomial``; by default a plane.

    Raises:
        InputError: the selected pixels do not determine the polynomial.
    """
    return subtract(z, robust_surface(z, chosen, polynomial_terms(x_degree, y_degree, total_degree)))


def robust_surface(z: Array, chosen: Array, terms: Terms) -> Array:
    """Fit a polynomial robustly to the chosen pixels, and return the polynomial's values at all pixels."""
    surface = evaluate(fit_terms(z, chosen, terms), z.shape)
    for weights_of in (_huber, _tukey):
        for _ in range(_MAX_ROUNDS):
            residual = np.where(chosen, z - surface, 0.0)
            sigma = noise_sigma(residual[chosen])
            if sigma <= np.finfo(float).eps * float(np.abs(z[chosen]).max()):
                return surface
            weights = chosen * weights_of(residual / sigma)
            before, surface = surface, evaluate(fit_terms(z, weights, terms), z.shape)
            if float(np.abs(surface - before).max()) < _SETTLED * sigma:
                break
    return surface


def noise_sigma(residual: Array) -> float:
    """Return 1.4826 times the median absolute residual. For Gaussian noise this is the standard deviation,
    and a few outliers hardly change it.
    """
    return _MAD_TO_SIGMA * float(np.median(np.abs(residual)))


def _huber(scaled: Array) -> Array:
    return _HUBER / np.maximum(np.abs(scaled), _HUBER)


def _tukey(scaled: Array) -> Array:
    return np.clip(1 - (scaled / _TUKEY) ** 2, 0.0, None) ** 2


def polynomial_terms(x_degree: int, y_degree: int, total_degree: int | None = None) -> Terms:
    """Return the exponents (p, q) of all polynomial terms x^p y^q up to the given degrees."""
    degrees = (x_degree, y_degree) if total_degree is None else (total_degree, total_degree)
    return tuple(
        (p, q)
        for q in range(degrees[1] + 1)
        for p in range(degrees[0] + 1)
        if total_degree is None or p + q <= total_degree
    )


def fit_terms(z: Array, weights: Array, terms: Terms) -> Array:
    """Fit the heights by weighted least squares, and return the coefficients c[q, p] of the products P_q(y)
    P_p(x) of Legendre polynomials.

    Column j has the coordinate x = 2 j / (nx - 1) - 1, which runs from -1 to 1. The y coordinates of rows are
    defined in the same way. With Legendre polynomials, the fit is far better conditioned than with powers.
    Both span the same polynomials if, for each term in ``terms``, all terms of lower degrees are included as
    well. The sums over the pixels separate into x and y, so the fit costs only a few products of thin
    matrices.

    Args:
        z: heights, shape (ny, nx); NaN only where the weight is zero.
        weights: weight of each pixel, shape (ny, nx); non-negative numbers, or booleans, where True is the
            weight 1.

    Raises:
        InputError: the weighted pixels do not determine all terms.
    """
    weights = np.asarray(weights, float)
    p, q = np.array(terms).T
    basis_y, basis_x = (_basis(n, int(most.max())) for n, most in zip(z.shape, (q, p), strict=True))
    pairs_y, pairs_x = (one[:, :, None] * one[:, None, :] for one in (basis_y, basis_x))
    moments = np.tensordot(pairs_y, np.tensordot(weights, pairs_x, axes=1), axes=(0, 0))
    scales, directions = np.linalg.eigh(moments[q[:, None], q, p[:, None], p])
    if scales[0] <= _SINGULAR * scales[-1]:
        raise InputError(
            "the selected pixels do not determine the background",
            got=f"{len(terms)} terms, condition {scales[-1] / max(scales[0], np.finfo(float).tiny):.1g}",
            wanted="a lower degree or more pixels",
        )
    residual = np.where(weights > 0, z, 0.0)
    coefficients = np.zeros((basis_y.shape[1], basis_x.shape[1]))
    # If the mask makes the fit badly conditioned, a second round fits the residual that rounding errors left
    # after the first round.
    for _ in range(1 if scales[-1] <= _WELL_CONDITIONED * scales[0] else 2):
        right = (basis_y.T @ (weights * residual) @ basis_x)[q, p]
        step = np.zeros_like(coefficients)
        step[q, p] = directions @ ((directions.T @ right) / scales)
        coefficients += step
        residual = residual - evaluate(step, z.shape)
    return coefficients


def evaluate(coefficients: Array, shape: Shape) -> Array:
    """Evaluate a surface on a grid of the given shape. The coefficients are as returned by ``fit_terms``."""
    basis_y, basis_x = (_basis(n, k - 1) for n, k in zip(shape, coefficients.shape, strict=True))
    return basis_y @ coefficients @ basis_x.T


@lru_cache(maxsize=64)
def _basis(n: int, degree: int) -> Array:
    basis = legendre.legvander(np.linspace(-1.0, 1.0, n), degree)
    basis.flags.writeable = False
    return basis
