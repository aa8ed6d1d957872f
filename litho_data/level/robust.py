"""Robust background: a polynomial that follows the majority of the pixels, not their mean."""

from typing import Literal

import numpy as np

from litho_data.foundation.kinds import Array
from litho_data.level.operation import operation
from litho_data.level.polynomial import Degree, Terms, evaluate, fit_terms, polynomial_terms
from litho_data.level.selection import Levelled, Masking, as_height, select, subtract

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
    height: Array,
    *,
    x_degree: Degree = 1,
    y_degree: Degree = 1,
    total_degree: Degree | None = 1,
    loss: Loss = "tukey",
    mask: Array | None = None,
    masking: Masking = "exclude",
) -> Levelled:
    """Subtract the robust polynomial with its constant: the main surface then lies at zero.

    Iteratively reweighted least squares with the scale 1.4826 · MAD. Tukey's biweight gives no
    weight to distant features and starts from the Huber solution, which has a single minimum.

    Args:
        height: (ny, nx), any unit.
        x_degree, y_degree, total_degree: as in ``level_polynomial``; by default a plane.

    Raises:
        InputError: an unknown loss, or pixels that do not determine the polynomial.
    """
    z = as_height(height)
    terms = polynomial_terms(x_degree, y_degree, total_degree)
    return subtract(z, robust_surface(z, select(z, mask, masking), terms, loss))


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
