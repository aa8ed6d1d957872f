"""Test the marks that are found in raw files and scans without a model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from litho_data.store import Store, open_store
from litho_models.loop.marks import rounding, rounding_step_um, scars
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.record import ScanFinding
from tests.litho_models.loop_scans import blank_scans, with_heights
from tests.litho_models.prints import write_store

HEIGHTS = np.random.default_rng(0).normal(0.5, 0.1, size=(80, 90))
# The transform of a scan that is rotated by 90°, so that its lines lie along y.
TURNED = np.array([[0.0, -1.0, 19.2], [1.0, 0.0, 0.0], [0, 0, 1]])


@pytest.mark.parametrize("step_um", [0.001, 0.0268])
def test_the_step_of_rounded_heights_is_read_off(step_um: float) -> None:
    rounded = (np.floor(HEIGHTS / step_um) * step_um + 0.0123).astype(np.float32)
    # A float32 of 1 µm is exact to 6e-8 µm, so a step of 1 nm is known to 1e-4 or better.
    assert rounding_step_um(rounded) == pytest.approx(step_um, rel=1e-3)


def test_heights_that_were_not_rounded_have_no_step() -> None:
    assert rounding_step_um(HEIGHTS.astype(np.float32)) == 0.0
    assert rounding_step_um(np.full((4, 4), np.nan)) == 0.0
    assert rounding_step_um(np.zeros((4, 4))) == 0.0


def test_rounding_counts_by_the_noise_it_adds() -> None:
    def of(step_um: float) -> ScanFinding:
        raw = np.round(HEIGHTS / step_um) * step_um if step_um else HEIGHTS
        store = cast(Store, SimpleNamespace(scan_frame=lambda scan_id, name: raw))
        [found] = rounding(store, blank_scans(2))
        return found

    # Rounding to steps of q adds a variance of q² / 12.
    coarse, fine, none = (of(step_um * np.sqrt(12)) for step_um in (0.012, 0.0001, 0.0))
    assert coarse.seen
    assert "12 nm rms" in coarse.evidence
    assert not fine.seen
    assert not none.seen


def test_without_raw_files_nothing_is_said_about_rounding(tmp_path: Path) -> None:
    scans = blank_scans(2)
    assert rounding(open_store(write_store(tmp_path / "s.zarr", scans)), scans) == []


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("along", [True, False])
def test_scars_are_told_from_marks_across_the_lines(along: bool, turned: bool) -> None:
    grain = 0.05 * (HEIGHTS[:64, :64] - 0.5)
    for start in (12, 30, 44):
        long, short = slice(start, start + 14), slice(start, start + 1)
        grain[(short, long) if along != turned else (long, short)] += 0.2
    scans = blank_scans(10, 64)
    if turned:
        scans = [replace(scan, scan_to_layout=TURNED) for scan in scans]
    one = scars(prepare_scans(with_heights(scans, [grain] * 10)), [np.zeros(grain.shape)] * 10)
    assert one.seen is along
    assert ("30 outliers are elongated along the scan lines and 0 " in one.evidence) is along
