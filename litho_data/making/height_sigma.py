"""Compute the standard uncertainty of every registered height, and the parts of this uncertainty."""

from collections.abc import Mapping

import numpy as np

from litho_data.foundation import YX, Array
from litho_data.register.resample import line_variance_factor, noise_variance_factor, transfer_error
from litho_data.register.topography import fill_gaps
from litho_data.register.warp_error import warp_error
from litho_data.roughness import psd_along, white_noise
from litho_data.scan import Axis


def height_sigma(
    levelled_um: Array,
    height_um: Array,
    layout_level: Array,
    *,
    scan_pitch_um: YX,
    layout_pitch_um: float,
    blur_px: float,
    model: str,
    levelled: bool,
    fast_axis: Axis = "x",
    z_uncertainty: float = 0.0,
) -> tuple[Array, Mapping[str, float]]:
    """Return the standard uncertainty of registered heights, without the uncertainty of the scan's offset.

    The variance is a sum of six parts, which have these causes:

    - ``pixel``: white noise of pixels, after resampling;
    - ``line``: white noise of lines, after resampling;
    - ``resampling``: the fine structure that interpolation loses;
    - ``registration``: the uncertainty of the warp, multiplied by the slope of the heights;
    - ``levelling``: the surface that levelling left or wrongly removed;
    - ``calibration``: the uncertainty of the z scale, multiplied by the height above the scan's mean.

    Args:
        levelled_um: heights (ny, nx) in the scan's own frame, NaN where not measured.
        height_um: heights on the layout's grid, NaN where not valid.
        layout_level: levels on that grid.
        blur_px, model: blur and model of the registration, see ``warp_error``.
        levelled: whether a recipe was applied. If so, the uncertainty includes an estimate of the part of the
            print that the recipe removed. If not, it includes a surface that does not belong to the print,
            but only if this surface is significant.
        fast_axis: the axis along which the tip moved.
        z_uncertainty: relative uncertainty of the z scale; 0 if it was not calibrated.

    Returns:
        The uncertainty in µm as float32 on the layout's grid, NaN where not valid, and a mapping of root mean
        squares: ``sigma_<part>_nm`` for each part and ``sigma_nm`` for the whole.
    """
    own, height = levelled_um.astype(float), height_um.astype(float)
    valid, shape = np.isfinite(height), height.shape
    pixel_nm, line_nm = white_noise(own, fast_axis=fast_axis)
    slow_pitch_um = scan_pitch_um[0 if fast_axis == "x" else 1]
    fit = warp_error(height, layout_level, blur_px, model)
    variance_um2 = {
        "pixel": 1e-6 * pixel_nm**2 * noise_variance_factor(scan_pitch_um, layout_pitch_um),
        "line": 1e-6 * line_nm**2 * line_variance_factor(slow_pitch_um, layout_pitch_um),
        "resampling": 1e-6
        * _resampling_nm2(own, scan_pitch_um, layout_pitch_um, pixel_nm, line_nm, fast_axis),
        "registration": fit.warp_variance(fill_gaps(height)),
        "levelling": fit.surface_variance(levelled),
        "calibration": (z_uncertainty * (height - height[valid].mean())) ** 2,
    }
    total = np.zeros(shape)
    budget = {}
    for name, part in variance_um2.items():
        total += part
        budget[f"sigma_{name}_nm"] = 1e3 * float(np.broadcast_to(part, shape)[valid].mean()) ** 0.5
    sigma_um = np.where(valid, np.sqrt(total), np.nan).astype(np.float32)
    return sigma_um, {**budget, "sigma_nm": 1e3 * float(total[valid].mean()) ** 0.5}


def _resampling_nm2(
    levelled_um: Array,
    scan_pitch_um: YX,
    layout_pitch_um: float,
    pixel_nm: float,
    line_nm: float,
    fast_axis: Axis,
) -> float:
    """Return the variance, in nm², of the fine structure that interpolation loses. At each frequency, the
    noise-free spectrum of the print is multiplied by the relative loss; the variance is the integral of this
    product.
    """
    filled = fill_gaps(levelled_um)
    lost = 0.0
    axes: tuple[Axis, Axis] = ("y", "x")
    for axis, pitch_um in zip(axes, scan_pitch_um, strict=True):
        spectrum = psd_along(filled, pitch_um, axis)
        white_nm2 = pixel_nm**2 + (line_nm**2 if axis != fast_axis else 0.0)
        error = np.interp(spectrum.frequency_per_um, *transfer_error(pitch_um, layout_pitch_um))
        # The density is one-sided, so the density of white noise with variance s² is 2 s² times the pitch.
        lost += float(((spectrum.density - 2 * pitch_um * white_nm2) * error).sum()) * float(
            spectrum.frequency_per_um[0]
        )
    return max(lost, 0.0)
