"""Write known height maps as other programs do, in many formats, units and arrangements."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tifffile

from litho_data.foundation.units import um_per
from tests.litho_data import afm_files


@dataclass
class MapFile:
    """Describe a written map by its heights in µm and by the arguments that a reader needs. Missing pixels
    are NaN.

    ``says_size`` tells whether the file states the size of the map. ``asks`` tells whether the file cannot be
    read without the arguments. ``atol_um`` is half the resolution of the numbers in the file.
    """

    height_um: np.ndarray
    pitch_um: float
    unit: str
    mark: Any = None
    arguments: dict[str, Any] = field(default_factory=dict)
    says_size: bool = False
    asks: bool = False
    atol_um: float = 1e-9

    def in_unit(self) -> np.ndarray:
        """Return the heights in the file's unit, with NaN replaced by the mark of missing pixels."""
        values = self.height_um / um_per(self.unit)
        return (
            values
            if self.mark is None or isinstance(self.mark, str)
            else np.where(np.isnan(values), self.mark, values)
        )

    def needs(self, **arguments: Any) -> None:
        """Record that a reader cannot read the file without these arguments."""
        self.arguments |= arguments
        self.asks = True

    def needs_mark(self) -> None:
        """Record that the reader must be told which value marks missing pixels, if there are any.

        The file itself does not state this value.
        """
        if self.mark is not None and np.isnan(self.height_um).any():
            self.needs(missing=[self.mark])

    def rows(self, separator: str = "\t", decimal: str = ".") -> list[str]:
        """Return the rows of the map as lines of text, with ten digits per number."""

        def cell(value: float) -> str:
            if np.isnan(value):
                return str(self.mark) if isinstance(self.mark, str) else "nan"
            return f"{value:.9e}".replace(".", decimal)

        return [separator.join(cell(value) for value in row) for row in self.in_unit()]

    @property
    def size_um(self) -> tuple[float, float]:
        """Return the size (y, x) of the map in µm, from edge to edge."""
        return self.height_um.shape[0] * self.pitch_um, self.height_um.shape[1] * self.pitch_um


def random_map(rng: np.random.Generator) -> np.ndarray:
    """Return an asymmetric map of heights between 0.1 and 1 µm, in steps of 0.1 nm."""
    ny, nx = rng.choice(np.arange(9, 24), 2, replace=False)
    y, x = np.mgrid[0:ny, 0:nx]
    height = 0.1 + 0.4 * rng.random((ny, nx)) + 0.01 * y + 0.005 * x
    height[:2, :3] = 0.95 + 0.01 * rng.random((2, 3))
    return np.round(height, 4)


Writer = Callable[[Path, MapFile, np.random.Generator], None]


def text(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a text matrix, with or without a header, in one of the notations that occur in practice."""
    separator, decimal = [("\t", "."), (" ", "."), (",", "."), (";", "."), (";", ","), ("\t", ",")][
        rng.integers(6)
    ]
    lines = one.rows(separator, decimal)
    if rng.random() < 0.5:
        size_y, size_x = one.size_um
        lines = [
            "# Channel: Topography", f"# Width: {size_x:.9f} µm", f"# Height: {size_y:.9f} µm",
            f"# Value units: {one.unit}", *lines,
        ]  # fmt: skip
        one.says_size = True
        if isinstance(one.mark, float) and rng.random() < 0.5:
            lines.insert(0, f"# NODATA_value: {one.mark}")
            one.mark = None
    else:
        one.needs(unit=one.unit)
    one.needs_mark()
    end = ["\n", "\r\n", "\r"][rng.integers(3)]
    code = ["utf-8", "utf-8-sig", "utf-16", "latin-1"][rng.integers(4)]
    path.write_bytes((end.join(lines) + end).encode(code))


def text_of_two_channels(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write two channels as Gwyddion exports them to text, separated by a blank line or by headers."""
    rows = one.rows()
    other = ["\t".join(f"{value:.3f}" for value in row) for row in np.nan_to_num(one.height_um) * 30]
    if rng.random() < 0.5:
        head = [
            "# Channel: {}",
            f"# Width: {one.size_um[1]:.9f} µm",
            f"# Height: {one.size_um[0]:.9f} µm",
            "# Value units: {}",
        ]
        lines = [line.format(one.unit if "units" in line else "Topography") for line in head] + rows
        lines += ["", *(line.format("deg" if "units" in line else "Phase") for line in head), *other]
        one.says_size = True
    else:
        lines = [*rows, "", *other]
        one.needs(unit=one.unit, channel="block 1")
    one.needs_mark()
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def axes(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a matrix as spreadsheets do, with coordinates in µm in its first row and column."""
    separator, decimal = [(",", "."), (";", ","), ("\t", ".")][rng.integers(3)]
    rows = one.rows(separator, decimal)
    nx = one.height_um.shape[1]
    corner = ["0", "", "nan"][rng.integers(3)]

    def at(place: int) -> str:
        return f"{place * one.pitch_um:.6f}".replace(".", decimal)

    head = separator.join([corner, *(at(k) for k in range(nx))])
    lines = [head, *(f"{at(k)}{separator}{row}" for k, row in enumerate(rows))]
    path.write_text("\n".join(lines) + "\n")
    one.needs(unit=one.unit)
    one.needs_mark()
    one.says_size = one.unit == "um"


def frame(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a data frame as pandas does, with its index and its header."""
    import pandas as pd

    names = None if rng.random() < 0.5 else [f"c{k}" for k in range(one.height_um.shape[1])]
    pd.DataFrame(one.in_unit(), columns=names).to_csv(
        path, na_rep="nan", sep=[",", ";", "\t"][rng.integers(3)]
    )
    one.needs(unit=one.unit)
    if not isinstance(one.mark, str):
        one.needs_mark()


def points(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write the points x, y, z of the grid, one per line. Missing pixels may be left out."""
    ny, nx = one.height_um.shape
    y, x = (axis.ravel() * one.pitch_um / um_per(one.unit) for axis in np.mgrid[0:ny, 0:nx])
    table = np.column_stack([x, y, one.height_um.ravel() / um_per(one.unit)])
    if rng.random() < 0.5:
        table = table[np.isfinite(table[:, 2])]
    np.savetxt(path, table, fmt="%.12e")
    one.mark = None
    one.needs(unit=one.unit)


def surfer(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a Surfer grid of one of the three kinds, with coordinates in µm."""
    ny, nx = one.height_um.shape
    blank, upward = 1.70141e38, one.height_um[::-1] / um_per(one.unit)
    values = np.where(np.isnan(upward), blank, upward)
    ends = 0.0, (nx - 1) * one.pitch_um, 0.0, (ny - 1) * one.pitch_um
    kind = rng.integers(3)
    if kind == 0:
        lines = ["DSAA", f"{nx} {ny}", "{} {}".format(*ends[:2]), "{} {}".format(*ends[2:]), "0 1"]
        path.write_text("\n".join(lines + [" ".join(f"{v:.9e}" for v in row) for row in values]) + "\n")
    elif kind == 1:
        path.write_bytes(b"DSBB" + struct.pack("<2h6d", nx, ny, *ends, 0, 1) + values.astype("<f4").tobytes())
        one.atol_um = 1e-7
    else:
        grid = struct.pack("<2i8d", ny, nx, 0, 0, one.pitch_um, one.pitch_um, 0, 1, 0, blank)
        data = values.astype("<f8").tobytes()
        parts = [(b"DSRB", struct.pack("<i", 1)), (b"GRID", grid), (b"DATA", data)]
        path.write_bytes(b"".join(tag + struct.pack("<i", len(content)) + content for tag, content in parts))
    one.mark = None
    one.needs(unit=one.unit)
    one.says_size = one.unit == "um"


def esri(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write an ESRI grid, which states the value that marks missing pixels."""
    one.mark = mark = one.mark if isinstance(one.mark, float) else -9999.0
    ny, nx = one.height_um.shape
    head = [
        f"ncols {nx}",
        f"nrows {ny}",
        "xllcorner 0.0",
        "yllcorner 0.0",
        "cellsize 0.2",
        f"NODATA_value {mark}",
    ]
    path.write_text("\n".join(head + one.rows(" ")) + "\n")
    one.needs(unit=one.unit)


def wyko(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write Wyko ASCII: column by column, each from bottom to top, in nm or in waves."""
    ny, nx = one.height_um.shape
    real = rng.integers(2)
    values = one.height_um * 1e3 / (1 if real else 632.8)
    head = [
        f"Wyko ASCII Data File Format 0\t{real}\t1", f"X Size\t{nx}", f"Y Size\t{ny}",
        "Block Name\tType\tLength\tValue", f"Pixel_size\t7\t4\t{one.pitch_um * 1e-3:.9f}",
        "Wavelength\t7\t4\t632.8", "RAW_DATA\t3\t48\t",
    ]  # fmt: skip
    lines = ["\t".join("Bad" if np.isnan(v) else f"{v:.9f}" for v in column[::-1]) for column in values.T]
    path.write_text("\n".join(head + lines) + "\n")
    one.mark, one.unit, one.says_size = None, "nm", True


def tiff(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a TIFF of real numbers, or of counts with a calibration as ImageJ or GDAL state it."""
    kind = rng.integers(3)
    values = one.in_unit()
    if kind == 0:
        tifffile.imwrite(path, values.astype(np.float32))
        one.atol_um = 1e-6
        one.needs(unit=one.unit)
        one.needs_mark()
        return
    scale = 1e-4 / um_per(one.unit)
    counts = np.where(np.isnan(one.height_um), 0, np.round(one.height_um * 1e4)).astype(np.uint16)
    if kind == 1:
        one.height_um = counts * 1e-4
        about = {"c0": 0.0, "c1": scale, "vunit": one.unit, "cf": 0}
        tifffile.imwrite(path, counts, imagej=True, metadata=about)
    else:
        items = f'<Item name="SCALE" sample="0" role="scale">{scale!r}</Item>'
        items += f'<Item name="UNITTYPE" sample="0" role="unittype">{one.unit}</Item>'
        tags = [(42112, "s", 0, f"<GDALMetadata>{items}</GDALMetadata>", False), (42113, "s", 0, "0", False)]
        tifffile.imwrite(path, counts, extratags=tags)
    one.mark = None


def hdf5(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write HDF5 in the style of no particular program: counts with attributes of the CF conventions."""
    counts = np.where(np.isnan(one.height_um), -1, np.round(one.height_um * 1e4)).astype(np.int32)
    with h5py.File(path, "w") as file:
        data = file.create_dataset("scan/height", data=counts)
        data.attrs.update(
            {"scale_factor": 1e-4 / um_per(one.unit), "_FillValue": np.int32(-1), "units": one.unit}
        )
    one.mark = None


def netcdf(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write NetCDF 3 or 4 with xarray, with the dimensions in either order and coordinates in µm."""
    import xarray as xr

    ny, nx = one.height_um.shape
    y, x = ((np.arange(n) + 0.5) * one.pitch_um for n in (ny, nx))
    array = xr.DataArray(
        one.height_um / um_per(one.unit),
        dims=("y", "x"),
        coords={"y": y, "x": x},
        attrs={"units": one.unit},
        name="height",
    )
    array.x.attrs["units"] = array.y.attrs["units"] = "um"
    if rng.random() < 0.5:
        array = array.transpose()
    array.to_netcdf(path, engine="scipy", format="NETCDF3_CLASSIC")
    one.mark, one.says_size = None, True


def matlab(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a MATLAB file of version 5, or of version 7.3, which is HDF5 with transposed arrays."""
    from scipy.io import savemat

    if rng.random() < 0.5:
        savemat(path, {"Z": one.in_unit()})
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            file.create_dataset("Z", data=one.in_unit().T)
        with path.open("r+b") as stream:
            stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\x02IM")
    one.needs(unit=one.unit)
    one.needs_mark()


def nhf(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a Nanosurf file with two signals as int32 counts. Each array has one or two dimensions."""
    ny, nx = one.height_um.shape
    one.height_um = np.nan_to_num(one.height_um, nan=0.5)
    counts = np.round(one.height_um * 1e-6 / 2e-6 * (2**31 - 1)).astype(np.int32)
    with h5py.File(path, "w") as file:
        file.attrs["nsf_file_version_major"] = 2
        segment = file.create_group("group_0000/subgroup_0000")
        segment.attrs["rect_axis_size"], segment.attrs["segment_name"] = [nx, ny], "Forward"
        segment.attrs["rect_axis_range"] = [nx * one.pitch_um * 1e-6, ny * one.pitch_um * 1e-6]
        for k, (name, limit, unit) in enumerate((("Position Z", 2e-6, "m"), ("Deflection", 10.0, "V"))):
            data = segment.create_dataset(
                f"dataset_{k:04}", data=counts if rng.random() < 0.5 else counts.ravel()
            )
            data.attrs.update({"signal_name": name, "signal_calibration_unit": unit})
            data.attrs.update({"signal_calibration_min": -limit, "signal_calibration_max": limit})
    one.mark, one.says_size = None, True


def digital_surf(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a Digital Surf file, either uncompressed or compressed in two streams."""
    one.height_um = np.nan_to_num(one.height_um, nan=0.5)
    afm_files.write_sur(path, np.round(one.height_um * 1e4).astype(int), height_per_count_um=1e-4)
    if rng.random() < 0.6:
        raw = path.read_bytes()
        parts = raw[512:700], raw[700:]
        packed = [zlib.compress(part) for part in parts]
        sizes = b"".join(
            struct.pack("<2I", len(part), len(zipped)) for part, zipped in zip(parts, packed, strict=True)
        )
        path.write_bytes(b"DSCOMPRESSED" + raw[12:512] + struct.pack("<I", 2) + sizes + b"".join(packed))
    one.mark, one.atol_um = None, 1e-6
    one.says_size = False  # as the writer of the other tests does
    one.pitch_um = float("nan")


def park(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a Park Systems file: a TIFF page with a preview, and the counts and their scale in private tags.

    The rows run from bottom to top.
    """
    ny, nx = one.height_um.shape
    one.height_um = np.nan_to_num(one.height_um, nan=0.5)
    counts = np.round(one.height_um[::-1] * 1e4).astype("<i2")
    values = (
        struct.pack("<I", 0)
        + "Topography".encode("utf-16-le").ljust(64, b"\0")
        + "NC".encode("utf-16-le").ljust(16, b"\0")
    )
    values += (
        struct.pack("<dII", 0, 0, 0) + struct.pack("<II", nx, ny) + struct.pack("<dId3I", 0, 0, 0, 1, 1, 0)
    )
    values += (
        struct.pack("<6d", nx * one.pitch_um, ny * one.pitch_um, 0, 0, 1, 0)
        + bytes(16)
        + struct.pack("<2d", 0, 0)
    )
    values += (
        struct.pack("<3d", 1e-4, 1.0, 0.0)
        + "um".encode("utf-16-le").ljust(16, b"\0")
        + struct.pack("<6i", 0, 1, 0, 0, 0, 0)
    )
    tags = [
        (50432, "I", 1, 0x0E031301, False), (50433, "I", 1, 0x1000001, False),
        (50434, "B", counts.nbytes, counts.tobytes(), False), (50435, "B", len(values), values, False),
    ]  # fmt: skip
    tifffile.imwrite(path, np.zeros((ny, nx, 3), np.uint8), photometric="rgb", extratags=tags, metadata=None)
    one.mark, one.says_size, one.atol_um = None, True, 1e-8


def sdf(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write an ISO 25178-71 text file, in which a number times Zscale is a height in metres."""
    ny, nx = one.height_um.shape
    head = {
        "ManufacID": "TEST", "CreateDate": "010120200000", "ModDate": "010120200000", "NumPoints": nx,
        "NumProfiles": ny,
        "Xscale": one.pitch_um * 1e-6, "Yscale": one.pitch_um * 1e-6, "Zscale": 1e-6, "Zresolution": 1e-9,
        "Compression": 0, "DataType": 7, "CheckType": 0,
    }  # fmt: skip
    cells = [" ".join("BAD" if np.isnan(v) else f"{v:.9f}" for v in row) for row in one.height_um]
    lines = ["aISO-1.0", *(f"{key} = {value}" for key, value in head.items()), "*", *cells, "*"]
    path.write_text("\r\n".join(lines) + "\r\n")
    one.mark, one.says_size = None, True


def bcr(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a BCR file: a text header of 2048 bytes with lengths in nm, then 16-bit counts."""
    ny, nx = one.height_um.shape
    one.height_um = np.nan_to_num(one.height_um, nan=0.5)
    says = {
        "fileformat": "bcrstm", "headersize": 2048, "xpixels": nx, "ypixels": ny, "bit2nm": 0.1, "zmin": 0,
        "xlength": nx * one.pitch_um * 1e3, "ylength": ny * one.pitch_um * 1e3,
    }  # fmt: skip
    head = "".join(f"{key} = {value}\n" for key, value in says.items()).encode().ljust(2048, b"%")
    path.write_bytes(head + np.round(one.height_um * 1e4).astype("<i2").tobytes())
    one.mark, one.says_size, one.atol_um = None, True, 1e-8


def gsf(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write a Gwyddion Simple Field file (GSF)."""
    size_y, size_x = one.size_um
    header = {"XReal": f"{size_x * 1e-6!r}", "YReal": f"{size_y * 1e-6!r}", "XYUnits": "m", "ZUnits": "m"}
    afm_files.write_gsf(path, one.height_um * 1e-6, header)
    one.mark, one.says_size, one.atol_um = None, True, 1e-6


def numpy_archive(path: Path, one: MapFile, rng: np.random.Generator) -> None:
    """Write an NPY file, or an NPZ file with two maps."""
    stream = io.BytesIO()
    if rng.random() < 0.5:
        np.save(stream, one.in_unit())
    else:
        np.savez(stream, height=one.in_unit(), phase=np.nan_to_num(one.height_um) * 30)
        one.needs(channel="height")
    path.write_bytes(stream.getvalue())
    one.needs(unit=one.unit)
    one.needs_mark()


WRITERS: tuple[Writer, ...] = (
    text, text, text, text_of_two_channels, axes, axes, frame, points, surfer, esri, wyko, tiff, tiff, hdf5,
    netcdf, matlab, nhf, digital_surf, park, sdf, bcr, gsf, numpy_archive,
)  # fmt: skip
