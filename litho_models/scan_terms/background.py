"""Learn the smooth background that appears in all scans of one microscope.

For example, levelling with planes leaves a bow in every scan. The part of the bow that is the same in every
scan is learned from the training scans and added to predictions of *measured* maps. This background does not
belong to the printer, so designs do not use it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mode

import numpy as np
from pydantic import ConfigDict

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scan_terms.cross_fit import fitted_terms
from litho_models.scan_terms.policies import POLICIES
from litho_models.scan_terms.term import FloatMap, smooth_shapes

# Relative tolerance for the size of a field. A bow that was learned on a field 1 % larger or smaller is wrong
# by 2 %.
_SAME_SIZE = 0.01

# A pair consists of a scan and the predicted height of its print, µm, of shape (ny, nx).
Pair = tuple[PrintedScan, np.ndarray]


@dataclass(frozen=True, repr=False)
class ScanPart(PrintedScan):
    """A rectangular part of a scan. ``whole`` is the shape (ny, nx) of the scan, and ``area`` contains the
    rows and columns of the scan that the part shows.
    """

    whole: tuple[int, int] = (0, 0)
    area: tuple[slice, slice] = (slice(0), slice(0))


class Background(Record):
    """The coefficients, in nm, of a background with the terms x, y, x², xy and y². The coefficients come from
    one fit to all training scans. ``scans`` is the number of these scans; each part of a scan counts as one
    scan.

    x and y run from -1 to 1 over a whole field whose size (y, x) is ``field_um``. Each term has zero mean, so
    a background does not change the datum.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    x_nm: float
    y_nm: float
    xx_nm: float
    xy_nm: float
    yy_nm: float
    field_um: tuple[float, float]
    scans: int

    def fits(self, scan: PrintedScan) -> bool:
        """Return whether the scan's field has the size on which the background was learned."""
        return is_of_size(scan, self.field_um)

    def map_um(self, shape: tuple[int, int]) -> FloatMap:
        """Return the background, µm, as a map of the given shape (ny, nx)."""
        coefficients = (self.x_nm, self.y_nm, self.xx_nm, self.xy_nm, self.yy_nm)
        return np.tensordot(coefficients, smooth_shapes(shape), axes=1) / NM_PER_UM

    def of_scan(self, scan: PrintedScan) -> FloatMap:
        """Return the background at the pixels of a scan, µm, of shape (ny, nx). It is zero if the field of
        the scan has another size.
        """
        return on_field(scan, self.map_um) if self.fits(scan) else np.zeros(scan.shape)


def field_um(scan: PrintedScan) -> tuple[float, float]:
    """Return the size (y, x) of a scan's field, µm. For a part, this is the size of the whole field."""
    ny, nx = scan.whole if isinstance(scan, ScanPart) else scan.shape
    return ny * scan.pitch_um, nx * scan.pitch_um


def on_field(scan: PrintedScan, maps: Callable[[tuple[int, int]], FloatMap]) -> FloatMap:
    """Evaluate maps of the whole field at the pixels of a scan, which may show only a part of the field.
    ``maps`` is a function that takes the shape (ny, nx) of the field and returns its maps. The last two axes
    of the maps are y and x.
    """
    if not isinstance(scan, ScanPart):
        return maps(scan.shape)
    return maps(scan.whole)[..., *scan.area]


def of_usual_size(
    scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray]
) -> tuple[tuple[float, float], list[Pair]]:
    """Return the most frequent size (y, x) of the scans' fields, µm, and those of the scans whose fields have
    this size, each with the predicted height of its print.
    """
    usual_um = mode(map(field_um, scans))
    pairs = zip(scans, predictions_um, strict=True)
    return usual_um, [pair for pair in pairs if is_of_size(pair[0], usual_um)]


def is_of_size(scan: PrintedScan, size_um: tuple[float, float]) -> bool:
    """Return whether a scan's field has the size (y, x) given in µm, within 1 %."""
    return np.allclose(field_um(scan), size_um, rtol=_SAME_SIZE, atol=0)


def learn_background(scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray]) -> Background:
    """Learn the smooth background that all scans show in addition to the heights that a model predicts.

    All terms of policy ``full`` (offset, gain, tilt and bow) are fitted to the valid pixels of each scan. The
    background is one smooth surface over the whole field. It is fitted to the tilts and bows of all scans at
    these pixels, with a free offset for each scan. If all scans show the whole field and are fully measured,
    its coefficients are the means of the tilt and bow coefficients of the scans. If the fields of the scans
    differ in size, only the scans with the most frequent field size are used.

    Args:
        scans: training scans.
        predictions_um: height that the model predicts for each scan, µm, as a map of shape (ny, nx). The maps
            are in the order of ``scans``.
    """
    usual_um, pairs = of_usual_size(scans, predictions_um)
    pairs = [pair for pair in pairs if pair[0].usable.any()]
    products, seen = np.zeros((5, 5)), np.zeros(5)
    for scan, prediction in pairs:
        usable = scan.usable
        coefficients, _ = fitted_terms(scan.height_um, prediction, usable, POLICIES["full"])
        own = coefficients[2:] @ smooth_shapes(scan.shape)[:, usable]
        shapes = on_field(scan, smooth_shapes)[:, usable]
        shapes -= shapes.mean(axis=1, keepdims=True)
        products += shapes @ shapes.T
        seen += shapes @ own
    x, y, xx, xy, yy = (NM_PER_UM * np.linalg.lstsq(products, seen, rcond=1e-12)[0]).tolist()
    return Background(x_nm=x, y_nm=y, xx_nm=xx, xy_nm=xy, yy_nm=yy, field_um=usual_um, scans=len(pairs))
