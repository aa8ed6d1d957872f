"""Fit σ(x), the spread of a residual at each pixel. The logarithm of the spread is modelled as a linear
function of covariates, which describe the layout at the pixel and the position of the pixel.

The model of the height is fitted first and then kept fixed. Then the scale s of the residuals of this model
is fitted as ln s² = X β by maximum likelihood. The residuals are assumed to follow Student's t distribution.
Because the fit has these two stages, a wide spread cannot hide errors of the predicted height (compare
Seitzer et al. 2022, arXiv:2203.09168). Only a few covariates are used, because some tens of scans do not
determine more coefficients.
"""

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.noise.spread_scores import GAUSSIAN, Tails
from litho_models.scoring.like_layouts import blurred_layout_um

# Names of the maps on which σ depends. The square of the slope and the fourth power of the radius are also
# covariates.
PLACES = ("level", "slope", "edge distance", "radius²")
# The dependence on the level is linear between these knots. A single straight line would not fit, because the
# rare levels at both ends are twice as rough as those in the middle.
_LEVEL_KNOTS = np.linspace(0, 1, 7)
COVARIATES = (
    *(f"level {share:.2f}" for share in _LEVEL_KNOTS),
    "slope",
    "slope²",
    "edge distance",
    "radius²",
    "radius⁴",
)
# Numbers of degrees of freedom of Student's t distribution that are tried. The smallest gives much heavier
# tails than residuals of prints have, and the largest gives a Gaussian.
_FREEDOMS = (4.0, 6.0, 10.0, 16.0, 30.0, float("inf"))
# Standard deviation of the optical spot. The layout is blurred by this spot before the slope of the layout is
# computed.
_SLOPE_BLUR_UM = 0.2
_FAR_FROM_EDGE_UM = 2.0
# Largest change of ln s² in one step of the fit, which keeps exp() finite. The limit is twice the largest
# effect of a covariate that was seen for noise of 1 to 100 nm.
_LARGEST_STEP = 2.0
_STEPS = 60


class VarianceModel(Record):
    """A fitted model of the spread: ln s² = Σ β_j φ_j, where s is the scale of the residual in nm and φ_j are
    the covariates. ``coefficients`` contains the β_j in the order of ``covariates``.

    The covariates are:

    - piecewise linear functions of the level, which is scaled to 0 ... 1;
    - the slope of the blurred layout (height over length), and its square;
    - the distance to the nearest change of level, limited to 2 µm and divided by this limit;
    - the second and the fourth power of r, the distance from the centre of the field divided by half the
      diagonal of the field.

    ``freedom`` is the number of degrees of freedom of Student's t distribution, or None for a Gaussian.
    """

    covariates: list[str]
    coefficients: list[float]
    freedom: float | None = None


def place_maps(scan: PrintedScan) -> dict[str, Array]:
    """For each quantity in ``PLACES``, return a map over the pixels of a scan, of shape (ny, nx)."""
    from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

    changes = maximum_filter(scan.mask_level, 3) != minimum_filter(scan.mask_level, 3)
    edge_um = np.full(scan.shape, _FAR_FROM_EDGE_UM)
    if changes.any():
        edge_um = np.minimum(distance_transform_edt(~changes) * scan.pitch_um, _FAR_FROM_EDGE_UM)
    y, x = np.meshgrid(*(np.linspace(-1, 1, size) for size in scan.shape), indexing="ij")
    maps = (
        scan.mask_level / (scan.levels - 1),
        layout_slope(scan),
        edge_um / _FAR_FROM_EDGE_UM,
        (y**2 + x**2) / 2,
    )
    return dict(zip(PLACES, maps, strict=True))


def covariates_of(places: dict[str, Array]) -> Array:
    """Return the covariates φ of each pixel, with shape (..., covariates). ``places`` is the result of
    ``place_maps``, or a dict with the same keys and the values at some of the pixels.
    """
    level, slope, edge, radius2 = (places[name] for name in PLACES)
    between = [np.interp(level, _LEVEL_KNOTS, row) for row in np.eye(len(_LEVEL_KNOTS))]
    return np.stack([*between, slope, slope**2, edge, radius2, radius2**2], axis=-1)


def layout_slope(scan: PrintedScan) -> Array:
    """Blur the layout by the optical spot, and return its slope (height over length) at each pixel, with
    shape (ny, nx).
    """
    return np.hypot(*np.gradient(blurred_layout_um(scan, _SLOPE_BLUR_UM), scan.pitch_um))


def fit_spread(covariates: Array, residual: Array) -> tuple[Array, Tails]:
    """Fit the residuals by maximum likelihood. Return the coefficients β of their scale s (ln s² = X β) and
    the shape of their distribution.
    """
    best, chosen = -np.inf, (np.zeros(0), GAUSSIAN)
    for tails in map(Tails, _FREEDOMS):
        beta = fit_log_scale(covariates, residual, tails)
        likelihood = float(tails.log_likelihood(residual, scale_nm(beta, covariates)).mean())
        if likelihood > best:
            best, chosen = likelihood, (beta, tails)
    return chosen


def fit_log_scale(covariates: Array, residual: Array, tails: Tails = GAUSSIAN) -> Array:
    """Fit β of ln s² = X β by maximum likelihood, for a given shape of the distribution. Each step of the
    Fisher scoring is β += (XᵀX)⁻¹ Xᵀ (w r²/s² − 1) / 2I.

    Here w are weights and I is the Fisher information of a pixel about ln s². I does not depend on s, so the
    same matrix is used in all steps.

    Args:
        covariates: matrix X, of shape (pixels, k). Some of its columns must add up to a constant.
        residual: residuals r, of shape (pixels,).
        tails: distribution of r/s, which determines the weights w and the information I.

    Raises:
        InputError: there are not more pixels than covariates, or all residuals are zero.
    """
    square = np.asarray(residual, np.float64) ** 2
    if square.size <= covariates.shape[1] or not square.any():
        raise InputError(
            "residuals from which to fit a spread",
            got=f"{square.size} pixels, {np.count_nonzero(square)} not zero",
            wanted="more pixels than covariates, and some nonzero residuals",
        )
    normal = covariates.T @ covariates
    level = np.full(square.size, np.log(square.mean()))
    beta = np.linalg.lstsq(normal, covariates.T @ level, rcond=1e-10)[0]
    for _ in range(_STEPS):
        z2 = square * np.exp(-covariates @ beta)
        score = covariates.T @ (tails.weight(z2) * z2 - 1) / (2 * tails.information)
        step = np.linalg.lstsq(normal, score, rcond=1e-10)[0]
        largest = np.abs(covariates @ step).max()
        step *= min(1.0, _LARGEST_STEP / largest) if largest > 0 else 1.0
        beta = beta + step
        if largest < 1e-8:
            break
    return beta


def scale_nm(beta: Array, covariates: Array) -> Array:
    """Return the scale s of each pixel, nm. ``covariates`` has shape (..., k), and the result has shape
    (...).
    """
    return np.exp(0.5 * covariates @ beta)


def variance_model(beta: Array, tails: Tails) -> VarianceModel:
    """Return the fitted coefficients and the shape of the distribution as a record."""
    freedom = None if np.isinf(tails.freedom) else tails.freedom
    return VarianceModel(covariates=list(COVARIATES), coefficients=beta.tolist(), freedom=freedom)
