"""Measure the roughness of a surface that should be flat, such as the bare substrate or a flat print."""

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


class SurfaceNoise(Record):
    """The roughness of a surface: how far its heights deviate from its smooth background.

    Args:
        background: background that was removed: the mean height (``offset``) or a polynomial of second degree
            (``quadratic``).
        sigma_nm: root-mean-square deviation (Sq).
        sigma_uncertainty_nm: standard uncertainty of ``sigma_nm``, computed from ``independent_heights``.
        mae_nm: mean absolute deviation from the median. No distribution is assumed.
        independent_heights: number of independent heights in the field: the number of pixels divided by the
            sum of the squared autocorrelation.
    """

    id: str
    background: Background
    sigma_nm: float
    sigma_uncertainty_nm: float
    mae_nm: float
    independent_heights: float
    pixels: int


class PrintNoise(Record):
    """The roughness that a print adds to the substrate, nm. Its square is the squared roughness of the flat
    print minus the squared roughness of the substrate: ``print² = flat² − substrate²``.

    ``print_nm`` is None if the flat print is not rougher than the substrate.
    """

    background: Background
    print_nm: float | None
    print_uncertainty_nm: float | None


def surface_noise(scan_id: str, height_um: np.ndarray, background: Background) -> SurfaceNoise:
    """Measure the roughness of one surface relative to its background.

    Args:
        scan_id: name of the scan in the result.
        height_um: measured height, µm, with shape (ny, nx); NaN where it was not measured.
        background: background to remove: ``offset`` or ``quadratic``.

    Raises:
        InputError: fewer than 64 pixels were measured.
    """
    deviation = without_background(height_um, background)
    finite = np.isfinite(deviation)
    if finite.sum() < 64:
        raise InputError(f"surface {scan_id}", got=f"{finite.sum()} measured pixels", wanted="at least 64")
    sigma = NM_PER_UM * rms(deviation[finite])
    # For the autocorrelation, unmeasured pixels are replaced by the mean, because they carry no information.
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
    """Return the height minus its background, µm. The background is fitted to the measured pixels by least
    squares. The result is float64 and has the shape of ``height_um``.
    """
    level = np.zeros(height_um.shape)
    return height_um - fitted_terms(height_um, level, np.isfinite(height_um), BACKGROUNDS[background])[1]


def print_noise(flat: SurfaceNoise, substrates: Sequence[SurfaceNoise]) -> PrintNoise:
    """Compute the roughness that a print adds: the root of the squared roughness of the flat print minus the
    mean squared roughness of the substrates. The subtraction assumes that the roughness of the substrate and
    the noise of the microscope are independent of the roughness of the print.

    Args:
        flat: roughness of the flat print.
        substrates: roughness of one or more substrates, from which the same kind of background was removed as
            from the flat print.
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
