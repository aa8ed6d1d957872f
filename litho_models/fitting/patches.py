"""Patches of a store for your own training loop: a PyTorch ``Dataset`` without the lock box."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan, Store, open_store
from litho_models.fitting.crops import Window, cut

Flips = Literal["none", "y", "x", "both"]


class Patch(TypedDict):
    """One patch: layout with its margin, measured height and which pixels count; its scan and corner."""

    layout_um: Tensor
    height_um: Tensor
    valid: Tensor
    scan: str
    y_px: int
    x_px: int


class PatchDataset(Dataset[Patch]):
    """Squares drawn from the scans of a store, each a function of seed and index alone.

    ``layout_um`` (1, s + 2m, s + 2m) float32 has a margin m of the layout around the patch, so that a model
    sees what lies beyond its edge; ``height_um`` (1, s, s) float32 is 0 where not measured, and ``valid``
    (1, s, s) bool says where it counts. Patches are never turned by 90°: scan lines and written lines have a
    direction, and the two axes of a print are not alike. A flip reverses what acts to one side, such as a
    lag of the beam or of the microscope, so none is made unless asked for.

    Args:
        store: dataset store or its path. Locked scans are left out.
        size_px: side s of a patch; ``margin_px``: m.
        per_scan: number of patches from each scan.
        ids: scans to draw from; all that are not locked by default.
        flips: axes along which half of the patches are reversed, at random.
        seed: decides places and flips.

    Raises:
        InputError: unknown or locked ids, or a patch that is larger than a scan.
    """

    def __init__(
        self,
        store: str | Path | Store,
        *,
        size_px: int = 128,
        margin_px: int = 32,
        per_scan: int = 64,
        ids: Sequence[str] | None = None,
        flips: Flips = "none",
        seed: int = 0,
    ):
        opened = store if isinstance(store, Store) else open_store(store)
        self._scans = _chosen(opened, ids)
        self._layouts_um = [scan.layout_um for scan in self._scans]
        smallest = min(min(scan.shape) for scan in self._scans)
        if not 1 <= size_px <= smallest:
            raise InputError("size_px of a patch", got=size_px, wanted=f"1 to {smallest}, the smallest scan")
        if margin_px < 0 or per_scan < 1:
            got = f"margin_px {margin_px}, per_scan {per_scan}"
            raise InputError("patches", got=got, wanted="a margin of 0 or more and at least one per scan")
        self.size_px, self.margin_px, self.per_scan = size_px, margin_px, per_scan
        self.flips, self.seed = flips, seed

    @property
    def ids(self) -> list[str]:
        """The scans that patches are drawn from."""
        return [scan.id for scan in self._scans]

    def __len__(self) -> int:
        return self.per_scan * len(self._scans)

    def __getitem__(self, index: int) -> Patch:
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = index // self.per_scan
        scan, random = self._scans[number], np.random.default_rng([self.seed, index])
        y, x = (int(random.integers(length - self.size_px + 1)) for length in scan.shape)
        along_y, along_x = (bool(drawn) for drawn in random.integers(2, size=2))
        flip = (along_y and self.flips in ("y", "both"), along_x and self.flips in ("x", "both"))
        window = Window(number, y, x, self.size_px, flip)
        height_um = cut(scan.height_um, window)
        valid = cut(scan.valid, window) & np.isfinite(height_um)
        return Patch(
            layout_um=_tensor(cut(self._layouts_um[number], window, self.margin_px), np.float32),
            height_um=_tensor(np.where(valid, height_um, 0), np.float32),
            valid=_tensor(valid, bool),
            scan=scan.id,
            y_px=y,
            x_px=x,
        )

    def __repr__(self) -> str:
        return (
            f"<PatchDataset: {len(self):,} patches of {self.size_px} px with {self.margin_px} px around, "
            f"from {len(self._scans)} scans>"
        )


def _chosen(store: Store, ids: Sequence[str] | None) -> list[PrintedScan]:
    open_ids = [scan_id for scan_id in store.ids if scan_id not in store.locked_ids]
    if refused := [scan_id for scan_id in ids or () if scan_id not in open_ids]:
        got = ", ".join(f"{one} ({'locked' if one in store.locked_ids else 'unknown'})" for one in refused)
        raise InputError("ids of patches", got=got, wanted="scans of the store that are not locked")
    wanted = [store.scan(scan_id) for scan_id in (open_ids if ids is None else ids)]
    if not wanted:
        raise InputError("patches", got="no scan", wanted="at least one that is not locked")
    return wanted


def _tensor(field: np.ndarray, dtype: type) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(field[None], dtype=dtype))
