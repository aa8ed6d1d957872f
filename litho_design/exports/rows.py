"""Read the levels of an element of any size, one band of rows at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from litho_design.tasks.design import LEVELS_FILE, RINGS_FILE, Design, read_array


class LevelRows(Protocol):
    """A level map of shape (ny, nx) in memory or on disk, with row 0 at the top. Its rows can be sliced as in
    an array.
    """

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape (ny, nx) of the map."""

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Return the levels in all columns of the given rows."""


@dataclass(frozen=True)
class RingRows:
    """The level map of a lens that consists of rings. Only those rows that are requested are computed.

    Args:
        ring_level: level of each pixel along the radius, uint8. The last of these levels is also the level of
            all pixels in the corners of the map, beyond the aperture.
    """

    ring_level: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Return the shape (ny, nx) of the map."""
        return (2 * len(self.ring_level),) * 2

    def __getitem__(self, rows: slice) -> np.ndarray:
        radius = len(self.ring_level)
        x = np.arange(radius) + 0.5
        y = np.arange(2 * radius)[rows] + 0.5 - radius
        ring = np.hypot(y[:, None], x).astype(np.intp)
        right = self.ring_level[np.minimum(ring, radius - 1, out=ring)]
        return np.concatenate([right[:, ::-1], right], axis=1)


def layout_rows(folder: str | Path) -> LevelRows:
    """Open the levels in a design folder without loading them into memory, and check the file of the levels
    against the hash in the record of the design.

    Raises:
        InputError: the folder contains no design, or the file of the levels changed after the design was
            written.
    """
    if Design.read(folder).in_rings:
        return RingRows(read_array(folder, RINGS_FILE))
    return read_array(folder, LEVELS_FILE, on_disk=True)


def bands_of(levels: LevelRows, band_px: int) -> Iterator[slice]:
    """Yield slices that divide the rows of a map into bands of ``band_px`` rows; the last band may have
    fewer.
    """
    height = levels.shape[0]
    return (slice(top, min(top + band_px, height)) for top in range(0, height, band_px))
