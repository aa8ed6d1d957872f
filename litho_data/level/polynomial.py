"""Polynomial backgrounds: by least squares, as in Gwyddion, and of the majority of the pixels."""

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.polynomial import legendre
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array, Shape
from litho_data.level.operation import operation
from litho_data.level.selection import Levelled, subtract, subtract_product

Degree = Annotated[int, Field(ge=0, le=11)]
Terms = tuple[tuple[int, int], ...]

# Below it, the smallest direction of the normal matrix is rounding noise.
_SINGULAR = 1e-12
_WELL_CONDITIONED = 1e3


@operation("polynomial")
def level_polynomial(
    z: Array,
    chosen: Array | None,
    *,
    x_degree: Degree = 3,
    y_degree: Degree = 3,
    total_degree: Degree | None = None,
) -> Levelled:
    """Subtract the least-squares polynomial, its constant included.

    The mean of the fitted pixels becomes zero. Without ``total_degree`` the terms are x^p y^q with
    p <= x_degree and q <= y_degree (Gwyddion's independent degrees, column and row degree); with
    it, p + q <= total_degree and the other two degrees do not count (limited total degree).

    Args:
        z: (ny, nx), any unit.

    Raises:
        InputError: a degree outside 0..11, or selected pixels that do not determine all terms.
    """
    terms = polynomial_terms(x_degree, y_degree, total_degree)
    return subtract_product(z, *surface_factors(fit_terms(z, chosen, terms), z.shape))


def polynomial_terms(x_degree: int, y_degree: int, total_degree: int | None = None) -> Terms:
    """The exponents (p, q) of x^p y^q."""
    degrees = (x_degree, y_degree) if total_degree is None else (total_degree, total_degree)
    return tuple(
        (p, q)
        for q in range(degrees[1] + 1)
        for p in range(degrees[0] + 1)
        if total_degree is None or p + q <= total_degree
    )


def fit_terms(z: Array, weights: Array | None, terms: Terms) -> Array:
    """Weighted least-squares coefficients c[q, p] of P_q(y) P_p(x), P the Legendre polynomials.

    x = 2 j / (nx - 1) - 1 and y alike. Any set of terms that contains all lower ones spans the
    same polynomials in the Legendre basis as in powers, at a far better condition. The moments
    are separable, so that the cost is that of a few thin matrix products.

    Args:
        z: (ny, nx); NaN only where the weight is zero.
        weights: (ny, nx), not negative, or bool with weight 1 for True; None for 1 everywhere.

    Raises:
        InputError: the weighted pixels do not determine all terms.
    """
    weights = None if weights is None else np.asarray(weights, float)
    powers_x, powers_y = [p for p, _ in terms], [q for _, q in terms]
    basis_x = _basis(z.shape[1], max(powers_x))
    basis_y = _basis(z.shape[0], max(powers_y))
    factors = _eigen_factors(_normal_matrix(weights, basis_x, basis_y, powers_x, powers_y))
    coefficients = np.zeros((basis_y.shape[1], basis_x.shape[1]))
    if weights is None:
        coefficients[powers_y, powers_x] = _solve(factors, (basis_y.T @ (z @ basis_x))[powers_y, powers_x])
        return coefficients
    known = weights * z
    if not np.isfinite(known.sum()):
        known[~(weights > 0)] = 0.0
    coefficients[powers_y, powers_x] = _solve(factors, (basis_y.T @ (known @ basis_x))[powers_y, powers_x])
    if factors[0][-1] > _WELL_CONDITIONED * factors[0][0]:
        # A second round removes the rounding error of the first under a badly conditioned mask.
        known -= weights * (basis_y @ (coefficients @ basis_x.T))
        coefficients[powers_y, powers_x] += _solve(
            factors, (basis_y.T @ (known @ basis_x))[powers_y, powers_x]
        )
    return coefficients


def evaluate(coefficients: Array, shape: Shape) -> Array:
    """The surface of ``fit_terms``'s coefficients on (ny, nx) pixels."""
    along_y, along_x = surface_factors(coefficients, shape)
    return along_y @ along_x


def surface_factors(coefficients: Array, shape: Shape) -> tuple[Array, Array]:
    """(ny, k) and (k, nx): the surface of ``fit_terms``'s coefficients is their product."""
    basis_y = _basis(shape[0], coefficients.shape[0] - 1)
    basis_x = _basis(shape[1], coefficients.shape[1] - 1)
    return basis_y, coefficients @ basis_x.T


@lru_cache(maxsize=64)
def _basis(n: int, degree: int) -> Array:
    basis = legendre.legvander(np.linspace(-1.0, 1.0, n), degree)
    basis.flags.writeable = False
    return basis


def _normal_matrix(
    weights: Array | None,
    basis_x: Array,
    basis_y: Array,
    powers_x: list[int],
    powers_y: list[int],
) -> Array:
    if weights is None:
        gram_x, gram_y = basis_x.T @ basis_x, basis_y.T @ basis_y
        return gram_x[np.ix_(powers_x, powers_x)] * gram_y[np.ix_(powers_y, powers_y)]
    pairs_x, pairs_y = _pairs(basis_x), _pairs(basis_y)
    moments = pairs_y.T @ (weights @ pairs_x)
    moments = moments.reshape(basis_y.shape[1], basis_y.shape[1], basis_x.shape[1], basis_x.shape[1])
    p, q = np.array(powers_x), np.array(powers_y)
    return moments[q[:, None], q[None, :], p[:, None], p[None, :]]


def _pairs(basis: Array) -> Array:
    """(n, d^2): products of any two columns."""
    return (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)


def _eigen_factors(normal: Array) -> tuple[Array, Array]:
    scales, directions = np.linalg.eigh(normal)
    if scales[0] <= _SINGULAR * scales[-1]:
        raise InputError(
            "the selected pixels do not determine the background",
            got=f"{len(normal)} terms, condition {scales[-1] / max(scales[0], np.finfo(float).tiny):.1g}",
            wanted="a lower degree or more pixels",
        )
    return scales, directions


def _solve(factors: tuple[Array, Array], right: Array) -> Array:
    scales, directions = factors
    return directions @ ((directions.T @ right) / scales)


Loss = Literal["huber", "tukey"]
# Widths in units of the noise at which 95 % of the efficiency of least squares is kept under
# Gaussian noise (Holland and Welsch 1977, doi:10.1080/03610927708827533).
_WIDTH = {"huber": 1.345, "tukey": 4.685}
_MAD_TO_SIGMA = 1.4826
_MAX_ROUNDS = 200
# A change of the surface, in units of the noise, that is too small to matter.
_SETTLED = 1e-7


@operation("robust")
def level_robust(
    z: Array,
    chosen: Array | None,
    *,
    x_degree: Degree = 1,
    y_degree: Degree = 1,
    total_degree: Degree | None = 1,
    loss: Loss = "tukey",
) -> Levelled:
    """Subtract the robust polynomial with its constant: the main surface then lies at zero.

    Iteratively reweighted least squares with the scale 1.4826 · MAD. Tukey's biweight gives no
    weight to distant features and starts from the Huber solution, which has a single minimum.

    Args:
        z: (ny, nx), any unit.
        x_degree, y_degree, total_degree: as in ``level_polynomial``; by default a plane.

    Raises:
        InputError: an unknown loss, or pixels that do not determine the polynomial.
    """
    terms = polynomial_terms(x_degree, y_degree, total_degree)
    return subtract(z, robust_surface(z, chosen, terms, loss))


def robust_surface(z: Array, chosen: Array | None, terms: Terms, loss: Loss = "tukey") -> Array:
    """The robust polynomial on all pixels, fitted to the chosen ones."""
    usable = np.isfinite(z) if chosen is None else chosen
    base = usable.astype(float)
    surface = evaluate(fit_terms(z, base, terms), z.shape)
    surface = _reweight(z, base, usable, terms, "huber", surface)
    return surface if loss == "huber" else _reweight(z, base, usable, terms, "tukey", surface)


def noise_sigma(residual: Array) -> float:
    """1.4826 times the median absolute value: the sigma of Gaussian noise, unaffected by rare outliers."""
    return _MAD_TO_SIGMA * float(np.median(np.abs(residual)))


def _reweight(z: Array, base: Array, usable: Array, terms: Terms, loss: Loss, surface: Array) -> Array:
    for _ in range(_MAX_ROUNDS):
        residual = np.where(usable, z - surface, 0.0)
        sigma = noise_sigma(residual[usable])
        if sigma <= np.finfo(float).eps * float(np.abs(z[usable]).max()):
            return surface
        weights = base * _weights(residual / sigma, loss)
        previous, surface = surface, evaluate(fit_terms(z, weights, terms), z.shape)
        if float(np.abs(surface - previous).max()) < _SETTLED * sigma:
            return surface
    return surface


def _weights(scaled: Array, loss: Loss) -> Array:
    width = _WIDTH[loss]
    if loss == "huber":
        return width / np.maximum(np.abs(scaled), width)
    return np.clip(1 - (scaled / width) ** 2, 0.0, None) ** 2
