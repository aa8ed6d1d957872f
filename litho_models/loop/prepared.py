"""Prepare scans for the loop: convert their layouts to tensors, choose the pixels for fits, and find the
position of each scan in the write field and in the writing order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from scipy.stats import rankdata

from litho_data.foundation import Array
from litho_data.store import PrintedScan
from litho_models.effects import FieldContext
from litho_models.fitting.crops import part_to_fit
from litho_models.fitting.least_squares import orthonormal
from litho_models.scan_terms import FloatMap, LineIndex, TermPixels, Terms, scan_line_index, term_maps
from litho_models.scan_terms.blocks import thinned
from litho_models.splits.folds import Crop

# Terms that are fitted freely to each scan when a model is fitted. The gain is not one of them, because it
# also depends on long-range effects of the printer.
FREE_TERMS: Terms = frozenset({"offset", "bow", "warp"})
# Terms that are fitted freely to each scan when the errors of models are compared.
ALL_FREE: Terms = FREE_TERMS | {"gain"}
# If both sides of a scan have at least this length, fits and screening use only one quadrant of the scan. The
# quadrant is predicted with a margin.
LARGE_PX = 400
_MARGIN_PX = 48
# Number of pixels of each scan that are used for fits and screening. Residuals are correlated over about 5
# px, so more pixels would add little information.
_SAMPLED_PX = 16384


@dataclass(frozen=True, repr=False, kw_only=True)
class PreparedScan(PrintedScan):
    """A scan with the data that are needed to predict it and to compare it with predictions.

    Attributes:
        context: facts about the scan that effects use, such as the exposed layout and the position in the
            write field.
        line: index of the scan line of each pixel, of shape (ny, nx).
        number: number of the scan. It determines which quadrant of the scan becomes its ``window``.
    """

    context: FieldContext
    line: LineIndex
    number: int

    @cached_property
    def sample(self) -> Array:
        """Return the flat indices of the n pixels that are used for fits and screening. These pixels are a
        part of the measured pixels, without the pixels near the edge of the scan.
        """
        return np.flatnonzero(thinned(self._inner, _SAMPLED_PX))

    @cached_property
    def window(self) -> PreparedScan:
        """Return the part of the scan that is used for fits and screening. It is a quadrant if the scan is
        large, and otherwise the whole scan.

        Successive scans use different quadrants, so that together they cover the whole field. A quadrant with
        few measured pixels is replaced by the quadrant that has the most measured pixels.
        """
        shape = self.shape
        if min(shape) < LARGE_PX:
            return self
        quadrants = [Crop(self.id, number).slices(shape) for number in (0, 2, 1, 3)]
        counts = [self._inner[own].sum() for own in quadrants]
        own = quadrants[part_to_fit(counts, self.number % 4)]
        sampled = np.zeros(shape, bool)
        sampled[own] = self._inner[own]
        rows, columns = area = tuple(
            slice(max(part.start - _MARGIN_PX, 0), part.stop + _MARGIN_PX) for part in own
        )
        context = replace(
            self.context,
            layout_um=self.context.layout_um[..., rows, columns],
            scan_shape=shape,
            origin_px=(rows.start, columns.start),
        )
        return replace(
            self,
            mask_level=self.mask_level[area],
            height_um=self.height_um[area],
            valid=sampled[area],
            height_sigma_um=None,
            context=context,
            line=self.line[area],
        )

    @cached_property
    def _inner(self) -> Array:
        ny, nx = self.shape
        border = sample_border_px(min(ny, nx))
        return np.pad(self.usable[border : ny - border, border : nx - border], border)

    def at_sample(self, field_map: Array) -> Array:
        """Return the values of a map of shape (ny, nx) at the sampled pixels, as float64. The result has
        shape (n,).
        """
        return field_map.reshape(-1)[self.sample].astype(np.float64)

    def residual(self, prediction_um: Array) -> Array:
        """Return the measured minus the predicted height at the n sampled pixels, µm, float64, of shape (n,).
        ``prediction_um`` is the predicted height, µm, of shape (ny, nx).
        """
        return self.at_sample(self.height_um) - self.at_sample(prediction_um)

    def terms_at_sample(self, prediction_um: Array, terms: Terms) -> FloatMap:
        """Return the smooth maps of the named scan terms at the sampled pixels, for the given predicted
        height. The result has shape (k, n).
        """
        return term_maps(TermPixels(prediction_um, self.line, self.sample), terms)

    def free_basis(self, prediction_um: Array, terms: Terms) -> Array:
        """Return an orthonormal basis of the named scan terms at the sampled pixels. The terms are computed
        from a predicted height, µm, of shape (ny, nx). The result has shape (n, k).
        """
        return orthonormal(self.terms_at_sample(prediction_um, terms).T)

    def freed(self, values: Array, prediction_um: Array) -> Array:
        """Subtract from values at the n sampled pixels the part that the free terms can explain.

        Args:
            values: one or m columns of values, of shape (n,) or (n, m). The result has the same shape.
            prediction_um: predicted height from which the terms are computed, µm, of shape (ny, nx).
        """
        basis = self.free_basis(prediction_um, ALL_FREE)
        return values - basis @ (basis.T @ values)


def prepare_scans(scans: Sequence[PrintedScan], known: Sequence[PreparedScan] = ()) -> list[PreparedScan]:
    """Prepare scans of one printer.

    Args:
        scans: the scans. Their positions in the writing order are scaled so that they run from -0.5 (first of
            these scans) to 0.5 (last). Scans with the same position get the same value.
        known: scans that have already been prepared. If they are given, the position of each scan is instead
            interpolated between their scaled positions, so that the positions of all scans have the same
            scale.
    """
    orders = [scan.order for scan in scans]
    if known:
        stated = sorted((one.order, one.context.order) for one in known)
        places = np.interp(orders, *np.transpose(stated))
    elif len(set(orders)) > 1:
        # Scans with the same position, such as two scans of one print, stay together.
        ranks = rankdata(orders, "dense")
        places = (ranks - 1) / (ranks.max() - 1) - 0.5
    else:
        places = np.zeros(len(orders))
    prepared = []
    for number, (scan, order) in enumerate(zip(scans, places.tolist(), strict=True)):
        write = scan.write or {}
        context = FieldContext(
            layout_um=torch.from_numpy(scan.exposed_um)[None, None],
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
            pixel_size=float(scan.pixel_size or 1),
            dose=float(scan.dose or 1),
        )
        line = scan_line_index(scan.shape, scan.scan_to_layout, scan.pitch_um, scan.bend_um)
        # Scans of another loop are already prepared, but for another study.
        stored = {one.name: getattr(scan, one.name) for one in fields(PrintedScan)}
        prepared.append(PreparedScan(**stored, context=context, line=line, number=number))
    return prepared


def sample_border_px(size: int) -> int:
    """Return the width, in pixels, of the border that fits leave out of a scan. The prediction at these
    pixels depends on surroundings outside the layout. ``size`` is the length of the shorter axis of the scan.

    The errors in ``ErrorRow`` are nevertheless scored on all pixels, as in the benchmark
    (``NuisanceProtocol.border_px``).
    """
    return min(8, size // 8)
