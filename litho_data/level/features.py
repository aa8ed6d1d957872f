"""Mark features, such as particles or structures, and level a scan by a background that is fitted only to the
pixels outside the features.
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy import ndimage

from litho_data.foundation import Array, InputError
from litho_data.level.operation import operation
from litho_data.level.polynomial import (
    Degree,
    evaluate,
    fit_terms,
    noise_sigma,
    polynomial_terms,
    robust_surface,
)
from litho_data.level.selection import MaskedLevelling, subtract

Side = Literal["above", "below", "both"]
Threshold = Annotated[float, Field(gt=0)]
Grown = Annotated[int, Field(ge=0)]
_MAX_ROUNDS = 50
# Smallest accepted share of background among the selected pixels. With less, the fitted background is
# unreliable.
_LEAST_BACKGROUND = 0.02


@operation("mark-features")
def mark_features(
    z: Array,
    chosen: Array,
    *,
    threshold: Threshold = 3.0,
    side: Side = "both",
    grow_px: Grown = 0,
) -> Array:
    """Mark the pixels whose height differs from the main surface by more than ``threshold`` times the noise
    sigma.

    The height of the main surface is the median over the selected pixels, and the noise sigma is 1.4826 times
    the median absolute deviation (MAD) from this median. Both estimates are reliable only if features cover
    less than half of the selected pixels. Measured pixels that were not selected are marked too, so the mask
    contains all pixels that later steps should exclude.

    Args:
        z: heights in any unit, already levelled, shape (ny, nx).
        threshold: height difference from the main surface above which a pixel is marked, in units of the
            noise sigma.
        side: whether to mark pixels above the main surface, below it, or on both sides.
        grow_px: number of pixels by which the marked areas are widened, to cover blurred edges.

    Returns:
        A bool array of shape (ny, nx).

    Raises:
        InputError: the threshold is not positive, the side is unknown, or ``grow_px`` is negative.
    """
    centre = float(np.median(z[chosen]))
    limit = threshold * noise_sigma(z[chosen] - centre)
    return _off_surface(z - centre, chosen, limit, side, grow_px) | (np.isfinite(z) & ~chosen)


@operation("mask-and-relevel")
def mask_and_relevel(
    z: Array,
    chosen: Array,
    *,
    x_degree: Degree = 1,
    y_degree: Degree = 1,
    total_degree: Degree | None = 1,
    threshold: Threshold = 3.0,
    side: Side = "both",
    grow_px: Grown = 2,
) -> MaskedLevelling:
    """Level a scan, mark its features, and level it again without the marked pixels. This is repeated until
    the marks no longer change.

    In the first round, the background is a robust polynomial fit (Tukey's biweight). In all later rounds, it
    is a least-squares fit to the unmarked pixels. The whole background, including its constant term, is
    subtracted, so that the main surface lies at zero. As in ``mark_features``, measured pixels that were not
    selected are marked too.

    Raises:
        InputError: a parameter is outside its range, or the features leave too few background pixels.
    """
    terms = polynomial_terms(x_degree, y_degree, total_degree)
    surface = robust_surface(z, chosen, terms)
    # The noise is estimated only once. If it were estimated again in every round from the unmarked pixels,
    # the estimate would shrink each time.
    limit = threshold * noise_sigma((z - surface)[chosen])
    seen: set[bytes] = set()
    for _ in range(_MAX_ROUNDS):
        features = _off_surface(z - surface, chosen, limit, side, grow_px)
        background = chosen & ~features
        if np.count_nonzero(background) < _LEAST_BACKGROUND * np.count_nonzero(chosen):
            raise InputError(
                "mask-and-relevel finds no main surface",
                got="nearly all pixels marked as features",
                wanted="a higher threshold or a mask",
            )
        surface = evaluate(fit_terms(z, background, terms), z.shape)
        key = np.packbits(features).tobytes()
        if key in seen:
            break
        seen.add(key)
    return MaskedLevelling(subtract(z, surface), features | (np.isfinite(z) & ~chosen))


def _off_surface(residual: Array, usable: Array, limit: float, side: Side, grow_px: int) -> Array:
    with np.errstate(invalid="ignore"):
        above, below = residual > limit, residual < -limit
    marked = usable & (above if side == "above" else below if side == "below" else above | below)
    return usable & ndimage.binary_dilation(marked, iterations=grow_px) if grow_px else marked
