"""Design a lens of any size ring by ring. An element that is 10 mm wide has 10¹⁰ pixels but only 50,000 rings
of 0.1 µm. The print and the light are therefore computed along one radius and never on the whole plane.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from litho_design.large.bands import require_reach
from litho_design.large.hologram import LIGHT, only
from litho_design.lenses.bench import RadialLensBench
from litho_design.lenses.settings import LensSettings
from litho_design.lenses.task import DirectLensTask, check_lens, strip_rings
from litho_design.optics import Optics
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.phases import focusing_levels
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.tasks.design import RING_HEIGHT_FILE, RINGS_FILE, Findings
from litho_design.tasks.task import Task


class RadiusMap(CellMap):
    """Spread the values of the rings, one per ring, over the pixels along one radius. The values have shape
    (..., rings), and the result has shape (..., pixels). ``CellMap`` does the same for cells on a plane.
    """

    area: Tensor

    def __init__(self, layout: LayoutSettings):
        nn.Module.__init__(self)
        radius_px = torch.arange(layout.size_px // 2, dtype=torch.float64) + 0.5
        self.register_buffer("ring", (radius_px / layout.ring_px).floor().long(), persistent=False)
        self.register_buffer("area", radius_px, persistent=False)
        self.radial = True
        self._own = slice(None)
        self.cells = self.of_all = (int(self.ring[-1]) + 1,)

    def average(self, pixels: Tensor) -> Tensor:
        """Return the mean of real or complex pixel values over each ring. The pixels lie along one radius.
        Each pixel represents all pixels at the same radius. Their number is proportional to the radius, so
        each pixel is weighted with its radius.
        """
        area = self.area.to(pixels)
        sums = [pixels.new_zeros(self.cells).index_add_(0, self.ring, one) for one in (pixels * area, area)]
        return sums[0] / sums[1]


class RingLens(DirectLensTask):
    """The task of designing a focusing lens that consists of rings. Its print is computed only along one
    radius, in tiles.

    Args:
        settings: settings of the lens. They must state rings, a circular aperture and a thin element.
        printer: a frozen model with a finite reach, or nominal heights.
        tile_px: length of a tile in pixels. The print of a strip along the radius is predicted tile by tile.

    Raises:
        InputError: the settings or the printer are not supported for a lens of rings.
    """

    in_one_piece = radial = False
    bench: Any

    def __init__(self, settings: LensSettings, printer: Printer, tile_px: int):
        only(settings, LIGHT | {"task": "direct"})
        check_lens(settings, radial=True)
        self.tile_px = tile_px
        Task.__init__(self, settings, printer)
        self.notes = ["a lens of rings has levels and heights along one radius, but no layout of the plane"]

    def check_printer(self, printer: Printer) -> None:
        """Check that the reach of a printer is finite."""
        require_reach(printer)

    def inputs_sha256(self) -> str:
        """Return a constant, because a lens has no inputs besides the settings."""
        return "rings"

    def make_cells(self) -> CellMap:
        """Return the map that spreads the values of rings over the pixels along the radius."""
        return RadiusMap(self.settings.layout)

    def make_bench(self, optics: Optics) -> Any:
        """Return the bench, which computes the PSF from the heights along the radius."""
        return RadialLensBench(self.settings.layout, optics, self.settings.view).to(self.printer.device)

    def search_bench(self, optics: Optics) -> Any:
        """Return the existing bench, whatever the optics. Each draw of the process window has other optics,
        but computing the matrix of a new bench for each of them would take too long. The search therefore
        uses only the optics in the settings.
        """
        return self.bench

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Return the levels whose printed phases come closest to the phases of a perfect lens."""
        ideal = self.bench.ideal_height_um().double() * (2 * math.pi / self.settings.optics.wave_height_um)
        wave = self.cells.average(torch.polar(torch.ones_like(ideal), ideal))
        return focusing_levels(wave.angle().float().cpu(), level_phase.cpu())

    def printed(self, level: Tensor, printer: Printer) -> Tensor:
        """Return the printed height, µm, of each pixel along the radius. ``level`` contains the levels along
        the radius, shape (1, 1, pixels).
        """
        rings = self.cells.average(level[0, 0])
        strip = rings[strip_rings(self.settings.layout, printer.halo_px, len(rings))]
        return printer.print_in_tiles(strip[None, None], self.tile_px)[0, 0].mean(0)

    def arrays(self, level: Tensor, height_um: Tensor) -> dict[str, np.ndarray]:
        """Return levels and heights along the radius."""
        levels = level.cpu().numpy().astype(np.uint8)
        return {RINGS_FILE: levels, RING_HEIGHT_FILE: height_um.cpu().numpy()}

    def findings(self, folder: Path, level: Tensor, height_um: Tensor) -> Findings:
        """Return the scores of the lens and of its baselines, computed along the radius."""
        return Findings(predicted=self.score(height_um).model_dump(), baselines=self.baselines())
