"""Level Rotate: turn the surface until its mean plane is horizontal, as a rigid body."""

from __future__ import annotations

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.level.plane import PLANE, slopes_per_px
from litho_data.level.polynomial import fit_terms
from litho_data.level.selection import Levelled, Masking, as_height, select


def level_rotate(
    height_um: np.ndarray,
    *,
    pitch_um: tuple[float, float],
    mask: np.ndarray | None = None,
    masking: Masking = "exclude",
) -> Levelled:
    """Rotate by the angles of the least-squares plane, first every row, then every column.

    Subtracting a plane shears the surface, which stretches steep flanks; rotating keeps their
    shape. Each profile turns about its middle pixel and is interpolated linearly at the old
    positions; what turns out of the image is continued by the outermost value.

    Args:
        height_um: (ny, nx), µm; every pixel must be measured.
        pitch_um: (y, x) sampling, µm, in the unit of the heights.

    Raises:
        InputError: missing pixels, or an angle at which the surface would overhang.
    """
    z = as_height(height_um)
    if not np.isfinite(z).all():
        raise InputError("rotation of a scan with missing pixels", wanted="every pixel measured")
    chosen = select(z, mask, masking)
    weights = None if chosen is None else chosen.astype(np.float64)
    slope_x, slope_y = slopes_per_px(fit_terms(z, weights, PLANE), z.shape)
    turned = _rotate_rows(z, slope_x / pitch_um[1], pitch_um[1])
    turned = _rotate_rows(turned.T, slope_y / pitch_um[0], pitch_um[0]).T
    return Levelled(np.ascontiguousarray(turned), z - turned)


def _rotate_rows(z: np.ndarray, slope: float, pitch_um: float) -> np.ndarray:
    angle = -np.arctan(slope)
    position = (np.arange(z.shape[1]) - (z.shape[1] - 1) / 2) * pitch_um
    # Rotating about the profile's own middle keeps the height there, whatever the datum.
    last = z.shape[1] - 1
    pivot = 0.5 * (z[:, last // 2] + z[:, (last + 1) // 2])[:, None]
    moved_x = position * np.cos(angle) - (z - pivot) * np.sin(angle)
    moved_z = position * np.sin(angle) + (z - pivot) * np.cos(angle) + pivot
    if (np.diff(moved_x, axis=1) <= 0).any():
        raise InputError(
            "rotation makes the surface overhang", got=f"{np.degrees(angle):.3g}°", wanted="level_plane"
        )
    return np.stack([np.interp(position, x, row) for x, row in zip(moved_x, moved_z, strict=True)])
