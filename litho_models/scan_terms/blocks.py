"""Divide the pixels of a scan into pixels to which terms are fitted and pixels that are scored.

If terms were fitted to the scored pixels, a model would look better than it is. Smooth terms are therefore
fitted to one half of a checkerboard and subtracted from the other half. For the offset of a line, fitted and
scored pixels must be farther apart, because the offset is estimated from few pixels with correlated
roughness. (Along x, the correlation is still 0.2 at a distance of 32 px.) Therefore, to score a line on one
side of the scan, its offset is fitted on the other side, beyond a gap.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.errors import InputError

BoolMap = NDArray[np.bool_]


class Blocks(NamedTuple):
    """The geometry by which the pixels of a scan are divided into fitted and scored pixels. Every result
    records this geometry.

    Attributes:
        block_px: side length of a block of the checkerboard, in pixels.
        buffer_px: distance between fitted and scored pixels. Every fitted pixel is more than ``buffer_px``
            away from every scored pixel. The default is about one correlation length of the residuals of
            measured prints. At a distance of 5 px, the correlation of these residuals is 0.5.
        line_gap_px: for line offsets, distance along the line between fitted and scored pixels.
        seed: seed of the random shift of the checkerboard's origin.
    """

    block_px: int = 32
    buffer_px: int = 7
    line_gap_px: int = 32
    seed: int = 0


class Half(NamedTuple):
    """Two masks of shape (ny, nx), for scoring one colour of the checkerboard and fitting terms to the other
    colour. ``score`` is True at all pixels of the scored colour. ``calibrate`` is True at those pixels of the
    other colour that are far enough from the scored pixels.
    """

    calibrate: BoolMap
    score: BoolMap


class Cell(NamedTuple):
    """A part of the scan that is scored, and the pixels to which the line offsets for this part are fitted.

    ``score`` is the mask of the scored part. ``other_side[axis]`` is the mask of the pixels to which the
    offsets of lines along ``axis`` are fitted. These pixels lie on the other side of the scan. All masks have
    shape (ny, nx).
    """

    score: BoolMap
    other_side: dict[int, BoolMap]


@lru_cache(maxsize=8)
def checkerboard(shape: tuple[int, int], blocks: Blocks) -> tuple[Half, ...]:
    """Divide the scan into a checkerboard of square blocks, and return the masks for each of its two colours.

    Raises:
        InputError: the blocks are too small for the buffer.
    """
    block_px, buffer_px = blocks.block_px, blocks.buffer_px
    from scipy.ndimage import minimum_filter

    if block_px <= 2 * buffer_px:
        raise InputError("block_px", got=block_px, wanted=f"more than twice the buffer of {buffer_px} px")
    shift = np.random.default_rng(blocks.seed).integers(0, 2 * block_px, size=2)
    first = ((np.indices(shape) + shift[:, None, None]) // block_px).sum(axis=0) % 2 == 0
    return tuple(
        Half(minimum_filter(part, size=2 * buffer_px + 1, mode="constant", cval=1), ~part)
        for part in (first, ~first)
    )


def line_cells(shape: tuple[int, int], axes: Iterable[int], gap_px: int) -> list[Cell]:
    """Divide the scan into parts by cuts across its lines. If all lines run along the same axis, the parts
    are two halves. If there are lines along both axes, the parts are four quadrants. Without lines, there is
    one part, the whole scan.

    Args:
        shape: shape (ny, nx) of the scan.
        axes: axes along which the lines run; axis 1 is x.
        gap_px: smallest distance along a line between a scored pixel and the pixels that determine the offset
            of this line.
    """
    axes, cells = sorted(set(axes)), []
    for sides in product((False, True), repeat=len(axes)):
        score, other_side = np.ones(shape, bool), {}
        for axis, second in zip(axes, sides, strict=True):
            at, middle = np.indices(shape)[axis], shape[axis] // 2
            score &= (at >= middle) == second
            other_side[axis] = at < middle - gap_px if second else at >= middle + gap_px
        cells.append(Cell(score, other_side))
    return cells


def thinned(used: BoolMap, count: int) -> BoolMap:
    """Select about ``count`` of the used pixels, on a square lattice, and return the mask of these pixels."""
    stride = max(1, round((used.sum() / count) ** 0.5))
    lattice = np.zeros_like(used)
    lattice[stride // 2 :: stride, stride // 2 :: stride] = True
    return used & lattice
