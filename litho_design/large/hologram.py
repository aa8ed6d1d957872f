"""A hologram in bands: what ``HologramTask`` is for an element in one piece, for the rows of this process."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_design.holograms.loss import hologram_loss
from litho_design.holograms.settings import HologramSettings
from litho_design.large.bands import Allocate, Bands, in_memory
from litho_design.large.printing import check_printer, print_bands
from litho_design.large.propagator import BandedPropagator
from litho_design.optics import centred_grid, element_field, intensity_share
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.starts import Scene
from litho_design.printers.printer import Printer


class BandedHologram:
    """The loss of the rows that this process holds, and of those of all others with them.

    Args:
        settings: of the hologram; see ``check_settings`` for what is left out.
        printer: frozen model with a finite reach, or nominal heights.
        target: wanted image (size, size) in [0, 1].
        bands: of the element.
        allocate: room for the spectrum; memory of the printer's device by default.

    Raises:
        InputError: settings or a printer that a large element cannot have.
    """

    def __init__(
        self,
        settings: HologramSettings,
        printer: Printer,
        target: np.ndarray,
        bands: Bands,
        allocate: Allocate | None = None,
    ):
        check_settings(settings)
        check_printer(printer, bands)
        self.settings, self.printer, self.bands = settings, printer, bands
        layout, rows = settings.layout, bands.rows()
        self.target = torch.from_numpy(np.ascontiguousarray(target[rows.start : rows.stop])).to(
            printer.device
        )
        self.grid = part_of_grid(centred_grid((layout.size_px,) * 2, layout.pitch_um), rows)
        room = allocate or in_memory(printer.device)
        self.propagator = BandedPropagator(layout.pitch_um, settings.optics, bands, room)

    def image(self, height_um: Tensor) -> Tensor:
        """Share of the incident power on the own pixels (rows, size) behind the own heights, µm."""
        pixels = self.settings.layout.size_px**2
        field = element_field(height_um, self.grid, self.settings.optics, pixels=pixels)
        return intensity_share(self.propagator(field), self.grid)

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Loss of the whole element, of the own levels (1, 1, rows, size), and its parts."""
        seen = self.image(print_bands(level[0, 0], self.printer, self.bands))
        ranks = self.bands.ranks
        loss, parts = hologram_loss(seen, self.target, self.settings.loss, total=ranks.total)
        return ranks.shared_loss(loss), parts

    def scene(self, level_phase: Tensor) -> Scene:
        """What a start can use."""
        settings = self.settings
        return Scene(
            cells=CellMap(settings.layout, self.bands.rows()),
            pitch_um=settings.layout.pitch_um,
            optics=settings.optics,
            level_phase=level_phase.to(self.printer.device),
            iterations=settings.search.start_iterations,
            seed=settings.search.seed,
            target=self.target,
            propagator=self.propagator,
            total=self.bands.ranks.total,
        )


def part_of_grid(grid: PixelGrid, rows: range) -> PixelGrid:
    """Some rows of a grid."""
    top = grid.origin_um[0] + rows.start * grid.pitch_um[0]
    return replace(grid, shape=(len(rows), grid.shape[1]), origin_um=(top, grid.origin_um[1]))


def check_settings(settings: HologramSettings) -> None:
    """Refuse what a large element does not have.

    Raises:
        InputError: a distribution over levels, a thick element, a process window or fabrication penalties in
            the loss, a signal window, noise on the start.
    """
    search, fabrication = settings.search, settings.fabrication
    unknown = {
        "search.parametrisation": (search.parametrisation, "direct"),
        "search.start_jitter_levels": (search.start_jitter_levels, 0.0),
        "search.draft": (search.draft, ""),
        "optics.element": (settings.optics.element, "thin"),
        "optics.source_sine": (settings.optics.source_sine, 0.0),
        "optics.bandwidth_um": (settings.optics.bandwidth_um, 0.0),
        "window.samples": (settings.window.samples, 0),
        "loss.signal_window_um": (settings.loss.signal_window_um, 0.0),
        "fabrication.max_step_levels": (fabrication.max_step_levels, 0),
        "fabrication.min_feature_um": (fabrication.min_feature_um, 0.0),
        "fabrication.inside_weight": (fabrication.inside_weight, 0.0),
        "layout.symmetry": (settings.layout.symmetry, "none"),
        "layout.cell_filter_um": (settings.layout.cell_filter_um, 0.0),
    }
    for name, (given, wanted) in unknown.items():
        if given != wanted:
            hint = "without --large the element is designed in one piece"
            raise InputError(f"{name} of a large element", got=repr(given), wanted=repr(wanted), hint=hint)
