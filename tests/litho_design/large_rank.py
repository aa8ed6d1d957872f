"""Provide the work of one of several processes for the tests of large elements."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist

from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.images.targets import load_target
from litho_design.large.bands import Bands
from litho_design.large.hologram import BandedHologram
from litho_design.optimisation.ranks import Ranks
from litho_design.printers.printer import Printer
from litho_design.reports.design import write_design_report
from litho_design.tasks.run import run_design
from tests.litho_design.conftest import BlurPrinter

SIZE, BAND, ITERATIONS = 160, 32, 14


def settings(iterations: int = ITERATIONS) -> HologramSettings:
    """Return settings for a hologram that is 16 µm wide and has its image at a distance of 30 µm."""
    changes = {"layout.size_px": SIZE, "optics.distance_um": 30.0}
    changes |= {"search.iterations": iterations, "search.checkpoint_every": 8, "search.evaluate_every": 5}
    return hologram_settings(changes=changes)


def printer() -> Printer:
    """Return a printer whose blur has a reach of 8 px."""
    return Printer(BlurPrinter(), settings().layout, source="closed form")


def work(folder: Path, ranks: Ranks) -> None:
    """Write the field, gradient and layout of one process, so that the parent process can compare them."""
    torch.set_num_threads(1)
    bands = Bands(SIZE, BAND, ranks, cell_px=4)
    rows = bands.rows()
    hologram = banded(bands)
    draw = torch.Generator().manual_seed(0)
    level = 12 * torch.rand(SIZE, SIZE, generator=draw)[rows.start : rows.stop]
    field = torch.randn(SIZE, SIZE, dtype=torch.complex64, generator=draw)[rows.start : rows.stop]
    level.requires_grad_()
    loss, _ = hologram.objective(level[None, None])
    loss.backward()
    np.savez(
        folder / f"{ranks.rank}.npz",
        field=hologram.bench.propagator(field).numpy(),
        back=hologram.bench.propagator.adjoint(field).numpy(),
        gradient=level.grad.numpy(),
        loss=float(loss.detach()),
    )
    design(folder / "design", bands)


def banded(bands: Bands) -> BandedHologram:
    """Return the hologram task for the bands of this process."""
    target = load_target("ring", SIZE)
    given = {"inputs": {"target": target.pixels}, "record": target.record}
    return BandedHologram(settings(), printer(), bands, **given)


def design(folder: Path, bands: Bands) -> None:
    """Design the hologram in the bands of this process."""
    run_design(banded(bands), folder, write_design_report, announce=False)


def start(rank: int, count: int, port: int, folder: Path) -> None:
    """Join the other processes and do the work."""
    os.environ |= {
        "RANK": str(rank),
        "WORLD_SIZE": str(count),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    work(folder, Ranks.joined())
    dist.destroy_process_group()
