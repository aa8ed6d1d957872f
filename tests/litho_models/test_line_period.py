"""Lines that repeat are reported with their period; lines that do not have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from litho_models.twin.prepared import PreparedScan, prepare_scans
from litho_models.loop.single_scans.line_period import period_of_lines
from tests.litho_models.loop_scans import printed_scans

SIZE_PX = 160


def striped(
    seed: int, hum_um: float, stripes_um: float = 0.003
) -> tuple[list[PreparedScan], list[np.ndarray]]:
    """Ten scans with random line offsets and a hum of 1.3 µm period, its phase another in every scan."""
    random = np.random.default_rng(seed)
    plain = printed_scans(count=10, size_px=SIZE_PX, seed=seed)
    scans = []
    for scan in plain:
        phase = 2 * np.pi * (np.arange(SIZE_PX) / 13 + random.random())
        lines = hum_um * np.sin(phase) + stripes_um * random.normal(size=SIZE_PX)
        scans.append(replace(scan, height_um=(scan.height_um + lines[:, None]).astype(np.float32)))
    return prepare_scans(scans), [scan.height_um for scan in plain]


def test_a_hum_is_found_with_its_period() -> None:
    scans, clean = striped(1, hum_um=0.004)
    found = period_of_lines(scans, clean, [scan.line for scan in scans])
    assert found is not None
    # A bin of the spectrum is 1.3 µm · 1.3 / 16 = 0.1 µm wide; its centre of mass is known better.
    assert found.period_um == pytest.approx(1.3, abs=0.05)
    # 4² / 2 = 8 nm² of hum beside 3² = 9 nm² of chance.
    assert found.share == pytest.approx(8 / 17, abs=0.15)


@pytest.mark.parametrize("seed", range(4))
def test_random_lines_have_no_period(seed: int) -> None:
    scans, clean = striped(seed, hum_um=0.0)
    assert period_of_lines(scans, clean, [scan.line for scan in scans]) is None
