"""Make phantoms: scans of prints with a known warp, some with defects or with creep of the scanner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from litho_data.register import Registration, register_scan
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
SHAPE, SCAN_SHAPE = (320, 320), (376, 376)
SNR = 10
BARE_UM = 0.005
INVERSE = {"rotate-90": "rotate-270", "rotate-270": "rotate-90"}
Seen = Callable[[np.ndarray], np.ndarray]


def random_layout(shape: tuple[int, int], seed: int, blob_px: float = 8.0, levels: int = 13) -> np.ndarray:
    """Return a random layout: low-pass noise scaled to the range of levels."""
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
    """Return the matrix from layout indices to scan indices for a warp about the centre. Pairs are (x, y)."""
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
    """Return a scan in µm. The print is blurred, warped and multiplied by ``polarity``; then noise is added
    and the scan is re-oriented.

    ``snr`` is the standard deviation of the print divided by that of the white noise. The function
    ``orient(result, orientation)`` makes the result upright again.
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
    """Return the true matrix in µm of a result of ``scan_of``; ``scan_shape`` is the shape of the upright
    scan.
    """
    back = INVERSE.get(orientation, orientation)
    frame = index_to_um((PITCH_UM, PITCH_UM))
    to_turned = orientation_matrix(back, scan_shape) @ layout_to_scan
    return frame @ np.linalg.inv(to_turned) @ np.linalg.inv(frame)


def warp_error_px(found: np.ndarray, true: np.ndarray, layout_shape: tuple[int, int]) -> float:
    """Return the largest difference of two ``scan_to_layout`` matrices on the layout, in layout pixels."""
    ny, nx = layout_shape
    y, x = np.meshgrid(np.linspace(0, ny, 9), np.linspace(0, nx, 9), indexing="ij")
    points_um = PITCH_UM * np.stack([x.ravel(), y.ravel()], axis=1)
    on_scan = apply_transform(np.linalg.inv(true), points_um)
    return float(np.hypot(*(apply_transform(found, on_scan) - points_um).T).max() / PITCH_UM)


def register(scan: np.ndarray, layout: np.ndarray, **options: Any) -> Registration:
    """Register a phantom in the same way as a build does."""
    return register_scan(scan, layout, scan_pitch_um=(PITCH_UM,) * 2, layout_pitch_um=PITCH_UM, **options)


def print_of(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a layout and the matrix from its indices to those of its scan."""
    layout = random_layout(SHAPE, seed, blob_px=7.0)
    warp = warp_about_centre(
        SHAPE, rotation_deg=0.6, scale=(1.015, 0.99), shift_px=(3.3, -2.2), margin_px=(28.0, 28.0)
    )
    return layout, warp


def rms_error_px(found: Registration, warp: np.ndarray, seen: Seen | None = None) -> float:
    """Return the rms error of a registration in layout pixels. A border of 8 px does not count.

    ``seen`` maps true positions in the scan to the positions where they appear.
    """
    truth = true_scan_to_layout(warp, "identity", SCAN_SHAPE)
    y, x = np.meshgrid(*(np.linspace(8, n - 8, 33) for n in SHAPE), indexing="ij")
    points_um = PITCH_UM * np.stack([x.ravel(), y.ravel()], axis=1)
    on_scan = apply_transform(np.linalg.inv(truth), points_um)
    at = on_scan if seen is None else seen(on_scan)
    at = at if found.bend_um is None else found.bend_um.straighten(at)
    error_um = apply_transform(found.scan_to_layout, at) - points_um
    return float(np.sqrt((error_um**2).sum(axis=1).mean()) / PITCH_UM)


def dust(scan: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add eight dust particles with radii of 0.5 to 1.6 µm and heights of 1 to 4 µm to a scan."""
    y, x = np.mgrid[: scan.shape[0], : scan.shape[1]]
    for _ in range(8):
        middle, radius = rng.uniform(0.08, 0.92, 2) * scan.shape, rng.uniform(5, 16)
        cap = np.clip(1 - ((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / radius**2, 0, 1) ** 0.5
        scan = scan + rng.uniform(1, 4) * cap
    return scan


def missing_corner(scan: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Replace a corner of the print by bare substrate. ``share`` is the length of its sides divided by that
    of the sides of the print.
    """
    scan, side = scan.copy(), 28 + round(share * SHAPE[0])
    scan[:side, :side] = BARE_UM * rng.standard_normal((side, side))
    return scan


def delaminated(scan: np.ndarray, rng: np.random.Generator, lift_um: float) -> np.ndarray:
    """Lift a tenth of the print by ``lift_um``, or remove it if ``lift_um`` is 0."""
    smooth = gaussian_filter(rng.standard_normal(scan.shape), 25)
    off = smooth > np.quantile(smooth, 0.9)
    return np.where(off, scan + lift_um if lift_um else BARE_UM * rng.standard_normal(scan.shape), scan)


DEFECTS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "dust of 8 particles": dust,
    "corner missing, 10 % of both sides": lambda scan, rng: missing_corner(scan, rng, 0.1),
    "corner missing, 20 %": lambda scan, rng: missing_corner(scan, rng, 0.2),
    "corner missing, 33 %": lambda scan, rng: missing_corner(scan, rng, 0.33),
    "a tenth gone": lambda scan, rng: delaminated(scan, rng, 0.0),
    "a tenth lifted by 0.6 µm": lambda scan, rng: delaminated(scan, rng, 0.6),
}


def creeping(
    layout: np.ndarray, warp: np.ndarray, creep_um: float, slow: int, constant: float = 0.25
) -> tuple[np.ndarray, Seen]:
    """Return a scan by a scanner that creeps exponentially, and a function that describes its distortion.

    The function maps true positions in µm to the positions where they appear.
    """
    place = np.arange(SCAN_SHAPE[0])
    settling_px = creep_um / PITCH_UM * np.exp(-place / (constant * SCAN_SHAPE[0]))
    amount = (1.0, 0.4)  # along x and y
    y, x = np.mgrid[: SCAN_SHAPE[0], : SCAN_SHAPE[1]].astype(float)
    along = np.interp(y if slow else x, place, settling_px)
    whole = scan_of(layout, warp, SCAN_SHAPE)
    scan = map_coordinates(whole, (y - amount[1] * along, x - amount[0] * along), order=5)

    def seen(points_um: np.ndarray) -> np.ndarray:
        true = points_um / PITCH_UM - 0.5
        at = true.copy()
        for _ in range(50):
            shift = np.interp(at[:, slow], place, settling_px)
            at = true + np.stack([amount[0] * shift, amount[1] * shift], axis=1)
        return (at + 0.5) * PITCH_UM

    noise = np.random.default_rng(0).standard_normal(scan.shape) / SNR
    return scan + scan.std() * noise, seen
