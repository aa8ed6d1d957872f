"""Resample a scan onto the layout's pixels in a single step. Heights remain floats, and gaps remain gaps."""

from functools import lru_cache

import numpy as np

from litho_data.foundation import YX, Array, InputError, Shape
from litho_data.register.bend import Bend
from litho_data.register.geometry import index_to_um, warped_grid
from litho_data.register.topography import fill_gaps

SPLINE_ORDER = 3
# Sub-pixel positions, and pixels that the spline reaches, used to compute how resampling changes noise.
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

    Args:
        height_um: (ny, nx) in the scan's own frame, NaN where not measured.
        scan_to_layout: 3×3 matrix that maps (x_um, y_um, 1) of the scan to the layout.
        layout_shape: (ny, nx) of the result.
        scan_pitch_um: (y, x) pitch of the scan.
        layout_pitch_um: pitch of the layout.
        bend_um: bend of the scan, in µm in the scan's frame; it changes where the heights are interpolated.

    Returns:
        ``height_um`` float32 (NaN where not valid) and ``valid`` bool, both of ``layout_shape``. A pixel is
        valid if it falls between the scan's pixel centres and if no gap lies within two pixels of it. Two
        pixels are the reach of the spline's kernel.

    Raises:
        InputError: the transform is not an invertible 3×3 matrix, or the scan has no measured pixel.

    If the scan is sampled more finely than the layout, a Gaussian first averages it over the size of a layout
    pixel, because plain interpolation would alias the scan's noise.
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
    """Return the share of the variance of white pixel noise that remains after resampling.

    The share is a mean over sub-pixel positions.
    """
    along_y, along_x = (line_variance_factor(pitch_um, layout_pitch_um) for pitch_um in scan_pitch_um)
    return along_y * along_x


def line_variance_factor(pitch_um: float, layout_pitch_um: float) -> float:
    """Return the share of the variance of white line offsets that remains after resampling across
    the lines.
    """
    return float((_weights(pitch_um, layout_pitch_um) ** 2).sum(axis=1).mean())


@lru_cache
def transfer_error(pitch_um: float, layout_pitch_um: float) -> tuple[Array, Array]:
    """Return frequencies (n,) and the squared errors (n,) that resampling causes in waves of these
    frequencies.

    The frequencies run up to the Nyquist frequency, in cycles/µm. The error is relative to the wave's squared
    amplitude and averaged over sub-pixel positions. Averaging a finely sampled scan over the layout's pixel
    does not count as an error.
    """
    frequency = np.linspace(0, 0.5, 129)
    lags = _LAGS[None, :] + _PHASES[:, None]
    waves = np.exp(-2j * np.pi * frequency[:, None, None] * lags)
    passed = (_weights(pitch_um, layout_pitch_um) * waves).sum(axis=-1)
    averaged = np.exp(-2 * (np.pi * frequency * _average_px(pitch_um, layout_pitch_um)) ** 2)
    return frequency / pitch_um, (np.abs(passed - averaged[:, None]) ** 2).mean(axis=1)


@lru_cache
def _weights(pitch_um: float, layout_pitch_um: float) -> Array:
    """Return the weights (phases, lags) that the pixels of a scan have in one pixel of the layout.

    The distance of each scan pixel from the layout pixel is lag + phase, in pixels.
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
    """Return the sigma, in scan pixels, of the Gaussian that averages a scan over the layout's pixel."""
    # A box of r pixels has the variance (r² - 1) / 12. Pitches that differ by less than 10 % count as equal.
    ratio = layout_pitch_um / pitch_um
    return ((ratio**2 - 1) / 12) ** 0.5 if ratio > 1.1 else 0.0
