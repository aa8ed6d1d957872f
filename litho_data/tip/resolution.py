"""Compute the lateral resolution of a scan as limited by the tip."""

import numpy as np

from litho_data.foundation import YX, Array

# Artefacts of the tip begin at wavelengths at which peaks reach this share of the tip's curvature (Sanner et
# al. 2022).
_SHARE = 0.5


def lateral_resolution_um(height_um: Array, pitch_um: YX, radius_um: float) -> float | None:
    """Return the wavelength, µm, below which the scan may show the shape of the tip instead of the surface.

    Peaks of an image are at most as sharp as the tip. For each wavelength λ, the curvature of the sharpest
    peak is computed along both axes from heights that are λ/2 apart: ``(h(x − λ/2) − 2 h(x) + h(x + λ/2)) /
    (λ/2)²``. The result is the largest λ at which this curvature reaches half of the tip's curvature 1/R
    (Sanner et al., Scale-dependent roughness parameters for topography analysis, arXiv:2106.16103). Peaks
    that are due to noise are not distinguished from peaks of the surface, so the result is an upper bound.

    Args:
        height_um: heights in µm, shape (ny, nx); NaN where not measured.
        pitch_um: pixel pitch along y and x, µm.
        radius_um: radius of the end of the tip, µm.

    Returns:
        The wavelength. None means that no peak reaches half of the tip's curvature at any λ, so the tip does
        not limit the resolution.
    """
    found = [
        _along(np.moveaxis(height_um, axis, 0), pitch, _SHARE / radius_um)
        for axis, pitch in enumerate(pitch_um)
    ]
    return max((value for value in found if value is not None), default=None)


def _along(lines: Array, pitch_um: float, limit: float) -> float | None:
    steps = np.arange(1, (len(lines) - 1) // 2 + 1)
    sharpest = np.array([_sharpest(lines, int(step)) / (step * pitch_um) ** 2 for step in steps])
    reached = np.flatnonzero(sharpest >= limit)
    if reached.size == 0:
        return None
    last = reached[-1]
    step = float(steps[last])
    if last + 1 < len(steps):
        step += (sharpest[last] - limit) / (sharpest[last] - sharpest[last + 1])
    return 2 * step * pitch_um


def _sharpest(lines: Array, step: int) -> float:
    bend = 2 * lines[step:-step] - lines[: -2 * step] - lines[2 * step :]
    finite = bend[np.isfinite(bend)]
    return float(finite.max()) if finite.size else 0.0
