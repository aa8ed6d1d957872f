"""Make grids centred on a given position, and find the distances at which a sampled propagation kernel is
valid.
"""

from __future__ import annotations

import math
from dataclasses import replace

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid

# Sampling creates a copy of the spectrum around the frequency 1/pitch. The intensity of the evanescent wave
# at this frequency must decay by the factor exp(-2 pi n), where n is the number below. For n = 2, this factor
# is 3.5e-6.
_DECAY_LENGTHS = 2.0


def centred_grid(
    shape: tuple[int, int], pitch_um: float, centre_um: tuple[float, float] = (0.0, 0.0)
) -> PixelGrid:
    """Make a grid of square pixels. The middle of the grid lies at the position ``centre_um`` (y, x), for
    even and odd numbers of pixels.
    """
    grid = PixelGrid.square(shape, pitch_um)
    height, width = grid.size_um
    return replace(grid, origin_um=(centre_um[0] - height / 2, centre_um[1] - width / 2))


def sampling_limit_um(source: PixelGrid, target: PixelGrid, wavelength_um: float) -> float:
    """Return the smallest distance, µm, at which the sampled Rayleigh-Sommerfeld kernel is not aliased.

    At a lateral separation x between a source point and a target point, the kernel oscillates with x /
    (wavelength r) cycles/µm, where r is the distance between the two points. This frequency must stay below
    the Nyquist frequency of the source grid. Sampling also creates copies of the spectrum. The evanescent
    waves in these copies must have decayed at the target, which sets a second limit on the distance.
    """
    limit = 0.0
    for axis in range(2):
        pitch = source.pitch_um[axis]
        reach = largest_separation_um(source, target, axis)
        if 2 * pitch > wavelength_um:
            limit = max(limit, reach * math.sqrt((2 * pitch / wavelength_um) ** 2 - 1))
        if pitch < wavelength_um:
            limit = max(limit, _DECAY_LENGTHS / math.sqrt(pitch**-2 - wavelength_um**-2) / 2)
    return limit


def check_distance(distance_um: float, source: PixelGrid, target: PixelGrid, wavelength_um: float) -> None:
    """Check that the Rayleigh-Sommerfeld kernel is not aliased at a distance.

    Raises:
        InputError: ``distance_um`` is not positive, or below ``sampling_limit_um``.
    """
    limit = sampling_limit_um(source, target, wavelength_um)
    if not math.isfinite(distance_um) or distance_um <= 0 or distance_um < limit:
        raise InputError(
            "propagation distance",
            got=f"{distance_um:.4g} µm",
            wanted=f"at least {limit:.4g} µm for a pitch of {source.pitch_um[1]:g} µm",
            hint="use the angular spectrum method or a finer pitch",
        )


def fast_length(length: int) -> int:
    """Return the smallest size >= ``length`` with a fast FFT (no prime factors except 2, 3 and 5)."""
    from scipy.fft import next_fast_len  # imported late to save the command line a tenth of a second

    found: int = next_fast_len(length, real=True)
    return found


def first_centre_um(grid: PixelGrid, axis: int) -> float:
    """Return the coordinate of the first pixel centre along ``axis`` (0 = y, 1 = x), µm."""
    return grid.origin_um[axis] + grid.pitch_um[axis] / 2


def largest_separation_um(source: PixelGrid, target: PixelGrid, axis: int) -> float:
    """Return the largest distance along ``axis`` between a pixel of the source and one of the target, µm."""
    start = first_centre_um(target, axis) - first_centre_um(source, axis)
    source_span = (source.shape[axis] - 1) * source.pitch_um[axis]
    target_span = (target.shape[axis] - 1) * target.pitch_um[axis]
    return max(abs(start - source_span), abs(start + target_span))
