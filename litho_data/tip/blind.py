"""The bluntest tip that could have made an image: blind tip estimation.

Villarrubia (1997), J. Res. Natl. Inst. Stand. Technol. 102, 425: an image is its surface dilated by the tip,
so that everything in it is at least as blunt as the tip. Each image pixel x' whose surroundings the present
bound does not explain lowers the bound to ``max over d of image(x' + u − d) + tip(d) − image(x')``, d being
the contacts that are possible there, until the opening of the image by the tip is the image, to within the
noise.
"""

from collections.abc import Sequence

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX, Array
from litho_data.tip.morphology import dilate, erode

_PIXELS_A_ROUND = 300
_ROUNDS = 6
# A pixel with more possible contacts says next to nothing.
_MOST_CONTACTS = 200


def blind_tip(images_um: Sequence[Array], half_px: int, threshold_um: float) -> Array:
    """Upper bound of the tip that made all these images.

    The bound is mirrored, as the tip appears in an image: where the image of a spike falls off.

    Args:
        images_um: (ny, nx) each, µm, of one pitch; NaN where not measured.
        half_px: the bound covers half_px pixels to each side. The tip must rise above the images' range of
            heights within it, or contacts outside are missed.
        threshold_um: height differences that noise and sampling may cause; the latter pitch²/2R.

    Returns:
        (2 half_px + 1, 2 half_px + 1), µm, 0 in the middle and ≤ 0 elsewhere; nowhere below the true tip if
        the differences stay below the threshold. All 0: the images say nothing.

    Raises:
        InputError: an image smaller than the tip, or no measured pixel.
    """
    size = 2 * half_px + 1
    for image in images_um:
        if min(image.shape) < size or not np.isfinite(image).any():
            raise InputError(
                "image for a blind tip",
                got=f"{image.shape} px",
                wanted=f"measured heights, {size} px or more",
            )
    tip = np.zeros((size, size), np.float32)
    for image in images_um:
        for _ in range(_ROUNDS):
            before = tip.copy()
            _tighten(tip, np.asarray(image, dtype=np.float32), threshold_um)
            if np.abs(tip - before).max() <= 0.05 * threshold_um:
                break
    return tip


def full_angle_bound_deg(tip: Array, pitch_um: YX) -> float:
    """Upper bound of the angle between opposite flanks: the sharpest cone from the end of the tip, degrees.

    A rounded cone lies outside the cone itself, so that radius/depth of no ring is below the tangent of its
    half angle. 180 where the bound is flat.

    Args:
        tip: as ``blind_tip`` returns it; ``pitch_um``: (y, x).
    """
    half = tip.shape[0] // 2
    steps = np.arange(-half, half + 1)
    distance = np.hypot(steps[:, None] * pitch_um[0], steps * pitch_um[1])
    rings = np.rint(np.hypot(steps[:, None], steps)).astype(int)
    sharpest = np.inf
    for ring in (rings == k for k in range(2, half + 1)):
        depth = -float(np.median(tip[ring]))
        if depth > 0:
            sharpest = min(sharpest, float(np.median(distance[ring])) / depth)
    return float(np.degrees(2 * np.arctan(sharpest)))


def _tighten(tip: Array, image: Array, threshold_um: float) -> None:
    """Lower the bound, in place, by the pixels where it explains the image least."""
    from scipy.ndimage import maximum_filter

    half = tip.shape[0] // 2
    measured = np.isfinite(image)
    left = np.where(measured, image - dilate(erode(image, tip), tip), 0.0)
    inside = np.zeros_like(measured)
    inside[half : image.shape[0] - half, half : image.shape[1] - half] = True
    worst = inside & (left > threshold_um) & (left == maximum_filter(left, 3))
    # What was not measured may hold any height, and the contact may lie half a pixel away.
    known = np.where(measured, image, np.inf)
    near = np.pad((known + maximum_filter(known, 3)) / 2, 2 * half, constant_values=np.inf)
    places = np.argwhere(worst)
    order = np.argsort(-left[worst])[:_PIXELS_A_ROUND]
    for y, x in places[order]:
        window = near[y : y + 4 * half + 1, x : x + 4 * half + 1] - image[y, x]
        _lower(tip, window, threshold_um)


def _lower(tip: Array, window: Array, threshold_um: float) -> None:
    """Lower the bound by one pixel; ``window`` (4 half + 1, …) is the image around it minus its height."""
    size, half = tip.shape[0], tip.shape[0] // 2
    opposite = window[half : half + size, half : half + size][::-1, ::-1]
    contacts = np.argwhere(opposite + tip >= -threshold_um)
    if len(contacts) > _MOST_CONTACTS:
        return
    allowed = np.full_like(tip, -np.inf)
    for row, column in contacts:
        part = window[size - 1 - row : 2 * size - 1 - row, size - 1 - column : 2 * size - 1 - column]
        np.maximum(allowed, part + tip[row, column], out=allowed)
    np.minimum(tip, allowed + threshold_um, out=tip)
    tip[half, half] = 0.0
