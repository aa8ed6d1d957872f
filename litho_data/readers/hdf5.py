"""HDF5 files: JPK's image series, TopoStats' results, and through SurfaceTopography all others."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.readers import vendor
from litho_data.readers.confined import confined
from litho_data.readers.reader import Channel, Loaded, Reader, foreign_parser, with_unique_names

_MAGIC = b"\x89HDF\r\n\x1a\n"
_JPK = b"JPK SCAN"
_UM_PER_M = 1e6
_UM_PER_NM = 1e-3
_TOPOSTATS_IMAGES = ("image", "image_original")


def read_channels(path: Path) -> list[Channel]:
    """JPK: one channel per signal, direction and frame. TopoStats: the flattened and the raw image, in nm.

    Thumbnails, traces of grains and other tables are passed over.

    Raises:
        InputError: damaged file, or one without a map.
    """
    import h5py

    with foreign_parser(path, "HDF5"), h5py.File(path) as file:
        if file.attrs.get("file-format-info") == _JPK:
            channels = [channel for name in sorted(file) for channel in _jpk_channels(path, file[name])]
        elif "topostats_file_version" in file:
            channels = [_topostats_channel(path, file, name) for name in _TOPOSTATS_IMAGES if name in file]
        else:
            return vendor.read_channels(path)
    if not channels:
        raise InputError(f"{path} (HDF5) holds no two-dimensional channel")
    return with_unique_names(channels)


def _jpk_channels(path: Path, measurement: Any) -> list[Channel]:
    """Signals of one measurement: values (pixel, frame), the pixels in the order of ``Position_Indices``."""
    grid = {key: measurement.attrs[f"position-pattern.grid.{key}"] for key in ("ilength", "jlength")}
    size_m = [float(measurement.attrs[f"position-pattern.grid.{key}length"]) for key in "vu"]
    shape = int(grid["jlength"]), int(grid["ilength"])
    channels = []
    for group in (measurement[name] for name in sorted(measurement) if name.startswith("Channel_")):
        says = {key: _text(value) for key, value in group.attrs.items()}
        name = says["channel.fancy-name"] + (", retrace" if says.get("retrace") == "true" else "")
        for values in (one for key, one in sorted(group.items()) if key != "thumbnail"):
            if values.shape[0] != shape[0] * shape[1]:
                raise InputError(f"{path} {values.name}: pixels", got=values.shape[0], wanted=shape)
            channels += [
                Channel(
                    name=name if values.shape[1] == 1 else f"{name}, frame {frame + 1}",
                    shape=shape,
                    unit=says["net-encoder.scaling.unit.unit"],
                    size_um=(size_m[0] * _UM_PER_M, size_m[1] * _UM_PER_M),
                    load=partial(_load_jpk, path, values.name, frame),
                    fast_axis="x",
                    header=says,
                )
                for frame in range(values.shape[1])
            ]
    return channels


def _load_jpk(path: Path, name: str, frame: int) -> Loaded:
    """Values of the default calibration; y of the grid points up, so its last row comes first."""
    import h5py

    with foreign_parser(path, "HDF5"), h5py.File(path) as file:
        counts, scaling = file[name], file[name].parent.attrs
        measurement = file[name].parent.parent
        column, row = measurement["Position_Indices"][()].astype(int).T
        values = np.full((row.max() + 1, column.max() + 1), np.nan)
        values[row.max() - row, column] = counts[:, frame]
        slope, offset = (scaling[f"net-encoder.scaling.{key}"] for key in ("multiplier", "offset"))
    return values * float(slope) + float(offset), None


def _topostats_channel(path: Path, file: Any, name: str) -> Channel:
    nm_per_px = float(file["pixel_to_nm_scaling"][()])
    ny, nx = file[name].shape
    scalars = {key: _text(item[()]) for key, item in file.items() if getattr(item, "shape", None) == ()}
    return Channel(
        name=name,
        shape=(ny, nx),
        unit="nm",
        size_um=(ny * nm_per_px * _UM_PER_NM, nx * nm_per_px * _UM_PER_NM),
        load=partial(_load_plain, path, name),
        header=scalars,
    )


def _load_plain(path: Path, name: str) -> Loaded:
    import h5py

    with foreign_parser(path, "HDF5"), h5py.File(path) as file:
        return np.asarray(file[name][()], dtype=np.float64), None


def _text(value: Any) -> str:
    return value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)


READER = Reader(
    "hdf5", lambda path, head: head.startswith(_MAGIC), confined(read_channels, ("h5py", *vendor.IMPORTS))
)
