"""Check that each statement in a file is either applied or named in a refusal. The other parts of the file
remain readable.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr

from litho_data.foundation.errors import InputError
from litho_data.readers import list_channels, read_scan
from litho_data.readers.gsf import gsf_bytes
from tests.litho_data import afm_files
from tests.litho_data.afm_files import HEIGHT_UM, SHAPE, SIZE_UM

ROWS = "\n".join("\t".join(f"{value:.4f}" for value in row) for row in np.tile(HEIGHT_UM, (2, 2))) + "\n"


def refused(path: Path, message: str, **arguments: object) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_scan(path, **({"unit": "um"} | arguments))
    assert "\n" not in str(caught.value)


def test_a_calibration_that_is_not_linear_is_refused_with_its_keys(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    tifffile.imwrite(
        path, np.ones(SHAPE, np.uint16), imagej=True, metadata={"cf": 3, "c0": 1.0, "c1": 2.0, "c2": 3.0}
    )
    refused(path, "cf = 3, c0 = 1.0, c1 = 2.0, c2 = 3.0")


def test_a_unit_that_is_no_length_makes_no_height(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    about = {"c0": 0.0, "c1": 1e-3, "vunit": "V"}
    tifffile.imwrite(path, np.ones(SHAPE, np.uint16), imagej=True, metadata=about)
    refused(path, "no height channel.*'page 0'.*V")


def test_a_picture_beside_an_unknown_private_tag_is_no_map(tmp_path: Path) -> None:
    """Check this because instrument makers store a preview in a TIFF page, and the heights elsewhere."""
    path = tmp_path / "scan.tif"
    tag = (55555, "B", 4 * HEIGHT_UM.size, HEIGHT_UM.astype("<f4").tobytes(), False)
    tifffile.imwrite(path, np.ones(SHAPE, np.uint8), extratags=[tag], metadata=None)
    refused(path, "private tag 55555", unit=None, full_scale_um=1.0)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"scaling": 2.0}, "scaling = 2.0"),
        ({"Z_offset": 1.0, "gain": 3.0}, "gain = 3.0"),
        ({"calibration": [1.0, 2.0]}, r"calibration = \[1.0, 2.0\]"),
        ({"sensitivity": 0.1}, "sensitivity = 0.1"),
        ({"nm_per_count": 0.1}, "nm_per_count = 0.1"),
        ({"z_resolution": 0.1}, "z_resolution = 0.1"),
        ({"to_m": 1e-9}, "to_m = 1e-09"),
    ],
)
def test_numbers_beside_an_array_are_applied_or_named(tmp_path: Path, attributes: dict, message: str) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("height", data=HEIGHT_UM).attrs.update(attributes)
        file.create_dataset("other", data=2 * HEIGHT_UM)
    refused(path, message, channel="height")
    # The other channel is still read.
    np.testing.assert_array_equal(read_scan(path, channel="other", unit="um").height_um, 2 * HEIGHT_UM)
    assert [bool(one.problem) for one in list_channels(path)] == [True, False]


def test_numbers_beside_counts_may_be_their_calibration(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("z", data=np.ones(SHAPE, np.uint16)).attrs.update({"m": 1e-4, "b": 0.0})
    refused(path, "b = 0.0, m = 0.0001")


def test_an_array_states_which_axis_runs_along_x(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("plain", data=HEIGHT_UM)
        turned = file.create_dataset("turned", data=HEIGHT_UM.T)
        turned.dims[0].label, turned.dims[1].label = "x", "y"
    plain, turned = list_channels(path)
    assert (plain.x_is, turned.x_is) == ("the second index", "the first index, x")
    np.testing.assert_array_equal(plain.load()[0], turned.load()[0])


def test_a_field_without_its_size_is_still_read(tmp_path: Path) -> None:
    from gwyfile.objects import GwyContainer, GwyDataField, GwyObject, GwySIUnit

    path = tmp_path / "scan.gwy"
    field = GwyDataField(
        HEIGHT_UM * 1e-6, si_unit_xy=GwySIUnit(unitstr="m"), si_unit_z=GwySIUnit(unitstr="m")
    )
    for key in ("xreal", "yreal"):
        GwyObject.__delitem__(field, key)
    GwyContainer({"/0/data": field, "/1/data": GwyDataField(HEIGHT_UM)}).tofile(str(path))
    assert read_scan(path, channel="channel 0", size_um=SIZE_UM).height_um == pytest.approx(HEIGHT_UM)


@pytest.mark.parametrize(
    ("text", "asked", "arguments"),
    [
        (ROWS.replace("0.0310", "Bad"), "line 4, got 'Bad'.*missing = ", {"missing": ["Bad"]}),
        (ROWS.replace("0.0310", "--"), "line 4, got '--'.*missing = ", {"missing": ["--"]}),
        (ROWS.replace("0.0310", ""), "line 4, got an empty cell.*missing = ", {"missing": [""]}),
        (
            ROWS.replace("0.0310", "-9999"),
            r"missing = \[-9999\]; if not, set missing = \[\]",
            {"missing": [-9999]},
        ),
        (ROWS.replace("0.0310", "3.4028e+38"), r"missing = \[3.4028e\+38\]", {"missing": [3.4028235e38]}),
        (
            ROWS.replace("0.0310", "-77.5"),
            r"got -77.5 in 4 pixels.*missing = \[-77.5\]",
            {"missing": [-77.5]},
        ),
        (
            ROWS.replace("0.0310", "-9999").replace("0.0420", "1.70141e38"),
            r"missing = \[1.70141e\+38, -9999\]",
            {"missing": [-9999, 1.70141e38]},
        ),
    ],
)
def test_marks_of_missing_pixels_are_asked_about(
    tmp_path: Path, text: str, asked: str, arguments: dict
) -> None:
    path = tmp_path / "scan.txt"
    path.write_text(text)
    refused(path, asked)
    height_um = read_scan(path, unit="um", **arguments).height_um
    assert np.isnan(height_um[3, 1])
    assert np.nanmax(np.abs(height_um)) < 1


def test_a_caller_may_say_that_no_pixel_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_text(ROWS.replace("0.0310", "-9999"))
    assert read_scan(path, unit="nm", missing=[]).height_um.min() == -9.999


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("# Height [V]", "no height channel.*V"),
        ("# Heights in 0.1 nm", "a scale in the header.*0.1 nm"),
        ("# Heights (x 10 nm)", "a scale in the header.*10 nm"),
        ("# multiply by 10 to get nm", "a scale in the header.*multiply by 10"),
        ("# 1 count = 0.1 nm", "a scale in the header.*1 count = 0.1 nm"),
        ("# Height image in um", "unit, got 'nm', wanted 'um'"),
        ("height_um", "unit, got 'nm', wanted 'um'"),
        ("Units of height: microns", "unit, got 'nm', wanted 'microns'"),
        ("# units: nm\n# z-units: um", "unit, got 'nm', wanted 'um'"),
        (", ".join(f"h{k} (um)" for k in range(4)), "unit, got 'nm', wanted 'um'"),
    ],
)
def test_statements_about_the_heights_in_words_are_not_ignored(
    tmp_path: Path, head: str, message: str
) -> None:
    path = tmp_path / "scan.txt"
    path.write_text(f"{head}\n{ROWS}")
    refused(path, message, unit="nm")


def test_blanks_between_thousands_make_no_columns(tmp_path: Path) -> None:
    path = tmp_path / "scan.txt"
    path.write_text("\n".join("\t".join(f"1 0{value:05.2f}" for value in 10 * row) for row in HEIGHT_UM))
    refused(path, "line 1.*no thousands separators")


def test_axes_in_the_last_row_and_column_are_no_heights(tmp_path: Path) -> None:
    path = tmp_path / "scan.csv"
    table = np.pad(np.tile(HEIGHT_UM, (2, 2)), ((0, 1), (0, 1)))
    table[-1], table[:, -1] = 0.2 * np.arange(table.shape[1]), 0.2 * np.arange(len(table))
    np.savetxt(path, table, fmt="%.4f", delimiter=",")
    refused(path, "axes in the last row and column")


@pytest.mark.parametrize("level", [True, False])
def test_a_first_row_and_column_with_a_level_part_are_no_axes(level: bool, tmp_path: Path) -> None:
    table = np.random.default_rng(0).permutation(72).reshape(8, 9).astype(float)
    falling = np.array([99.0, 80, 71, 71 if level else 70, 60, 50, 30, 10])
    table[0, 1:], table[1:, 0] = falling, falling[:7]
    np.savetxt(tmp_path / "scan.txt", table, fmt="%g")
    if level:
        np.testing.assert_array_equal(read_scan(tmp_path / "scan.txt", unit="um").height_um, table)
    else:
        refused(tmp_path / "scan.txt", "first row and column that rise like axes")


def test_json_beside_a_page_is_read_like_words(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    tifffile.imwrite(path, HEIGHT_UM.astype(np.float32), metadata={"unit": "nm"})
    assert read_scan(path).unit == "nm"
    tifffile.imwrite(path, HEIGHT_UM.astype(np.float32), metadata={"scale": 10})
    refused(path, "scale = 10")


def test_other_entries_beside_a_map_in_an_archive_are_not_ignored(tmp_path: Path) -> None:
    path = tmp_path / "scan.npz"
    y, x = (0.2 * np.arange(count) for count in SHAPE)
    np.savez(path, z=HEIGHT_UM.T, x=x, y=y, unit="um")
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.height_um, HEIGHT_UM)
    assert scan.require_pitch() == pytest.approx((0.2, 0.2))
    for beside, message in (({"scale": 10.0}, "scale = 10"), ({"mask": HEIGHT_UM > 0}, "mask 'mask'")):
        np.savez(path, z=HEIGHT_UM, **beside)
        refused(path, message)


def test_a_scale_in_the_header_of_a_simple_field_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.gsf"
    path.write_bytes(gsf_bytes(HEIGHT_UM, None).replace(b"ZUnits = m", b"ZScale = 5"))
    refused(path, "ZScale = 5")


@pytest.mark.parametrize(
    "says", [("axis", "X", "Y"), ("standard_name", *(f"projection_{k}_coordinate" for k in "xy"))]
)
def test_axes_may_be_told_by_attributes(tmp_path: Path, says: tuple[str, str, str]) -> None:
    path, (key, x, y) = tmp_path / "scan.nc", says
    lines = {name: 0.2 * np.arange(count) for name, count in zip("ba", SHAPE, strict=True)}
    array = xr.DataArray(HEIGHT_UM.T, dims=("a", "b"), name="height_um", coords=lines)
    array["a"].attrs, array["b"].attrs = {key: x, "units": "um"}, {key: y, "units": "um"}
    array.to_netcdf(path, engine="scipy")
    # The name states the unit.
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.height_um, HEIGHT_UM)
    assert scan.require_pitch() == pytest.approx((0.2, 0.2))


def test_a_mask_beside_a_map_is_not_ignored(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file["z"], file["seen"] = HEIGHT_UM, HEIGHT_UM > 0
    refused(path, "mask '/seen'")


def test_one_extreme_value_in_many_pixels_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "scan.npy"
    height_um = np.random.default_rng(0).random((40, 50))
    np.save(path, np.minimum(height_um, 0.97))
    assert "its highest value occurs in many pixels (0.97 in " in read_scan(path, unit="um").notes[0]
    np.save(path, height_um)
    assert read_scan(path, unit="um").notes == ()


def test_bytes_without_a_known_start_are_unknown_and_not_damaged(tmp_path: Path) -> None:
    """Check that NMS of NanoFocus, which begins like an Igor wave 2, is not called a damaged wave."""
    path = tmp_path / "scan.nms"
    path.write_bytes(b"\2\0\0\0\1\0\0\0\0\0\xff\xff" + bytes(4000))
    refused(path, "unknown content", unit=None)


@pytest.mark.parametrize("kind", [1, 5, 12, 20])
def test_a_digital_surf_file_of_another_kind_is_named(tmp_path: Path, kind: int) -> None:
    path = tmp_path / "scan.sur"
    afm_files.write_sur(path, np.ones(SHAPE, int), height_per_count_um=1.0)
    raw = bytearray(path.read_bytes())
    raw[18] = kind
    path.write_bytes(raw)
    if kind == 1:  # kind 1 is a surface, which is read
        assert read_scan(path).shape == SHAPE
    else:
        refused(path, f"kind of studiable, got {kind}", unit=None)


def test_axes_at_uneven_steps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.csv"
    values = np.random.default_rng(0).random((9, 12))
    values[0], values[:, 0] = np.arange(12) ** 2, np.arange(9) ** 2
    np.savetxt(path, values, delimiter=",")
    refused(path, "rise like axes, got uneven steps")


@pytest.mark.parametrize(
    ("unit", "step", "pitch_um"),
    [
        ("um", 0.2, 0.2),
        ("m", 2e-7, 0.2),
        ("nm", 200, 0.2),
        ("nm", 0.2, 0.2),
        ("m", 0.2, 0.2),
        ("nm", 20, None),
    ],
)
def test_coordinates_without_a_unit_are_taken_as_micrometres_or_need_a_size(
    tmp_path: Path, unit: str, step: float, pitch_um: float | None
) -> None:
    """Check coordinates that may be in µm or in the unit of the heights.

    If both give a plausible scan, the pitch is left open, so that the size has to be given.
    """
    path = tmp_path / "scan.txt"
    values = 0.05 * np.random.default_rng(0).random((9, 12))
    values[0, 1:], values[1:, 0] = np.arange(11) * step, np.arange(8) * step
    np.savetxt(path, values)
    scan = read_scan(path, unit=unit)
    found = scan.pitch_um
    assert found is None if pitch_um is None else found == pytest.approx((pitch_um, pitch_um))
    assumed = "µm" if step == 0.2 else unit
    said = f"its coordinates have no unit; {assumed} was assumed, because a size of 1.6 × 2.2 µm is likely"
    assert [note.partition(":")[0] for note in scan.notes] == [said] * (pitch_um is not None)
    if pitch_um is not None:
        assert read_scan(path, unit=unit, size_um=(1.6, 2.2)).notes == ()


def test_points_of_a_grid_say_how_y_runs_without_a_warning(tmp_path: Path) -> None:
    rng, points = np.random.default_rng(0), [(x, y) for y in range(8) for x in range(9)]
    for order, way in ((points, "grows"), (points[::-1], "falls")):
        rows = (f"{0.2 * x:.1f} {0.2 * y:.1f} {rng.random():.4f}" for x, y in order)
        (tmp_path / "scan.xyz").write_text("\n".join(["X (um) Y (um) Z (nm)", *rows]) + "\n")
        (channel,) = list_channels(tmp_path / "scan.xyz")
        assert channel.x_is == f"column 1 of points; y {way} downwards"
        assert read_scan(tmp_path / "scan.xyz").notes == ()
