"""A lens of any size, ring by ring: a strip along one radius is printed, and a wave of rings propagated.

The plane is never computed: an element of 10 mm is 50,000 rings of 0.1 µm, not 10¹⁰ pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from litho_design.judging.score import JudgedScore, Judgement
from litho_design.large.bands import BAND_PX, Bands
from litho_design.large.hologram import ONLY, only
from litho_design.large.printing import check_printer, tiles
from litho_design.lenses.bench import RadialLensBench
from litho_design.lenses.score import LensScore, lens_score
from litho_design.lenses.settings import LensSettings
from litho_design.lenses.task import DirectLensTask, strip_rings
from litho_design.optics import Optics
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.phases import focusing_levels
from litho_design.printers.layout import LayoutSettings, printability
from litho_design.printers.printer import Printer
from litho_design.tasks.design import (
    RING_HEIGHT_FILE,
    RINGS_FILE,
    Design,
    Findings,
    read_array,
    write_arrays,
)
from litho_design.tasks.task import Task


class RadiusMap(CellMap):
    """Free rings along one radius, (..., rings) to (..., pixels): ``CellMap`` for less than a plane."""

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
        """Mean over the area of each ring of real or complex ``pixels`` along the radius."""
        area = self.area.to(pixels)
        sums = [pixels.new_zeros(self.cells).index_add_(0, self.ring, one) for one in (pixels * area, area)]
        return sums[0] / sums[1]


class RingLens(DirectLensTask):
    """A direct lens of rings, printed along a radius in tiles.

    Args:
        settings: settings of the lens, with rings, a circular aperture and a thin element.
        printer: a frozen model with a finite reach, or nominal heights.
        tile_px: length of the tiles in which the strip is printed.
        bench: bench of another lens with these settings, to reuse its matrix, which takes time to compute.

    Raises:
        InputError: settings or a printer that a lens of rings does not support.
    """

    polished = reported = False
    bench: Any

    def __init__(
        self, settings: LensSettings, printer: Printer, tile_px: int, bench: RadialLensBench | None = None
    ):
        rings = {"task": "direct", "layout.symmetry": "radial", "view.aperture": "circle"}
        only(settings, ONLY | rings)
        check_printer(printer, Bands(settings.layout.size_px, settings.layout.size_px))
        self.tile_px, self._bench = tile_px, bench
        Task.__init__(self, settings, printer)
        self._strip = strip_rings(settings.layout, printer.halo_px, self.cells.cells[0]).to(printer.device)
        self.notes = ["a lens of rings: levels and heights along one radius; no layout of the plane"]

    def inputs_sha256(self) -> str:
        """Empty: nothing else decides the layout."""
        return "rings"

    def make_cells(self) -> CellMap:
        """From rings to pixels of the radius."""
        return RadiusMap(self.settings.layout)

    def make_bench(self, optics: Optics) -> Any:
        """The bench along the radius."""
        return self._bench or RadialLensBench(self.settings.layout, optics, self.settings.view).to(
            self.printer.device
        )

    @cached_property
    def scenes(self) -> list[Any]:
        """Only the lens as modelled."""
        return [(None, self.bench)]

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Levels whose print is nearest to a perfect lens."""
        ideal = self.bench.ideal_height_um().double() * (2 * math.pi / self.settings.optics.wave_height_um)
        wave = self.cells.average(torch.polar(torch.ones_like(ideal), ideal))
        return focusing_levels(wave.angle().float().cpu(), level_phase.cpu())

    def search_print(self, level: Tensor, printer: int) -> Tensor:
        """Printed height, µm (rings of a pixel,), of levels along the radius (1, 1, pixels)."""
        strip, press = self.cells.average(level[0, 0])[self._strip], self.printers[printer]
        parts = tiles(strip, press, self.tile_px)
        printed = [press.print_again(strip[None, None, :, part]) for part in parts]
        return torch.cat(printed, -1)[0, 0].mean(0)

    @torch.no_grad()
    def printed_um(self, level: Tensor, printer: int = 0) -> Tensor:
        """Printed height along the radius, µm."""
        return self.search_print(level[None, None].float(), printer)

    def score(self, height_um: Tensor, expected_um: Tensor | None = None) -> LensScore:
        """Figures of the PSF of a print along the radius."""
        return lens_score(self.bench, height_um)

    def save(self, folder: Path, level: Tensor, height_um: Tensor) -> dict[str, str]:
        """Levels and heights along the radius."""
        levels = level.cpu().numpy().astype(np.uint8)
        return write_arrays(folder, {RINGS_FILE: levels, RING_HEIGHT_FILE: height_um.cpu().numpy()})

    def findings(self, level: Tensor, height_um: Tensor) -> Findings:
        """Figures along the radius."""
        across = torch.cat([level.flip(0), level])[None].cpu().numpy()
        return Findings(
            printability=printability(across, self.settings.layout),
            reference_efficiency=self.reference_efficiency(height_um),
            predicted=self.score(height_um).model_dump(),
        )


@torch.no_grad()
def judge_rings(folder: Path, record: Design, judges: Sequence[Printer]) -> Judgement:
    """Score the rings of a design along the radius, as printed by models.

    Height differences are taken over the plane; the pictures are square roots of PSFs over their peaks.

    Raises:
        InputError: rings that changed after the design, or a judge without a finite reach.
    """
    settings, bench = LensSettings.model_validate(record.settings), None
    rings, expected = (torch.from_numpy(read_array(folder, name)) for name in (RINGS_FILE, RING_HEIGHT_FILE))
    scores: list[JudgedScore] = []
    pictures: dict[str, np.ndarray] = {}
    for printer in judges:
        lens, judge = RingLens(settings, printer, BAND_PX, bench), printer.record()
        bench = lens.bench
        height = lens.printed_um(rings.to(printer.device))
        for title, print_um in (("in design", expected), (f"printed by {judge.name}", height)):
            pictures[title] = lens.display(bench(print_um.to(printer.device)).cpu().numpy())
        off, area = (height.cpu() - expected).double(), bench.propagator.ring_area_um2
        share = area / area.sum()
        off_um = float((off * share).sum()), float((off.square() * share).sum().sqrt())
        scores.append(JudgedScore.of_print(record, judge, off_um, lens.score(height).model_dump()))
    assert bench is not None
    return Judgement(scores, pictures, bench.window.size_um[0])
