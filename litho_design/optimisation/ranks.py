"""The processes that share one element: those that torchrun started, or only this process."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Ranks:
    """The rank of this process among all processes. The methods sum values over the processes and exchange
    values between them; gradients flow through both operations.
    """

    rank: int = 0
    count: int = 1

    @classmethod
    def joined(cls) -> Ranks:
        """Join the processes that torchrun started, over gloo for CPUs and NCCL for GPUs.

        Without torchrun, this process is the only one.
        """
        if int(os.environ.get("WORLD_SIZE", "1")) == 1:
            return cls()
        if not dist.is_initialized():
            if torch.cuda.is_available():
                torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
            dist.init_process_group()
        return cls(dist.get_rank(), dist.get_world_size())

    @property
    def part(self) -> str:
        """Return a text for the names of files that each process writes separately. The text identifies the
        process; it is empty if there is only one process.
        """
        return f"-{self.rank + 1}-of-{self.count}" if self.count > 1 else ""

    def device(self, device: str | torch.device) -> str | torch.device:
        """Choose the device of this process; with ``cuda``, each process uses its own GPU."""
        return f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if str(device) == "cuda" else device

    def share(self, count: int, rank: int | None = None) -> range:
        """Divide ``count`` items among the processes, and return the range of the items of the process
        ``rank``. By default, ``rank`` is the rank of this process.
        """
        place = self.rank if rank is None else rank
        return range(count * place // self.count, count * (place + 1) // self.count)

    def exchange(self, parts: Sequence[Tensor], sizes: Sequence[int]) -> Tensor:
        """Send ``parts[r]`` to each process r, and receive ``sizes[r]`` entries from it. Return all received
        entries as a flat tensor.

        Args:
            parts: for each process, the tensor to send to it. All tensors have the same real or complex
                dtype.
            sizes: for each process, the number of entries to receive from it.
        """
        if self.count == 1:
            return parts[0].reshape(-1)
        from torch.distributed.nn.functional import all_to_all_single

        sent = torch.cat([part.reshape(-1) for part in parts])
        # The collectives of gloo do not support complex numbers.
        given = torch.view_as_real(sent) if sent.is_complex() else sent
        room = given.new_empty((sum(sizes), *given.shape[1:]))
        got: Tensor = all_to_all_single(room, given, list(sizes), [part.numel() for part in parts])
        return torch.view_as_complex(got) if sent.is_complex() else got

    def total(self, values: Tensor) -> Tensor:
        """Return the sum of the values in all processes, a float64 scalar. The gradient adds the
        contributions of all processes.
        """
        own = values.sum(dtype=torch.float64)
        if self.count == 1:
            return own
        from torch.distributed.nn.functional import all_reduce

        total: Tensor = all_reduce(own)
        return total

    def any(self, value: bool) -> bool:
        """Wait until all processes have called this method, and return True if ``value`` is True in any of
        them.
        """
        return bool(self.total(torch.tensor([float(value)])) > 0)

    def wait(self) -> None:
        """Wait until all processes have reached this call."""
        if self.count > 1:
            dist.barrier()


# The ranks to use if this process alone holds the element.
ALONE = Ranks()
