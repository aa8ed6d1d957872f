"""A printer for one element. It turns the levels of a layout into printed heights."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_design.printers.fab import FabSimulator
from litho_design.printers.layout import LayoutSettings

Precision = Literal["float32", "bfloat16"]


class TilingCheck(Record):
    """Difference between two predictions of the same print: one for the whole layout, the other in tiles.

    For models with a finite reach, the difference is only a rounding error. For other models, such as a
    Fourier neural operator, the difference is an error of the model.
    """

    tile_px: int
    tiles: int
    max_nm: float
    rms_nm: float


class PrinterRecord(Record):
    """The printer that was used for a design or a score. ``dataset_sha256`` identifies the dataset on which
    the model of this printer was trained.
    """

    name: str
    sha256: str
    source: str
    dataset_sha256: str = ""
    guard_um: float
    extrapolated: bool = False


class Printer(nn.Module):
    """A frozen lithography model, or nominal heights, applied to one element.

    The element stands alone on the substrate, but a model assumes that a layout continues beyond its edge.
    The layout is therefore surrounded by a guard ring of level 0 before printing, and the print is cropped.

    Args:
        simulator: a frozen model, which is called as ``simulator(layout_um, pitch_um=...)``. If None, the
            print has the nominal heights.
        layout: geometry and levels of the element.
    """

    device_marker: Tensor

    def __init__(
        self,
        simulator: nn.Module | None,
        layout: LayoutSettings,
        *,
        source: str,
        name: str = "",
        extrapolate: bool = False,
    ):
        super().__init__()
        self.simulator = simulator
        self.register_buffer("device_marker", torch.zeros(()), persistent=False)
        self.layout = layout
        self.source = source
        self.extrapolate = extrapolate
        self.name = name or ("none" if simulator is None else str(simulator.name))
        borders_px = (0, 0, 0) if simulator is None else _borders_px(simulator)
        self.guard_px, self.halo_px, self.strip_halo_px = borders_px
        self._level_heights_um: list[float] = []
        if simulator is not None:
            simulator.eval().requires_grad_(False)

    @property
    def card(self) -> Mapping[str, Any]:
        """Return the model card, which describes the model and its training data, or an empty mapping if the
        heights are nominal.
        """
        return getattr(self.simulator, "card", {})

    @property
    def only_judges(self) -> bool:
        """Return True if the printer provides no gradients. Such a printer can judge layouts, but a search
        cannot use it.
        """
        return isinstance(self.simulator, FabSimulator)

    @property
    def depends_on_position(self) -> bool:
        """Return True if the print may depend on the position in the write field. This position is unknown if
        the print of only a patch of a layout is predicted.
        """
        return bool(self.card.get("process_effects"))

    @property
    def device(self) -> torch.device:
        """Return the device of the printer. Waves are computed on this device too, so it is set even for
        nominal heights, which have no model.
        """
        return self.device_marker.device

    def forward(self, level: Tensor) -> Tensor:
        """Return the printed height, µm, of real-valued levels; both have shape (b, 1, size, size)."""
        height_um = level * self.layout.level_height_um
        return self._inside(F.pad(height_um, (self.guard_px,) * 4), self.guard_px)

    def print_patch(self, level: Tensor, halo_px: int | None = None) -> Tensor:
        """Predict the print of a patch of a layout. Return the printed height, µm, without the outer
        ``halo_px`` pixels of the patch. The levels of the patch have shape (b, 1, y, x).

        By default, ``halo_px`` is the halo of the printer. If only two rows remain inside the halo, the
        narrower ``strip_halo_px`` is enough.
        """
        height_um = level * self.layout.level_height_um
        return self._inside(height_um, self.halo_px if halo_px is None else halo_px)

    def print_in_tiles(self, around: Tensor, tile_px: int) -> Tensor:
        """Predict the print of levels tile by tile, and return its height, µm, of shape (b, 1, y, x).

        ``around`` contains the levels, extended on all sides by the printer's halo.

        The backward pass prints each tile again, so memory depends on ``tile_px`` and not on the element. If
        the model has a finite reach, the result equals that of ``forward`` up to rounding. Otherwise,
        ``tiling_check`` measures the difference.
        """

        def tiles(length: int) -> list[slice]:
            border = 2 * self.halo_px
            ends = range(0, length - border, tile_px)
            return [slice(at, min(at + tile_px, length - border) + border) for at in ends]

        def printed(patch: Tensor) -> Tensor:
            if not torch.is_grad_enabled():
                return self.print_patch(patch)
            again: Tensor = checkpoint(self.print_patch, patch, use_reentrant=False)
            return again

        rows = [around[..., part, :] for part in tiles(around.shape[-2])]
        columns = tiles(around.shape[-1])
        return torch.cat([torch.cat([printed(row[..., part]) for part in columns], -1) for row in rows], -2)

    @torch.no_grad()
    def tiling_check(self, level: Tensor, tile_px: int = 256) -> TilingCheck | None:
        """Compare the print that is predicted for the whole element with prints that are predicted for single
        tiles, each with a halo.

        Args:
            level: levels of the layout, shape (1, 1, size, size).
            tile_px: side of a tile without its halo; up to four of them along the diagonal are compared.

        Returns:
            The differences, or None if nothing can be compared: the heights are nominal, the element is not
            larger than one tile, or the print depends on the position.
        """
        size, halo = self.layout.size_px, self.halo_px
        if self.simulator is None or size <= tile_px or self.depends_on_position:
            return None
        whole = self(level)
        around = F.pad(level, (halo,) * 4)
        count = min(4, size // tile_px)
        # Tiles start at odd pixel numbers, so that none of them coincides with an internal tile of the model.
        # Such a tile would be compared with itself.
        starts = [round((size - tile_px) * (index + 0.5) / count) | 1 for index in range(count)]
        off = []
        for start in (min(start, size - tile_px) for start in starts):
            part = slice(start, start + tile_px)
            wide = slice(start, start + tile_px + 2 * halo)
            off.append(self.print_patch(around[..., wide, wide]) - whole[..., part, part])
        nm = torch.stack(off).double() * NM_PER_UM
        return TilingCheck(
            tile_px=tile_px,
            tiles=count,
            max_nm=float(nm.abs().max()),
            rms_nm=float(nm.square().mean().sqrt()),
        )

    def at_precision(self, precision: Precision) -> AbstractContextManager[None]:
        """Return a context manager. Inside it, the networks of a frozen model run in ``precision``, if the
        model supports this. Heights, blurs and waves stay in float32.
        """
        at_precision = getattr(self.simulator, "at_precision", None)
        return nullcontext() if at_precision is None else at_precision(precision)

    def record(self) -> PrinterRecord:
        """Return the record of this printer for results: its name, its hashes and its guard ring."""
        return PrinterRecord(
            name=self.name,
            sha256=self.weights_sha256(),
            source=self.source,
            dataset_sha256=(self.card.get("dataset") or {}).get("sha256", ""),
            guard_um=self.guard_px * self.layout.pitch_um,
            extrapolated=self.extrapolate,
        )

    def weights_sha256(self) -> str:
        """Return the hash of the current values of all parameters and buffers. The hash must not change
        during a design run.
        """
        digest = hashlib.sha256()
        state = {} if self.simulator is None else self.simulator.state_dict()
        for name in sorted(state):
            value = state[name].detach().cpu().contiguous()
            digest.update(f"{name}:{value.dtype}:{tuple(value.shape)};".encode())
            digest.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()

    @torch.no_grad()
    def level_heights_um(self) -> list[float]:
        """For each level, return the printed height of a wide uniform field, µm."""
        if self._level_heights_um:
            return self._level_heights_um
        size = 2 * self.guard_px + 16
        heights = []
        for level in range(self.layout.levels):
            nominal = torch.full((1, 1, size, size), level * self.layout.level_height_um, device=self.device)
            heights.append(float(self._inside(nominal, size // 2 - 4).mean()))
        self._level_heights_um = heights
        return heights

    def _inside(self, height_um: Tensor, border_px: int) -> Tensor:
        """Print the nominal heights ``height_um``, and cut the outer ``border_px`` pixels off the print."""
        # A frozen model has a method that computes only as much of the border as the inner part needs.
        inside: Callable[..., Tensor] | None = getattr(self.simulator, "inside", None)
        if inside is not None:
            return inside(height_um, border_px, pitch_um=self.layout.pitch_um)
        return F.pad(self._printed(height_um), (-border_px,) * 4)

    def _printed(self, height_um: Tensor) -> Tensor:
        if self.simulator is None:
            return height_um
        printed: Tensor = self.simulator(height_um, pitch_um=self.layout.pitch_um)
        return printed


def _borders_px(simulator: Any) -> tuple[int, int, int]:
    """Return three widths in pixels: of the guard ring, of the halo of a patch, and of the halo of a two-row
    strip.

    If a model divides layouts into tiles internally, a patch needs a halo as wide as a tile. A strip of two
    rows needs only a narrower halo, because it lies where two rows of tiles overlap. The model averages the
    two tiles there, and this mean has a smaller error than a single tile.
    """
    guard = simulator.guard_px
    tile = getattr(simulator, "tile", None)
    if tile is None:
        return guard, guard, guard
    rows = (2 * tile.size_px - 3 * tile.overlap_px) // 2 - 1
    return guard, max(guard, tile.size_px), max(guard, rows)
