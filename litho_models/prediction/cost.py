"""What the prediction of a scan costs on the machine at hand: time and memory."""

import ctypes
import gc
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from litho_data.commands.progress import progress
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan

_STATUS, _CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_RESET_PEAK = "5"  # see proc(5): the peak of resident memory starts again from the present


class PredictionCost(Record):
    """Medians over scans; memory is what a prediction needs beyond what was in use; None if not known."""

    seconds_per_scan: float
    peak_memory_mib: float | None
    device: str
    threads: int


def measured_predictions(
    predict: Callable[[PrintedScan], np.ndarray], scans: Sequence[PrintedScan], device: str
) -> tuple[list[np.ndarray], PredictionCost]:
    """Heights of all scans (ny, nx), µm, and what they cost.

    Memory is the peak of resident memory (Linux) or of the accelerator's allocations (CUDA).

    Args:
        predict: scan to height; ``scans``: at least one; ``device``: where the model is, as torch names it.
    """
    heights, seconds, memory = [], [], []
    gc.collect()
    for scan in progress(scans, "predicting"):
        before = _start_of_peak(device)
        started = time.perf_counter()
        heights.append(predict(scan))
        seconds.append(time.perf_counter() - started)
        if before is not None:
            memory.append((_peak_bytes(device) - before) / 2**20)
    cost = PredictionCost(
        seconds_per_scan=float(np.median(seconds)),
        peak_memory_mib=float(np.median(memory)) if memory else None,
        device=device,
        threads=torch.get_num_threads(),
    )
    return heights, cost


def _start_of_peak(device: str) -> int | None:
    """Bytes in use, from which the peak is counted again; None where the peak cannot be reset."""
    if device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    if not _CLEAR_REFS.exists():
        return None
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)  # what the last prediction left free is still resident, and would be used again unseen
    try:
        _CLEAR_REFS.write_text(_RESET_PEAK)
    except OSError:
        return None
    return _status_bytes("VmRSS")


def _peak_bytes(device: str) -> int:
    return torch.cuda.max_memory_allocated() if device.startswith("cuda") else _status_bytes("VmHWM")


def _status_bytes(key: str) -> int:
    """One entry of this process's status, which Linux gives in KiB."""
    found = re.search(rf"^{key}:\s*(\d+) kB$", _STATUS.read_text(encoding="ascii"), re.MULTILINE)
    assert found is not None, f"{_STATUS} has no {key}"
    return 1024 * int(found[1])
