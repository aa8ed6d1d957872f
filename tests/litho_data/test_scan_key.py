"""Check that a change of any field of a scan changes its key."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from litho_data.register.bend import Bend
from litho_data.store.printed_scan import PrintedScan, scan_sha256
from litho_data.virtual_fab.jobs import Job
from litho_data.virtual_fab.simulate import _described

SHAPE, LEVELS = (6, 5), 13


def whole_scan() -> PrintedScan:
    """Return a scan in which every optional field is set."""
    rng = np.random.default_rng(0)
    return PrintedScan(
        id="P11", print_id="P1", order=3,
        mask_level=rng.integers(0, LEVELS, SHAPE).astype(np.uint8),
        height_um=rng.random(SHAPE).astype(np.float32),
        valid=rng.random(SHAPE) > 0.2,
        pitch_um=0.1, level_height_um=0.1, levels=LEVELS,
        scan_to_layout=np.eye(3),
        write={"slow_axis": "y", "field_um": 200.0},
        field_x_um=10.0, field_y_um=-20.0, dose=1.0,
        turned_deg=90.0, direction=1.0, tip=1.0, pixel_size=1.0,
        bend_um=Bend(np.full((2, 3), 0.01), np.array([0.3, 0.25]), np.array([0.3, 0.25])),
        tip_radius_um=0.02,
        height_sigma_um=rng.random(SHAPE).astype(np.float32),
    )  # fmt: skip


def otherwise(value: Any) -> list[Any]:
    """Return different values of the same type, for example the next number or a rotated array."""
    if isinstance(value, np.ndarray):
        one, moved = value.copy(), value[::-1, ::-1].copy()
        one.flat[-1] = ~one.flat[-1] if one.dtype == bool else np.asarray(one.flat[-1] + 1, one.dtype)
        return [one, moved, value.T.copy()] if value.shape == SHAPE else [one]
    if isinstance(value, Bend):
        return [
            Bend(value.amount * 2, value.middle, value.half),
            Bend(value.amount, value.half * 2, value.half),
        ]
    if isinstance(value, dict):
        return [None, {**value, "slow_axis": "x"}, {**value, "field_um": 201.0}]
    if isinstance(value, float):
        return [float(np.nextafter(value, np.inf))]
    if isinstance(value, int):
        return [value + 1]
    assert isinstance(value, str), f"add another value of type {type(value).__name__} to otherwise()"
    return [value + "x"]


def test_every_field_of_a_scan_is_in_its_key() -> None:
    scan = whole_scan()
    stated = {one.name: getattr(scan, one.name) for one in fields(PrintedScan)}
    assert not [name for name, value in stated.items() if value is None], "give new fields a value above"
    known = {scan_sha256(scan)}
    for name, value in stated.items():
        for other in otherwise(value):
            key = scan_sha256(replace(scan, **{name: other}))
            assert key not in known, f"{name} is not in the key"
            known.add(key)
    unsaid = {one.name for one in fields(PrintedScan) if one.default is None}
    for name in unsaid:
        left_out: dict[str, Any] = {name: None}
        assert scan_sha256(replace(scan, **left_out)) != scan_sha256(scan)


def test_the_key_does_not_depend_on_the_memory_layout_of_an_array() -> None:
    scan = whole_scan()
    turned = replace(scan, height_um=np.asfortranarray(scan.height_um))
    assert scan_sha256(turned) == scan_sha256(scan)


@pytest.mark.parametrize("name", [one.name for one in fields(Job)])
def test_every_field_of_own_layouts_affects_the_result_of_the_fab(name: str) -> None:
    """Check that jobs that differ in one field are described differently."""
    rng = np.random.default_rng(1)
    job = Job(id="P11", level=rng.integers(0, LEVELS, SHAPE).astype(np.uint8))
    value = getattr(job, name)
    other: dict[str, Any] = {name: value[::-1].copy() if name == "level" else None}
    if isinstance(value, tuple):
        other[name] = tuple(one + 1 for one in value)
    elif name != "level":
        other[name] = f"{value}x" if isinstance(value, str) else (value or 0) + 1
    assert _described(replace(job, **other)) != _described(job)
