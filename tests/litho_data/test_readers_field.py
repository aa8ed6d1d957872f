"""Read files as instruments and users deliver them: packed files, unusual text, real vendor files."""

from __future__ import annotations

import gzip
import io
import os
import struct
import time
import zipfile
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from litho_data.foundation.errors import InputError
from litho_data.readers import Channel, list_channels, read_scan
from litho_data.readers.confined import parse
from tests.litho_data import afm_files
from tests.litho_data.afm_files import HEIGHT_UM, SHAPE, SIZE_UM


@pytest.mark.parametrize("suffix", ["txt", "ibw"])
def test_gzip_is_read_as_its_content(tmp_path: Path, suffix: str) -> None:
    plain = tmp_path / f"scan.{suffix}"
    if suffix == "txt":
        np.savetxt(plain, HEIGHT_UM * 1e-6)
    else:
        afm_files.write_ibw(plain, {"Height": HEIGHT_UM * 1e-6}, "")
    packed = tmp_path / f"{plain.name}.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    scan = read_scan(packed, unit="m")
    np.testing.assert_array_equal(scan.height_um, read_scan(plain, unit="m").height_um)
    assert (scan.name, scan.source) == ("scan", str(packed))
    np.testing.assert_allclose(list_channels(packed)[0].load()[0], HEIGHT_UM * 1e-6, rtol=1e-6)
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"\.gz: cannot be unpacked"):
        read_scan(packed, unit="m")


def test_npz_offers_its_maps(tmp_path: Path) -> None:
    path = tmp_path / "scan.npz"
    np.savez_compressed(path, height=HEIGHT_UM, pitch=0.2, names=np.array(["a", "b"]))
    np.testing.assert_array_equal(read_scan(path, unit="um").height_um, HEIGHT_UM)
    assert [channel.name for channel in list_channels(path)] == ["height"]
    np.savez(path, forward=HEIGHT_UM, backward=HEIGHT_UM)
    with pytest.raises(InputError, match=r"several height channels.*'forward'"):
        read_scan(path, unit="um")


@pytest.mark.parametrize("unit", ["µm", "nm"])
def test_ome_tiff_states_its_pitch(tmp_path: Path, unit: str) -> None:
    path = tmp_path / "scan.ome.tif"
    factor = 1 if unit == "µm" else 1000
    metadata = {"axes": "YX", "PhysicalSizeX": 0.2 * factor, "PhysicalSizeY": 0.5 * factor}
    if unit != "µm":  # the standard's default unit need not be stated
        metadata |= {"PhysicalSizeXUnit": unit, "PhysicalSizeYUnit": unit}
    tifffile.imwrite(path, HEIGHT_UM.astype(np.float32), ome=True, metadata=metadata)
    assert read_scan(path, unit="um").pitch_um == pytest.approx((0.5, 0.2), rel=1e-12)


def test_a_nanoscope_channel_without_calibration_does_not_hide_the_heights(tmp_path: Path) -> None:
    """Check that the file can still be read if one of its channels has no calibration in metres."""
    path = tmp_path / "scan.spm"
    afm_files.write_spm(path, np.ones(SHAPE, int), hard_v=1.0, sensitivity_nm_per_v=1.0)
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b"V [Sens. Zsens]", b"V [Sens. Phase]"))
    assert [(one.is_height, one.size_um) for one in list_channels(path)] == [(False, SIZE_UM)]


def write_jpk_series(path: Path) -> None:
    """Write an HDF5 file as JPK does. In it, x varies fastest, y points upwards, each frame has a column of
    counts, and there is a thumbnail.
    """
    ny, nx = SHAPE
    with h5py.File(path, "w") as file:
        file.attrs["file-format-info"] = np.bytes_("JPK SCAN")
        whole = file.create_group("Measurement_000")
        for key, value in {"ilength": nx, "jlength": ny, "ulength": 1.6e-6, "vlength": 2.5e-6}.items():
            whole.attrs[f"position-pattern.grid.{key}"] = value
        j, i = np.divmod(np.arange(nx * ny), nx)
        whole["Position_Indices"] = np.stack([i, j], axis=1).astype("u4")
        channel = whole.create_group("Channel_000")
        channel.attrs["channel.fancy-name"] = np.bytes_("Height")
        channel.attrs["net-encoder.scaling.unit.unit"] = np.bytes_("m")
        channel.attrs["net-encoder.scaling.multiplier"] = -1e-9
        channel.attrs["net-encoder.scaling.offset"] = 5e-7
        counts = np.round((0.5 - HEIGHT_UM[::-1]) * 1000).astype(int).ravel()
        channel["Height"] = np.stack([counts, 2 * counts], axis=1)
        channel["thumbnail"] = np.zeros((16, 1))


def test_a_series_of_jpk_images(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5-jpk"
    write_jpk_series(path)
    assert [one.name for one in list_channels(path)] == ["Height, frame 1", "Height, frame 2"]
    scan = read_scan(path, channel="Height, frame 1")
    np.testing.assert_allclose(scan.height_um, HEIGHT_UM, atol=1e-12)
    assert scan.pitch_um == pytest.approx((0.5, 0.2))


def _height(path: Path, load) -> list[Channel]:
    return [Channel(name="height", shape=(2, 2), unit="m", size_um=None, load=load)]


def _endless(path: Path) -> list[Channel]:
    while True:
        pass


def _greedy(path: Path) -> list[Channel]:
    raise InputError(f"got {len(bytearray(1 << 31))} bytes")


def _asleep(path: Path) -> list[Channel]:
    time.sleep(60)
    return []


def _crash(path: Path) -> list[Channel]:
    os.abort()


def _whole(path: Path) -> list[Channel]:
    return _height(path, partial(np.full, (1, 2, 2), 7.0))


def test_a_parser_that_crashes_or_never_ends_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("litho_data.readers.confined._COMPUTING_S", 0.3)
    path = tmp_path / "scan"
    path.write_bytes(b"1")
    start = time.process_time()
    for parser, message in (
        (_endless, "after 0 s of computing"),
        (_asleep, "after 0 s of computing"),
        (_crash, "crashed"),
        (_greedy, "memory"),
    ):
        # On a busy machine the start may take minutes. Only the sleeping parser has to exceed the limit.
        waiting = 2 if parser is _asleep else 500
        monkeypatch.setattr("litho_data.readers.confined._WAITING_PER_COMPUTING", waiting)
        with pytest.raises(InputError, match=message):
            parse(partial(parser, path), path, "toy", ("json",))
        monkeypatch.setattr("litho_data.readers.confined._WAITING_PER_COMPUTING", 500)
        # The next file can still be read.
        found = parse(partial(_whole, path), path, "toy", ("json",))
        assert parse(found[0].load, path, "toy", ("json",))[0, 0, 0] == 7
    assert time.process_time() - start < 2


# For each real file: the number of height channels, (ny, nx), the unit, and the size (y, x) in µm.
INTACT = {
    "10x10-one_channel_without_name.ibw": (1, (10, 10), None, None),
    "al3d-1.al3d": (1, (296, 200), "m", (296 * 0.438027, 200 * 0.438027)),
    "di-1.di": (2, (512, 512), "nm", (0.5, 0.5)),
    "di-4.di": (2, (512, 512), "nm", (10.0, 10.0)),
    "gwyddion-export-english.txt": (1, (4, 3), "m", (5.6789, 12.34)),
    "gwyddion-export-german.txt": (1, (4, 3), "m", (5.6789, 12.34)),
    "matrix-4.txt.gz": (1, (305, 75), "m", (305 * 0.369862, 75 * 0.369862)),
    "matrix-5.txt": (1, (10, 10), None, None),
    "matrix-6.txt": (1, (3, 4), "m", (10.0, 10.0)),
    "mi-1.mi": (1, (256, 256), "µm", (20.0, 20.0)),
    "mnt-1.mnt": (1, (600, 960), "µm", (600 * 1.8545542570951588, 960 * 1.853393117831074)),
    "multiple_data_sets.h5": (2, (256, 256), None, None),
    "nid-1.nid": (4, (256, 256), "m", (20.0, 20.0)),
    "opd-1.opd": (1, (480, 640), "mm", (480 * 0.19673303, 640 * 0.19673303)),
    "plu-1.plu": (1, (576, 768), "µm", (576 * 1.66, 768 * 1.66)),
    "sample_0.h5-jpk": (28, (128, 128), "m", (0.15, 0.15)),
    "sample_0.jpk": (6, (256, 256), "m", (0.326916514, 0.326916514)),
    "sample_0.stp": (1, (512, 512), "nm", (0.5, 0.5)),
    "sample_0.top": (1, (512, 512), "nm", (0.5, 0.5)),
    "sample_0_2.topostats": (2, (64, 64), "nm", (64 * 1.97601171875e-3, 64 * 1.97601171875e-3)),
    "sur-3.sur": (1, (512, 512), "m", (512 * 295.546, 512 * 295.546)),
    "tmd-1.tmd": (1, (300, 300), "mm", (18956.6002, 18956.6002)),
    "x3p-2.x3p": (1, (650, 650), "m", (650 * 0.314582113527746, 650 * 0.127656509837346)),
}
REFUSED = {
    "damaged_header.ibw": "as ibw, got 804 bytes.*may be damaged",
    "di_corrupted.di": "as di.*not large enough.*may be damaged",
    "nonuniform.asc": "holds a profile",
    "xy-1.txt": "holds a profile",
    "xyz-1.txt": "holds a point cloud",
    "xyz-2.txt": "holds a point cloud",
}


@pytest.mark.oracle
def test_real_files_of_vendors(oracles: Path) -> None:
    folder = oracles / "vendor"
    assert {path.name for path in folder.iterdir()} == {*INTACT, *REFUSED, "README.md", "reference.npz"}
    for name, (count, shape, unit, size_um) in INTACT.items():
        heights = [channel for channel in list_channels(folder / name) if channel.is_height]
        first = heights[0]
        assert (name, len(heights), first.shape, first.unit) == (name, count, shape, unit)
        # The files state their sizes with six digits or more.
        assert first.size_um == (pytest.approx(size_um, rel=2e-6) if size_um else None)
        values, _ = first.load()
        assert values.shape == shape
        # The Digital Surf file marks nine tenths of its pixels as unmeasured.
        assert np.isfinite(values).mean() > 0.1
    for name, message in REFUSED.items():
        with pytest.raises(InputError, match=message):
            list_channels(folder / name)


@pytest.mark.oracle
def test_real_files_agree_with_another_reader(oracles: Path) -> None:
    """Compare every 8th pixel with AFMReader 0.0.7, whose WSxM maps are first rotated by 180°.

    An example at https://spmimages.ftmc.uam.es/file-specifications shows one WSxM image as a matrix and as
    points. The first number of the matrix belongs to the point with the largest x and the smallest y. WSxM
    therefore writes numbers in the order of decreasing x and increasing y. This point is the lower right
    pixel, but AFMReader puts it at the upper left.
    """
    reference = np.load(oracles / "vendor" / "reference.npz")
    for name, channel, key, turned in (
        ("sample_0.jpk", "Height", "jpk", False),
        ("sample_0.jpk", "Height (measured)", "jpkm", False),
        ("sample_0.stp", None, "stp", True),
    ):
        scan = read_scan(oracles / "vendor" / name, channel=channel)
        height_um = scan.height_um[::-1, ::-1] if turned else scan.height_um
        expected_um = reference[f"{key}_nm_every_8px"] * 1e-3
        np.testing.assert_allclose(height_um[::8, ::8], expected_um, rtol=1e-12, atol=1e-15)
        assert scan.require_pitch()[1] == pytest.approx(float(reference[f"{key}_nm_per_px"]) * 1e-3)


@pytest.mark.parametrize("format", ["gsf", "npy", "npz", "gwy", "h5"])
def test_a_declared_size_without_the_pixels_is_one_line(tmp_path: Path, format: str) -> None:
    """Check files whose header declares 16000 × 16000 pixels (1 GB) that the file does not contain."""
    path, side = tmp_path / f"scan.{format}", 16_000
    header = io.BytesIO()
    shape = {"descr": "<f4", "fortran_order": False, "shape": (side, side)}
    np.lib.format.write_array_header_1_0(header, shape)
    if format == "gsf":
        path.write_bytes(b"Gwyddion Simple Field 1.0\nXRes = 16000\nYRes = 16000\n\0\0\0\0" + bytes(400))
    elif format == "npy":
        path.write_bytes(header.getvalue() + bytes(800))
    elif format == "npz":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("height.npy", header.getvalue() + bytes(800))
    elif format == "gwy":
        numbers = [f"{key}\0i".encode() + struct.pack("<i", side) for key in ("xres", "yres")]
        field = b"".join([*numbers, b"data\0D" + struct.pack("<I", 50) + bytes(400)])
        entry = b"/0/data\0oGwyDataField\0" + struct.pack("<I", len(field)) + field
        path.write_bytes(b"GWYPGwyContainer\0" + struct.pack("<I", len(entry)) + entry)
    else:
        with h5py.File(path, "w") as file:
            file.create_dataset("height", shape=(side, side), chunks=(1000, 1000), dtype="f4")
    with pytest.raises(InputError) as caught:
        read_scan(path, unit="m", size_um=(1.0, 1.0))
    assert "\n" not in str(caught.value)
