"""Resample a scan onto the layout's pixels by a single interpolation. Missing pixels of the scan remain
missing.
"""

from functools import lru_cache

import numpy as np

from litho_data.foundation import YX, Array, InputError, Shape
from litho_data.register.bend import Bend
from litho_data.register.geometry import index_to_um, warped_grid
from litho_data.register.topography import fill_gaps

SPLINE_ORDER = 3
# The weights of scan pixels are computed at the distances lag + phase from a layout pixel, in scan pixels,
# for every lag in ``_LAGS`` and every phase (sub-pixel position) in ``_PHASES``. Effects of resampling are
# averaged over the phases.
_PHASES = (np.arange(64) + 0.5) / 64
_LAGS = np.arange(-128, 129)


def resample_to_layout(
    height_um: Array,
    scan_to_layout: Array,
    layout_shape: Shape,
    *,
    scan_pitch_um: YX,
    layout_pitch_um: float,
    bend_um: Bend | None = None,
) -> tuple[Array, Array]:
    """Interpolate the heights of a scan at the layout's pixel centres by a cubic spline.

    If the scan is sampled more finely than the layout, its heights are first averaged by a Gaussian over
    about the size of a layout pixel. Without this average, interpolation would alias the noise of the scan.

    Args:
        height_um: heights in µm in the scan's own frame, shape (ny, nx), NaN where not measured.
        scan_to_layout: 3×3 matrix that maps positions (x_um, y_um, 1) of the scan to positions in the layout.
        layout_shape: shape (ny, nx) of the result.
        scan_pitch_um: pitch (y, x) of the scan in µm.
        layout_pitch_um: pitch of the layout in µm.
        bend_um: bend of the scan, in µm in the scan's frame. It changes the positions at which the heights
            are interpolated.

    Returns:
        ``height_um``, the heights in µm as float32, NaN where not valid; and ``valid``, a bool mask. Both
        have the shape ``layout_shape``. A pixel is valid if it lies between pixel centres of the scan, and if
        no missing pixel of the scan lies within two scan pixels of it, which is the reach of the spline's
        kernel.

    Raises:
        InputError: ``scan_to_layout`` is not an invertible 3×3 matrix, or the scan has no measured pixel.
    """
    from scipy.ndimage import binary_dilation, map_coordinates, spline_filter

    height, matrix = np.asarray(height_um, dtype=float), np.asarray(scan_to_layout, dtype=float)
    measured = np.isfinite(height)
    if not measured.any():
        raise InputError("scan to resample", got="no measured pixel", wanted="finite heights")
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise InputError("scan_to_layout", got=matrix.tolist(), wanted="an invertible 3x3 matrix")
    layout_to_um = index_to_um((layout_pitch_um, layout_pitch_um))
    to_scan = np.linalg.inv(index_to_um(scan_pitch_um)) @ np.linalg.inv(matrix) @ layout_to_um
    bend = None if bend_um is None else bend_um.in_pixels(scan_pitch_um)
    places = rows, columns = warped_grid(to_scan, layout_shape, bend)
    filled = _average_over_layout_pixel(fill_gaps(height), scan_pitch_um, layout_pitch_um)
    spline = spline_filter(filled, SPLINE_ORDER, mode="mirror")
    values = map_coordinates(spline, places, order=SPLINE_ORDER, mode="mirror", prefilter=False)
    ny, nx = height.shape
    valid = (rows >= 0) & (rows <= ny - 1) & (columns >= 0) & (columns <= nx - 1)
    if not measured.all():
        near_gap = binary_dilation(~measured, np.ones((3, 3), bool)).astype(np.float32)
        valid &= map_coordinates(near_gap, places, order=1, mode="nearest") == 0
    return np.where(valid, values, np.nan).astype(np.float32), valid


def noise_variance_factor(scan_pitch_um: YX, layout_pitch_um: float) -> float:
    """Return the factor by which resampling changes the variance of white noise in a scan (noise that is
    independent from pixel to pixel).

    The factor is a mean over sub-pixel positions.
    """
    along_y, along_x = (line_variance_factor(pitch_um, layout_pitch_um) for pitch_um in scan_pitch_um)
    return along_y * along_x


def line_variance_factor(pitch_um: float, layout_pitch_um: float) -> float:
    """Return the factor by which resampling changes the variance of the offsets of scan lines. The offsets
    are assumed to be independent from line to line.

    ``pitch_um`` is the pitch of the scan across its lines.
    """
    return float((_weights(pitch_um, layout_pitch_um) ** 2).sum(axis=1).mean())


@lru_cache
def transfer_error(pitch_um: float, layout_pitch_um: float) -> tuple[Array, Array]:
    """Return spatial frequencies, and the squared error that resampling causes in a wave of each frequency.

    Both arrays have shape (n,). The frequencies, in cycles/µm, run up to the Nyquist frequency of the scan.
    The squared error of a wave is relative to its squared amplitude, and averaged over sub-pixel positions.
    If the scan is sampled more finely than the layout, its heights are averaged over a layout pixel. This
    average is intended and does not count as an error.
    """
    frequency = np.linspace(0, 0.5, 129)
    lags = _LAGS[None, :] + _PHASES[:, None]
    waves = np.exp(-2j * np.pi * frequency[:, None, None] * lags)
    passed = (_weights(pitch_um, layout_pitch_um) * waves).sum(axis=-1)
    averaged = np.exp(-2 * (np.pi * frequency * _average_px(pitch_um, layout_pitch_um)) ** 2)
    return frequency / pitch_um, (np.abs(passed - averaged[:, None]) ** 2).mean(axis=1)


@lru_cache
def _weights(pitch_um: float, layout_pitch_um: float) -> Array:
    """Return the weights with which the pixels of a scan, along one axis, contribute to one pixel of the
    layout.

    The weights have shape (phases, lags). The distance of a scan pixel from the layout pixel is lag + phase,
    in scan pixels.
    """
    from scipy.ndimage import map_coordinates

    impulse = np.zeros((513, 1))
    impulse[256] = 1.0
    pitches = (pitch_um, layout_pitch_um)
    response = _average_over_layout_pixel(impulse, pitches, layout_pitch_um)[:, 0]
    return map_coordinates(response, [256 + _LAGS[None, :] + _PHASES[:, None]], order=SPLINE_ORDER)


def _average_over_layout_pixel(height: Array, scan_pitch_um: YX, layout_pitch_um: float) -> Array:
    from scipy.ndimage import gaussian_filter

    sigma_px = [_average_px(pitch_um, layout_pitch_um) for pitch_um in scan_pitch_um]
    return gaussian_filter(height, sigma_px, mode="nearest") if any(sigma_px) else height


def _average_px(pitch_um: float, layout_pitch_um: float) -> float:
    """Return the sigma, in scan pixels, of the Gaussian that averages a scan over the size of a layout
    pixel.
    """
    # A box of r pixels has the variance (r² - 1) / 12. Pitches that differ by less than 10 % count as equal.
    ratio = layout_pitch_um / pitch_um
    return ((ratio**2 - 1) / 12) ** 0.5 if ratio > 1.1 else 0.0
