"""Blobs that stand far out of one scan's residual: reported, kept out of the probes, never explained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import find_objects, label

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import POLICIES, freed_um

FAR_SD = 5.0
FEWEST_PX = 9
# Scar-like: much longer along the scan lines than across; the other way round it is a control.
_DRAWN_OUT = 4.0
SUSPICIOUS_SHARE = 0.02


@dataclass(frozen=True)
class Defect:
    """One blob: scan, centre and area on the layout's grid, signed peak, whether it is drawn out."""

    scan: str
    y_um: float
    x_um: float
    area_um2: float
    peak_nm: float
    row_limited: bool
    column_limited: bool


@dataclass(frozen=True)
class Defects:
    """All blobs, their pixels per scan (y, x), their share of each scan and of all squared error."""

    blobs: list[Defect]
    masks: list[np.ndarray]
    share_of_pixels: list[float]
    share_of_squares: float

    @property
    def suspicious(self) -> list[int]:
        """Numbers of the scans of which more than 2 % is masked."""
        return [i for i, share in enumerate(self.share_of_pixels) if share > SUSPICIOUS_SHARE]


def find_defects(scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray]) -> Defects:
    """Connected pixels farther than 5 robust standard deviations from a scan's own background.

    Args:
        scans, predictions: scans and their held-out predictions (y, x) µm.
    """
    blobs, masks, shares = [], [], []
    inside = total = 0.0
    for scan, prediction in zip(scans, predictions, strict=True):
        residual = freed_um(scan.stored.height_um, prediction, scan.usable, POLICIES["full"])
        seen = residual[scan.usable]
        spread = 1.4826 * float(np.median(np.abs(seen - np.median(seen))))
        numbered, count = label(scan.usable & (np.abs(residual) > FAR_SD * spread))
        sizes = np.bincount(numbered.ravel(), minlength=count + 1)
        large = np.flatnonzero(sizes >= FEWEST_PX)
        large = large[large > 0]
        mask = np.isin(numbered, large)
        boxes = find_objects(numbered)
        blobs += [_describe(scan, residual, numbered == n, boxes[n - 1]) for n in large]
        masks.append(mask)
        shares.append(float(mask.sum() / max(scan.usable.sum(), 1)))
        inside += float((residual[mask] ** 2).sum())
        total += float((seen**2).sum())
    return Defects(blobs, masks, shares, inside / max(total, np.finfo(float).tiny))


def _describe(
    scan: PreparedScan, residual: np.ndarray, blob: np.ndarray, box: tuple[slice, slice] | None
) -> Defect:
    assert box is not None
    y, x = np.nonzero(blob)
    values = residual[blob]
    pitch = scan.stored.pitch_um
    height, width = (part.stop - part.start for part in box)
    return Defect(
        scan=scan.id,
        y_um=float(y.mean() * pitch),
        x_um=float(x.mean() * pitch),
        area_um2=float(blob.sum() * pitch**2),
        peak_nm=float(values[np.argmax(np.abs(values))] * NM_PER_UM),
        row_limited=width >= _DRAWN_OUT * height,
        column_limited=height >= _DRAWN_OUT * width,
    )
