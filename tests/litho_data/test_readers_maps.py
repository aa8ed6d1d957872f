"""A map is right or refused: 200 files of other programs, formats × unit × axes × missing × channels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.readers import read_scan
from litho_data.scan import Scan
from tests.litho_data.map_files import WRITERS, MapFile, random_map

FILES = 200


def made(path: Path, seed: int) -> MapFile:
    """The file of a seed; some maps have missing pixels, marked by a number or a word or not at all."""
    rng = np.random.default_rng(seed)
    height_um, mark = random_map(rng), None
    if rng.random() < 0.4:
        height_um[rng.integers(3, height_um.shape[0], 4), rng.integers(3, height_um.shape[1], 4)] = np.nan
        mark = [None, -9999.0, -32768.0, "Bad", "--", 1.70141e38][rng.integers(6)]
    one = MapFile(height_um, float(rng.choice([0.1, 0.2, 0.35])), str(rng.choice(["um", "nm", "m"])), mark)
    WRITERS[seed % len(WRITERS)](path, one, rng)
    return one


def differs(scan: Scan, one: MapFile) -> bool:
    same_map = scan.shape == one.height_um.shape and np.allclose(
        scan.height_um, one.height_um, rtol=1e-6, atol=one.atol_um, equal_nan=True
    )
    pitch_um = None if np.isnan(one.pitch_um) else scan.pitch_um
    return not same_map or (pitch_um is not None and not np.allclose(pitch_um, one.pitch_um, rtol=1e-5))


def test_no_file_is_read_wrongly_without_a_word(tmp_path: Path) -> None:
    wrong = []
    for seed in range(FILES):
        path = tmp_path / f"scan{seed}"
        one = made(path, seed)
        what = f"{seed} {WRITERS[seed % len(WRITERS)].__name__} {one.unit} {one.mark} {one.arguments}"
        try:
            # As a newcomer: with nothing but the file.
            if differs(read_scan(path), one) or one.asks:
                wrong.append(f"{what}: read as it is, wrongly")
        except InputError as error:
            if not one.asks:
                wrong.append(f"{what}: {error}")
        try:
            scan = read_scan(path, **one.arguments)
            if differs(scan, one) or (one.says_size and scan.pitch_um is None):
                wrong.append(f"{what}: {scan!r}, {scan.pitch_um}")
        except InputError as error:
            wrong.append(f"{what}: with what it asks for {error}")
    assert not wrong, f"{len(wrong)} of {FILES}:\n" + "\n".join(wrong)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_law_can_fail(tmp_path: Path, seed: int) -> None:
    """A map that is turned, or whose unit is not that of the file, differs."""
    one = made(tmp_path / "scan", seed)
    scan = read_scan(tmp_path / "scan", **one.arguments)
    assert not differs(scan, one)
    one.height_um = one.height_um[::-1] if seed else one.height_um * 1e-3
    assert differs(scan, one)
