"""Make printed scans with a known printer and a known microscope, in memory or as a store."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.layouts import random_layout
from litho_data.store import PrintedScan

PITCH_UM, LEVEL_HEIGHT_UM, LEVELS = 0.1, 0.1, 13
BLUR_UM = 0.25


def printed_height_um(layout_um: np.ndarray) -> np.ndarray:
    """Return the true heights of a print, which are blurred by 0.25 µm and saturate."""
    dose = gaussian_filter(layout_um.astype(np.float64), BLUR_UM / PITCH_UM, mode="nearest", truncate=6)
    return 0.03 + 0.9 * dose - 0.25 * dose**2


def make_scan(
    number: int, size_px: int = 96, *, noise_um: float = 0.004, datum_um: float = 0.03, bow_um: float = 0.0
) -> PrintedScan:
    """Return a scan with its own layout, a bow of zero mean and white noise. The sign of the datum alternates
    from scan to scan.
    """
    random = np.random.default_rng([7, number])
    level = random_layout(
        (size_px, size_px), levels=LEVELS, cutoff_per_um=0.4, pitch_um=PITCH_UM, seed=number
    )
    y = np.linspace(-1, 1, size_px)[:, None]
    bow = bow_um * (y**2 - np.mean(y**2))
    height = printed_height_um(level * LEVEL_HEIGHT_UM) + datum_um * (-1) ** number + bow
    height = height + random.normal(0, noise_um, height.shape)
    return PrintedScan(
        id=f"P{number // 2}F{number % 2}",
        print_id=str(number // 2),
        order=number,
        mask_level=level.astype(np.uint8),
        height_um=height.astype(np.float32),
        valid=np.ones(height.shape, bool),
        pitch_um=PITCH_UM,
        level_height_um=LEVEL_HEIGHT_UM,
        levels=LEVELS,
        scan_to_layout=np.eye(3),
    )


def make_scans(count: int, size_px: int = 96, **settings: float) -> list[PrintedScan]:
    """Return ``count`` scans, two of each print."""
    return [make_scan(number, size_px, **settings) for number in range(count)]


def write_store(path: Path, scans: Sequence[PrintedScan], **attributes: float | str) -> Path:
    """Write a store in the published format, using only xarray."""
    import xarray as xr

    first = scans[0]
    dims = ("scan", "y", "x")
    data = xr.Dataset(
        {
            "mask_level": (dims, np.stack([scan.mask_level for scan in scans])),
            "height_um": (dims, np.stack([scan.height_um for scan in scans])),
            "valid": (dims, np.stack([scan.valid for scan in scans])),
            "scan_to_layout": (("scan", "row", "column"), np.stack([scan.scan_to_layout for scan in scans])),
        },
        coords={
            "scan": [scan.id for scan in scans],
            "print": ("scan", [scan.print_id for scan in scans]),
            "order": ("scan", [scan.order for scan in scans]),
            "y_um": ("y", (np.arange(first.shape[0]) + 0.5) * first.pitch_um),
            **{
                name: ("scan", [getattr(scan, name) for scan in scans])
                for name in ("dose", "turned_deg")
                if getattr(first, name) is not None
            },
            "x_um": ("x", (np.arange(first.shape[1]) + 0.5) * first.pitch_um),
        },
        attrs={
            "name": "made",
            "pitch_um": first.pitch_um,
            "level_height_um": first.level_height_um,
            "levels": first.levels,
            **attributes,
        },
    )
    data.to_zarr(path, mode="w", zarr_format=3, write_empty_chunks=True)
    return path
