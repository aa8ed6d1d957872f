"""Bands of rows, the unit in which a large element is printed and transformed, and their processes.

The bands depend only on the layout: an element has the same bands with the same numbers, whether one process
computes them or many.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from litho_data.foundation.errors import InputError

# Most rows of a band. Memory for a print grows with their square, and an element cannot be shared by more
# processes than it has bands. Below about four times the model's reach, most of the time goes into rows that
# are printed twice.
BAND_PX = 512


@dataclass(frozen=True)
class Ranks:
    """The processes that share an element: those that torchrun started, or this one alone."""

    rank: int = 0
    count: int = 1

    @classmethod
    def joined(cls) -> Ranks:
        """Join the processes of torchrun, over gloo for processors and NCCL for GPUs; alone without it."""
        if int(os.environ.get("WORLD_SIZE", "1")) == 1:
            return cls()
        if not dist.is_initialized():
            if torch.cuda.is_available():
                torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
            dist.init_process_group()
        return cls(dist.get_rank(), dist.get_world_size())

    def device(self, device: str | torch.device) -> str | torch.device:
        """``device`` for this process; with ``cuda`` each process takes a GPU of its own."""
        return f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if str(device) == "cuda" else device

    def share(self, count: int, rank: int | None = None) -> range:
        """The range among ``count`` items that belongs to a process, by default this one."""
        place = self.rank if rank is None else rank
        return range(count * place // self.count, count * (place + 1) // self.count)

    def exchange(self, parts: Sequence[Tensor], sizes: Sequence[int]) -> Tensor:
        """Send ``parts[r]`` to process r and receive ``sizes[r]`` entries from each, concatenated flat.

        Args:
            parts: one tensor per process, real or complex, of one dtype.
        """
        if self.count == 1:
            return parts[0].reshape(-1)
        sent = torch.cat([part.reshape(-1) for part in parts])
        received = sent.new_empty(sum(sizes))
        # The collectives of gloo do not support complex numbers.
        to, of = (torch.view_as_real(one) if one.is_complex() else one for one in (received, sent))
        dist.all_to_all_single(to, of, list(sizes), [part.numel() for part in parts])
        return received

    def total(self, values: Tensor) -> Tensor:
        """Sum over the values of all processes in double precision, () float64.

        Differentiable: the gradient adds up what every process does with the sum (see ``shared_loss``).
        """
        total: Tensor = _Total.apply(values.sum(dtype=torch.float64), self)
        return total

    def shared_loss(self, loss: Tensor) -> Tensor:
        """A loss that all processes share; its gradient is scaled so that the loss counts once."""
        return (loss - loss.detach()) / self.count + loss.detach()

    def wait(self) -> None:
        """Wait until all processes are here."""
        if self.count > 1:
            dist.barrier()


class _Total(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, ranks: Ranks) -> Tensor:
        ctx.ranks = ranks
        return _summed(value, ranks)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _summed(gradient, ctx.ranks), None


def _summed(value: Tensor, ranks: Ranks) -> Tensor:
    total = value.clone()
    if ranks.count > 1:
        dist.all_reduce(total)
    return total


@dataclass(frozen=True)
class Bands:
    """The bands of a square element, and those of this process.

    Args:
        size_px: side of the element.
        most_px: most rows of a band; all bands have the same number, only the last may have fewer.
        ranks: the processes.
        cell_px: side of a free cell; no band cuts a cell.

    Raises:
        InputError: more processes than bands.
    """

    size_px: int
    most_px: int
    ranks: Ranks = Ranks()
    cell_px: int = 1

    def __post_init__(self) -> None:
        if self.count < self.ranks.count:
            raise InputError(
                "processes",
                got=f"{self.ranks.count} for {self.count} bands ({self.size_px} rows, {self.band_px} a band)",
                wanted="at most one per band",
                hint="fewer processes, or a smaller --band-px",
            )

    @property
    def band_px(self) -> int:
        """Rows of every band but the last."""
        count = -(-self.size_px // self.most_px)
        return -(-self.size_px // (count * self.cell_px)) * self.cell_px

    @property
    def count(self) -> int:
        """Number of bands of the element."""
        return -(-self.size_px // self.band_px)

    def rows(self, rank: int | None = None) -> range:
        """The rows of the element that a process holds, by default this one."""
        own = self.ranks.share(self.count, rank)
        return range(own.start * self.band_px, min(own.stop * self.band_px, self.size_px))

    def own(self) -> list[slice]:
        """The bands of this process, as slices of its own rows."""
        rows = len(self.rows())
        return [slice(start, min(start + self.band_px, rows)) for start in range(0, rows, self.band_px)]

    def check_halo(self, halo: int) -> None:
        """Refuse bands so narrow that a row lies in the halos of two other bands.

        Raises:
            InputError: fewer rows than twice the halo, or than the halo in the last band.
        """
        last = self.size_px - (self.count - 1) * self.band_px
        if self.count > 1 and (self.band_px < 2 * halo or last < halo):
            raise InputError(
                "rows of a band",
                got=f"{self.band_px} px, and {last} px in the last, with a reach of the printer of {halo} px",
                wanted=f"at least {2 * halo} and {halo} px",
                hint="a larger --band-px",
            )

    def with_halo(self, values: Tensor, halo: int) -> Tensor:
        """The own rows (rows, x) with ``halo`` rows of the neighbours on both sides, zero beyond the element.

        ``add_halo`` is its adjoint.
        """
        around = torch.nn.functional.pad(values, (0, 0, halo, halo))
        if halo:
            before, after = self._from_neighbours(values[:halo], values[-halo:])
            around[:halo] += before
            around[-halo:] += after
        return around

    def add_halo(self, around: Tensor, halo: int) -> Tensor:
        """Add to the own rows what neighbours computed for them; each sends ``halo`` rows to their owner."""
        own = around[halo : len(around) - halo].clone()
        if halo:
            before, after = self._from_neighbours(around[:halo], around[-halo:])
            own[:halo] += before
            own[-halo:] += after
        return own

    def _from_neighbours(self, first: Tensor, last: Tensor) -> list[Tensor]:
        """What the neighbouring processes send: each sends ``first`` and ``last`` to its own neighbours."""
        rank, count = self.ranks.rank, self.ranks.count
        parts, sizes = [first[:0]] * count, [0] * count
        sides = {rank - 1: first, rank + 1: last}
        for other in sides.keys() & set(range(count)):
            parts[other], sizes[other] = sides[other], sides[other].numel()
        got = self.ranks.exchange(parts, sizes).split(sizes)
        return [
            got[other].reshape(first.shape) if 0 <= other < count else torch.zeros_like(first)
            for other in sides
        ]
