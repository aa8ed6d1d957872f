"""Class Scan: one height map as an instrument recorded it, with everything that its file states about it."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from litho_data.foundation import YX, Array, InputError
from litho_data.foundation.grid import PixelGrid

Axis = Literal["x", "y"]


@dataclass(frozen=True, eq=False)
class Scan:
    """A height map in the scan's own frame.

    Args:
        height_um: heights in µm, a float64 array of shape (ny, nx) with row 0 at the top. Pixels that were
            not measured are NaN.
        pitch_um: distance between neighbouring pixels along y and along x, in µm; None if neither the file
            nor the caller states the pitch.
        name: name of the scan, by default the stem of its file name.
        channel: name of the channel that was read.
        unit: unit of the heights in the file, before conversion to µm.
        fast_axis: the axis along which the tip moved fast; None if unknown.
        mask: mask that the file contains, a bool array of shape (ny, nx); None if the file has no mask.
        header: all other entries of the file's header, as strings.
        source: path of the file.
        format: name of the reader that read the file.
        sized_by_file: whether the file states the size. If not, the pitch follows from a size that the caller
            stated.
        notes: warnings about the heights, which everyone who uses them should know.

    Raises:
        InputError: the heights are not a map of at least 2 x 2 pixels or contain no finite value, the shape
            of the mask differs from that of the heights, or the pitch is out of range.
    """

    height_um: Array
    pitch_um: YX | None
    name: str = ""
    channel: str = ""
    unit: str = "µm"
    fast_axis: Axis | None = None
    mask: Array | None = None
    header: dict[str, str] = field(default_factory=dict)
    source: str = ""
    format: str = ""
    sized_by_file: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        what = f"scan {self.source or self.name}".strip()
        height = np.array(self.height_um, dtype=float, order="C")
        if height.ndim != 2 or min(height.shape) < 2:
            raise InputError(f"{what}: shape", got=height.shape, wanted="at least 2 x 2 pixels")
        height[~np.isfinite(height)] = np.nan
        if np.isnan(height).all():
            raise InputError(f"{what}: no finite height", wanted="at least one measured pixel")
        height.flags.writeable = False
        object.__setattr__(self, "height_um", height)
        if self.mask is not None:
            mask = np.array(self.mask, dtype=bool)
            if mask.shape != height.shape:
                raise InputError(f"{what}: shape of the mask", got=mask.shape, wanted=height.shape)
            mask.flags.writeable = False
            object.__setattr__(self, "mask", mask)
        if self.pitch_um is not None:
            grid = PixelGrid((height.shape[0], height.shape[1]), self.pitch_um)
            object.__setattr__(self, "pitch_um", (float(grid.pitch_um[0]), float(grid.pitch_um[1])))

    def __repr__(self) -> str:
        ny, nx = self.shape
        pitch = f"{self.pitch_um[0]:g} x {self.pitch_um[1]:g} µm" if self.pitch_um else "an unknown pitch"
        low, high = np.nanmin(self.height_um), np.nanmax(self.height_um)
        missing = int(np.isnan(self.height_um).sum())
        return (
            f"<Scan {self.name}: {ny} x {nx} px of {pitch}, heights {low:.3g} to {high:.3g} µm, "
            f"{missing} px missing>"
        )

    def _repr_html_(self) -> str:
        from litho_data.reports.pictures import shown_html

        return shown_html(repr(self), height_um=self.height_um)

    @property
    def shape(self) -> tuple[int, int]:
        """Return the shape (ny, nx) in pixels."""
        return self.height_um.shape[0], self.height_um.shape[1]

    def require_pitch(self) -> YX:
        """Return the pitch along y and along x in µm, for operations that cannot work without it.

        Raises:
            InputError: the pitch is unknown.
        """
        if self.pitch_um is None:
            raise InputError(
                f"scan {self.source or self.name} has no pixel pitch",
                wanted="a pitch in µm",
                hint="give the field size, for example size_um = [54.0, 54.0], --size-um 54 54 or "
                "--scan-size-um 54",
            )
        return self.pitch_um

    @property
    def grid(self) -> PixelGrid:
        """Return the scan's pixel grid (shape and pitch), or raise InputError if the pitch is unknown."""
        return PixelGrid(self.shape, self.require_pitch())
