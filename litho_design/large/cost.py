"""What a large design costs: a model of time, memory and network, fitted to small sizes measured here."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_design.holograms.settings import HologramSettings
from litho_design.images.targets import load_target
from litho_design.large.bands import BAND_PX, Bands, Ranks
from litho_design.large.hologram import BandedHologram
from litho_design.optics.sampling import fast_length
from litho_design.optimisation.budget import measure_budget, peak_memory_gib
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printer

_GIB = 2**30
# In use at the peak of an iteration; 32 are the spectrum and half the transfer function, of twice the side.
# Between small sizes the peak of a process grows by up to twice as much: the C library keeps freed arrays
# below 32 MiB for later ones. That part, the interpreter, libraries, model and a band stay as they are.
_IN_USE_BYTES_PER_PX = 64
# A row of the spectrum is kept, sent and received: two complex64 of twice the length more than alone.
_EXCHANGE_BYTES_PER_PX = 2 * 2 * 8
_LEVEL, _HEIGHT, _IMAGE, _TARGET = 1, 4, 4, 4


class MeasuredSize(Record):
    """Cost of one size in one process: an iteration, the transforms in it, an evaluation without gradient."""

    size_px: int
    iteration_s: float
    transforms_s: float
    evaluation_s: float
    peak_memory_gib: float


class CostModel(Record):
    """Transforms grow as K² log K, K being twice the side; all other time and memory as the pixels.

    ``memory_gib`` is the constant part of the memory.
    """

    transform_s_per_operation: float
    rest_s_per_px: float
    evaluation_s_per_px: float
    memory_gib: float

    def iteration_s(self, size_px: int, ranks: int = 1) -> float:
        """Time of one iteration of the search, with gradient, without what the network takes."""
        return (
            self.transform_s_per_operation * _operations(size_px) + self.rest_s_per_px * size_px**2
        ) / ranks

    def evaluation_s(self, size_px: int, ranks: int = 1) -> float:
        """Time of one evaluation of a printable layout."""
        half = self.transform_s_per_operation * _operations(size_px) / 2
        return (half + self.evaluation_s_per_px * size_px**2) / ranks

    def memory_of_rank_gib(self, size_px: int, ranks: int = 1) -> float:
        """Peak memory of each process."""
        return self.memory_gib + memory_in_use_gib(size_px, ranks)

    def search_s(self, size_px: int, settings: HologramSettings, ranks: int = 1) -> float:
        """Time of the start and the search."""
        search = settings.search
        starts = 0 if search.start == "random" else search.start_iterations
        evaluations = search.iterations / search.evaluate_every + 2
        return (
            starts * self.transform_s_per_operation * _operations(size_px) / ranks
            + search.iterations * self.iteration_s(size_px, ranks)
            + evaluations * self.evaluation_s(size_px, ranks)
        )


def memory_in_use_gib(size_px: int, ranks: int = 1) -> float:
    """What each process holds of an element at the peak of an iteration."""
    per_px = _IN_USE_BYTES_PER_PX + (_EXCHANGE_BYTES_PER_PX if ranks > 1 else 0)
    return per_px * size_px**2 / ranks / _GIB


def sent_gib(size_px: int, ranks: int) -> float:
    """What each process sends in one iteration: its rows, four times, but for its own share."""
    rows = size_px / ranks * fast_length(2 * size_px - 1) * 8
    return 4 * rows * (ranks - 1) / ranks / _GIB


def disk_gib(size_px: int) -> float:
    """Size of the folder of a large design."""
    return (_LEVEL + _HEIGHT + _IMAGE + _TARGET) * size_px**2 / _GIB


def measure_size(
    settings: HologramSettings,
    printer: Printer,
    size_px: int,
    band_px: int,
    clock: Callable[[], float] = time.perf_counter,
) -> MeasuredSize:
    """Time one iteration, its transforms and an evaluation of an element of ``size_px``; memory so far.

    Args:
        clock: seconds; ``time.process_time`` on a machine that does other work.
    """
    layout = settings.layout.model_copy(update={"size_px": size_px})
    bands = Bands(size_px, band_px, cell_px=layout.cell_px)
    square = np.zeros((size_px, size_px), np.float32)
    square[size_px // 4 : size_px // 2, size_px // 4 : size_px // 2] = 1
    search = settings.search.model_copy(update={"start": "random"})
    given = settings.model_copy(update={"layout": layout, "search": search})
    hologram = BandedHologram(given, printer, load_target(square, size_px), bands)
    parameters = hologram.free_parameters()
    budget = measure_budget(parameters, hologram.objective, settings.search, clock)
    wave = torch.ones(size_px, size_px, dtype=torch.complex64, device=printer.device)
    started = clock()
    hologram.bench.propagator.adjoint(hologram.bench.propagator(wave))
    transforms = clock() - started
    return MeasuredSize(
        size_px=size_px,
        iteration_s=budget.seconds_per_iteration,
        transforms_s=transforms,
        evaluation_s=budget.seconds_per_evaluation,
        peak_memory_gib=peak_memory_gib(printer.device),
    )


def fit_cost(measured: Sequence[MeasuredSize]) -> CostModel:
    """The model that meets the largest size."""
    last = max(measured, key=lambda one: one.size_px)
    pixels, operations = last.size_px**2, _operations(last.size_px)
    return CostModel(
        transform_s_per_operation=last.transforms_s / operations,
        rest_s_per_px=max(last.iteration_s - last.transforms_s, 0.0) / pixels,
        evaluation_s_per_px=max(last.evaluation_s - last.transforms_s / 2, 0.0) / pixels,
        memory_gib=last.peak_memory_gib - _IN_USE_BYTES_PER_PX * pixels / _GIB,
    )


def estimate_large(
    model: str | Path | Printer,
    settings: HologramSettings,
    measure_px: Sequence[int],
    ranks: int = 1,
    band_px: int = BAND_PX,
    *,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> list[str]:
    """What ``design_hologram`` in bands would take with these settings, from small elements measured here.

    Args:
        measure_px: sides of elements, to the largest of which the model of the cost is fitted.
        ranks: processes that would share the element, each on a machine like this one.

    Returns:
        One sentence for each size that was measured, and those of the estimate.

    Raises:
        InputError: no size, sizes that cells do not fill, or what ``design_hologram`` refuses.
    """
    sizes = sorted(set(measure_px))
    if not sizes:
        raise InputError("sizes to measure", got="none", wanted="at least one")
    layout, search = settings.layout, settings.search
    Bands(layout.size_px, band_px, Ranks(0, ranks), layout.cell_px)
    printer = load_printer(model, layout, device=device, extrapolate=extrapolate)
    measured = [measure_size(settings, printer, size, band_px) for size in sizes]
    cost, size = fit_cost(measured), layout.size_px
    lines = [
        f"measured: {one.size_px} px, {one.iteration_s:.2f} s per iteration, {one.transforms_s:.2f} s of it "
        f"for the transforms; {one.peak_memory_gib:.2f} GiB"
        for one in measured
    ]
    hours = cost.search_s(size, settings, ranks) / 3600
    lines.append(
        f"estimate for {size} px ({layout.size_um / 1000:.3g} mm), {search.iterations} iterations: "
        f"{cost.iteration_s(size, ranks):.3g} s per iteration, {hours:.3g} h in all; memory "
        f"{cost.memory_of_rank_gib(size, ranks):.3g} GiB{' in each process' if ranks > 1 else ''}; folder of "
        f"{disk_gib(size):.3g} GiB"
    )
    if ranks > 1:
        lines.append(
            f"{ranks} processes on as many machines like this one; each sends "
            f"{sent_gib(size, ranks):.3g} GiB per iteration, whose time is not in the estimate"
        )
    return lines


def _operations(size_px: int) -> float:
    """Of a transform and its inverse of twice the side, in units that are fitted."""
    length = fast_length(2 * size_px - 1)
    return length**2 * math.log2(length)
