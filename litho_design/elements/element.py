"""A printed element as a differentiable module: levels become printed heights, and heights become a wave."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.commands.settings import changed
from litho_data.foundation.errors import InputError, require_known, unknown_name
from litho_data.foundation.quantities import Range
from litho_design.elements.transforms import printed_anyhow
from litho_design.optics import Optics
from litho_design.optics.materials import Resin, refractive_index
from litho_design.optics.thin_element import (
    LONGEST_UM,
    SHORTEST_UM,
    ElementKind,
    known_height,
    through_relief,
)
from litho_design.optimisation.parameters import DirectLevels
from litho_design.optimisation.phases import focusing_levels, printed_phase
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printer

Index = Callable[[float], float]
_SURROUNDINGS, _ABSORPTION = Range(1, 10), Range(0, 1e3, "1/µm")


class Element(nn.Module):
    """A printed element for your own program. The call ``element(field, wavelength_um)`` returns the wave
    behind the element.

    The only trainable parameters are the free levels, one per cell or ring. The levels are rounded and
    clipped to the range of the layout, so the wave always belongs to a printable layout. The gradient ignores
    this step (straight-through estimator). A frozen model predicts the print of these levels, which are
    surrounded by a guard ring of level 0. The printed height h delays the wave by the phase 2 pi
    (n(wavelength) - surroundings) h / wavelength. If you set ``element.whole = False``, for example during
    the first steps of a search, the levels are not rounded.

    Args:
        model: folder of a frozen model, ``zoo:NAME``, ``none`` for nominal heights, or a loaded printer.
        layout: geometry and number of levels of the layout, or a mapping of changes to the default layout
            settings, such as ``{"size_px": 256}``.
        resin: name of a resin, its refractive index, or a function from the wavelength in µm to this index.
        surroundings: refractive index above the relief, 1 or more.
        absorption_per_um: absorption coefficient of the resin for intensity, 1/µm, 0 or more.
        kind: ``thin`` or ``thick``. For ``thick``, the wave is propagated through the relief by the wave
            propagation method; the relief must be in air.
        tile_px: side, in pixels, of the overlapping tiles into which an element larger than one tile is
            divided. The prints of the tiles are predicted one after the other, and again in the backward
            pass, so the memory needed depends on the tiles and not on the size of the element. If None, the
            print of the whole element is predicted at once.
        seed: seed of the random levels at the start.
        device, extrapolate: as for ``load_printer``.

    Raises:
        InputError: ``load_printer`` rejects the model, the printer model provides no gradients, the resin or
            the kind of element is not known, or an optical constant is out of range. The error is also raised
            if tiles are requested for a model whose print depends on the position, or if a thick element is
            not in air.
    """

    def __init__(
        self,
        model: str | Path | Printer,
        layout: LayoutSettings | Mapping[str, Any] | None = None,
        *,
        resin: Resin | float | Index = "ip-dip",
        surroundings: float = 1.0,
        absorption_per_um: float = 0.0,
        kind: ElementKind = "thin",
        tile_px: int | None = 1024,
        seed: int = 0,
        device: Device = "cpu",
        extrapolate: bool = False,
    ):
        super().__init__()
        if not (callable(resin) or isinstance(resin, int | float) or resin in get_args(Resin)):
            raise unknown_name("resin", resin, get_args(Resin), also="its refractive index")
        require_known("kind of an element", kind, get_args(ElementKind))
        _SURROUNDINGS.require("surroundings", surroundings)
        _ABSORPTION.require("absorption_per_um", absorption_per_um)
        if not isinstance(layout, LayoutSettings):
            layout = changed(LayoutSettings(), dict(layout or {}))
        self.layout, self.kind, self.tile_px = layout, kind, tile_px
        self.printer = load_printer(model, layout, device=device, extrapolate=extrapolate)
        self.surroundings, self.absorption_per_um = surroundings, absorption_per_um
        self._index: Index = resin if callable(resin) else partial(refractive_index, resin)
        self._check()
        self.free = DirectLevels(layout).to(device)
        self.free.start_random(seed)
        self.whole = True

    def forward(
        self, field: Tensor, wavelength_um: float, height_um: Tensor | np.ndarray | None = None
    ) -> Tensor:
        """Return the wave behind the element when ``field`` illuminates it. The wave is a complex tensor of
        shape (..., size, size).

        Args:
            field: the incident wave on the pixels of the layout, a complex tensor of shape (..., size, size).
            wavelength_um: wavelength in vacuum.
            height_um: heights of a known print, for example measured heights, in µm, shape (size, size). They
                replace the heights that the model predicts for the levels.

        Raises:
            InputError: field or heights do not have the shape of the element, a height is missing, or
                ``optics`` rejects the wavelength.
        """
        self._check_map("field", field)
        if self.kind == "thin":
            return field * self.transmission(wavelength_um, height_um)
        height = self._height_um(height_um)
        kept = (-0.5 * self.absorption_per_um * height).exp()
        return through_relief(field * kept, height, self.layout.pitch_um, self.optics(wavelength_um))

    def transmission(self, wavelength_um: float, height_um: Tensor | np.ndarray | None = None) -> Tensor:
        """Return the complex transmission of the thin element, shape (size, size).

        The transmission is exp(2 pi j (n - n0) h / wavelength - a h / 2), where n and n0 are the refractive
        indices of the resin and its surroundings, h is the height, and a is the absorption coefficient.
        """
        height = self._height_um(height_um)
        phase = height * (2 * math.pi / self.optics(wavelength_um).wave_height_um)
        return torch.polar((-0.5 * self.absorption_per_um * height).exp(), phase)

    def height_um(self) -> Tensor:
        """Return the printed height, µm, shape (size, size). Gradients flow to the free levels."""
        return printed_anyhow(self._print, self.free.sample(hard=self.whole))[0, 0]

    def _height_um(self, known_um: Tensor | np.ndarray | None) -> Tensor:
        if known_um is None:
            return self.height_um()
        height = known_height(known_um, self.free.height)
        self._check_map("height", height)
        return height

    def _print(self, level: Tensor) -> Tensor:
        if self.tile_px is None or self.layout.size_px <= self.tile_px:
            return self.printer(level)
        around = torch.nn.functional.pad(level, (self.printer.halo_px,) * 4)
        return self.printer.print_in_tiles(around, self.tile_px)

    def levels(self) -> np.ndarray:
        """Return the integer levels of the layout to be printed, a uint8 array of shape (size, size)."""
        return self.free.cells(self.free.best_levels()).cpu().numpy().astype(np.uint8)

    def optics(self, wavelength_um: float) -> Optics:
        """Return the optical settings of the element at this wavelength: the wavelength, the refractive index
        step and the kind of element (thin or thick).

        Raises:
            InputError: the wavelength is not one number in the range of light, or the refractive index of the
                resin does not exceed that of the surroundings.
        """
        if isinstance(wavelength_um, Sequence) or getattr(wavelength_um, "ndim", False):
            got, hint = f"a {type(wavelength_um).__name__}", "call the element once for each wavelength"
            raise InputError("wavelength", got=got, wanted="one number in µm", hint=hint)
        if not SHORTEST_UM < wavelength_um < LONGEST_UM:
            wanted = f"{SHORTEST_UM:g} to {LONGEST_UM:g} µm"
            hint = "convert nm or metres to µm, or use as_torchoptics(unit_um=1e6) for metres"
            raise InputError("wavelength", got=f"{wavelength_um:g} µm", wanted=wanted, hint=hint)
        index, around = self._index(wavelength_um), self.surroundings
        if not index > around:
            raise InputError(
                "resin",
                got=f"an index of {index:g}",
                wanted=f"an index above that of the surroundings, {around:g}",
            )
        return Optics(wavelength_um=wavelength_um, index_step=index - around, element=self.kind)

    def start_from_levels(self, levels: np.ndarray) -> None:
        """Set the free levels to the values in ``levels``, an array of shape (size, size). The values need
        not be integers.

        Raises:
            InputError: a level is beyond the range of the layout, or levels differ within a cell or ring.
        """
        pixels = torch.as_tensor(levels, dtype=self.free.height.dtype, device=self.free.height.device)
        self._check_map("levels", pixels)
        highest, what = self.layout.levels - 1, "levels of an element"
        if not ((pixels >= 0) & (pixels <= highest)).all():
            raise InputError(what, got=f"{pixels.min():g} to {pixels.max():g}", wanted=f"0 to {highest}")
        values = self.free.cells.average(pixels)
        # Averages over a cell are rounded to float32, so the levels of a cell may differ slightly from their
        # average even if they are equal.
        if (self.free.cells(values) - pixels).abs().max() > 1e-3:
            cell = "ring" if self.free.cells.radial else "cell"
            raise InputError(
                what,
                got=f"levels that differ within a {cell}",
                wanted=f"one level per {cell} of {self.layout.cell_um:g} µm",
                hint=f"average them over each {cell}, or give the element another cell_um",
            )
        self.free.start_from(values)

    def start_from_phase(self, phase: Tensor, wavelength_um: float) -> None:
        """Set the free levels to the levels whose printed phases come closest to a target phase, apart from a
        constant phase.

        ``phase`` is in radians and has shape (size, size).
        """
        self._check_map("phase", phase)
        printed = printed_phase(self.printer.level_heights_um(), self.optics(wavelength_um))
        wave = self.free.cells.average(torch.polar(torch.ones_like(phase), phase).to(self.free.height.device))
        self.free.start_from(focusing_levels(wave.angle().float(), printed.to(wave.device)).float())

    def as_torchoptics(self, *, z: float = 0.0, offset: Any = None, unit_um: float = 1.0) -> Any:
        """Return this element as a ``PolychromaticModulationElement`` of torchoptics, which needs the package
        extra ``torchoptics``.

        Args:
            z, offset: position of the element along and across the axis, in the unit of length that your
                program uses.
            unit_um: size of this unit of length in µm, for example 1e6 if your program uses metres.

        Raises:
            InputError: torchoptics is not installed; or the element is thick, which one complex factor per
                pixel cannot describe.
        """
        try:
            from litho_design.elements.in_torchoptics import PrintedElement
        except ImportError:
            raise InputError(
                "element for torchoptics", got="no torchoptics", hint="install litholoop[torchoptics]"
            ) from None
        if self.kind != "thin":
            raise InputError("element for torchoptics", got="a thick element", wanted="a thin element")
        return PrintedElement(self, z=z, offset=offset, unit_um=unit_um)

    def _check_map(self, what: str, values: Tensor) -> None:
        size = self.layout.size_px
        if tuple(values.shape[-2:]) != (size, size):
            got = f"shape {tuple(values.shape)}"
            raise InputError(
                f"{what} of an element", got=got, wanted=f"(..., {size}, {size}), the pixels of the element"
            )

    def _check(self) -> None:
        if self.printer.only_judges:
            raise InputError(
                "printer of an element",
                got="a virtual fab",
                wanted="a frozen model, or none for nominal heights",
            )
        if self.kind == "thick" and self.surroundings != 1:
            raise InputError("thick element", got=f"surroundings of {self.surroundings:g}", wanted="air, 1")
        large = self.tile_px is not None and self.layout.size_px > self.tile_px
        if large and self.printer.depends_on_position:
            raise InputError(
                "tile_px",
                got="a model whose print depends on the position",
                wanted="None, which prints in one piece",
            )
