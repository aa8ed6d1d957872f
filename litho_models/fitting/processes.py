"""Divide a training among the processes that ``torchrun`` started. Without ``torchrun``, there is only one
process.
"""

import os
from collections.abc import Iterable

import torch
from torch import Tensor
from torch import distributed as dist


def joined() -> tuple[int, int]:
    """Connect this process with the others that torchrun started, if there are any. The processes communicate
    through gloo on CPUs and through NCCL on GPUs. With GPUs, each process uses its own GPU.

    Returns:
        The rank of this process, counted from 0, and the number of processes.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return 0, 1
    if not dist.is_initialized():
        if torch.cuda.is_available():
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group()
    return dist.get_rank(), dist.get_world_size()


def add_over_processes(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor by its sum over all processes. Every process must pass its tensors in the same
    order.
    """
    if joined()[1] > 1:
        for tensor in tensors:
            dist.all_reduce(tensor)
