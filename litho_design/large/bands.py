"""Divide a large element into bands of rows. The print of the element and the light behind it are computed
band by band.

The bands depend only on the layout and on the largest number of rows in a band. One process and many
processes use the same bands, numbered in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.optimisation.ranks import ALONE, Ranks
from litho_design.printers.printer import Printer

# Default for the largest number of rows in a band. The memory that a print needs grows with the square of
# this number. There cannot be more processes than bands. If a band has fewer rows than about four times the
# model's reach (the distance up to which a level affects the print), most of the time is spent on rows whose
# print is computed twice.
BAND_PX = 512


@dataclass(frozen=True)
class Bands:
    """The division of a square element into bands, and the bands that this process holds.

    Args:
        size_px: side of the element.
        most_px: largest number of rows in a band. All bands have the same number of rows, except the last,
            which may have fewer.
        ranks: the processes that share the element.
        cell_px: side of a free cell. No cell is divided between two bands.

    Raises:
        InputError: there are more processes than bands.
    """

    size_px: int
    most_px: int
    ranks: Ranks = ALONE
    cell_px: int = 1

    def __post_init__(self) -> None:
        if self.count < self.ranks.count:
            raise InputError(
                "processes",
                got=f"{self.ranks.count} for {self.count} bands ({self.size_px} rows, {self.band_px} each)",
                wanted="at most one per band",
                hint="use fewer processes, or a smaller --band-px",
            )

    @property
    def band_px(self) -> int:
        """Return the number of rows in each band. The last band may have fewer."""
        count = -(-self.size_px // self.most_px)
        return -(-self.size_px // (count * self.cell_px)) * self.cell_px

    @property
    def count(self) -> int:
        """Return the number of bands of the element."""
        return -(-self.size_px // self.band_px)

    def rows(self, rank: int | None = None) -> range:
        """Return the rows of the element that the process ``rank`` holds. By default, these are the rows of
        this process.
        """
        own = self.ranks.share(self.count, rank)
        return range(own.start * self.band_px, min(own.stop * self.band_px, self.size_px))

    def own(self) -> list[slice]:
        """Return the bands of this process as slices. They are slices of the array of rows that the process
        holds.
        """
        rows = len(self.rows())
        return [slice(start, min(start + self.band_px, rows)) for start in range(0, rows, self.band_px)]

    def check_halo(self, halo: int) -> None:
        """Check that the bands have enough rows, so that no row lies in the halos of two other bands.

        Raises:
            InputError: a band has fewer rows than twice the halo, or the last band has fewer rows than the
                halo.
        """
        last = self.size_px - (self.count - 1) * self.band_px
        if self.count > 1 and (self.band_px < 2 * halo or last < halo):
            raise InputError(
                "rows of a band",
                got=f"{self.band_px} px, and {last} px in the last one; the printer's reach is {halo} px",
                wanted=f"at least {2 * halo} px, and {halo} px in the last band",
                hint="use a larger --band-px",
            )

    def with_halo(self, values: Tensor, halo: int) -> Tensor:
        """Return the rows of this process, extended on both sides by ``halo`` rows of the neighbouring
        process, or by zeros at the edge of the element. ``values`` has shape (rows, x).

        In the backward pass, the gradient of a row is a sum over at most two bands, so it does not depend on
        the order of the bands.
        """
        rank, count = self.ranks.rank, self.ranks.count
        # The neighbour above needs the first rows, and the neighbour below needs the last ones.
        ends = {rank - 1: values[:halo], rank + 1: values[len(values) - halo :]}
        parts = [ends.get(other, values[:0]) for other in range(count)]
        sizes = [part.numel() for part in parts]
        got = self.ranks.exchange(parts, sizes).split(sizes)
        above, below = (
            got[other].reshape(rows.shape) if 0 <= other < count else torch.zeros_like(rows)
            for other, rows in ends.items()
        )
        return torch.cat([above, values, below])


def require_reach(printer: Printer) -> None:
    """Check that ``printer`` can predict the print of an element in parts.

    Raises:
        InputError: according to the printer model, the print at one place depends on the whole layout or on
            the position in the write field.
    """
    # A virtual fab has no halo. It adds the frame of level 0 itself and prints the layout as a whole.
    no_reach = printer.simulator is not None and getattr(printer.simulator, "reach_um", None) is None
    whole = no_reach or printer.only_judges
    if whole or printer.depends_on_position:
        why = "the whole image" if whole else "the position in the write field"
        raise InputError(
            f"printer {printer.name} for a large element",
            got=f"a print that depends on {why}",
            wanted="a model with a finite reach, such as zoo:pbl, or none",
            hint="without --large and --stream, the element is designed and scored in one piece",
        )
