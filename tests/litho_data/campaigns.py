"""Write small measuring campaigns to disk: layouts, scans of their prints, and a card."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile
from scipy import ndimage

PITCH_UM = 0.1
LEVEL_HEIGHT_UM = 0.1
LEVELS = 13
MARGIN_PX = 8
NOISE_UM = 0.004


def layout_of(seed: int, shape: tuple[int, int] = (112, 112)) -> np.ndarray:
    """Return a layout of random smooth levels as uint8."""
    smooth = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(shape), 3.0)
    low, high = np.percentile(smooth, [2, 98])
    return np.clip((smooth - low) / (high - low) * (LEVELS - 1), 0, LEVELS - 1).round().astype(np.uint8)


def height_of(layout: np.ndarray, seed: int) -> np.ndarray:
    """Return the heights in µm of a scan of the print, including a margin of ``MARGIN_PX``."""
    print_um = ndimage.gaussian_filter(layout * LEVEL_HEIGHT_UM, 1.0)
    height = np.pad(print_um, MARGIN_PX, mode="edge")
    return height + NOISE_UM * np.random.default_rng(1000 + seed).standard_normal(height.shape)


def write_scan(path: Path, height_um: np.ndarray) -> None:
    """Write a scan as a text matrix in metres, in the format of the scans of the measured prints."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, height_um * 1e-6, fmt="%.5e", delimiter="\t", newline="\r\n")


def write_campaign(folder: Path, count: int = 3, shape: tuple[int, int] = (112, 112), **card: str) -> Path:
    """Write layouts ``P11``, ``P12``, … and their scans, and return the path of ``card.toml``."""
    for index in range(count):
        layout = layout_of(index, shape)
        scan_id = f"P{1 + index // 2}{1 + index % 2}"
        (folder / "layouts").mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(folder / "layouts" / f"{scan_id}.tif", layout)
        write_scan(folder / "scans" / f"{scan_id}.txt", height_of(layout, index))
    size_um = [round((n + 2 * MARGIN_PX) * PITCH_UM, 6) for n in shape]
    text = card_text(size_um=str(size_um), **card)
    (folder / "card.toml").write_text(text, encoding="utf-8")
    return folder / "card.toml"


def card_text(
    size_um: str = "[12.8, 12.8]", *, unit: str = '"m"', pitch_um: str = "0.1", more: str = ""
) -> str:
    """Return the text of a card. The arguments are values in TOML; ``more`` is text to append to the card."""
    return f"""
name = "test-prints"
[layout]
files = "layouts/{{id}}.tif"
pitch_um = {pitch_um}
level_height_um = {LEVEL_HEIGHT_UM}
levels = {LEVELS}
[scan]
files = "scans/{{id}}.txt"
format = "text-matrix"
unit = {unit}
size_um = {size_um}
levelled = true
[ids]
print = 'P(?P<print>\\d)\\d'
{more}
"""
