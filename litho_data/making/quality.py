"""Figures of one scan that need no layout: noise, line errors, and what levelling removed.

All contain topography, so as estimates of instrument noise they are upper bounds.
"""

import numpy as np

from litho_data.foundation.kinds import Array

# The median absolute deviation of a Gaussian is 0.6745 sigma.
_MAD_PER_SIGMA = 0.674489750196


def noise_figures(height_um: Array) -> dict[str, float]:
    """Noise and line errors of a scan, (ny, nx) µm with NaN where not measured, in nm.

    ``noise_x_nm``, ``noise_y_nm``: second difference z[i-1] - 2 z[i] + z[i+1] along the axis, median absolute
    deviation as sigma, divided by sqrt(6): the standard deviation of white noise, 0 for a plane.
    ``row_step_nm``: standard deviation of the steps between the medians of neighbouring rows;
    ``column_step_nm``: the same for columns, as a control.
    """
    height_nm = np.asarray(height_um, dtype=float) * 1e3
    return {
        "noise_x_nm": _second_difference_sigma(height_nm),
        "noise_y_nm": _second_difference_sigma(height_nm.T),
        "row_step_nm": _line_step_sd(height_nm),
        "column_step_nm": _line_step_sd(height_nm.T),
        "unmeasured_fraction": float(np.isnan(height_nm).mean()),
    }


def levelling_figures(removed_um: Array) -> dict[str, float]:
    """Peak-to-valley and standard deviation of the surface that levelling removed, nm."""
    removed_nm = np.asarray(removed_um, dtype=float) * 1e3
    return {
        "removed_range_nm": float(np.nanmax(removed_nm) - np.nanmin(removed_nm)),
        "removed_sd_nm": float(np.nanstd(removed_nm)),
    }


def _second_difference_sigma(height: Array) -> float:
    difference = height[:, :-2] - 2 * height[:, 1:-1] + height[:, 2:]
    measured = difference[np.isfinite(difference)]
    if measured.size == 0:
        return float("nan")
    spread = np.median(np.abs(measured - np.median(measured))) / _MAD_PER_SIGMA
    return float(spread / np.sqrt(6))


def _line_step_sd(height: Array) -> float:
    lines = height[np.isfinite(height).any(axis=1)]
    if len(lines) < 2:
        return float("nan")
    return float(np.std(np.diff(np.nanmedian(lines, axis=1))))
