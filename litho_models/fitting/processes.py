"""Several processes that share one training, started by ``torchrun``; without it there is one."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch import distributed as dist


@contextmanager
def processes_of_torchrun() -> Iterator[bool]:
    """Join the other processes, if ``torchrun`` started any; yields whether this is the first."""
    started = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if started:
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield rank_and_count()[0] == 0
    finally:
        if started:
            dist.destroy_process_group()


def rank_and_count() -> tuple[int, int]:
    """Number of this process, from 0, and how many there are."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def own_device() -> torch.device:
    """A GPU of its own for each process of a machine, if there is one."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    return torch.device("cuda", torch.cuda.current_device())


def add_over_processes(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor by its sum over the processes; they must come in one order."""
    if rank_and_count()[1] > 1:
        for tensor in tensors:
            dist.all_reduce(tensor)
