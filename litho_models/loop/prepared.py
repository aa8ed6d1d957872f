"""Scans prepared for the loop: tensors, pixels to compute on, and what is known of their place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_models.effects import FieldContext
from litho_models.scan_terms import FloatMap, LineIndex, TermPixels, Terms, scan_line_index, term_maps
from litho_models.scan_terms.blocks import thinned

# Fits and screening keep away from the edge: pixels nearer to it see a neighbourhood that the layout does not
# hold. Errors are scored on all pixels, as in the benchmark (``Blocks.border_px``).
SAMPLE_BORDER_PX = 8
# About as many pixels per scan as carry independent information: residuals correlate over ~5 px.
SAMPLE_PX = 16384
# Fits and screening of larger scans see one quadrant and this margin around it.
LARGE_PX = 400
MARGIN_PX = 48


@dataclass(frozen=True)
class PreparedScan:
    """One scan ready to be predicted and compared.

    Attributes:
        stored: the scan as it lies in the store.
        layout: nominal height times relative dose (1, 1, y, x) float32, µm.
        context: its place, for the effects.
        usable: bool (y, x), measured pixels; scored.
        sample: flat indices of thinned usable pixels away from the edge; fitted and screened.
        height: measured height at ``sample``, float64 µm.
        line: index of the scan line under each pixel (y, x).
        quadrant: part of a large scan that stands for it in fits and screening; see ``window``.
    """

    stored: PrintedScan
    layout: Tensor
    context: FieldContext
    usable: np.ndarray
    sample: np.ndarray
    height: np.ndarray
    line: LineIndex
    quadrant: PreparedScan | None = None

    @property
    def id(self) -> str:
        return self.stored.id

    @property
    def window(self) -> PreparedScan:
        return self if self.quadrant is None else self.quadrant

    @property
    def position(self) -> np.ndarray:
        """(2, n) of (y, x) at ``sample``, -1 ... 1 over the scan."""
        ny, nx = self.usable.shape
        y, x = np.divmod(self.sample, nx)
        return np.stack([2 * y / max(ny - 1, 1) - 1, 2 * x / max(nx - 1, 1) - 1])

    def at_sample(self, field_map: Tensor | np.ndarray) -> np.ndarray:
        """Values of a (…, y, x) map at the thinned pixels, float64."""
        flat = field_map.detach().cpu().numpy() if isinstance(field_map, Tensor) else field_map
        return flat.reshape(-1)[self.sample].astype(np.float64)

    def terms_at_sample(self, prediction_um: np.ndarray, terms: Terms) -> FloatMap:
        """Smooth scan terms at the thinned pixels, (k, n)."""
        return term_maps(TermPixels(prediction_um, self.line, self.sample), terms)


def prepare_scans(scans: Sequence[PrintedScan]) -> list[PreparedScan]:
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


def _prepare(scan: PrintedScan, order: float) -> PreparedScan:
    dose = 1.0 if scan.dose is None else float(scan.dose)
    # Level times dose is the exposure: to all that follows, less dose is a lower layout.
    layout = torch.from_numpy(scan.layout_um * np.float32(dose))[None, None]
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
        quarter_turns=scan.quarter_turns,
        backward=scan.direction == -1,
        new_tip=scan.tip not in (None, 1),
        pixel_size=1.0 if scan.pixel_size is None else float(scan.pixel_size),
        dose=dose,
    )
    return _thinned(scan, context, scan.usable, scan.usable & _inner(scan.shape), line)


def _with_quadrant(scan: PreparedScan, number: int) -> PreparedScan:
    """Large scans get a window: scans take their four quadrants in turn, so that all places are covered."""
    ny, nx = scan.stored.shape
    if min(ny, nx) < LARGE_PX:
        return scan
    rows, row_start = _half(ny, number % 2)
    columns, column_start = _half(nx, number // 2 % 2)
    cut = (rows, columns)
    own = np.zeros_like(scan.usable)
    own[row_start : row_start + ny // 2, column_start : column_start + nx // 2] = True
    usable = (own & scan.usable & _inner((ny, nx)))[cut]
    sigma_um = scan.stored.height_sigma_um
    part = replace(
        scan.stored,
        mask_level=scan.stored.mask_level[cut],
        height_um=scan.stored.height_um[cut],
        valid=usable,
        height_sigma_um=None if sigma_um is None else sigma_um[cut],
    )
    pitch = scan.stored.pitch_um
    centre = tuple(
        old + ((side.start + side.stop) / 2 - n / 2) * pitch
        for old, side, n in zip(scan.context.field_centre_um, cut, (ny, nx), strict=True)
    )
    context = replace(
        scan.context,
        layout_um=scan.layout[..., rows, columns],
        field_centre_um=(centre[0], centre[1]),
        field_radius_um=scan.context.radius_um(),
        scan_shape=(ny, nx),
        origin_px=(rows.start, columns.start),
    )
    return replace(scan, quadrant=_thinned(part, context, usable, usable, scan.line[cut]))


def _half(size: int, second: int) -> tuple[slice, int]:
    """Half of an axis with a margin towards the other half, and where the half itself starts."""
    middle = size // 2
    return (slice(middle - MARGIN_PX, size), middle) if second else (slice(0, middle + MARGIN_PX), 0)


def sample_border_px(size: int) -> int:
    """Pixels at either end of an axis of this shortest length that are not sampled."""
    return min(SAMPLE_BORDER_PX, size // 8)


def _inner(shape: tuple[int, int]) -> np.ndarray:
    border = sample_border_px(min(shape))
    inner = np.zeros(shape, bool)
    inner[border : shape[0] - border, border : shape[1] - border] = True
    return inner


def _thinned(
    scan: PrintedScan, context: FieldContext, usable: np.ndarray, sampled: np.ndarray, line: LineIndex
) -> PreparedScan:
    sample = thinned(sampled, SAMPLE_PX)
    height = scan.height_um.reshape(-1)[sample].astype(np.float64)
    return PreparedScan(scan, context.layout_um, context, usable, sample, height, line)
