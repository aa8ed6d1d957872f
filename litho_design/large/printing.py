"""Prints of an element in bands, one band at a time; gradients print each band again."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.large.bands import Bands
from litho_design.printers.printer import Printer


def check_printer(printer: Printer, bands: Bands) -> None:
    """Refuse a printer that cannot print in bands.

    Raises:
        InputError: a print that depends on the whole image or on the position in the write field, or bands
            narrower than the printer's reach.
    """
    whole = printer.simulator is not None and getattr(printer.simulator, "reach_um", None) is None
    if whole or printer.depends_on_position:
        why = "the whole image" if whole else "the place in the write field"
        raise InputError(
            f"printer {printer.name} of a large element",
            got=f"a print that depends on {why}",
            wanted="a model with a finite reach, such as zoo:pbl, or none",
        )
    bands.check_halo(printer.halo_px)


def print_bands(level: Tensor, printer: Printer, bands: Bands) -> Tensor:
    """Printed height, µm, of the own rows of levels (rows, size); gradients flow to the levels.

    Each band is printed in square tiles with the printer's reach around them. No intermediate result is kept:
    the gradient prints each tile again.
    """
    printed: Tensor = _Print.apply(level, printer, bands)
    return printed


def print_band(around: Tensor, printer: Printer, tile_px: int) -> Tensor:
    """Printed height, µm (y, x), of a band of levels with the printer's halo above and below it."""
    wide = F.pad(around, (printer.halo_px, printer.halo_px))
    return torch.cat(
        [printer.print_patch(wide[None, None, :, part])[0, 0] for part in tiles(wide, printer, tile_px)], 1
    )


def tiles(wide: Tensor, printer: Printer, tile_px: int) -> list[slice]:
    """Columns of the tiles, including their halos, of a band (y, x) with its halo on all sides."""
    border = 2 * printer.halo_px
    length = wide.shape[1] - border
    return [slice(at, min(at + tile_px, length) + border) for at in range(0, length, tile_px)]


class _Print(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, level: Tensor, printer: Printer, bands: Bands) -> Tensor:
        ctx.save_for_backward(level)
        ctx.given = printer, bands
        halo = printer.halo_px
        around = bands.with_halo(level, halo)
        height = torch.empty_like(level)
        for band in bands.own():
            height[band] = print_band(around[band.start : band.stop + 2 * halo], printer, bands.band_px)
        return height

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (level,) = ctx.saved_tensors
        printer, bands = ctx.given
        halo = printer.halo_px
        around = bands.with_halo(level, halo)
        found = torch.zeros_like(around)
        for band in bands.own():
            reached = slice(band.start, band.stop + 2 * halo)
            found[reached] += _band_gradient(around[reached], gradient[band], printer, bands.band_px)
        # At most two bands contribute to a row, so the sum is the same in any order.
        return bands.add_halo(found, halo), None, None


def _band_gradient(around: Tensor, gradient: Tensor, printer: Printer, tile_px: int) -> Tensor:
    """Gradient with respect to the levels of a band and its halo, from that of its height (y, x)."""
    halo = printer.halo_px
    wide = F.pad(around, (halo, halo))
    found = torch.zeros_like(wide)
    for part in tiles(wide, printer, tile_px):
        patch = wide[None, None, :, part].clone().requires_grad_()
        with torch.enable_grad():
            printed = printer.print_patch(patch)
        own = gradient[None, None, :, part.start : part.stop - 2 * halo]
        found[:, part] += torch.autograd.grad(printed, patch, own)[0][0, 0]
    return found[:, halo : wide.shape[1] - halo]
