"""Check that the lock box holds a sixth of the scans, from different prints, and never changes."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from litho_data.foundation.errors import InputError
from litho_data.store import open_store
from litho_data.store.lock_box import field_of, ids_sha256, lock_box, locked_ids

MEASURED_IDS = [f"FOV{print_}{field}" for print_ in (1, 2, 3, 4, 6, 7) for field in (1, 2, 3, 4)]
PRINTS = [scan_id[3] for scan_id in MEASURED_IDS]


def test_a_lock_box_takes_scans_from_different_prints():
    locked = lock_box(MEASURED_IDS, PRINTS, MEASURED_IDS)
    assert len(locked) == 4
    assert len({scan_id[3] for scan_id in locked}) == 4


@pytest.mark.parametrize(("scans", "wanted"), [(1, 0), (2, 0), (3, 1), (8, 1), (24, 4)])
def test_a_lock_box_is_a_sixth_of_the_scans(scans, wanted):
    assert len(lock_box(MEASURED_IDS[:scans], PRINTS[:scans], MEASURED_IDS[:scans])) == wanted


def test_the_recorded_lock_box_of_the_measured_prints_is_the_computed_one():
    record = Path(__file__).parents[2] / "datasets" / "neural-lithography.split.toml"
    stated = tomllib.loads(record.read_text(encoding="utf-8"))["lock_box"]
    locked = lock_box(MEASURED_IDS, PRINTS, MEASURED_IDS)
    assert stated["ids"] == locked
    assert stated["sha256"] == ids_sha256(locked)


def test_the_order_of_the_scans_does_not_matter():
    assert lock_box(MEASURED_IDS[::-1], PRINTS[::-1], MEASURED_IDS[::-1]) == lock_box(
        MEASURED_IDS, PRINTS, MEASURED_IDS
    )


@pytest.mark.parametrize(("ids", "prints"), [(["a", "b"], ["1"]), (["a", "a"], ["1", "2"])])
def test_an_impossible_lock_box_is_refused(ids, prints):
    with pytest.raises(InputError):
        lock_box(ids, prints, ids)


def test_the_lock_box_takes_all_scans_of_a_field_or_none():
    ids = [f"{scan_id}{way}" for scan_id in MEASURED_IDS for way in ("", "turned", "retrace")]
    fields = [scan_id[:5] for scan_id in ids]
    locked = lock_box(ids, [scan_id[3] for scan_id in ids], fields)
    assert len(locked) == 12
    assert {field for scan_id, field in zip(ids, fields, strict=True) if scan_id not in locked}.isdisjoint(
        scan_id[:5] for scan_id in locked
    )


def test_scans_show_one_field_if_print_layout_place_and_dose_are_the_same(campaign: Path):
    scan = open_store(campaign / "prints.zarr").scans()[0]
    assert field_of(replace(scan, id="again", order=9, direction=-1.0, turned_deg=90.0)) == field_of(scan)
    other = {"print_id": "9", "dose": 1.1, "field_x_um": 5.0, "mask_level": scan.mask_level[::-1]}
    assert len({field_of(replace(scan, **{name: value})) for name, value in other.items()}) == 4
    assert field_of(scan) not in {field_of(replace(scan, **{name: value})) for name, value in other.items()}


def test_a_store_draws_its_lock_box_from_all_its_scans(campaign: Path):
    store = open_store(campaign / "prints.zarr")
    assert store.locked_ids == locked_ids(store.scans())
    assert len(store.locked_ids) == 1
