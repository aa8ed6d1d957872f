"""The search of a large hologram, shared among processes, each with levels and checkpoints of its rows."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256, record_sha256
from litho_design.holograms.settings import HologramSettings
from litho_design.images.targets import Target
from litho_design.large.bands import Bands
from litho_design.large.hologram import BandedHologram
from litho_design.large.printing import print_bands
from litho_design.large.score import image_figures
from litho_design.optimisation.budget import measure_budget
from litho_design.optimisation.checkpoint import finished_iterations, remove_checkpoint
from litho_design.optimisation.parameters import DirectLevels
from litho_design.optimisation.phases import printed_phase
from litho_design.optimisation.search import search_layout
from litho_design.optimisation.starts import start_levels, start_search
from litho_design.printers.layout import printability
from litho_design.printers.printer import Printer
from litho_design.printers.training import out_of_distribution
from litho_design.tasks.design import (
    HEIGHT_FILE,
    IMAGE_FILE,
    LEVELS_FILE,
    TARGET_FILE,
    Design,
    RunRecord,
    finished_design,
)

_LEFT_OUT = (
    "a large element: without polish, process window, baselines, thick element and report; the figures that "
    "need the whole image at once are left out"
)


def design_in_bands(
    settings: HologramSettings,
    printer: Printer,
    target: Target,
    out: str | Path,
    bands: Bands,
    *,
    announce: bool = True,
) -> Design:
    """Optimise the layout of a hologram in bands, and write the folder ``out``; an interrupted run resumes.

    All processes call it with the same arguments, and share the file system of ``out``. The layout is the
    same for any number of them.

    Raises:
        InputError: what ``BandedHologram`` refuses; ``out`` holds another result, or the checkpoints of
            another number of processes.
    """
    ranks, search, folder = bands.ranks, settings.search, Path(out)
    speaks = announce and ranks.rank == 0
    hologram = BandedHologram(settings, printer, target.pixels, bands)
    before = printer.weights_sha256()
    fingerprint = record_sha256(
        ["hoe in bands", settings.model_dump(mode="json"), before, target.record.sha256, bands.band_px]
    )
    finished = finished_design(folder, fingerprint, settings)
    if finished is not None:
        return finished
    part = f"-{ranks.rank + 1}-of-{ranks.count}" if ranks.count > 1 else ""
    done = _resumed(folder, part, bands)
    started = time.monotonic()
    heights = printer.level_heights_um()
    parameters = DirectLevels(settings.layout, bands.rows()).to(printer.device)
    with printer.at_precision(search.precision):
        phase = printed_phase(heights, settings.optics)
        start_search(parameters, search, lambda: start_levels(search.start, hologram.scene(phase)))
        with torch.no_grad():
            start_loss = float(hologram.objective(_pixels(parameters, parameters.best_levels()))[0])
        budget = measure_budget(parameters, hologram.objective, search)
        if speaks:
            processes = f" in each of {ranks.count} processes" if ranks.count > 1 else ""
            unpolished = search.model_copy(update={"polish_rounds": 0})
            print(budget.sentence(unpolished, done) + processes, file=sys.stderr)
        state = search_layout(
            parameters, hologram.objective, search, folder=folder, fingerprint=fingerprint, part=part
        )
    seconds = state.earlier_seconds + time.monotonic() - started
    assert state.best_levels is not None
    level = _pixels(parameters, state.best_levels)[0, 0]
    with torch.no_grad():
        height = print_bands(level, printer, bands)
        image = hologram.image(height)
    if printer.weights_sha256() != before:
        raise InputError(f"model {printer.name}", got="weights that changed", wanted="a model that stays")
    arrays = {LEVELS_FILE: level.byte(), HEIGHT_FILE: height, IMAGE_FILE: image, TARGET_FILE: hologram.target}
    files = write_rows(folder, arrays, bands)
    if ranks.rank == 0:
        levels, seen, aim = (
            np.load(folder / name, mmap_mode="r") for name in (LEVELS_FILE, IMAGE_FILE, TARGET_FILE)
        )
        layout = settings.layout
        Design.searched(
            settings,
            printer,
            heights,
            state,
            task="hoe",
            fingerprint=fingerprint,
            run=RunRecord.of(printer.device, seconds, budget.seconds_per_iteration),
            target=target.record,
            printer_unchanged=True,
            printability=printability(levels, layout),
            out_of_distribution=out_of_distribution(levels, layout, printer.card),
            notes=[_LEFT_OUT, f"{bands.count} bands of {bands.band_px} rows, {ranks.count} process(es)"],
            start_loss=start_loss,
            polished_loss=state.best_loss,
            predicted=image_figures(seen, aim, Bands(layout.size_px, bands.band_px)),
            files=files,
        ).write(folder)
    ranks.wait()
    remove_checkpoint(folder, part)
    return Design.read(folder)


def write_rows(folder: Path, arrays: dict[str, Tensor], bands: Bands) -> dict[str, str]:
    """Write arrays whose own rows (rows, size) each process has, by file name; their SHA-256 in the first."""
    size, rows, hashes = bands.size_px, bands.rows(), {}
    for name, values in arrays.items():
        own = values.detach().cpu().numpy()
        if bands.ranks.rank == 0:
            np.lib.format.open_memmap(folder / name, "w+", own.dtype, (size, size)).flush()
        bands.ranks.wait()
        whole = np.load(folder / name, mmap_mode="r+")
        whole[rows.start : rows.stop] = own
        whole.flush()
        del whole
        bands.ranks.wait()
        if bands.ranks.rank == 0:
            hashes[name] = file_sha256(folder / name)
    return hashes


def _pixels(parameters: DirectLevels, levels: Tensor) -> Tensor:
    return parameters.cells(levels)[None, None].float()


def _resumed(folder: Path, part: str, bands: Bands) -> int:
    """Iterations that are done; all processes have to have done the same."""
    done, ranks = finished_iterations(folder, part), bands.ranks
    others = list(folder.glob("checkpoint*.pt"))
    together = float(ranks.total(torch.tensor([float(done)])))
    if together != done * ranks.count or (others and not done):
        raise InputError(
            f"checkpoints in {folder}",
            got="those of another number of processes, or of different iterations",
            wanted=f"one of the same iteration from each of {ranks.count}",
            hint="start as many processes as before, or delete them to start again",
        )
    return done
