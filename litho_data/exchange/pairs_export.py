"""Writing the authors' pair format; see ``litho_data.exchange.pairs`` for what it can hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from litho_data.exchange.pairs import GREY_MAX, SCALES_FILE, quadrant_slices
from litho_data.foundation.commands import progress
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.outputs import require_replaceable_folder
from litho_data.store.read import open_store

_QUADRANTS = (1, 2, 3, 4)


def export_pairs(store_path: str | Path, out: str | Path) -> list[str]:
    """Write a store in the pair format; returns a note for whatever a scan lost on the way.

    Heights are rounded to the nearest grey value; pixels that were not measured become 0.

    Raises:
        InputError: a store whose fields cannot be cut into quadrants, or a folder with something else in it.
    """
    store = open_store(store_path)
    notes: list[str] = []
    scales: dict[str, float] = {}
    require_replaceable_folder(out, "mask", "afm", SCALES_FILE)
    with atomic_folder(out) as folder:
        for name in ("mask", "afm"):
            (folder / name).mkdir()
        for scan_id in progress(store.ids, "exporting pairs"):
            scan = store.scan(scan_id)
            if scan.shape[0] % 2 or scan.shape[1] % 2:
                raise InputError(
                    f"size of field {scan_id}", got=scan.shape, wanted="even numbers of pixels, for quadrants"
                )
            height_um, lift_um = _positive(scan.height_um)
            if lift_um:
                notes.append(
                    f"{scan_id}: raised by {lift_um * 1e3:.1f} nm, the format has no negative heights"
                )
            if unmeasured := int(np.isnan(height_um).sum()):
                notes.append(
                    f"{scan_id}: {unmeasured} pixels without measurement became 0, the format has no gaps"
                )
            full_scale_um = max(float(np.nanmax(height_um, initial=0)), 1e-6)
            grey = np.rint(np.nan_to_num(height_um) / full_scale_um * GREY_MAX).astype(np.uint8)
            for quadrant in _QUADRANTS:
                name = f"{scan_id}{quadrant}.tif"
                _write_tiff(
                    folder / "mask" / name, np.repeat(_cut(scan.mask_level, quadrant)[..., None], 3, axis=2)
                )
                _write_tiff(folder / "afm" / name, _cut(grey, quadrant))
                scales[name] = full_scale_um * 1e-6
        (folder / SCALES_FILE).write_text(json.dumps(scales), encoding="utf-8")
    return notes


def _positive(height_um: np.ndarray) -> tuple[np.ndarray, float]:
    lowest = float(np.nanmin(height_um, initial=0))
    return (height_um - lowest, -lowest) if lowest < 0 else (height_um, 0.0)


def _cut(image: np.ndarray, quadrant: int) -> np.ndarray:
    return image[quadrant_slices(quadrant, image.shape)]


def _write_tiff(path: Path, image: np.ndarray) -> None:
    import tifffile

    photometric = "rgb" if image.ndim == 3 else "minisblack"
    tifffile.imwrite(path, np.ascontiguousarray(image), compression="lzw", photometric=photometric)
