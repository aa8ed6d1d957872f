"""Register a scan to the layout of a design."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.register.flows import LADDER, changes
from litho_data.register.pyramid import SCAN_BLUR_PX
from litho_data.register.refine import interior_of
from litho_data.register.topography import predicted_topography, smooth_measured
from litho_data.scan import Scan
from litho_design.images.noise import covariance_by_tiles, white_noise
from litho_design.scans.shapes import legendre_shapes

# Standard deviation of the shift of the whole print along one axis, by which models of the same printer
# differ (rms over 80 prints by two of five models, less the scatter between tiles). A lag along x causes most
# of it.
_PRINT_SHIFT_UM = 0.0075


class Placed(NamedTuple):
    """A scan resampled on the pixels of the layout and of ``margin_px`` pixels around it. It contains the
    heights and the mask of measured pixels, both of shape (ny + 2 margin, nx + 2 margin), the orientation, a
    warning, and the errors of the registration (see ``MeasuredRecord``).

    Resampling weakens noise, most of all at the high frequencies from which ``white_noise`` estimates it. The
    estimate must therefore be multiplied by ``noise_factor``.
    """

    height_um: np.ndarray
    valid: np.ndarray
    margin_px: int = 0
    noise_factor: float = 1.0
    orientation: str = "identity"
    warning: str = ""
    warp_errors_px: np.ndarray = np.zeros((0, 6))

    def inner(self, one: np.ndarray) -> np.ndarray:
        """Return the part of a map that lies on the layout, of shape (ny, nx)."""
        ny, nx = one.shape
        return one[self.margin_px : ny - self.margin_px, self.margin_px : nx - self.margin_px]


def as_it_lies(scan: Scan, level: np.ndarray, pitch_um: float) -> Placed:
    """Take a scan that already has the pixels of the layout. Raise InputError if it has other pixels."""
    own_pitch = scan.require_pitch()
    if scan.height_um.shape != level.shape or not np.allclose(own_pitch, pitch_um, rtol=1e-3):
        raise InputError(
            f"aligned scan {scan.source}",
            got=f"{scan.height_um.shape} px of {own_pitch[0]:g} µm",
            wanted=f"{level.shape} px of {pitch_um:g} µm, the pixels of the element",
        )
    return Placed(scan.height_um, np.isfinite(scan.height_um))


def registered(scan: Scan, level: np.ndarray, pitch_um: float) -> Placed:
    """Register a scan by an affine map, and resample it. Raise InputError if it does not match the layout."""
    from litho_data.register import register_scan, resample_to_layout

    pitches: Any = {"scan_pitch_um": scan.require_pitch(), "layout_pitch_um": pitch_um}
    found = register_scan(scan.height_um, level, **pitches, model="affine")
    quality = found.quality
    if not quality.passed:
        raise InputError(
            f"scan {scan.source} on the layout of the design",
            got=quality.reason,
            wanted="a match",
            hint="use --scan-aligned if the scan has the pixels of the element",
        )
    margin_px = min(level.shape) // 8
    moved = np.eye(3)
    moved[:2, 2] = margin_px * pitch_um

    def resampled(map_um: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shape = tuple(size + 2 * margin_px for size in level.shape)
        return resample_to_layout(
            map_um, moved @ found.scan_to_layout, shape, **pitches, bend_um=found.bend_um
        )  # fmt: skip

    placed = Placed(*resampled(scan.height_um), margin_px, 1.0, quality.dihedral, quality.warning)
    noise = placed.inner(resampled(np.random.default_rng(0).standard_normal(scan.height_um.shape))[0])
    factor = float(np.nanstd(noise)) / white_noise(np.nan_to_num(noise))
    topography = predicted_topography(level, quality.blur_um / pitch_um).astype(float)
    errors_px = warp_errors_px(placed.inner(placed.height_um), topography)
    shifts_px = _PRINT_SHIFT_UM / pitch_um * np.eye(2, 6)
    return placed._replace(noise_factor=factor, warp_errors_px=np.vstack([errors_px, shifts_px]))


def warp_errors_px(height_um: np.ndarray, topography: np.ndarray) -> np.ndarray:
    """Return six independent errors of the affine map that registers a scan, one in each row, shape (6, 6).

    Each error is as large as its standard deviation. It consists of the coefficients of the six generators of
    an affine map (see ``register.flows``), in pixels: a coefficient of 1 displaces the middle of an edge of a
    square by one pixel. The errors are computed from the deviation of the heights from the topography, the
    image to which the scan was registered. Gain and a quadratic background are fitted, too.

    Args:
        height_um: height of the registered scan, shape (ny, nx), NaN where not measured.
        topography: height of the layout after blurring, in any unit, shape (ny, nx).
    """
    shape = topography.shape
    used = interior_of(shape) & np.isfinite(height_um)
    height = smooth_measured(height_um, SCAN_BLUR_PX)
    fixed = np.dstack([legendre_shapes(shape, (0, 1, 2)), topography])
    found, *_ = np.linalg.lstsq(fixed[used], height[used], rcond=None)
    moved = np.moveaxis(changes(found[-1] * topography, LADDER["affine"]), 0, -1)
    slopes = np.where(used[..., None], np.dstack([fixed, moved]), 0.0)
    residual = np.where(used, height - fixed @ found, 0.0)
    covariance = covariance_by_tiles(slopes.reshape(-1, slopes.shape[-1]), residual.ravel(), shape)
    variance, ways = np.linalg.eigh(covariance[-6:, -6:])
    errors: np.ndarray = (ways * np.sqrt(variance.clip(0))).T
    return errors
