"""A PyTorch ``Dataset`` of patches for your own training loop. The patches are drawn from those scans of a
store that are not locked, i.e. not reserved for the final test.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan, Store, open_store
from litho_models.fitting.crops import Window, cut


class Patch(TypedDict):
    """One patch: the exposed layout with its margin, the measured height, the mask of valid pixels, the id of
    the scan, and the row and column of the patch's first pixel in the scan.
    """

    layout_um: Tensor
    height_um: Tensor
    valid: Tensor
    scan: str
    y_px: int
    x_px: int


class PatchDataset(Dataset[Patch]):
    """Square patches at random positions in the scans of a store. The position of a patch depends only on the
    seed and on the index of the patch.

    For a patch of side s and a margin of width m, ``layout_um`` is float32 of shape (1, s + 2m, s + 2m). It
    is the layout times the dose of the scan, from which models predict prints. With the margin, a model also
    receives the layout around the patch. ``height_um`` is float32 of shape (1, s, s), with 0 where nothing
    was measured. ``valid`` is a boolean mask of shape (1, s, s) that marks the measured pixels. Patches are
    neither rotated nor flipped, because the two axes of a print differ, and a lag of the beam or of the
    microscope acts in one direction only.

    Args:
        store: dataset store or its path. Locked scans are left out.
        size_px: side s of a patch, in pixels; ``margin_px``: width m of the margin, in pixels.
        per_scan: number of patches drawn from each scan.
        ids: ids of the scans to draw from; by default all scans that are not locked.
        seed: seed of the random positions of the patches.

    Raises:
        InputError: a scan id is unknown or locked, no scan is left, a patch is larger than a scan, or a size
            is out of range.
    """

    def __init__(
        self,
        store: str | Path | Store,
        *,
        size_px: int = 128,
        margin_px: int = 32,
        per_scan: int = 64,
        ids: Sequence[str] | None = None,
        seed: int = 0,
    ):
        self._scans = _chosen(store if isinstance(store, Store) else open_store(store), ids)
        self._layouts_um = [scan.exposed_um for scan in self._scans]
        smallest = min(min(scan.shape) for scan in self._scans)
        if not 1 <= size_px <= smallest:
            raise InputError(
                "size_px of a patch", got=size_px, wanted=f"1 to {smallest}, the shortest side of a scan"
            )
        if margin_px < 0 or per_scan < 1:
            got = f"margin_px {margin_px}, per_scan {per_scan}"
            raise InputError(
                "patches", got=got, wanted="a margin of 0 or more, and at least one patch per scan"
            )
        self.size_px, self.margin_px, self.per_scan, self.seed = size_px, margin_px, per_scan, seed

    @property
    def ids(self) -> list[str]:
        """Return the ids of the scans from which patches are drawn."""
        return [scan.id for scan in self._scans]

    def __len__(self) -> int:
        return self.per_scan * len(self._scans)

    def __getitem__(self, index: int) -> Patch:
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = index // self.per_scan
        scan, random = self._scans[number], np.random.default_rng([self.seed, index])
        y, x = (int(random.integers(length - self.size_px + 1)) for length in scan.shape)
        window = Window(number, y, x, self.size_px)
        height_um, valid = cut(scan.height_um, window), cut(scan.usable, window)
        return Patch(
            layout_um=_tensor(cut(self._layouts_um[number], window, self.margin_px), np.float32),
            height_um=_tensor(np.where(valid, height_um, 0), np.float32),
            valid=_tensor(valid, bool),
            scan=scan.id,
            y_px=y,
            x_px=x,
        )


def _chosen(store: Store, ids: Sequence[str] | None) -> list[PrintedScan]:
    open_ids = [scan_id for scan_id in store.ids if scan_id not in store.locked_ids]
    if refused := [scan_id for scan_id in ids or () if scan_id not in open_ids]:
        got = ", ".join(f"{one} ({'locked' if one in store.locked_ids else 'unknown'})" for one in refused)
        raise InputError(
            "scans to draw patches from", got=got, wanted="scans of the store that are not locked"
        )
    wanted = [store.scan(scan_id) for scan_id in (open_ids if ids is None else ids)]
    if not wanted:
        raise InputError("patches", got="no scan", wanted="at least one scan that is not locked")
    return wanted


def _tensor(field: np.ndarray, dtype: type[Any]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(field[None], dtype=dtype))
