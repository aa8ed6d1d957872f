"""Separating line noise from pixel noise, and the print's roughness from the microscope's."""

from math import comb

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.roughness.amplitude import amplitude_parameters, sq_uncertainty_nm
from litho_data.roughness.spectrum import lines_nm
from litho_data.scan import Axis

# Median absolute deviation of a Gaussian: 0.6745 sd.
_MAD_TO_SD = 1 / 0.6744897501960817
# Passes half of the amplitude at 0.84 of the highest frequency, a fiftieth at 0.56: 0.28 cycles per pixel.
_FINE_ORDER = 8


class NoiseSplit(Record):
    """Noise of one scan by second and first differences; topography adds, so all are upper bounds.

    Args:
        pixel_nm: uncorrelated noise from second differences along the fast axis.
        pixel_slow_nm: the same along the slow axis; larger by the line noise.
        line_nm: sd of one offset per line, from steps between the medians of neighbouring lines.
        column_nm: the same for columns, where no such noise is expected: the control.
    """

    pixel_nm: float
    pixel_slow_nm: float
    line_nm: float
    column_nm: float


class PrintRoughness(Record):
    """Sq of a flat print without microscope and substrate, with its standard uncertainty."""

    print_nm: float
    print_uncertainty_nm: float
    flat_nm: float
    flat_uncertainty_nm: float
    substrate_nm: float
    substrate_uncertainty_nm: float


def split_noise(height_um: Array, *, fast_axis: Axis = "x") -> NoiseSplit:
    """Separate the offsets of scan lines from noise of single pixels.

    Second differences ``z₋ − 2z₀ + z₊`` of white noise have 6 times its variance. The difference of
    two line medians has variance ``2 (line² + π/2 · pixel²/n)`` with n pixels in a line; the sd of both
    is taken from the median absolute deviation, which single scars and edges do not move.

    Args:
        height_um: finite heights, µm, shape (ny, nx).
        fast_axis: axis along which the tip moved.

    Raises:
        InputError: NaN in the surface, or fewer than 8 pixels along an axis.
    """
    if not np.isfinite(height_um).all() or min(height_um.shape) < 8:
        raise InputError(
            "surface", got=f"{height_um.shape} px", wanted="finite heights, at least 8 px each way"
        )
    lines = lines_nm(height_um, fast_axis)
    pixel_nm = _robust_sd(np.diff(lines, 2, axis=1)) / 6**0.5
    return NoiseSplit(
        pixel_nm=pixel_nm,
        pixel_slow_nm=_robust_sd(np.diff(lines, 2, axis=0)) / 6**0.5,
        line_nm=_line_sd(lines, pixel_nm),
        column_nm=_line_sd(lines.T, pixel_nm),
    )


def white_noise(height_um: Array, *, fast_axis: Axis = "x") -> tuple[float, float]:
    """Pixel noise and line noise of a scan of any print, nm: what is white at the finest scales.

    A printer writes nothing finer than its spot, so differences of high order leave noise alone: those along
    both axes the pixels', those of the means of lines along the slow axis the lines'. Line noise that is
    correlated over lines (drift) and noise that the feedback smooths look like the print and are not counted.

    Args:
        height_um: heights, µm, shape (ny, nx), NaN where not measured.
        fast_axis: axis along which the tip moved.

    Returns:
        sd of the pixels' and of the lines' noise; NaN for one that too few pixels determine.
    """
    lines = lines_nm(height_um, fast_axis)
    pixel_nm = _fine_sd(_fine(_fine(lines, 0), 1))
    measured = np.isfinite(lines)
    count = measured.sum(axis=1)
    means = np.where(measured, lines, 0.0).sum(axis=1) / np.maximum(count, 1)
    line_nm = _fine_sd(_fine(np.where(2 * count > lines.shape[1], means, np.nan), 0))
    return pixel_nm, float(np.sqrt(max(0.0, line_nm**2 - pixel_nm**2 / max(1.0, float(np.median(count))))))


def _fine(values: Array, axis: int) -> Array:
    """Differences of order ``_FINE_ORDER`` along an axis; white noise keeps its variance."""
    return np.diff(values, _FINE_ORDER, axis=axis) / comb(2 * _FINE_ORDER, _FINE_ORDER) ** 0.5


def _fine_sd(differences: Array) -> float:
    known = differences[np.isfinite(differences)]
    return _robust_sd(known) if known.size > _FINE_ORDER else float("nan")


def print_roughness(flat_um: Array, substrate_um: Array) -> PrintRoughness:
    """Roughness of a print from a flat print and a bare substrate, in quadrature.

    ``print² = flat² − substrate²``: microscope and substrate are assumed to add independently. Level both
    surfaces in the same way.

    Raises:
        InputError: a substrate rougher than the print.
    """
    flat_nm, substrate_nm = (amplitude_parameters(surface).sq_nm for surface in (flat_um, substrate_um))
    if substrate_nm >= flat_nm:
        raise InputError(
            "roughness of the substrate",
            got=f"{substrate_nm:.3g} nm",
            wanted=f"less than the print's {flat_nm:.3g} nm",
        )
    print_nm = float(np.sqrt(flat_nm**2 - substrate_nm**2))
    flat_u_nm, substrate_u_nm = sq_uncertainty_nm(flat_um), sq_uncertainty_nm(substrate_um)
    return PrintRoughness(
        print_nm=print_nm,
        print_uncertainty_nm=float(np.hypot(flat_nm * flat_u_nm, substrate_nm * substrate_u_nm) / print_nm),
        flat_nm=flat_nm,
        flat_uncertainty_nm=flat_u_nm,
        substrate_nm=substrate_nm,
        substrate_uncertainty_nm=substrate_u_nm,
    )


def _line_sd(lines: Array, pixel_nm: float) -> float:
    """Sd of the offsets of lines, without what pixel noise adds to a median."""
    step_variance = _robust_sd(np.diff(np.median(lines, axis=1))) ** 2
    return float(np.sqrt(max(0.0, step_variance / 2 - np.pi / 2 * pixel_nm**2 / lines.shape[1])))


def _robust_sd(values: Array) -> float:
    return float(_MAD_TO_SD * np.median(np.abs(values - np.median(values))))
