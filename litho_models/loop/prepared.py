"""Scans prepared for the loop: tensors, pixels to compute on, and what is known of their place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.store.read import PrintedScan
from litho_models.effects import FieldContext
from litho_models.scan_terms.nuisance import scan_line_index

# Pixels nearer to the edge see a neighbourhood that the layout does not hold.
BORDER_PX = 8
# About as many pixels per scan as carry independent information: residuals correlate over ~5 px.
SAMPLE_PX = 16384
# Fits and screening of larger fields see one quadrant and this margin around it.
LARGE_PX = 400
MARGIN_PX = 48


@dataclass(frozen=True)
class Field:
    """One scan ready to be predicted and compared.

    Attributes:
        scan: the stored scan.
        layout: nominal height (1, 1, y, x) float32, µm; ``context``: its place, for the effects.
        usable: bool (y, x), valid pixels away from the border; scored.
        sample: flat indices of the thinned usable pixels; fitted and screened.
        height: measured height at ``sample``, float64 µm.
        position: (2, n) of (y, x) at ``sample``, -1 ... 1 over the scan.
        line: index of the scan line under each pixel (y, x).
        quadrant: part of a large field that stands for it in fits and screening; see ``window``.
    """

    scan: PrintedScan
    layout: Tensor
    context: FieldContext
    usable: np.ndarray
    sample: np.ndarray
    height: np.ndarray
    position: np.ndarray
    line: np.ndarray
    quadrant: Field | None = None

    @property
    def id(self) -> str:
        return self.scan.id

    @property
    def window(self) -> Field:
        return self if self.quadrant is None else self.quadrant

    def at_sample(self, field_map: Tensor | np.ndarray) -> np.ndarray:
        """Values of a (…, y, x) map at the thinned pixels, float64."""
        flat = field_map.detach().cpu().numpy() if isinstance(field_map, Tensor) else field_map
        return flat.reshape(-1)[self.sample].astype(np.float64)


def prepare_fields(scans: Sequence[PrintedScan]) -> list[Field]:
    """Prepare all scans of a store; places in the writing order are scaled over these scans.

    Raises:
        InputError: no scan.
    """
    if not scans:
        raise InputError("scans to close the loop on", got="none", wanted="at least one")
    ranks = np.argsort(np.argsort([scan.order for scan in scans], kind="stable"), kind="stable")
    scaled = ranks / max(len(scans) - 1, 1) - 0.5 if len({s.order for s in scans}) > 1 else 0.0 * ranks
    return [
        _with_quadrant(_prepare(s, float(order)), i)
        for i, (s, order) in enumerate(zip(scans, scaled, strict=True))
    ]


def _with_quadrant(field: Field, number: int) -> Field:
    """Large fields get a window: scans take their four quadrants in turn, so that all places are covered."""
    ny, nx = field.scan.shape
    if min(ny, nx) < LARGE_PX:
        return field
    rows, row_start = _half(ny, number % 2)
    columns, column_start = _half(nx, number // 2 % 2)
    cut = (rows, columns)
    scan = replace(
        field.scan,
        mask_level=field.scan.mask_level[cut],
        height_um=field.scan.height_um[cut],
        valid=field.scan.valid[cut] & _inside(field.usable, cut, row_start, column_start),
    )
    pitch = field.scan.pitch_um
    centre = tuple(
        old + ((part.start + part.stop) / 2 - n / 2) * pitch
        for old, part, n in zip(field.context.field_centre_um, cut, (ny, nx), strict=True)
    )
    context = replace(
        field.context,
        layout_um=field.layout[..., rows, columns],
        field_centre_um=(centre[0], centre[1]),
        field_radius_um=field.context.radius_um(),
        scan_shape=(ny, nx),
        origin_px=(rows.start, columns.start),
        scan_line=torch.from_numpy(field.line[cut]),
    )
    return replace(field, quadrant=_thinned(scan, context, field.line[cut], border_px=0))


def _half(size: int, second: int) -> tuple[slice, int]:
    """Half of an axis with a margin towards the other half, and where the half itself starts."""
    middle = size // 2
    return (slice(middle - MARGIN_PX, size), middle) if second else (slice(0, middle + MARGIN_PX), 0)


def _inside(usable: np.ndarray, cut: tuple[slice, slice], row_start: int, column_start: int) -> np.ndarray:
    ny, nx = usable.shape
    own = np.zeros_like(usable)
    own[row_start : row_start + ny // 2, column_start : column_start + nx // 2] = True
    return (own & usable)[cut]


def _prepare(scan: PrintedScan, order: float) -> Field:
    ny, nx = scan.shape
    layout = torch.from_numpy(scan.layout_um)[None, None]
    write = scan.write or {}
    line = scan_line_index(scan.shape, scan.scan_to_layout, scan.pitch_um, scan.bend_um)
    context = FieldContext(
        layout_um=layout,
        pitch_um=scan.pitch_um,
        full_height_um=(scan.levels - 1) * scan.level_height_um,
        slice_um=scan.level_height_um,
        field_centre_um=(scan.field_y_um or 0.0, scan.field_x_um or 0.0),
        field_radius_um=write["field_um"] / 2 if "field_um" in write else None,
        slow_axis=write.get("slow_axis", "y"),
        order=order,
        scan_line=torch.from_numpy(line),
    )
    return _thinned(scan, context, line, border_px=min(BORDER_PX, min(ny, nx) // 8))


def _thinned(scan: PrintedScan, context: FieldContext, line: np.ndarray, border_px: int) -> Field:
    ny, nx = scan.shape
    usable = np.asarray(scan.valid, bool) & np.isfinite(scan.height_um)
    inner = np.zeros_like(usable)
    inner[border_px : ny - border_px, border_px : nx - border_px] = True
    usable &= inner
    stride = max(1, round((usable.sum() / SAMPLE_PX) ** 0.5))
    lattice = np.zeros_like(usable)
    lattice[stride // 2 :: stride, stride // 2 :: stride] = True
    sample = np.flatnonzero(usable & lattice)
    y, x = np.divmod(sample, nx)
    position = np.stack([2 * y / max(ny - 1, 1) - 1, 2 * x / max(nx - 1, 1) - 1])
    height = scan.height_um.reshape(-1)[sample].astype(np.float64)
    return Field(scan, context.layout_um, context, usable, sample, height, position, line)
