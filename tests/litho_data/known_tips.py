"""Simulate scans of surfaces with a tip of known radius, on a grid four times as fine as the scan."""

from __future__ import annotations

import numpy as np
import scipy.ndimage

PITCH_UM = (0.1, 0.1)
SIZE_PX = 160
OVER = 4


def print_under_tip(
    kind: str, radius_um: float, height_um: float, seed: int = 11, size_px: int = SIZE_PX
) -> tuple[np.ndarray, np.ndarray]:
    """Scan a surface with a paraboloid. Return the image in µm and the touched share of each pixel."""
    fine_um = PITCH_UM[0] / OVER
    reach = int(np.ceil(np.sqrt(2 * radius_um * height_um) / fine_um)) + 1
    parabola = -((np.arange(-reach, reach + 1) * fine_um) ** 2) / (2 * radius_um)

    def dilated(heights: np.ndarray) -> np.ndarray:
        for line in (parabola[:, None], parabola[None]):
            heights = scipy.ndimage.grey_dilation(heights, size=line.shape, structure=line, mode="nearest")
        return heights

    surface = fine_surface(kind, height_um, seed, size_px)
    image = dilated(surface)
    # Where a contact lies between two points of the fine grid, the image misses the surface by up to
    # fine²/2R.
    touched = -dilated(-image) - surface < 2 * fine_um**2 / radius_um
    share = touched.reshape(size_px, OVER, size_px, OVER).mean(axis=(1, 3))
    return image[OVER // 2 :: OVER, OVER // 2 :: OVER], share


def fine_surface(kind: str, height_um: float, seed: int, size_px: int = SIZE_PX) -> np.ndarray:
    """Return a surface in µm on the fine grid. It has pillars of equal height, or varied spikes or bumps."""
    rng, size = np.random.default_rng(seed), size_px * OVER
    surface = np.zeros((size, size))
    for _ in range(size_px**2 // 2000):
        y, x = rng.uniform(0, size, 2)
        b, a = rng.uniform(2, 14, 2) * OVER
        if kind == "pillars":
            surface[max(int(y - b / 2), 0) : int(y + b / 2), max(int(x - a / 2), 0) : int(x + a / 2)] = (
                height_um
            )
            continue
        width = b / (12 if kind == "spikes" else 3)
        rows, columns = (np.exp(-((np.arange(size) - at) ** 2) / (2 * width**2)) for at in (y, x))
        np.maximum(surface, rng.uniform(0.4, 1) * height_um * np.outer(rows, columns), out=surface)
    return surface


def noise_of_snr(shape: tuple[int, ...], height_um: float, snr: float, seed: int) -> np.ndarray:
    """Return white noise in µm whose standard deviation is ``height_um / snr``."""
    return np.random.default_rng(seed + 1).standard_normal(shape) * height_um / snr
