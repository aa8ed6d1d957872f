"""A lens of any size ring by ring: a strip along one radius is printed, and the wave of rings is carried.

Nothing of the plane is ever made: an element of 10 mm is 50,000 rings of 0.1 µm, not 10¹⁰ pixels.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import record_sha256
from litho_design.judging.score import JudgedScore
from litho_design.large.bands import Bands
from litho_design.large.printing import check_printer, tiles
from litho_design.lenses.bench import RadialLensBench
from litho_design.lenses.score import LensScore, lens_score
from litho_design.lenses.settings import LensSettings
from litho_design.lenses.task import strip_rings
from litho_design.optimisation.budget import measure_budget
from litho_design.optimisation.checkpoint import finished_iterations, remove_checkpoint
from litho_design.optimisation.parameters import CellMap, DirectLevels
from litho_design.optimisation.phases import focusing_levels, printed_phase
from litho_design.optimisation.search import search_layout
from litho_design.optimisation.starts import start_search
from litho_design.printers.layout import LayoutSettings, printability
from litho_design.printers.printer import Printer
from litho_design.tasks.design import (
    RING_HEIGHT_FILE,
    RINGS_FILE,
    Design,
    RunRecord,
    finished_design,
    read_array,
    write_arrays,
)


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


class RingLens:
    """A direct lens of rings, printed along a radius.

    Args:
        settings: of the lens, with rings, a circular aperture and a thin element.
        printer: a frozen model with a finite reach, or nominal heights.
        tile_px: length of the tiles in which the strip is printed.
        bench: of another lens with these settings, whose matrix takes its time.

    Raises:
        InputError: settings or a printer that a lens of rings cannot have.
    """

    def __init__(
        self, settings: LensSettings, printer: Printer, tile_px: int, bench: RadialLensBench | None = None
    ):
        layout = settings.layout
        wanted: dict[str, tuple[Any, Any]] = {
            "task": (settings.task, "direct"),
            "layout.symmetry": (layout.symmetry, "radial"),
            "layout.cell_filter_um": (layout.cell_filter_um, 0.0),
            "view.aperture": (settings.view.aperture, "circle"),
            "optics.element": (settings.optics.element, "thin"),
            "search.parametrisation": (settings.search.parametrisation, "direct"),
            "search.draft": (settings.search.draft, ""),
            "window.samples": (settings.window.samples, 0),
            "size_px modulo 2": (layout.size_px % 2, 0),
        }
        for name, (given, only) in wanted.items():
            if given != only:
                raise InputError(f"{name} of a large lens", got=repr(given), wanted=repr(only))
        check_printer(printer, Bands(layout.size_px, layout.size_px))
        self.settings, self.printer, self.tile_px = settings, printer, tile_px
        self.bench = bench or RadialLensBench(layout, settings.optics, settings.view).to(printer.device)
        self.cells = RadiusMap(layout).to(printer.device)
        self._strip = strip_rings(layout, printer.halo_px, self.cells.cells[0]).to(printer.device)

    def printed_um(self, level: Tensor) -> Tensor:
        """Printed height, µm (rings of a pixel,), of levels along the radius (1, 1, pixels)."""
        free = self.cells.average(level[0, 0])
        strip = free[self._strip]
        printed = [
            self.printer.print_again(strip[None, None, :, part])
            for part in tiles(strip, self.printer, self.tile_px)
        ]
        return torch.cat(printed, -1)[0, 0].mean(0)

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """-log(centre-to-background ratio), and its parts."""
        return self.bench.focusing_loss(self.bench(self.printed_um(level)))

    def start(self, parameters: DirectLevels, heights: list[float]) -> None:
        """Levels whose print is nearest to a perfect lens, or random ones."""
        optics = self.settings.optics

        def perfect() -> Tensor:
            ideal = self.bench.ideal_height_um().double() * (2 * math.pi / optics.wave_height_um)
            wave = self.cells.average(torch.polar(torch.ones_like(ideal), ideal))
            return focusing_levels(wave.angle().float().cpu(), printed_phase(heights, optics))

        start_search(parameters, self.settings.search, perfect)

    @torch.no_grad()
    def score(self, height_um: Tensor) -> LensScore:
        """Figures of the PSF of a print along the radius."""
        return lens_score(self.bench, height_um)


def design_in_rings(
    settings: LensSettings,
    printer: Printer,
    out: str | Path,
    *,
    tile_px: int,
    announce: bool = True,
) -> Design:
    """Optimise the rings of a lens, and write the folder ``out``; an interrupted run resumes.

    Raises:
        InputError: what ``RingLens`` refuses, or ``out`` holds another result.
    """
    folder, search, layout = Path(out), settings.search, settings.layout
    before = printer.weights_sha256()
    fingerprint = record_sha256(["lens in rings", settings.model_dump(mode="json"), before])
    finished = finished_design(folder, fingerprint, settings)
    if finished is not None:
        return finished
    started = time.monotonic()
    lens, heights = RingLens(settings, printer, tile_px), printer.level_heights_um()
    parameters = DirectLevels(layout, cells=lens.cells).to(printer.device)
    lens.start(parameters, heights)
    with printer.at_precision(search.precision):
        with torch.no_grad():
            start_loss = float(lens.objective(lens.cells(parameters.best_levels().float())[None, None])[0])
        budget = measure_budget(parameters, lens.objective, search)
        if announce:
            unpolished = search.model_copy(update={"polish_rounds": 0})
            print(budget.sentence(unpolished, finished_iterations(folder)), file=sys.stderr)
        state = search_layout(parameters, lens.objective, search, folder=folder, fingerprint=fingerprint)
    assert state.best_levels is not None
    level = lens.cells(state.best_levels)
    with torch.no_grad():
        height = lens.printed_um(level.float()[None, None])
    seconds = state.earlier_seconds + time.monotonic() - started
    rows = level.cpu().numpy().astype("uint8")
    design = Design.searched(
        settings,
        printer,
        heights,
        state,
        task="lens-direct",
        fingerprint=fingerprint,
        run=RunRecord.of(printer.device, seconds, budget.seconds_per_iteration),
        printer_unchanged=printer.weights_sha256() == before,
        printability=printability(torch.cat([level.flip(0), level])[None].cpu().numpy(), layout),
        notes=["a lens in rings: levels and heights along one radius; no layout of the plane, no polish"],
        start_loss=start_loss,
        polished_loss=state.best_loss,
        reference_efficiency=lens.score(lens.bench.ideal_height_um()).focusing_efficiency,
        predicted=lens.score(height).model_dump(),
        files=write_arrays(folder, {RINGS_FILE: rows, RING_HEIGHT_FILE: height.cpu().numpy()}),
    )
    design.write(folder)
    remove_checkpoint(folder)
    return design


@torch.no_grad()
def judge_rings(
    folder: Path, record: Design, judges: Sequence[Printer], tile_px: int
) -> tuple[list[JudgedScore], dict[str, np.ndarray], float]:
    """Print the rings of a design by models, and score them along the radius.

    Returns:
        A score for each judge, with the differences of heights over the plane; PSFs (m, m) by title, share of
        the incident power per pixel; their side, µm.

    Raises:
        InputError: rings that changed after the design, or a judge without a finite reach.
    """
    settings, bench = LensSettings.model_validate(record.settings), None
    rings, expected = (torch.from_numpy(read_array(folder, name)) for name in (RINGS_FILE, RING_HEIGHT_FILE))
    scores: list[JudgedScore] = []
    pictures: dict[str, np.ndarray] = {}
    for printer in judges:
        lens, judge = RingLens(settings, printer, tile_px, bench), printer.record()
        bench = lens.bench
        height = lens.printed_um(rings.to(printer.device).float()[None, None])
        pictures |= {
            title: bench(print_um.to(printer.device)).cpu().numpy()
            for title, print_um in (("in design", expected), (f"printed by {judge.name}", height))
        }
        off, area = (height.cpu() - expected).double(), bench.propagator.ring_area_um2
        share = area / area.sum()
        off_um = float((off * share).sum()), float((off.square() * share).sum().sqrt())
        scores.append(JudgedScore.of_print(record, judge, off_um, lens.score(height).model_dump()))
    assert bench is not None
    return scores, pictures, bench.window.size_um[0]
