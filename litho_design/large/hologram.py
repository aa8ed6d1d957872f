"""A hologram in bands: the task of a hologram in one piece, restricted to the rows of this process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record
from litho_design.holograms.settings import HologramSettings
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import Target
from litho_design.large.bands import Bands
from litho_design.large.figures import image_figures
from litho_design.large.printing import check_printer, print_bands
from litho_design.large.propagator import BandedPropagator
from litho_design.optics import Optics, centred_grid, element_field, intensity_share
from litho_design.optimisation.parameters import CellMap
from litho_design.printers.layout import printability
from litho_design.printers.printer import Printer
from litho_design.printers.training import out_of_distribution
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Findings
from litho_design.tasks.task import Task

_LEFT_OUT = (
    "a large element: without polish, process window, baselines, thick element and report; the figures that "
    "need the whole image at once are left out"
)
# A large element supports only these values of these settings.
ONLY: dict[str, Any] = {
    "search.parametrisation": "direct",
    "optics.element": "thin",
    "optics.source_sine": 0.0,
    "optics.bandwidth_um": 0.0,
    "optics.beam_um": 0.0,
    "window.samples": 0,
    "fabrication.max_step_levels": 0,
    "fabrication.min_feature_um": 0.0,
    "fabrication.inside_weight": 0.0,
    "layout.cell_filter_um": 0.0,
}


class BandedHologram(HologramTask):
    """A hologram whose rows are shared by several processes; each computes the loss of the whole.

    All processes run it with the same arguments and share the file system of the folder. The layout does not
    depend on their number.

    Args:
        settings: settings of the hologram.
        printer: frozen model with a finite reach, or nominal heights.
        target: wanted image (size, size) in [0, 1].
        bands: bands of the element.

    Raises:
        InputError: settings or a printer that a large element does not support.
    """

    polished = reported = False

    def __init__(self, settings: HologramSettings, printer: Printer, target: Target, bands: Bands):
        only(settings, ONLY | {"loss.signal_window_um": 0.0, "layout.symmetry": "none"})
        check_printer(printer, bands)
        ranks, rows = bands.ranks, bands.rows()
        self.bands, self.total, self.leads = bands, ranks.total, ranks.rank == 0
        self.part = f"-{ranks.rank + 1}-of-{ranks.count}" if ranks.count > 1 else ""
        Task.__init__(self, settings, printer, record=target.record)
        self.counted = None
        own = np.ascontiguousarray(target.pixels[rows.start : rows.stop])
        self.target = torch.from_numpy(own).to(printer.device)
        self.notes = [_LEFT_OUT, f"{bands.count} bands of {bands.band_px} rows, {ranks.count} process(es)"]

    def inputs_sha256(self) -> str:
        """The bands are included, because they decide the rounding of sums and so the layout."""
        return f"bands of {self.bands.band_px}"

    def make_cells(self) -> CellMap:
        """The cells of the own rows."""
        return CellMap(self.settings.layout, self.bands.rows())

    def make_bench(self, optics: Optics) -> Any:
        """The bench from the element to the own rows of the image plane."""
        return BandedBench(self.settings.layout.pitch_um, optics, self.bands, self.printer.device)

    def search_print(self, level: Tensor, printer: int) -> Tensor:
        """Height of the own rows, µm."""
        return print_bands(level[0, 0], self.printers[printer], self.bands)

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Loss of the whole element and its parts, from the own levels (1, 1, rows, size)."""
        loss, parts = super().objective(level)
        return self.bands.ranks.shared_loss(loss), parts

    @torch.no_grad()
    def printed_um(self, level: Tensor, printer: int = 0) -> Tensor:
        """Height of the own rows, µm."""
        return print_bands(level.float(), self.printers[printer], self.bands)

    @torch.no_grad()
    def save(self, folder: Path, level: Tensor, height_um: Tensor) -> dict[str, str]:
        """Write the arrays that all processes share; only the first process gets the hashes."""
        seen = self.bench(height_um)
        arrays = {LEVELS_FILE: level.byte(), HEIGHT_FILE: height_um, IMAGE_FILE: seen}
        self.saved = folder
        return _write_rows(folder, arrays | {TARGET_FILE: self.target}, self.bands)

    def findings(self, level: Tensor, height_um: Tensor) -> Findings:
        """Figures of the whole element, from disk."""
        levels, seen, aim = (
            np.load(self.saved / name, mmap_mode="r") for name in (LEVELS_FILE, IMAGE_FILE, TARGET_FILE)
        )
        layout = self.settings.layout
        return Findings(
            printability=printability(levels, layout),
            out_of_distribution=out_of_distribution(levels, layout, self.printer.card),
            predicted=image_figures(seen, aim, Bands(layout.size_px, self.bands.band_px)),
        )

    def finished_iterations(self, folder: Path) -> int:
        """Iterations that all processes have finished.

        Raises:
            InputError: the processes differ in their iterations, or their number has changed.
        """
        done, ranks = super().finished_iterations(folder), self.bands.ranks
        others = list(folder.glob("checkpoint*.pt"))
        if float(ranks.total(torch.tensor([float(done)]))) != done * ranks.count or (others and not done):
            raise InputError(
                f"checkpoints in {folder}",
                got="checkpoints of another number of processes, or of different iterations",
                wanted=f"one of the same iteration from each of {ranks.count}",
                hint="start as many processes as before, or delete them to start again",
            )
        return done

    def together(self, value: bool) -> bool:
        """Whether ``value`` holds for any process; waits for all of them."""
        return bool(self.bands.ranks.total(torch.tensor([float(value)])) > 0)


class BandedBench(nn.Module):
    """Light of one plane wave through the own rows of an element onto the own rows of the image plane."""

    def __init__(self, pitch_um: float, optics: Optics, bands: Bands, device: torch.device):
        super().__init__()
        self.optics, self.pixels = optics, bands.size_px**2
        self.grid = self.window = centred_grid((bands.size_px,) * 2, pitch_um)
        self.propagator = BandedPropagator(pitch_um, optics, bands, device)
        rows, (top_um, left_um) = bands.rows(), self.grid.origin_um
        origin_um = (top_um + rows.start * pitch_um, left_um)
        self.rows = replace(self.grid, shape=(len(rows), bands.size_px), origin_um=origin_um)

    def forward(self, height_um: Tensor) -> Tensor:
        """Share of the incident power on the own pixels (rows, size), from the own heights, µm."""
        field = element_field(height_um, self.rows, self.optics, pixels=self.pixels)
        return intensity_share(self.propagator(field), self.rows)


def only(settings: Record, values: dict[str, Any]) -> None:
    """Refuse settings, by path, that a large element does not support.

    Raises:
        InputError: a value other than the one in ``values``.
    """
    for path, wanted in values.items():
        given: Any = settings
        for name in path.split("."):
            given = getattr(given, name)
        if given != wanted:
            hint = "without --large the element is designed in one piece"
            raise InputError(f"{path} of a large element", got=repr(given), wanted=repr(wanted), hint=hint)


def _write_rows(folder: Path, arrays: dict[str, Tensor], bands: Bands) -> dict[str, str]:
    """Write arrays from the own rows (rows, size) of each process; SHA-256 by file name in the first."""
    size, rows, hashes = bands.size_px, bands.rows(), {}
    for name, values in arrays.items():
        own = values.cpu().numpy()
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
