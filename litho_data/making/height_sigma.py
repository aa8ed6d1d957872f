"""Compute the standard uncertainty of every registered height, and the contributions to it."""

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

    The variance is the sum of six parts, each with its own cause:

    - ``pixel``: what resampling leaves of the noise that is independent from pixel to pixel;
    - ``line``: what resampling leaves of the offsets that are independent from scan line to scan line;
    - ``resampling``: the fine structure of the print that interpolation loses;
    - ``registration``: the uncertainty of the warp, multiplied by the slope of the heights;
    - ``levelling``: the tilt and bow that levelling left in the heights, or wrongly removed from the print;
    - ``calibration``: the uncertainty of the z scale, multiplied by the height above the scan's mean.

    Args:
        levelled_um: heights in µm in the scan's own frame, shape (ny, nx), NaN where not measured.
        height_um: heights in µm on the layout's grid, NaN where not valid.
        layout_level: levels of the layout on the same grid.
        scan_pitch_um: pitch (y, x) of the scan in µm.
        layout_pitch_um: pitch of the layout in µm.
        blur_px, model: results of the registration: the sigma of the blur, in layout pixels, and the kind of
            warp, as in ``warp_error``.
        levelled: whether a levelling recipe was applied. If so, the part ``levelling`` includes an estimate
            of the surface that the recipe wrongly removed from the print. If not, this part estimates the
            quadratic surface by which the heights differ from the print. It is 0 if this surface is not
            significant.
        fast_axis: the axis along which the tip moved fast.
        z_uncertainty: relative uncertainty of the z scale; 0 if the z scale was not calibrated.

    Returns:
        Two items. The first is the uncertainty in µm as float32 on the layout's grid, NaN where not valid.
        The second is a mapping with its root mean squares over the scan, in nm. The key ``sigma_<part>_nm``
        stands for one part, and the key ``sigma_nm`` for the total uncertainty.
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
    """Return the variance, in nm², of the fine structure that interpolation loses.

    It is the integral, over all spatial frequencies, of the power spectrum of the print without noise,
    multiplied by the share of power that interpolation loses at each frequency.
    """
    filled = fill_gaps(levelled_um)
    lost = 0.0
    axes: tuple[Axis, Axis] = ("y", "x")
    for axis, pitch_um in zip(axes, scan_pitch_um, strict=True):
        spectrum = psd_along(filled, pitch_um, axis)
        white_nm2 = pixel_nm**2 + (line_nm**2 if axis != fast_axis else 0.0)
        error = np.interp(spectrum.frequency_per_um, *transfer_error(pitch_um, layout_pitch_um))
        # The spectral density is one-sided, so white noise with variance s² has the density 2 s² times the
        # pitch.
        lost += float(((spectrum.density - 2 * pitch_um * white_nm2) * error).sum()) * float(
            spectrum.frequency_per_um[0]
        )
    return max(lost, 0.0)
