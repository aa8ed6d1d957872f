"""Printed and scanned phantoms whose warp is known: the truth that the registration tests compare with."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from litho_data.register.geometry import (
    apply_transform,
    centre,
    index_to_um,
    orient,
    orientation_matrix,
    warped_grid,
)

PITCH_UM = 0.1
LEVEL_HEIGHT_UM = 0.1
PRINT_BLUR_PX = 2.0
INVERSE = {"rotate-90": "rotate-270", "rotate-270": "rotate-90"}


def random_layout(shape: tuple[int, int], seed: int, blob_px: float = 8.0, levels: int = 13) -> np.ndarray:
    """Low-passed noise stretched over the levels."""
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), blob_px, mode="wrap")
    noise = (noise - noise.min()) / np.ptp(noise)
    return np.minimum(noise * levels, levels - 1).astype(np.uint8)


def warp_about_centre(
    shape: tuple[int, int],
    *,
    rotation_deg: float = 0.0,
    scale: tuple[float, float] = (1.0, 1.0),
    shear: float = 0.0,
    shift_px: tuple[float, float] = (0.0, 0.0),
    margin_px: tuple[float, float] = (14.0, 14.0),
    perspective: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """Layout index to scan index: scale and rotation about the layout's middle; pairs are (x, y)."""
    angle = np.radians(rotation_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = centre(shape)
    linear = np.eye(3)
    linear[:2, :2] = turn @ np.array([[1.0, shear], [0.0, 1.0]]) @ np.diag(scale)
    linear[2, :2] = perspective
    there, back = np.eye(3), np.eye(3)
    there[:2, 2] = -middle
    back[:2, 2] = middle + np.array(shift_px) + np.array(margin_px)
    return back @ linear @ there


def scan_of(
    layout_level: np.ndarray,
    layout_to_scan: np.ndarray,
    scan_shape: tuple[int, int],
    *,
    snr: float = np.inf,
    seed: int = 0,
    orientation: str = "identity",
    polarity: int = 1,
) -> np.ndarray:
    """Heights, µm, of the blurred print seen through a warp, then noise, turn and sign.

    ``snr`` is the standard deviation of the print over that of white noise. The result is turned so that
    ``orient(result, orientation)`` is upright again.
    """
    height = LEVEL_HEIGHT_UM * gaussian_filter(layout_level.astype(float), PRINT_BLUR_PX, mode="constant")
    rows, columns = warped_grid(np.linalg.inv(layout_to_scan), scan_shape)
    scan = map_coordinates(height, (rows, columns), order=5, mode="constant")
    scan = polarity * scan
    if np.isfinite(snr):
        scan = scan + np.random.default_rng(seed).standard_normal(scan_shape) * height.std() / snr
    back = INVERSE.get(orientation, orientation)
    return np.ascontiguousarray(orient(scan, back))


def true_scan_to_layout(
    layout_to_scan: np.ndarray, orientation: str, scan_shape: tuple[int, int]
) -> np.ndarray:
    """The truth in µm for the scan that ``scan_of`` returns; ``scan_shape`` is that of the upright one."""
    back = INVERSE.get(orientation, orientation)
    frame = index_to_um((PITCH_UM, PITCH_UM))
    to_turned = orientation_matrix(back, scan_shape) @ layout_to_scan
    return frame @ np.linalg.inv(to_turned) @ np.linalg.inv(frame)


def warp_error_px(found: np.ndarray, true: np.ndarray, layout_shape: tuple[int, int]) -> float:
    """Largest distance between two ``scan_to_layout`` over the layout, in layout pixels."""
    ny, nx = layout_shape
    y, x = np.meshgrid(np.linspace(0, ny, 9), np.linspace(0, nx, 9), indexing="ij")
    points_um = PITCH_UM * np.stack([x.ravel(), y.ravel()], axis=1)
    on_scan = apply_transform(np.linalg.inv(true), points_um)
    return float(np.hypot(*(apply_transform(found, on_scan) - points_um).T).max() / PITCH_UM)
