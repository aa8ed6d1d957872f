"""Check that 200 maps of many formats, units, axes, marks and channels are read correctly or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.readers import read_scan
from litho_data.scan import Scan
from tests.litho_data import afm_files
from tests.litho_data.map_files import (
    WRITERS,
    MapFile,
    Writer,
    bcr,
    digital_surf,
    gsf,
    hdf5,
    matlab,
    netcdf,
    nhf,
    numpy_archive,
    park,
    random_map,
    sdf,
    surfer,
    text,
    tiff,
    wyko,
)
from tests.litho_data.test_readers_field import INTACT

FILES = 200


def made(path: Path, seed: int) -> MapFile:
    """Write the map file for a seed and return its description.

    Some maps have missing pixels, marked by a number, by a word or not at all.
    """
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
            # First try the reader with the file only, as a new user would.
            if differs(read_scan(path), one) or one.asks:
                wrong.append(f"{what}: read wrongly without arguments")
        except InputError as error:
            if not one.asks:
                wrong.append(f"{what}: {error}")
        try:
            scan = read_scan(path, **one.arguments)
            if differs(scan, one) or (one.says_size and scan.pitch_um is None):
                wrong.append(f"{what}: {scan!r}, {scan.pitch_um}")
        except InputError as error:
            wrong.append(f"{what}: refused with the required arguments: {error}")
    assert not wrong, f"{len(wrong)} of {FILES}:\n" + "\n".join(wrong)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_comparison_finds_a_turned_map_and_a_wrong_unit(tmp_path: Path, seed: int) -> None:
    """Check that the comparison notices a flipped map and a map in the wrong unit."""
    one = made(tmp_path / "scan", seed)
    scan = read_scan(tmp_path / "scan", **one.arguments)
    assert not differs(scan, one)
    one.height_um = one.height_um[::-1] if seed else one.height_um * 1e-3
    assert differs(scan, one)


# The first words of each row of the page's table, with its writer here or with another test of real files.
TRIED = {
    "text": text, "Surfer grids": surfer, "Wyko ASCII": wyko, "TIFF": tiff, "GSF": gsf,
    "NPY": numpy_archive, "NPZ": numpy_archive, "GWY": afm_files.write_gwy, "IBW": afm_files.write_ibw,
    "HDF5 of JPK": nhf, "HDF5 of any": hdf5,
    "SPM": afm_files.write_spm, "SUR, MNT": digital_surf, "JPK": afm_files.write_jpk, "Park Systems": park,
    "X3P": afm_files.write_x3p, "SDF": sdf, "BCR": bcr, "STP, TOP": INTACT, "PNG, BMP": "test_readers_layout",
}  # fmt: skip


def test_every_format_of_the_page_is_tested_with_a_file() -> None:
    page = (Path(__file__).parents[2] / "docs" / "readers.md").read_text(encoding="utf-8")
    table = page.split("| tested with |\n")[1].split("\n\n")[0].splitlines()[1:]
    rows = [row.split("|")[1].strip() for row in table]
    assert len(rows) == len(TRIED)
    assert all(any(row.startswith(start) for start in TRIED) for row in rows)
    real = {"stp", "top", "nid", "mi", "opd", "plu", "al3d", "tmd"}
    assert real <= {Path(name).suffix[1:] for name in INTACT}


@pytest.mark.parametrize(
    ("writer", "format"),
    [
        (text, "text-matrix"), (surfer, "surfer"), (wyko, "wyko"), (tiff, "tiff"), (gsf, "gsf"),
        (nhf, "hdf5"), (hdf5, "hdf5"), (netcdf, "netcdf"), (matlab, "matlab"), (digital_surf, "vendor"),
        (park, "vendor"), (sdf, "vendor"), (bcr, "vendor"),
    ],
)  # fmt: skip
def test_a_file_is_given_to_the_reader_of_its_format(tmp_path: Path, writer: Writer, format: str) -> None:
    rng = np.random.default_rng(3)
    one = MapFile(random_map(rng), 0.2, "um")
    writer(tmp_path / "scan", one, rng)
    scan = read_scan(tmp_path / "scan", **one.arguments)
    assert scan.format == format
    assert not differs(scan, one)
    # The coordinates of a Surfer grid have no unit.
    assert [note.partition(";")[0] for note in scan.notes] == ["its coordinates have no unit"] * (
        format == "surfer"
    )
