"""Measure the roughness of one surface: bare substrate, flat print, or the treads of a staircase."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness import effective_samples
from litho_models.scan_terms import Terms
from litho_models.scan_terms.cross_fit import fitted_terms
from litho_models.scoring.statistics import rms

Background = Literal["offset", "quadratic"]
BACKGROUNDS: dict[Background, Terms] = {
    "offset": frozenset({"offset"}),
    "quadratic": frozenset({"offset", "bow"}),
}


class SurfaceNoise(Record, extra="ignore"):
    """Deviation of a surface from its background.

    Args:
        background: the background that was removed, which is the mean (``offset``) or a polynomial of second
            degree.
        sigma_nm: root mean square (Sq).
        sigma_uncertainty_nm: standard uncertainty of ``sigma_nm``, from the number of independent heights in
            the field.
        mae_nm: mean absolute deviation from the median, computed from the pixels without assuming a
            distribution.
        independent_heights: number of pixels divided by the sum of the squared autocorrelation.
    """

    id: str
    background: Background
    sigma_nm: float
    sigma_uncertainty_nm: float
    mae_nm: float
    independent_heights: float
    pixels: int


class PrintNoise(Record, extra="ignore"):
    """The roughness of the print alone: ``print² = flat² − substrate²``, nm.

    ``print_nm`` is None if the flat print is not rougher than the substrate.
    """

    background: Background
    print_nm: float | None
    print_uncertainty_nm: float | None


def surface_noise(scan_id: str, height_um: np.ndarray, background: Background) -> SurfaceNoise:
    """Measure the roughness of one surface relative to its background.

    Args:
        scan_id: name in the result.
        height_um: (ny, nx), µm; NaN where not measured.
        background: ``offset`` or ``quadratic``.

    Raises:
        InputError: fewer than 64 measured pixels.
    """
    deviation = without_background(height_um, background)
    finite = np.isfinite(deviation)
    if finite.sum() < 64:
        raise InputError(f"surface {scan_id}", got=f"{finite.sum()} measured pixels", wanted="at least 64")
    sigma = NM_PER_UM * rms(deviation[finite])
    # Unmeasured pixels carry no information, so the mean replaces them in the correlation.
    filled = np.where(finite, deviation, deviation[finite].mean())
    independent = effective_samples(filled) * float(finite.mean()) if sigma > 0 else float(finite.sum())
    centred = deviation[finite] - np.median(deviation[finite])
    return SurfaceNoise(
        id=scan_id,
        background=background,
        sigma_nm=sigma,
        sigma_uncertainty_nm=sigma / float(np.sqrt(2 * max(1.0, independent))),
        mae_nm=NM_PER_UM * float(np.abs(centred).mean()),
        independent_heights=independent,
        pixels=int(finite.sum()),
    )


def without_background(height_um: np.ndarray, background: Background) -> np.ndarray:
    """Return the height minus its background, float64 (ny, nx) µm. The background is fitted to the measured
    pixels by least squares.
    """
    level = np.zeros(height_um.shape)
    return height_um - fitted_terms(height_um, level, np.isfinite(height_um), BACKGROUNDS[background])[1]


def print_noise(flat: SurfaceNoise, substrates: Sequence[SurfaceNoise]) -> PrintNoise:
    """Compute the roughness of the print alone by subtraction in quadrature, assuming that the roughness of
    microscope and substrate is independent of the print.

    Args:
        flat: noise of the flat print.
        substrates: noise of one or more substrates, after the same kind of background is removed.
    """
    square = flat.sigma_nm**2 - np.mean([one.sigma_nm**2 for one in substrates])
    if square <= 0:
        return PrintNoise(background=flat.background, print_nm=None, print_uncertainty_nm=None)
    below = np.linalg.norm([one.sigma_nm * one.sigma_uncertainty_nm for one in substrates]) / len(substrates)
    print_nm = float(np.sqrt(square))
    return PrintNoise(
        background=flat.background,
        print_nm=print_nm,
        print_uncertainty_nm=float(np.hypot(flat.sigma_nm * flat.sigma_uncertainty_nm, below)) / print_nm,
    )
