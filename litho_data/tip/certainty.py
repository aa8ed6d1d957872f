"""Find which pixels of a surface the tip touched, and reconstruct the surface from the image that the tip
produced.

The height of an image pixel is determined by the point at which the tip touches the surface while it scans
this pixel. If a valley is more sharply curved than the tip, the point of contact jumps from one side of the
valley to the other, and the tip does not touch the surface in between. This part of the surface leaves only
one trace in the image: a single pixel at which the image is more sharply curved than the tip. Such a pixel is
called a jump. At every place, one pixel of the image sets the upper limit to the height of the surface. Where
this pixel is a jump, the tip did not touch the surface (Villarrubia 1997, section 5).
"""

import numpy as np

from litho_data.foundation import YX, Array, InputError
from litho_data.register.topography import smooth_measured
from litho_data.tip.curvature import (
    DISC_RADII_PX,
    QUIET,
    curvature_noise,
    disc,
    highest_curvature,
    noise_of,
)
from litho_data.tip.morphology import paraboloid_erosion

# Limits for the curvature of a valley in the image, in units of the tip's curvature. Above the first value,
# the point of contact may jump there; above the second value, it does jump. With a tip of radius R, a valley
# of curvature k has the curvature k / (1 − kR) in the image, so a curvature of 0.6/R in the image corresponds
# to 0.375/R in the surface. Curvatures are fitted over a disc. If noise requires a disc as wide as the
# valley, the fit underestimates the curvature. Noise alone reaches 0.6 only at 3.5 standard deviations.
_MAY_JUMP, _JUMPS = 0.35, 0.6
# A jump also raises, but by less, the curvatures at pixels up to a disc radius away. A pixel counts as part
# of the jump only if its curvature reaches this share of the highest curvature within a disc radius.
_CORE = 0.55
_SMOOTHING = 0.25


def tip_certain(height_um: Array, pitch_um: YX, radius_um: float) -> Array:
    """Return a bool array of shape (ny, nx) that is True at the pixels that the tip certainly touched.
    Regions that the tip did not touch are widened by one pixel on all sides.

    If the given radius is only an upper bound, the result is also False at some pixels that the tip touched.
    It is always False at unmeasured pixels.

    Args:
        height_um: heights of the image in µm, shape (ny, nx); NaN where not measured.
        pitch_um: pixel pitch along y and x, µm.
        radius_um: radius of the end of the tip, µm. The tip is assumed to be a paraboloid.

    Raises:
        InputError: the radius is not a positive number.
    """
    from scipy.ndimage import binary_dilation, label, maximum_filter

    height = _checked(height_um, radius_um)
    noise = noise_of(height)
    quiet = (r for r in DISC_RADII_PX if curvature_noise(noise, pitch_um, r) * radius_um <= QUIET)
    size = next(quiet, DISC_RADII_PX[-1])
    sharpness = np.nan_to_num(highest_curvature(height, pitch_um, size) * radius_um, nan=0.0)
    regions, count = label(sharpness > _MAY_JUMP, structure=np.ones((3, 3)))
    jumps = np.zeros(count + 1, bool)
    jumps[np.unique(regions[sharpness > _JUMPS])] = True
    jumps[0] = False
    valley = jumps[regions] & (sharpness >= _CORE * maximum_filter(sharpness, footprint=disc(size)))

    measured = np.isfinite(height)
    smooth = np.where(measured, smooth_measured(height, _SMOOTHING * size), np.nan)
    found = paraboloid_erosion(smooth, pitch_um, radius_um)
    return measured & ~binary_dilation(valley[found.row, found.column])


def reconstructed(height_um: Array, pitch_um: YX, radius_um: float) -> Array:
    """Erode an image by the tip. Return the highest surface from which the tip would produce this image, in
    µm, shape (ny, nx).

    The result equals the true surface where the tip touched it, and lies above it elsewhere. Noise is not
    removed before the erosion. The erosion widens each downward spike of the noise to the width of the tip,
    which lowers the result by up to the amplitude of the noise.

    Args:
        height_um, pitch_um, radius_um: as for ``tip_certain``.

    Raises:
        InputError: the radius is not a positive number.
    """
    return paraboloid_erosion(_checked(height_um, radius_um), pitch_um, radius_um).surface


def _checked(height_um: Array, radius_um: float) -> Array:
    if not (np.isfinite(radius_um) and radius_um > 0):
        raise InputError("radius of the tip", got=radius_um, wanted="a positive number in µm")
    return np.asarray(height_um, dtype=float)
