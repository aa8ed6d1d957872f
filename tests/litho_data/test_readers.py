"""Check that every reader returns the same asymmetric map with correct orientation, scale, pitch and unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from litho_data.foundation.errors import InputError
from litho_data.readers import list_channels, read_layout, read_scan
from tests.litho_data import afm_files
from tests.litho_data.afm_files import HEIGHT_UM, SHAPE, SIZE_UM

PITCH_UM = (SIZE_UM[0] / SHAPE[0], SIZE_UM[1] / SHAPE[1])


@pytest.mark.parametrize(("compression", "colours"), [("lzw", True), ("lzw", False), ("packbits", False)])
def test_tiff_of_integers_takes_a_full_scale(tmp_path: Path, compression: str, colours: bool) -> None:
    path = tmp_path / "scan.tif"
    counts = np.round(HEIGHT_UM / 0.5 * 255).astype(np.uint8)
    pixels = np.repeat(counts[..., None], 3, axis=2) if colours else counts
    tifffile.imwrite(path, pixels, compression=compression, photometric="rgb" if colours else "minisblack")
    scan = read_scan(path, full_scale_um=0.5)
    np.testing.assert_array_equal(np.round(scan.height_um / 0.5 * 255), counts)
    assert scan.pitch_um is None


def test_imagej_tiff_states_its_pitch(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    resolution = (1 / PITCH_UM[1], 1 / PITCH_UM[0])
    values = HEIGHT_UM.astype(np.float32)
    tifffile.imwrite(path, values, imagej=True, resolution=resolution, metadata={"unit": "um"})
    # A rational number in TIFF has a 32-bit numerator and denominator.
    assert read_scan(path, unit="um").pitch_um == pytest.approx(PITCH_UM, rel=1e-6)


def test_resolution_in_dots_per_inch_is_not_a_pitch(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    tifffile.imwrite(path, HEIGHT_UM.astype(np.float32), resolution=(72, 72), resolutionunit="inch")
    assert read_scan(path, unit="um").pitch_um is None


def test_npy(tmp_path: Path) -> None:
    path = tmp_path / "scan"
    with path.open("wb") as stream:
        np.save(stream, np.asfortranarray(HEIGHT_UM))
    scan = read_scan(path, unit="µm", size_um=SIZE_UM)
    np.testing.assert_array_equal(scan.height_um, HEIGHT_UM)
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-12)


@pytest.mark.parametrize("title", ["a", "ab", "abc", "abcd"])
def test_gsf_at_every_padding(tmp_path: Path, title: str) -> None:
    path = tmp_path / "scan.gsf"
    header = {"XReal": "1.6e-6", "YReal": "2.5e-6", "XYUnits": "m", "ZUnits": "m", "Title": title}
    afm_files.write_gsf(path, HEIGHT_UM * 1e-6, header)
    scan = read_scan(path)
    np.testing.assert_allclose(scan.height_um, HEIGHT_UM, rtol=1e-7)  # float32
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-12)
    assert scan.channel == title
    assert scan.header["XReal"] == "1.6e-6"


def test_gsf_without_units_states_neither_pitch_nor_height(tmp_path: Path) -> None:
    path = tmp_path / "scan.gsf"
    afm_files.write_gsf(path, HEIGHT_UM, {"XReal": "1", "YReal": "1"})
    with pytest.raises(InputError, match="does not state the unit"):
        read_scan(path)
    scan = read_scan(path, unit="um")
    assert scan.pitch_um is None
    with pytest.raises(InputError, match="no pixel pitch"):
        scan.require_pitch()


def test_gwy_keeps_the_mask_and_the_heights_under_it(tmp_path: Path) -> None:
    path = tmp_path / "scan.gwy"
    mask = HEIGHT_UM > 0.03
    channels = {"Topography": (HEIGHT_UM * 1e-6, "m"), "Phase": (HEIGHT_UM, "deg")}
    afm_files.write_gwy(path, channels, mask)
    scan = read_scan(path)
    np.testing.assert_allclose(scan.height_um, HEIGHT_UM, rtol=1e-15)
    np.testing.assert_array_equal(scan.mask, mask)
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-12)
    assert scan.header == {"Scan rate": "1.5 Hz"}
    assert [channel.name for channel in list_channels(path)] == ["Topography", "Phase"]


def test_bruker_spm(tmp_path: Path) -> None:
    path = tmp_path / "scan.spm"
    counts = np.round(HEIGHT_UM * 40000).astype(int)
    afm_files.write_spm(path, counts, hard_v=65.536, sensitivity_nm_per_v=25.0)
    scan = read_scan(path)
    # Height = counts · hard scale / 2^16 · sensitivity = counts · 0.001 V · 25 nm/V.
    np.testing.assert_allclose(scan.height_um, counts * 0.025e-3, rtol=1e-12)
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-12)
    assert scan.channel == "Height"
    assert scan.header["Ciao image list/Bytes/pixel"] == "2"
    assert scan.header["Ciao scan list/@Sens. Zsens"] == "V 25.0 nm/V"


def test_digital_surf(tmp_path: Path) -> None:
    path = tmp_path / "scan.sur"
    counts = np.round(HEIGHT_UM * 100000).astype(int)
    afm_files.write_sur(path, counts, height_per_count_um=1e-5)
    scan = read_scan(path)
    np.testing.assert_allclose(scan.height_um, counts * 1e-5, rtol=1e-7)  # the scale is a float32
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-7)


def test_jpk_takes_the_default_slot(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    counts = np.round(HEIGHT_UM * 40000).astype(int)
    afm_files.write_jpk(path, counts)
    scan = read_scan(path)
    assert scan.format == "vendor"
    # The default slot states 0.25 nm per count and an offset of 5 nm; the first slot states 3 nm and 7 nm.
    np.testing.assert_allclose(scan.height_um, 0.005 + 0.25e-3 * counts, rtol=1e-12)
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-12)
    assert scan.channel == "Height (measured)"


def test_x3p(tmp_path: Path) -> None:
    path = tmp_path / "scan.zip"
    afm_files.write_x3p(path, HEIGHT_UM * 1e-6)
    scan = read_scan(path)
    np.testing.assert_allclose(scan.height_um, HEIGHT_UM, rtol=1e-15)
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-12)


def test_asylum_ibw_with_several_channels(tmp_path: Path) -> None:
    path = tmp_path / "scan.ibw"
    channels = {"HeightTrace": HEIGHT_UM * 1e-6, "ZSensorTrace": 2e-6 * HEIGHT_UM}
    afm_files.write_ibw(path, channels, "ScanAngle: 180\rFastScanSize: 1.6e-06\r")
    with pytest.raises(InputError, match=r"several height channels.*'HeightTrace'.*'ZSensorTrace'"):
        read_scan(path)
    scan = read_scan(path, channel="ZSensorTrace")
    np.testing.assert_allclose(scan.height_um, 2 * HEIGHT_UM, rtol=1e-7)  # float32
    assert scan.pitch_um == pytest.approx(PITCH_UM, rel=1e-12)
    assert scan.fast_axis == "x"
    assert scan.header["FastScanSize"] == "1.6e-06"


def test_an_angle_other_than_0_leaves_the_fast_axis_to_the_caller(tmp_path: Path) -> None:
    path = tmp_path / "scan.ibw"
    afm_files.write_ibw(path, {"HeightTrace": HEIGHT_UM * 1e-6}, "ScanAngle: 90\r")
    assert read_scan(path).fast_axis is None
    assert read_scan(path, fast_axis="y").fast_axis == "y"


def test_channels_of_one_name_are_numbered(tmp_path: Path) -> None:
    path = tmp_path / "scan.ibw"
    afm_files.write_ibw(path, {"Height": HEIGHT_UM * 1e-6, "Height ": HEIGHT_UM * 2e-6}, "")
    names = [channel.name for channel in list_channels(path)]
    assert len(set(names)) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "does not state the unit"),
        ({"unit": "furlong"}, "unit of length.*'furlong'"),
        ({"unit": "A"}, "unit of length.*'A'"),
        ({"unit": "um", "size_um": (0.0, 1.0)}, "size_um"),
        ({"unit": "um", "size_um": (float("nan"), 1.0)}, "size_um"),
        ({"unit": "um", "channel": "Phase"}, "channel, got 'Phase', wanted one of 'height'"),
        ({"unit": "um", "fast_axis": "z"}, "fast axis"),
        ({"unit": "um", "format": "xls"}, "scan format"),
        (
            {"unit": "km"},
            "heights in µm, converted from unit 'km', got .*, wanted a number from -100000 to 100000 µm",
        ),
        ({"full_scale_um": 1.0}, "full scale"),
    ],
)
def test_wrong_arguments_of_a_reader_are_named(tmp_path: Path, arguments: dict, message: str) -> None:
    path = tmp_path / "scan.txt"
    np.savetxt(path, HEIGHT_UM)
    with pytest.raises(InputError, match=message):
        read_scan(path, **arguments)


def test_arguments_that_contradict_the_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.gwy"
    afm_files.write_gwy(path, {"Topography": (HEIGHT_UM * 1e-6, "m"), "Phase": (HEIGHT_UM, "deg")})
    with pytest.raises(InputError, match=r"unit.*'nm'.*'m' as in the file"):
        read_scan(path, unit="nm")
    with pytest.raises(InputError, match="size_um"):
        read_scan(path, size_um=(SIZE_UM[0], SIZE_UM[1] * 1.01))
    with pytest.raises(InputError, match="'Phase' does not contain heights"):
        read_scan(path, channel="Phase")
    assert read_scan(path, unit="m", size_um=SIZE_UM).pitch_um == pytest.approx(PITCH_UM)
    # If the arguments are only defaults for many files, what the file states takes precedence.
    scan = read_scan(path, unit="nm", size_um=(9.0, 9.0), defaults=["unit", "size_um"])
    assert (scan.unit, scan.pitch_um) == ("m", pytest.approx(PITCH_UM))
    assert [note.split(",")[0] for note in scan.notes] == ["heights in m", "size 2.5 × 1.6 µm"]
    assert read_scan(path, unit="m", size_um=(9.0, 9.0), defaults=["size_um"]).pitch_um == scan.pitch_um
    with pytest.raises(InputError, match=r"unit.*'nm'.*'m' as in the file"):
        read_scan(path, unit="nm", size_um=(9.0, 9.0), defaults=["size_um"])


def test_missing_files(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    for path, message in (
        (tmp_path / "none", "no such file"),
        (tmp_path, "not a file"),
        (tmp_path / "empty", "empty"),
    ):
        with pytest.raises(InputError, match=message):
            read_scan(path)


def test_layouts(tmp_path: Path) -> None:
    level = np.arange(40, dtype=np.uint8).reshape(5, 8) % 13
    rgb = np.repeat(level[..., None], 3, axis=2)
    tifffile.imwrite(tmp_path / "a", level, compression="packbits")
    tifffile.imwrite(tmp_path / "b", rgb, compression="lzw", photometric="rgb")
    np.save(tmp_path / "c.npy", level.astype(np.int32))
    import cv2

    cv2.imwrite(str(tmp_path / "d.png"), rgb)
    for name in ("a", "b", "c.npy", "d.png"):
        np.testing.assert_array_equal(read_layout(tmp_path / name), level)
        assert read_layout(tmp_path / name).dtype == np.uint8


def test_files_that_are_not_layouts_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "fraction.npy", np.full((4, 4), 0.5))
    np.save(tmp_path / "negative.npy", np.full((4, 4), -1))
    np.save(tmp_path / "large.npy", np.full((4, 4), 256))
    np.save(tmp_path / "nan.npy", np.full((4, 4), np.nan))
    np.savetxt(tmp_path / "text.txt", np.zeros((4, 4)))
    colours = np.zeros((4, 4, 3), np.uint8)
    colours[0, 0] = 1, 2, 3
    tifffile.imwrite(tmp_path / "colour.tif", colours, photometric="rgb")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(20))
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(InputError):
            read_layout(path)


@pytest.mark.oracle
@pytest.mark.parametrize("suffix", ["gwy", "gsf", "ibw"])
def test_fields_written_by_gwyddion(oracles: Path, suffix: str) -> None:
    from gwyfile.objects import GwyContainer

    field = GwyContainer.fromfile(str(oracles / "formats" / "synB.gwy"))["/0/data"]
    expected_um = np.asarray(field["data"]).reshape(field["yres"], field["xres"]) * 1e6
    scan = read_scan(oracles / "formats" / f"synB.{suffix}")
    # Rounding to float32 changes a value by at most 2^-24 of it.
    np.testing.assert_allclose(scan.height_um, expected_um, rtol=2**-24, atol=0)
    assert scan.shape == (301, 200)
    assert scan.channel == "Topography"
    assert scan.pitch_um == pytest.approx((3.6 / 301, 0.01), rel=1e-12)
    if suffix == "gwy":
        assert scan.mask is not None
        # The mask is not empty, and the heights under it are those of the formats without a mask.
        assert 0 < scan.mask.sum() < scan.mask.size
        np.testing.assert_array_equal(scan.height_um[scan.mask], expected_um[scan.mask])


@pytest.mark.oracle
@pytest.mark.measured
@pytest.mark.parametrize("suffix", ["gsf", "ibw"])
def test_a_measured_scan_through_gwyddion(oracles: Path, measured_prints: Path, suffix: str) -> None:
    raw = read_scan(measured_prints / "afm_ug" / "FOV11.txt", unit="m", size_um=(54, 54))
    scan = read_scan(oracles / "formats" / f"real_fov11.{suffix}")
    np.testing.assert_allclose(scan.height_um, raw.height_um, rtol=2**-24, atol=0)  # float32
    assert scan.pitch_um == pytest.approx(raw.pitch_um, rel=1e-12)


@pytest.mark.measured
def test_measured_scans_and_all_layouts(measured_prints: Path) -> None:
    scans = sorted((measured_prints / "afm_ug").glob("*.txt"))
    assert len(scans) == 24
    # A dataset of all of them is built in test_build_measured.py.
    for path in scans[1::3]:
        scan = read_scan(path, unit="m", size_um=(54, 54))
        assert scan.shape == (540, 540)
        assert np.isfinite(scan.height_um).all()
        # All scans except one have a minimum of zero.
        assert scan.height_um.min() == pytest.approx(0.021049 if path.stem == "FOV42" else 0.0, abs=1e-9)
    for path in sorted((measured_prints / "mask_ug").glob("*.tif")):
        assert read_layout(path).shape == (512, 512)
