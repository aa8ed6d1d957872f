"""Fit the tilt and bow of a scan to the substrate around the print, or to the print itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from litho_design.images.measurements import Levelling
from litho_design.scans.placing import Placed
from litho_design.scans.shapes import amounts, legendre_shapes

# Tilt and bow are fitted to the bare substrate around the print if enough of it was measured. The substrate
# closer to the print than ``_FOOT_UM`` is left out, because blur and the tip raise it there. On every side,
# at least the share ``_BARE_SHARE`` of the pixels within an eighth of the element must be measured. The
# spread of the heights must be at most ``_FLAT_UM``; otherwise, the substrate is not bare.
_FOOT_UM, _BARE_SHARE, _FLAT_UM = 0.5, 0.3, 0.02
# Roughness of a substrate is correlated, so this number of pixels counts as one independent height.
_PIXELS_PER_HEIGHT = 25
# Total orders of the Legendre polynomials from which the possible tilt and bow of the print itself are
# extrapolated.
_ORDERS = (3, 4, 5, 6)
# The deviation of a print from the expected print is larger in tilt and bow than in the orders above, by this
# factor, which was found with ``benchmarks.coverage``.
_LOW_ORDER_FACTOR = 2.0
# Total orders of the polynomials that each kind of levelling removes.
FITTED_ORDERS: dict[Levelling, tuple[int, ...]] = {"none": (), "plane": (1,), "bow": (1, 2)}
# Number of groups into which the pixels are divided by their expected height.
_HEIGHT_GROUPS = 32


@dataclass(frozen=True)
class Background:
    """Tilt and bow of a scan. ``map_um`` is their sum, shape (ny, nx). The other fields are the slopes of the
    tilt along x and y, the range of the bow, and the standard deviation of each term (empty if they were
    fitted to the print).
    """

    map_um: np.ndarray
    tilt_um_per_um: tuple[float, float]
    bow_um: float
    sd_um: list[float]

    @classmethod
    def of(cls, terms_um: np.ndarray, shape: tuple[int, int], pitch_um: float, sd_um: list[float]) -> Self:
        """Make the background with the given coefficients of x, y, x², xy and y² (``legendre_shapes``)."""
        terms_um = np.pad(terms_um, (0, 5 - len(terms_um)))
        shapes = legendre_shapes(shape, (1, 2))
        bow = shapes[..., 2:] @ terms_um[2:]
        lengths_um = [(size - 1) / 2 * pitch_um for size in shape[::-1]]
        x, y = (math.sqrt(3) * term / length for term, length in zip(terms_um, lengths_um, strict=False))
        return cls(shapes @ terms_um, (float(x), float(y)), float(np.ptp(bow)), sd_um)


def fitted_background(
    height_um: np.ndarray, expected_um: np.ndarray, valid: np.ndarray, pitch_um: float, levelling: Levelling
) -> Background:
    """Fit the tilt and bow of a scan, together with the gain of the expected print, by least squares. All
    maps have shape (ny, nx).
    """
    shapes = legendre_shapes(height_um.shape, FITTED_ORDERS[levelling])
    columns = np.dstack([shapes, expected_um, np.ones_like(expected_um)])
    found, *_ = np.linalg.lstsq(columns[valid], height_um[valid].astype(float), rcond=None)
    return Background.of(found[:-2], expected_um.shape, pitch_um, [])


def substrate_background(placed: Placed, pitch_um: float, levelling: Levelling) -> Background | None:
    """Fit the tilt and bow of a scan to the bare substrate around the print, without pixels that deviate.
    Return None if too little of the substrate was measured, or if the substrate is not flat.
    """
    margin, foot = placed.margin_px, math.ceil(_FOOT_UM / pitch_um)
    width, shape = margin - foot, placed.inner(placed.valid).shape
    if width < 1 or levelling == "none":
        return None
    bare = placed.valid.copy()
    bare[width:-width, width:-width] = False
    sides = bare[:width], bare[-width:], bare[:, :width], bare[:, -width:]
    if min(side.mean() for side in sides) < _BARE_SHARE:
        return None
    columns = legendre_shapes(shape, (0, *FITTED_ORDERS[levelling]), margin)
    for _ in range(3):
        seen, height = columns[bare], placed.height_um[bare].astype(float)
        found, *_ = np.linalg.lstsq(seen, height, rcond=None)
        rest = np.abs(height - seen @ found)
        spread_um = 1.4826 * float(np.median(rest))
        bare[bare] = rest <= 4 * spread_um
    if spread_um > _FLAT_UM or min(side.mean() for side in sides) < _BARE_SHARE:
        return None
    variances = np.diag(np.linalg.inv(seen.T @ seen))[1:] * _PIXELS_PER_HEIGHT
    return Background.of(found[1:], shape, pitch_um, (spread_um * np.sqrt(variances)).tolist())


def print_terms_sd_um(off_um: np.ndarray, expected_um: np.ndarray) -> float:
    """Return the standard deviation, µm, that each polynomial term of order 1 or 2 (tilt and bow) may have in
    the print itself.

    It is extrapolated from finer terms of ``off_um``, the deviation from the expected print. First, the mean
    deviation at each expected height is subtracted. The result is ``_LOW_ORDER_FACTOR`` times the rms of the
    terms of orders 3 to 6 in the remaining map. Both maps have shape (ny, nx).
    """
    edges_um = np.quantile(expected_um, np.linspace(0, 1, _HEIGHT_GROUPS + 1)[1:-1])
    group = np.searchsorted(edges_um, expected_um.ravel())
    mean = np.bincount(group, off_um.ravel()) / np.bincount(group).clip(min=1)
    foreign = off_um - mean[group].reshape(off_um.shape)
    finer = amounts(foreign, legendre_shapes(off_um.shape, _ORDERS))
    return _LOW_ORDER_FACTOR * float(np.sqrt(np.mean(finer**2)))
