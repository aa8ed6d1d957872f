"""Read HDF5 files. Files of JPK (series), Nanosurf (NHF), TopoStats and Zygo (DATX) are read by the
conventions of these makers and programs. All other files are read as self-describing arrays.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation import InputError, Shape
from litho_data.readers import vendor
from litho_data.readers.arrays import Read, dataset, read_hdf5
from litho_data.readers.reader import Channel, Loaded, Reader, extent_um, in_memory, one_by_one

_MAGIC = b"\x89HDF\r\n\x1a\n"
_JPK = b"JPK SCAN"
_UM_PER_M = 1e6
_UM_PER_NM = 1e-3
_NANOSURF = "nsf_file_version_major"
# The name of each attribute in version 2 of Nanosurf's files, followed by its name in version 1.
_NAMES, _LOW, _HIGH, _UNIT = (
    ("signal_name", "name"),
    ("signal_calibration_min", "base_calibration_min"),
    ("signal_calibration_max", "base_calibration_max"),
    ("signal_calibration_unit", "base_calibration_unit"),
)
_TOPOSTATS_IMAGES = ("image", "image_original")


def read_channels(path: Path) -> list[Channel]:
    """Return the channels of an HDF5 file.

    For files of JPK and Nanosurf, there is one channel per signal, scan direction (trace or retrace) and
    frame or image. For files of TopoStats, the channels are the flattened image and the raw image, both in
    nm. Thumbnails, traces of grains and other tables in these files are skipped. Zygo's files are read with
    the library SurfaceTopography, and all other files by ``read_hdf5``.

    Raises:
        InputError: the file is damaged.
    """
    import h5py

    with h5py.File(path) as file:
        if file.attrs.get("file-format-info") == _JPK:
            channels = [channel for name in sorted(file) for channel in _jpk_channels(path, file[name])]
        elif "topostats_file_version" in file:
            channels = [_topostats_channel(file, name) for name in _TOPOSTATS_IMAGES if name in file]
        elif _NANOSURF in file.attrs:
            channels = _nanosurf_channels(path, file)
        elif "MetaData" in file and "Data" in file:  # Zygo's DATX
            return vendor.read_channels(path)
        else:
            return read_hdf5(path, file)
    return channels


def _jpk_channels(path: Path, measurement: Any) -> list[Channel]:
    """Return the channels of one measurement in a JPK file, one per signal, scan direction and frame.

    The values of a signal have shape (pixels, frames). The dataset ``Position_Indices`` contains the column
    and row of each pixel.
    """
    grid = {key: measurement.attrs[f"position-pattern.grid.{key}"] for key in ("ilength", "jlength")}
    size_m = [float(measurement.attrs[f"position-pattern.grid.{key}length"]) for key in "vu"]
    shape = int(grid["jlength"]), int(grid["ilength"])
    positions = partial(dataset, path, f"{measurement.name}/Position_Indices")
    channels = []
    for group in (measurement[name] for name in sorted(measurement) if name.startswith("Channel_")):
        says = {key: _text(value) for key, value in group.attrs.items()}
        line = [float(group.attrs[f"net-encoder.scaling.{key}"]) for key in ("multiplier", "offset")]
        name = says["channel.fancy-name"] + (", retrace" if says.get("retrace") == "true" else "")
        for values in (one for key, one in sorted(group.items()) if key != "thumbnail"):
            if values.shape[0] != shape[0] * shape[1]:
                raise InputError(f"{values.name}: pixels", got=values.shape[0], wanted=shape)
            channels += [
                Channel(
                    name=name if values.shape[1] == 1 else f"{name}, frame {frame + 1}",
                    shape=shape,
                    unit=says["net-encoder.scaling.unit.unit"],
                    size_um=(size_m[0] * _UM_PER_M, size_m[1] * _UM_PER_M),
                    load=partial(_load_jpk, partial(dataset, path, values.name), positions, frame, *line),
                    fast_axis="x",
                    header=says,
                )
                for frame in range(values.shape[1])
            ]
    return channels


def _load_jpk(counts: Read, positions: Read, frame: int, slope: float, offset: float) -> Loaded:
    """Read the values of one frame, and convert them with the file's default calibration. JPK counts rows
    from the bottom, so the order of the rows is reversed.
    """
    column, row = positions().astype(int).T
    values = np.full((row.max() + 1, column.max() + 1), np.nan)
    values[row.max() - row, column] = counts()[:, frame]
    return values * slope + offset, None


def _nanosurf_channels(path: Path, file: Any) -> list[Channel]:
    """Return one channel per image, scan direction and signal. Groups without images are skipped."""
    import h5py

    channels = []
    for image in (one for _, one in sorted(file.items()) if isinstance(one, h5py.Group)):
        for segment in (one for _, one in sorted(image.items()) if isinstance(one, h5py.Group)):
            says = {key: value for group in (image, segment) for key, value in group.attrs.items()}
            for item in (one for _, one in sorted(segment.items()) if isinstance(one, h5py.Dataset)):
                if _first(item.attrs, _NAMES) is not None and item.size > 1:
                    label = _text(segment.attrs.get("segment_name", segment.attrs.get("name", "")))
                    name = ", ".join(filter(None, (_text(_first(item.attrs, _NAMES)), label)))
                    make = partial(_nanosurf_channel, path, item, says, name)
                    channels.append(one_by_one(name, make))
    return channels


def _nanosurf_channel(path: Path, item: Any, says: dict[str, Any], name: str) -> Channel:
    """Make the channel of a signal that is stored as integer counts.

    The full range of the integer type corresponds to the calibrated range that the file states. Rows and
    columns keep the order in which they are stored.
    """
    if "rect_axis_size" in says:
        nx, ny = (int(one) for one in says["rect_axis_size"])
        x_m, y_m = (float(one) for one in says.get("rect_axis_range", (0, 0)))
    else:
        nx, ny = int(says["image_points_per_line"]), int(says["image_number_of_lines"])
        x_m, y_m = float(says.get("image_size_x", 0)), float(says.get("image_size_y", 0))
    if item.shape not in ((ny, nx), (ny * nx,)):
        raise InputError(f"{item.name}: shape", got=item.shape, wanted=f"{ny} lines of {nx} points")
    low, high, unit = (_first(item.attrs, names) for names in (_LOW, _HIGH, _UNIT))
    read = partial(dataset, path, item.name)
    if item.dtype.kind not in "iu" or low is None or high is None or unit is None:
        raise InputError(
            f"{item.name}: calibration",
            got=f"{item.dtype}, {low} to {high} {unit}",
            wanted="integer counts with a range",
        )
    return Channel(
        name=name,
        shape=(ny, nx),
        unit=_text(unit) or "not a length",
        size_um=extent_um(y_m, x_m, "m"),
        load=partial(_load_nanosurf, read, (ny, nx), float(low), float(high), item.fillvalue),
        header={key: _text(value) for key, value in {**says, **item.attrs}.items()},
    )


def _first(attributes: Any, names: tuple[str, ...]) -> Any:
    return next((attributes[name] for name in names if name in attributes), None)


def _load_nanosurf(read: Read, shape: Shape, low: float, high: float, fill: Any) -> Loaded:
    counts = read().reshape(shape)
    info = np.iinfo(counts.dtype)
    values = low + (counts.astype(float) - info.min) / (float(info.max) - info.min) * (high - low)
    return np.where(counts == fill, np.nan, values) if fill else values, None


def _topostats_channel(file: Any, name: str) -> Channel:
    nm_per_px = float(file["pixel_to_nm_scaling"][()])
    ny, nx = file[name].shape
    scalars = {key: _text(item[()]) for key, item in file.items() if getattr(item, "shape", None) == ()}
    return Channel(
        name=name,
        shape=(ny, nx),
        unit="nm",
        size_um=(ny * nm_per_px * _UM_PER_NM, nx * nm_per_px * _UM_PER_NM),
        load=in_memory(np.asarray(file[name][()], dtype=float)),
        header=scalars,
    )


def _text(value: Any) -> str:
    return value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)


READER = Reader(
    "hdf5", lambda path, head: head.startswith(_MAGIC), read_channels, ("h5py", *vendor.READER.parsers)
)
