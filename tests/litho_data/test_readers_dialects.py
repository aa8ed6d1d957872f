"""Read texts and arrays from other programs and people. Either the map is right, or one line says why it
cannot be read.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from litho_data.foundation.errors import InputError
from litho_data.readers import read_scan

NY, NX, PITCH_UM = 24, 32, 0.2
Y, X = np.mgrid[0:NY, 0:NX]
HEIGHT_UM = np.round(0.3 * (X // 8 % 2) + 0.01 * Y + 0.002 * np.random.default_rng(1).random((NY, NX)), 4)
HEIGHT_UM[:3, :3] = 0.9


def rows(scale: float = 1.0, separator: str = "\t", decimal: str = ".", digits: int = 4) -> list[str]:
    """Return the heights in µm, times ``scale``, as lines of text."""
    lines = ([f"{value * scale:.{digits}f}" for value in row] for row in HEIGHT_UM)
    return [separator.join(line).replace(".", decimal) for line in lines]


def points(line: str, scale: float = 1.0) -> list[str]:
    """Return a list of points, one line of text per pixel."""
    places = zip(Y.ravel(), X.ravel(), HEIGHT_UM.ravel() * scale, strict=True)
    return [line.format(x=x * PITCH_UM, y=y * PITCH_UM, z=z, i=x, j=y) for y, x, z in places]


# Each text with the arguments that its reader needs. A name in brackets means that the text states the pitch.
RIGHT: dict[str, tuple[list[str], dict]] = {
    "[decimal commas in a header]": (
        ["Width: 6,4 µm", "Height: 4,8 µm", "Value units: µm", *rows(decimal=",")],
        {},
    ),
    "[Olympus]": (
        ['"XYCalibration","200","[nm]"', '"Unit","[um]"', *(f"{row}," for row in rows(1, ","))],
        {},
    ),
    "tabs after keys": (["Unit\tum", "Scan Size X\t6.4", *rows()], {}),
    "a unit after a length": (["Width(um): 6.4", "Height(um): 4.8", "Unit: um", *rows()], {}),
    "quoted cells": (['"' + row.replace(",", '","') + '"' for row in rows(1, ",")], {"unit": "um"}),
    "titled": (["Height [nm]", *rows(1e3)], {}),
    "titled in words": (["Höhe in nm", *rows(1e3, ";", ",")], {}),
    "in Russian": (["# Единицы измерения: nm", *rows(1e3)], {}),
    "a separator before every row": (["\t" + row for row in rows()], {"unit": "um"}),
    "MATLAB": (["Z = [", *(row + ";" for row in rows(1, " ")), "];"], {"unit": "um"}),
    "[points with units]": (["X (um) Y (um) Z (nm)", *points("{x:.2f} {y:.2f} {z:.3f}", 1e3)], {}),
    "[y before x]": (["y,x,z", *points("{y:.2f},{x:.2f},{z:.4f}")], {"unit": "um"}),
    "[an index before points]": ([",x,y,z", *points("{i},{x:.2f},{y:.2f},{z:.4f}")], {"unit": "um"}),
    "[another signal behind points]": (["x y z phase", *points("{x:.2f} {y:.2f} {z:.4f} 7")], {"unit": "um"}),
    "counts of pixels are no lengths": (["i,j,z", *points("{i},{j},{z:.4f}")], {"unit": "um"}),
}


@pytest.mark.parametrize("what", RIGHT)
def test_a_text_that_is_read(tmp_path: Path, what: str) -> None:
    lines, arguments = RIGHT[what]
    (tmp_path / "scan").write_text("\n".join(lines) + "\n", encoding="utf-8")
    scan = read_scan(tmp_path / "scan", **arguments)
    # The texts contain all digits of the heights.
    np.testing.assert_allclose(scan.height_um, HEIGHT_UM, atol=1e-9)
    assert (scan.pitch_um is not None) == what.startswith("[")
    assert scan.pitch_um is None or scan.pitch_um == pytest.approx((PITCH_UM, PITCH_UM))


def decimal_commas(separator: str) -> list[str]:
    return [separator.join(f"{value:.4f}".replace(".", ",") for value in row) for row in HEIGHT_UM]


REFUSED: dict[str, tuple[list[str], str]] = {
    "a unit that contradicts": (["# unit: nm", *rows()], "unit, got 'um', wanted 'nm'"),
    "a scale": (["# Multiplier: 10", *rows()], "a scale in the header, Multiplier = 10"),
    "other counts in the header": (["ncols 32", "nrows 25", *rows()], "number of rows, got 24, wanted 25"),
    "decimal commas between commas": (decimal_commas(","), "decimal commas or commas between cells"),
    "marks of thousands": (
        ["\t".join(f"{int(value * 1e4):,}" for value in row) for row in HEIGHT_UM],
        "no thousands separators",
    ),
    "errors of a spreadsheet": ([row.replace("0.9000", "#N/A") for row in rows()], "line 1, got '#N/A'"),
    "a row without numbers": (["\t".join(["Bad"] * NX), *rows()], "line 1, got 'Bad'"),
    "an Igor text wave": (["IGOR", "WAVES/D/N=(24,32) h", "BEGIN", *rows(), "END"], "Igor text wave"),
    "four profiles": ([f"{k}\t{k % 7}\t{k % 5}\t{k % 3}" for k in range(90)], "a point cloud or profiles"),
    "corners of a mesh": (points("v {x:g} {y:g} {z:g}"), "a point cloud or profiles"),
    "a mark ten spans away": ([row.replace("0.9000", "-9.999") for row in rows()], r"missing = \[-9.999\]"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_text_that_is_refused(tmp_path: Path, what: str) -> None:
    lines, message = REFUSED[what]
    (tmp_path / "scan").write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        read_scan(tmp_path / "scan", unit="um")
    assert "\n" not in str(caught.value)


def turned(file: h5py.File, **attributes: object) -> h5py.Dataset:
    data = file.create_dataset("scan/z", data=HEIGHT_UM.T)
    data.attrs.update({"units": "um", **attributes})
    return data


def labelled(x: str, y: str) -> Callable[[h5py.File], None]:
    def write(file: h5py.File) -> None:
        dims = turned(file).dims
        dims[0].label, dims[1].label = x, y

    return write


def with_lines(file: h5py.File) -> None:
    turned(file)
    for name, count in (("x", NX), ("y", NY)):
        file["scan"].create_dataset(name, data=PITCH_UM * np.arange(count)).attrs["units"] = "um"


@pytest.mark.parametrize(
    "write",
    [
        labelled("column", "row"),
        labelled("lon", "lat"),
        labelled("fast", "slow"),
        lambda file: turned(file, _ARRAY_DIMENSIONS=["x", "y"]),
        lambda file: turned(file, axes="x,y"),
        with_lines,
    ],
)
def test_axes_by_their_names_and_lengths(tmp_path: Path, write: Callable[[h5py.File], None]) -> None:
    with h5py.File(tmp_path / "scan", "w") as file:
        write(file)
    scan = read_scan(tmp_path / "scan")
    np.testing.assert_array_equal(scan.height_um, HEIGHT_UM)
    assert scan.pitch_um is None or write is with_lines


def test_a_falling_x_axis_is_reversed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "scan", "w") as file:
        data = file.create_dataset("z", data=HEIGHT_UM[:, ::-1])
        x = file.create_dataset("x", data=PITCH_UM * np.arange(NX)[::-1])
        x.make_scale("x")
        data.dims[1].attach_scale(x)
    np.testing.assert_array_equal(read_scan(tmp_path / "scan", unit="um").height_um, HEIGHT_UM)
    head = ",".join(["", *(f"{PITCH_UM * k:.1f}" for k in range(NX))][::-1])
    lines = [",".join([f"{PITCH_UM * k:.1f}", *row.split(",")[::-1]]) for k, row in enumerate(rows(1, ","))]
    (tmp_path / "scan").write_text("\n".join(["," + head.rstrip(","), *lines]) + "\n")
    np.testing.assert_array_equal(read_scan(tmp_path / "scan", unit="um").height_um, HEIGHT_UM)


@pytest.mark.parametrize(
    ("where", "name", "value", "message"),
    [
        ("scan/z", "Unit", "nm", "unit, got 'um', wanted 'nm'"),
        ("scan", "units", "nm", "unit, got 'um', wanted 'nm'"),
        ("/", "z_unit", "nm", "unit, got 'um', wanted 'nm'"),
        ("/", "scale_factor", 1e-4, "scale_factor = 0.0001"),
        ("beside", "z_scale", 1e-4, "z_scale = 0.0001"),
    ],
)
def test_numbers_above_and_beside_an_array(
    tmp_path: Path, where: str, name: str, value: object, message: str
) -> None:
    with h5py.File(tmp_path / "scan", "w") as file:
        file.create_dataset("scan/z", data=HEIGHT_UM)
        if where == "beside":
            file["scan"].create_dataset(name, data=value)
        else:
            file[where].attrs[name] = value
    with pytest.raises(InputError, match=message):
        read_scan(tmp_path / "scan", unit="um")


def test_numbers_beside_a_matrix_of_matlab(tmp_path: Path) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "scan", {"Z": HEIGHT_UM.T, "x": np.arange(NX) * 0.2, "y": np.arange(NY) * 0.2})
    scan = read_scan(tmp_path / "scan", unit="um")
    np.testing.assert_array_equal(scan.height_um, HEIGHT_UM)
    assert scan.pitch_um == pytest.approx((PITCH_UM, PITCH_UM))
    savemat(tmp_path / "scan", {"Z": HEIGHT_UM, "scale": 1e-4})
    with pytest.raises(InputError, match=r"scale = 0.0001"):
        read_scan(tmp_path / "scan", unit="um")


def test_the_statements_of_a_tiff_about_itself_are_applied(tmp_path: Path) -> None:
    path, values = tmp_path / "scan", HEIGHT_UM.astype(np.float32)
    tifffile.imwrite(path, values, extratags=[(274, "H", 1, 4, True)], metadata=None)
    with pytest.raises(InputError, match="Orientation of the page, got 4"):
        read_scan(path, unit="um")
    tifffile.imwrite(path, values * 1e3, description="ZUnit = nm", metadata=None)
    assert read_scan(path).height_um == pytest.approx(HEIGHT_UM)
    tifffile.imwrite(path, values, description="zscale = 0.001", metadata=None)
    with pytest.raises(InputError, match=r"zscale = 0.001"):
        read_scan(path, unit="um")


@pytest.mark.parametrize("unit", ["nanometers", "Nanometre", "nanometer", "nm"])
def test_units_in_words(tmp_path: Path, unit: str) -> None:
    (tmp_path / "scan").write_text("\n".join([f"unit: {unit}", *rows(1e3)]) + "\n")
    np.testing.assert_allclose(read_scan(tmp_path / "scan").height_um, HEIGHT_UM, atol=1e-9)
