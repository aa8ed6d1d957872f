"""Check that patches are parts of scans at the stated positions, and never parts of locked scans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader

from litho_data.foundation.errors import InputError
from litho_data.store import Store, open_store
from litho_models import PatchDataset
from tests.litho_models.prints import make_scans, write_store
from tests.tensors import assert_close

SIZE_PX, MARGIN_PX = 48, 8


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    scans = [replace(scan, dose=1.2) for scan in make_scans(6, 128)]
    random = np.random.default_rng(0)
    for scan in scans:
        scan.valid[:] = random.random(scan.shape) < 0.9
        scan.height_um[random.random(scan.shape) < 0.1] = np.nan
    return open_store(write_store(tmp_path_factory.mktemp("patches") / "prints.zarr", scans))


def test_a_patch_is_the_piece_of_the_scan_that_it_names(store: Store) -> None:
    patches = PatchDataset(store, size_px=SIZE_PX, margin_px=MARGIN_PX, per_scan=5)
    assert len(patches) == 5 * len(patches.ids)
    for index in range(len(patches)):
        patch = patches[index]
        scan = store.scan(patch["scan"])
        rows, columns = (slice(start, start + SIZE_PX) for start in (patch["y_px"], patch["x_px"]))
        height, valid = scan.height_um[rows, columns], patch["valid"][0].numpy()
        assert 0 < valid.sum() < valid.size
        np.testing.assert_array_equal(valid, scan.valid[rows, columns] & np.isfinite(height))
        np.testing.assert_array_equal(patch["height_um"][0].numpy()[valid], height[valid])
        assert not patch["height_um"][0].numpy()[~valid].any()
        inside = patch["layout_um"][0, MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        np.testing.assert_array_equal(inside.numpy(), np.float32(1.2) * scan.layout_um[rows, columns])


def test_locked_scans_are_never_drawn(store: Store) -> None:
    assert store.locked_ids
    assert set(PatchDataset(store, size_px=SIZE_PX).ids) == set(store.ids) - set(store.locked_ids)
    with pytest.raises(InputError, match="locked"):
        PatchDataset(store, size_px=SIZE_PX, ids=[store.locked_ids[0]])


def test_the_same_seed_draws_the_same_and_batches_in_order(store: Store) -> None:
    first, second = (PatchDataset(store, size_px=SIZE_PX, seed=3) for _ in range(2))
    other = PatchDataset(store, size_px=SIZE_PX, seed=4)
    assert first[7]["y_px"] == second[7]["y_px"]
    places = [[(patches[i]["y_px"], patches[i]["x_px"]) for i in range(20)] for patches in (first, other)]
    assert places[0] != places[1]
    batch = next(iter(DataLoader(first, batch_size=4)))
    assert batch["layout_um"].shape == (4, 1, SIZE_PX + 64, SIZE_PX + 64)
    assert_close(batch["height_um"][2], first[2]["height_um"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"size_px": 129}, "1 to 128"), ({"ids": ["nobody"]}, "unknown"), ({"margin_px": -1}, "margin")],
)
def test_what_cannot_be_drawn_is_one_line(store: Store, settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PatchDataset(store, **{"size_px": SIZE_PX, **settings})


def test_a_path_is_accepted_in_place_of_a_store(store: Store) -> None:
    assert PatchDataset(Path(store.path), size_px=SIZE_PX).ids == PatchDataset(store, size_px=SIZE_PX).ids
