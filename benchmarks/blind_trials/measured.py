"""Plant causes in measured prints. The changes of height that the causes make in the virtual fab are added to
the measured heights.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.store import Store
from litho_data.virtual_fab import Job, Printer
from litho_models.boards.planting import noise_free_um
from litho_models.boards.records import Draw, Planted


def measured_jobs(store: Store) -> tuple[Job, ...]:
    """Return jobs with which the virtual fab prints the layouts of a store.

    Raises:
        InputError: the pitch, level height or number of levels of the store is not that of the fab.
    """
    got = (store.pitch_um, store.level_height_um, store.levels)
    wanted = (Printer.pitch_um, Printer.level_height_um, Printer.levels)
    if got != wanted:
        raise InputError(f"pitch, level height and levels of {store.path}", got=got, wanted=wanted)
    scans = sorted(store.scans(), key=lambda scan: scan.order)
    last = max(len(scans) - 1, 1)
    return tuple(
        Job(id=scan.id, level=scan.mask_level, index=at, order=at / last - 0.5)
        for at, scan in enumerate(scans)
    )


def middle(jobs: Sequence[Job], size_px: int) -> list[Job]:
    """Return jobs for the centres of the fields only, of ``size_px`` × ``size_px`` pixels. The sizes of
    effects are measured with these jobs, because they take less time.
    """
    corners = [[(side - size_px) // 2 for side in job.level.shape] for job in jobs]
    return [
        replace(job, level=job.level[max(y, 0) : size_px + max(y, 0), max(x, 0) : size_px + max(x, 0)])
        for job, (y, x) in zip(jobs, corners, strict=True)
    ]


def inject(store: Store, out: Path, draw: Draw, planted: Sequence[Planted], jobs: Sequence[Job]) -> None:
    """Copy a store, and add the changes of height that the planted effects make to the heights of the copy.

    Raises:
        InputError: the store is a single file and not a folder.
    """
    import zarr

    if not store.path.is_dir():
        raise InputError("store of measured prints", got=store.path.name, wanted="a folder")
    shutil.copytree(store.path, out)
    heights = zarr.open_array(out / "height_um", mode="r+")
    for job in jobs:
        (with_um,), (without_um,) = (noise_free_um(draw, one, [job]) for one in (planted, []))
        row, (ny, nx) = store.ids.index(job.id), job.level.shape
        changed_um = store.sample("height_um", row) + (with_um - without_um)
        heights[row, :ny, :nx] = changed_um.astype(np.float32)
