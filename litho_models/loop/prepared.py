"""Prepare scans for the loop: convert their layouts to tensors, choose the pixels for fits, and find the
position of each scan in the write field and in the writing order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_models.effects import FieldContext
from litho_models.fitting.crops import part_to_fit
from litho_models.fitting.least_squares import orthonormal
from litho_models.scan_terms import FloatMap, LineIndex, TermPixels, Terms, scan_line_index, term_maps
from litho_models.scan_terms.blocks import thinned

# If both sides of a scan have at least this length, fits and screening use only one quadrant of the scan. The
# quadrant is predicted with a margin.
LARGE_PX = 400


@dataclass(frozen=True)
class PreparedScan:
    """A scan with the data that are needed to predict it and to compare it with predictions.

    Attributes:
        stored: the scan in the store.
        context: facts about the scan that effects use, such as the exposed layout and the position in the
            write field.
        sample: flat indices of the n pixels that fits and screening use. These pixels are a thinned selection
            of the measured pixels that are not near the edge.
        height: measured height at ``sample``, µm, float64, of shape (n,).
        line: index of the scan line of each pixel, of shape (ny, nx).
        quadrant: for a large scan, the quadrant that fits and screening use; None for other scans. See
            ``window``.
    """

    stored: PrintedScan
    context: FieldContext
    sample: np.ndarray
    height: np.ndarray
    line: LineIndex
    quadrant: PreparedScan | None = None

    @cached_property
    def usable(self) -> np.ndarray:
        """Return the mask of the measured pixels, which are the pixels that are scored. The mask has shape
        (ny, nx).
        """
        return self.stored.usable

    @property
    def id(self) -> str:
        return self.stored.id

    @property
    def window(self) -> PreparedScan:
        return self.quadrant or self

    def at_sample(self, field_map: Tensor | np.ndarray) -> np.ndarray:
        """Return the values of a map at the sampled pixels, as float64. The map has shape (ny, nx), possibly
        with leading axes of length 1, and the result has shape (n,).
        """
        flat = field_map.detach().cpu().numpy() if isinstance(field_map, Tensor) else field_map
        return flat.reshape(-1)[self.sample].astype(np.float64)

    def terms_at_sample(self, prediction_um: np.ndarray, terms: Terms) -> FloatMap:
        """Return the smooth maps of the named scan terms at the sampled pixels, for the given predicted
        height. The result has shape (k, n).
        """
        return term_maps(TermPixels(prediction_um, self.line, self.sample), terms)

    def free_basis(self, prediction_um: np.ndarray, terms: Terms) -> np.ndarray:
        """Return an orthonormal basis of the named scan terms at the sampled pixels. The terms are computed
        from a predicted height, µm, of shape (ny, nx). The result has shape (n, k).
        """
        return orthonormal(self.terms_at_sample(prediction_um, terms).T)


def prepare_scans(scans: Sequence[PrintedScan]) -> list[PreparedScan]:
    """Prepare all scans of a store. Positions in the writing order are scaled so that these scans span -0.5
    to 0.5.

    Raises:
        InputError: there is no scan.
    """
    if not scans:
        raise InputError("scans to close the loop on", got="none", wanted="at least one")
    ranks = np.argsort(np.argsort([scan.order for scan in scans], kind="stable"), kind="stable")
    scaled = ranks / max(len(scans) - 1, 1) - 0.5 if len({s.order for s in scans}) > 1 else 0.0 * ranks
    return [*map(_with_quadrant, map(_prepare, scans, scaled.tolist()), count())]


def prepared_among(scans: Sequence[PrintedScan], known: Sequence[PreparedScan]) -> list[PreparedScan]:
    """Prepare further scans, in addition to the prepared scans ``known``. The scaled positions of the further
    scans in the writing order are interpolated between those of the known scans, so that all scans are on the
    same scale.
    """
    orders, places = zip(*sorted((one.stored.order, one.context.order) for one in known), strict=True)

    def placed(scan: PreparedScan) -> PreparedScan:
        order = float(np.interp(scan.stored.order, orders, places))
        part = scan.quadrant and placed(scan.quadrant)
        return replace(scan, context=replace(scan.context, order=order), quadrant=part)

    return [*map(placed, prepare_scans(scans))]


def _prepare(scan: PrintedScan, order: float) -> PreparedScan:
    dose = 1.0 if scan.dose is None else float(scan.dose)
    # The exposure is the nominal height times the dose, so a smaller dose acts like a lower layout.
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
    return _thinned(scan, context, scan.usable & _inner(scan.shape), line)


def _with_quadrant(scan: PreparedScan, number: int) -> PreparedScan:
    """If a scan is large, choose the quadrant that fits and screening use. Successive scans use different
    quadrants, so that together they cover the whole field. A quadrant with few measured pixels is replaced by
    the one that has most.
    """
    shape, pitch = scan.stored.shape, scan.stored.pitch_um
    if min(shape) < LARGE_PX:
        return scan
    usable = scan.usable & _inner(shape)
    parts = [
        tuple(_half(size, bool(second)) for size, second in zip(shape, (one % 2, one // 2), strict=True))
        for one in range(4)
    ]
    counts = [int(np.count_nonzero(usable[tuple(own for _, own in part)])) for part in parts]
    cut, own = zip(*parts[part_to_fit(counts, number % 4)], strict=True)
    mine = np.zeros(shape, bool)
    mine[own] = True
    sigma_um = scan.stored.height_sigma_um
    part = replace(
        scan.stored,
        mask_level=scan.stored.mask_level[cut],
        height_um=scan.stored.height_um[cut],
        valid=(mine & usable)[cut],
        height_sigma_um=None if sigma_um is None else sigma_um[cut],
    )
    y_um, x_um = (
        old + ((side.start + side.stop) / 2 - size / 2) * pitch
        for old, side, size in zip(scan.context.field_centre_um, cut, shape, strict=True)
    )
    context = replace(
        scan.context,
        layout_um=scan.context.layout_um[(..., *cut)],
        field_centre_um=(y_um, x_um),
        field_radius_um=scan.context.radius_um(),
        scan_shape=shape,
        origin_px=(cut[0].start, cut[1].start),
    )
    return replace(scan, quadrant=_thinned(part, context, part.usable, scan.line[cut]))


def _half(size: int, second: bool) -> tuple[slice, slice]:
    """Return one half of an axis as two slices: first the half with a margin of 48 pixels that extends into
    the other half, then the half without this margin. ``second`` selects the second half.
    """
    middle = size // 2
    if second:
        return slice(middle - 48, size), slice(middle, middle + size // 2)
    return slice(0, middle + 48), slice(0, middle)


def sample_border_px(size: int) -> int:
    """Return the number of pixels that fits leave out at each edge of a scan. The neighbourhood of these
    pixels extends beyond the layout. ``size`` is the length of the shorter axis.

    Errors are nevertheless scored on all pixels, as in the benchmark (``NuisanceProtocol.border_px``).
    """
    return min(8, size // 8)


def _inner(shape: tuple[int, int]) -> np.ndarray:
    border = sample_border_px(min(shape))
    return np.pad(np.ones([size - 2 * border for size in shape], bool), border)


def _thinned(scan: PrintedScan, context: FieldContext, sampled: np.ndarray, line: LineIndex) -> PreparedScan:
    # Residuals are correlated over about 5 px, so more pixels would add little information.
    sample = thinned(sampled, 16384)
    return PreparedScan(scan, context, sample, scan.height_um.reshape(-1)[sample].astype(np.float64), line)
