"""Prints made of write fields that are each displaced a little."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from litho_data.commands.settings import setting
from litho_data.foundation.results import Record

if TYPE_CHECKING:
    from torch import Tensor


class Stitching(Record):
    """Write fields, counted from the corner of the element, and the spread of their displacements.

    ``sigma_um`` is the standard deviation along each axis; none by default.
    """

    field_um: float = setting(
        100.0, "Side of the write fields of a print", unit="µm",
        option="--stitch-field-um", gt=0,
    )  # fmt: skip
    sigma_um: float = setting(
        0.0, "Spread of the displacement of write fields, each axis", unit="µm", option="--stitch-sigma-um",
        ge=0,
    )  # fmt: skip

    def offsets_um(self, size_px: int, pitch_um: float, seed: list[int]) -> np.ndarray:
        """Random displacement (y, x) of each field, (fields, fields, 2), µm; the same for the same seed."""
        count = math.ceil(size_px / self.field_px(pitch_um))
        return self.sigma_um * np.random.default_rng(seed).standard_normal((count, count, 2))

    def drawn(self, height_um: Tensor, pitch_um: float, seed: list[int]) -> Tensor:
        """A print (size, size), µm, whose fields are displaced as this seed draws."""
        offsets_um = self.offsets_um(len(height_um), pitch_um, seed)
        return in_fields(height_um, pitch_um, self.field_px(pitch_um), offsets_um)

    def field_px(self, pitch_um: float) -> int:
        """Side of a field in pixels."""
        return max(1, round(self.field_um / pitch_um))


def in_fields(height_um: Tensor, pitch_um: float, field_px: int, offsets_um: np.ndarray) -> Tensor:
    """The print with displaced write fields, from the print in one piece; differentiable.

    A gap between two fields is bare, and where fields overlap the height is their mean, because writing twice
    makes nothing taller. A displaced pixel is divided among the four pixels that it covers.

    Args:
        height_um: print (size, size), µm.
        field_px: side of a field; ``offsets_um``: displacement (y, x) of every field, (fields, fields, 2),
            µm.

    Returns:
        Heights of the same shape.
    """
    import torch

    shape = height_um.shape
    summed, covered = (torch.zeros_like(height_um) for _ in range(2))
    for index in np.ndindex(offsets_um.shape[:2]):
        rows, columns = (
            (at * field_px, min((at + 1) * field_px, size)) for at, size in zip(index, shape, strict=True)
        )
        offset_px = offsets_um[index] / pitch_um
        whole = np.floor(offset_px).astype(int)
        share = offset_px - whole
        for step in np.ndindex(2, 2):
            weight = float(np.prod(np.where(step, share, 1 - share)))
            by = (whole + step).tolist()
            spans = [
                [min(max(end + d, 0), size) for end in edge]
                for edge, d, size in zip((rows, columns), by, shape, strict=True)
            ]
            if weight == 0 or any(low >= high for low, high in spans):
                continue
            to = tuple(slice(low, high) for low, high in spans)
            of = tuple(slice(low - d, high - d) for (low, high), d in zip(spans, by, strict=True))
            summed[to] += weight * height_um[of]
            covered[to] += weight
    return summed / covered.clamp(min=1)
