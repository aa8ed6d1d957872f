"""Estimate the uncertainty of a registration. It is estimated from the errors in blocks that were left out of
the fit, from a bootstrap, and from the correlation of scan and layout.
"""

from dataclasses import dataclass

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.geometry import corners
from litho_data.register.refine import BORDER_PX, Refinement, corner_motion_px, interior_of, solve_gram
from litho_data.register.topography import pearson, smooth_measured

WINDOW_CELLS = 4
WINDOW_SEARCH_PX = 6
MIN_MEASURED = 0.9
BOOTSTRAP_SAMPLES = 200
# Limits above which a scan counts as bent along an axis. The shifts of the blocks are averaged at every
# position along the axis. The first value limits the range of these means, in pixels. The second limits the
# root mean square of their deviations from the common mean, in standard errors. Straight scans reach no more
# than 0.2 px and 4 standard errors.
SMALLEST_CURVE_PX, CLEAR_CURVE_SIGMA = 0.2, 5.0


@dataclass(frozen=True)
class BlockShifts:
    """The shifts of the field's blocks relative to the positions that the warp predicts. All arrays have
    shape (n, 2), with columns x and y, in layout pixels.

    ``middle_px`` contains the centres of the blocks. ``shift_px`` contains, for every block, the displacement
    of its content from the position that the warp predicts. ``held_out_px`` contains the same displacement
    for a warp that was fitted without the block.
    """

    middle_px: Array
    shift_px: Array
    held_out_px: Array

    def held_out_error_percentiles_px(self, *percents: float) -> list[float]:
        """Return the given percentiles of the target registration error. This error is the length of a
        block's vector in ``held_out_px``. The percentiles are NaN if there are no blocks.
        """
        lengths = np.hypot(*self.held_out_px.T)
        return [float(np.percentile(lengths, p)) if len(lengths) else float("nan") for p in percents]

    def curve_px(self, axis: int, along: int) -> float:
        """Average the shifts of all blocks that have the same position along the axis ``along``. Return the
        largest of these means minus the smallest, or NaN if there are fewer than three positions.

        Args:
            axis: the component of the shifts that is averaged (0 = x, 1 = y).
            along: the axis along which the blocks are grouped by position (0 = x, 1 = y).

        If the scanner is linear and the kind of warp is general enough, the shifts vary only by noise. A
        larger variation means that an axis of the scanner is not linear or that the scanner creeps. Neither
        effect can be described by any of the kinds of warp in ``LADDER`` (translation to homography).
        """
        means = [shifts.mean() for shifts in self._by_place(axis, along)]
        return float(np.ptp(means)) if len(means) >= 3 else float("nan")

    def bends_along(self, along: int) -> bool:
        """Return whether the mean shift of the blocks depends on the position along this axis. The result is
        true only if the means differ by a relevant amount, and by clearly more than their standard errors.
        """
        for axis in (0, 1):
            groups = self._by_place(axis, along)
            if len(groups) < 3 or min(len(group) for group in groups) < 3:
                continue
            means = np.array([group.mean() for group in groups])
            errors = np.array([group.std(ddof=1) / len(group) ** 0.5 for group in groups])
            sigmas = np.sqrt((((means - means.mean()) / np.maximum(errors, 1e-6)) ** 2).mean())
            if np.ptp(means) > SMALLEST_CURVE_PX and sigmas > CLEAR_CURVE_SIGMA:
                return True
        return False

    def _by_place(self, axis: int, along: int) -> list[Array]:
        places = self.middle_px[:, along]
        return [self.shift_px[places == place, axis] for place in np.unique(places)]


def match_blocks_of_field(
    refinement: Refinement, registered: Array, measured: Array, topography: Array
) -> BlockShifts:
    """Measure the shift of every block of the field relative to two predicted positions. One is predicted by
    the warp, and the other by a warp that is fitted without the block.

    Args:
        refinement: the fit of the warp.
        registered: the smoothed scan on the layout's pixels, with the background removed and gaps filled,
            shape (ny, nx).
        measured: mask of the pixels that were measured, shape (ny, nx).
        topography: predicted topography with the blur of the scan, shape (ny, nx).

    Blocks are windows with sides of four cells. Adjacent blocks overlap by half. A block is used if it
    contains structure and at least nine tenths of its area were measured. The border of the layout is left
    out. The shift of a block is the position of the highest normalised cross-correlation, refined by a
    parabola through the adjacent values.
    """
    import cv2

    gram, shape = refinement.gram, topography.shape
    size = min(WINDOW_CELLS, gram.shape[0] // 2, gram.shape[1] // 2)
    total, scale = gram.sum(axis=(0, 1)), np.array(shape) / gram.shape[:2]
    image, template = registered.astype(np.float32), topography.astype(np.float32)
    middles, shifts, held_out = [], [], []
    step = max(1, size // 2)
    for i in range(0, gram.shape[0] - size + 1, step) if size else ():
        for j in range(0, gram.shape[1] - size + 1, step):
            top, left = np.maximum(np.rint(scale * (i, j)).astype(int), BORDER_PX)
            bottom, right = np.minimum(
                np.rint(scale * (i + size, j + size)).astype(int), np.array(shape) - BORDER_PX
            )
            block = template[top:bottom, left:right]
            if measured[top:bottom, left:right].mean() < MIN_MEASURED or block.std() < 0.1 * template.std():
                continue
            window = image[
                top - WINDOW_SEARCH_PX : bottom + WINDOW_SEARCH_PX,
                left - WINDOW_SEARCH_PX : right + WINDOW_SEARCH_PX,
            ]
            shift = _peak(cv2.matchTemplate(window, block, cv2.TM_CCOEFF_NORMED)) - WINDOW_SEARCH_PX
            others = total - gram[i : i + size, j : j + size].sum(axis=(0, 1))
            middle = np.array([(left + right - 1) / 2, (top + bottom - 1) / 2])
            # The scan at x shows what the topography predicts at x - shift. The warp fitted without the block
            # moves the topography from x to x + motion.
            motion = corner_motion_px(solve_gram(others), shape, middle[None])[0]
            middles.append(middle)
            shifts.append(shift)
            held_out.append(shift + motion)
    return BlockShifts(*(np.reshape(values, (-1, 2)) for values in (middles, shifts, held_out)))


def bootstrap_corner_sd_px(refinement: Refinement, shape: Shape, seed: int) -> float:
    """Return the standard deviation, in px, of the position of the layout's most uncertain corner. It is
    computed by a bootstrap over the blocks, and is NaN if there are fewer than four blocks.
    """
    blocks = refinement.blocks()
    blocks = blocks.reshape(-1, *blocks.shape[2:])
    if len(blocks) < 4:
        return float("nan")
    even = np.full(len(blocks), 1 / len(blocks))
    counts = np.random.default_rng(seed).multinomial(len(blocks), even, BOOTSTRAP_SAMPLES)
    samples = np.einsum("sb,bij->sij", counts.astype(float), blocks)
    motion = corner_motion_px(solve_gram(samples), shape, corners(shape))
    return float(np.sqrt(motion.var(axis=0).sum(axis=-1)).max())


def height_correlation(height: Array, layout_level: Array) -> float:
    """Smooth the heights by a Gaussian with sigma = 1 px, and return their Pearson correlation with the
    layout.

    Layout and heights have shape (ny, nx), and heights may be NaN. Only pixels that have a known height and
    do not lie in the border of the layout (see ``interior_of``) are used.
    """
    chosen = interior_of(height.shape) & np.isfinite(height)
    if chosen.sum() < 16:
        return float("nan")
    return pearson(smooth_measured(height, 1.0)[chosen], layout_level[chosen].astype(float))


def _peak(score: Array) -> Array:
    """Return the position (x, y) of the largest score. Along each axis, the position is refined to a fraction
    of a pixel if it does not lie at the border.
    """
    row, column = (int(k) for k in np.unravel_index(np.argmax(score), score.shape))
    position = np.array([column, row], dtype=float)
    for axis, line, k in ((0, score[row], column), (1, score[:, column], row)):
        if 0 < k < len(line) - 1:
            before, at, after = (float(value) for value in line[k - 1 : k + 2])
            curvature = before - 2 * at + after
            position[axis] += (before - after) / (2 * curvature) if curvature < 0 else 0.0
    return position
