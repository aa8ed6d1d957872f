"""The task of designing a hologram in bands. Unlike in ``HologramTask``, each process holds only its own rows
of the hologram.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record
from litho_design.holograms.bench import zero_order_share
from litho_design.holograms.settings import HologramSettings
from litho_design.holograms.task import HologramTask, check_target
from litho_design.images.targets import TargetRecord
from litho_design.large.bands import Bands, require_reach
from litho_design.large.figures import image_figures
from litho_design.large.propagator import BandedPropagator
from litho_design.optics import Optics, centred_grid, element_field, intensity_share
from litho_design.optics.thin_element import flat_field
from litho_design.optimisation.parameters import CellMap
from litho_design.printers.printer import Printer
from litho_design.printers.training import out_of_distribution
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Findings
from litho_design.tasks.task import Figures, Task

_LEFT_OUT = (
    "a large element has no polish, process window, baselines, thick-element score or report, and no scores "
    "that need the whole image at once"
)
_PREVIEW_PX = 1024
# Settings of the light, of the search and of the hologram for which a large element supports only one value,
# and this value.
LIGHT: dict[str, Any] = {
    "optics.element": "thin",
    "optics.source_sine": 0.0,
    "optics.bandwidth_um": 0.0,
    "optics.beam_um": 0.0,
}
SEARCH: dict[str, Any] = {
    "search.parametrisation": "direct",
    "window.samples": 0,
    "fabrication.inside_weight": 0.0,
    "layout.cell_filter_um": 0.0,
}
HOLOGRAM: dict[str, Any] = {"loss.signal_window_um": 0.0, "layout.symmetry": "none"}


class BandedHologram(HologramTask):
    """The task of a hologram whose rows are divided among several processes. Each process obtains the loss of
    the whole element.

    All processes run this task with the same arguments, and all of them must be able to write to the same
    folder. The resulting layout does not depend on the number of processes.

    Args:
        settings: settings of the hologram. This class does not check the settings of the search; use the
            function ``only`` for this.
        printer: frozen model with a finite reach, or nominal heights.
        bands: bands of the element.
        inputs: contains ``target``, the target image with values in [0, 1], shape (size, size), in memory or
            on disk.
        record: record that states where the target comes from.

    Raises:
        InputError: the settings of the light or the printer are not supported for a large element, or
            ``check_target`` rejects the target.
    """

    in_one_piece = False

    def __init__(
        self,
        settings: HologramSettings,
        printer: Printer,
        bands: Bands,
        *,
        inputs: Mapping[str, np.ndarray],
        record: TargetRecord | None = None,
    ):
        only(settings, LIGHT)
        check_target(inputs["target"], settings.layout)
        self.bands, self.ranks, self.total = bands, bands.ranks, bands.ranks.total
        Task.__init__(self, settings, printer, record=record)
        self.counted = None
        rows = bands.rows()
        own = np.ascontiguousarray(inputs["target"][rows.start : rows.stop])
        self.target = torch.from_numpy(own).to(printer.device)
        self.notes = [
            _LEFT_OUT,
            f"{bands.count} bands of {bands.band_px} rows, {self.ranks.count} process(es)",
        ]

    def check_printer(self, printer: Printer) -> None:
        """Check that the reach of a printer is finite and not too wide for the bands."""
        require_reach(printer)
        self.bands.check_halo(printer.halo_px)

    def inputs_sha256(self) -> str:
        """Return a string that identifies the bands. It is used because the rounding of sums, and thus the
        layout, depends on the bands.
        """
        return f"bands of {self.bands.band_px}"

    def make_cells(self) -> CellMap:
        """Return the map between the cells and the pixels in the rows of this process."""
        return CellMap(self.settings.layout, self.bands.rows())

    def make_bench(self, optics: Optics) -> Any:
        """Return the bench, which propagates from the element to the rows of the image plane that this
        process holds.
        """
        return BandedBench(self.settings.layout.pitch_um, optics, self.bands, self.printer.device)

    def printed(self, level: Tensor, printer: Printer) -> Tensor:
        """Return the printed height, µm, of the rows of this process."""
        halo = printer.halo_px
        around = F.pad(self.bands.with_halo(level[0, 0], halo), (halo, halo))
        return printer.print_in_tiles(around[None, None], self.bands.band_px)[0, 0]

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of the whole element, and the parts of this loss. ``level`` contains the levels in
        the rows of this process, shape (1, 1, rows, size).
        """
        loss, parts = super().objective(level)
        # Every process returns the loss of the whole element. The gradient is summed over the processes, so
        # each process contributes only its share.
        return (loss - loss.detach()) / self.ranks.count + loss.detach(), parts

    @torch.no_grad()
    def score(self, height_um: Tensor, expected_um: Tensor | None = None) -> Any:
        """Return the scores of a print, given as heights in µm of shape (size, size). This works only if one
        process holds the whole element.
        """
        figures = image_figures(self.bench(height_um).cpu().numpy(), self.target.cpu().numpy(), self.bands)
        grid, optics = self.bench.grid, self.settings.optics
        wave = element_field(height_um, grid, optics)
        return Figures(**figures, zero_order_share=zero_order_share(wave, grid, optics))

    @torch.no_grad()
    def save(self, folder: Path, level: Tensor, height_um: Tensor) -> dict[str, str]:
        """Write the arrays of the design; every process writes its own rows. The first process returns a dict
        from file name to SHA-256; the others return an empty dict.
        """
        arrays = {LEVELS_FILE: level.byte(), HEIGHT_FILE: height_um, IMAGE_FILE: self.bench(height_um)}
        return _write_rows(folder, arrays | {TARGET_FILE: self.target}, self.bands)

    def findings(self, folder: Path, level: Tensor, height_um: Tensor) -> Findings:
        """Compute the scores of the whole element from the arrays on disk."""
        levels, seen, aim = (
            np.load(folder / name, mmap_mode="r") for name in (LEVELS_FILE, IMAGE_FILE, TARGET_FILE)
        )
        layout = self.settings.layout
        return Findings(
            out_of_distribution=out_of_distribution(levels, layout, self.printer.card),
            predicted=image_figures(seen, aim, Bands(layout.size_px, self.bands.band_px)),
        )

    def display(self, seen: np.ndarray) -> np.ndarray:
        """Divide the image by its brightest value, and reduce it to at most 1,024 px per side."""
        import cv2

        side = min(len(seen), _PREVIEW_PX)
        small = cv2.resize(seen, (side, side), interpolation=cv2.INTER_AREA)
        return small / small.max()


class BandedBench(nn.Module):
    """Propagate a plane wave through the element onto the rows of the image plane that this process holds."""

    def __init__(self, pitch_um: float, optics: Optics, bands: Bands, device: torch.device):
        super().__init__()
        self.optics, self.pixels = optics, bands.size_px**2
        self.grid = self.window = centred_grid((bands.size_px,) * 2, pitch_um)
        self.propagator = BandedPropagator(pitch_um, optics, bands, device)
        rows, (top_um, left_um) = bands.rows(), self.grid.origin_um
        origin_um = (top_um + rows.start * pitch_um, left_um)
        self.rows = replace(self.grid, shape=(len(rows), bands.size_px), origin_um=origin_um)

    def illumination(self) -> Tensor:
        """Return the wave behind a flat element, in the rows of this process, complex128 of shape (rows,
        size).
        """
        return flat_field(self.rows, self.optics, pixels=self.pixels)

    def forward(self, height_um: Tensor) -> Tensor:
        """Return the share of the incident power on each pixel of the image plane, shape (rows, size). The
        result and ``height_um`` contain only the rows of this process.
        """
        field = element_field(height_um, self.rows, self.optics, pixels=self.pixels)
        return intensity_share(self.propagator(field), self.rows)


def only(settings: Record, values: dict[str, Any]) -> None:
    """For some settings, a large element supports only one value. ``values`` maps the paths of these settings
    to the supported values. Check that ``settings`` has these values.

    Raises:
        InputError: a setting has a different value.
    """
    for path, wanted in values.items():
        given: Any = settings
        for name in path.split("."):
            given = getattr(given, name)
        if given != wanted:
            hint = "without --large, the element is designed in one piece"
            raise InputError(f"{path} of a large element", got=repr(given), wanted=repr(wanted), hint=hint)


def _write_rows(folder: Path, arrays: dict[str, Tensor], bands: Bands) -> dict[str, str]:
    """Write each array to one file. Every process writes its own rows, shape (rows, size), into this file.
    The first process returns a dict from file name to SHA-256; the others return an empty dict.
    """
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
