"""Read files of self-describing arrays (HDF5 files of any program, NetCDF 3 and 4, MATLAB). The scale, the
unit and the axes of an array are taken from the file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation import Array, Facts, InputError, Shape, is_length, um_per
from litho_data.readers.reader import Channel, Loaded, Reader, one_by_one

_NUMBERS = "uif"
_MATLAB_7 = b"MATLAB 7.3 MAT-file"
_APPLIED = ("scale_factor", "add_offset")
_MISSING = ("_FillValue", "missing_value")
_RANGE = ("valid_min", "valid_max", "valid_range")
# Names of attributes whose numbers may scale or shift the values in a way that this module cannot interpret.
_UNKNOWN = re.compile(
    r"scal(e|ing)|offset|gain|calib|slope|intercept|factor|multipl|conver|_unsigned|lsb|sensitiv|"
    r"_per_(?!pixel|px)|^to_|(z|height|vertical)_?resolution",
    re.I,
)
# Names of numbers that convert counts into heights, such as m and b in "m · counts + b".
_OF_COUNTS = re.compile(r"resolution|[mb]|c[01]", re.I)
# Names of scales and offsets that are stored as scalars beside the array or as attributes of its groups, and
# not as attributes of the array itself. Many attributes there have nothing to do with the array, so only
# unambiguous names are listed.
_SCALE = re.compile(
    r"((z|heights?|data|values?|topography)[ _-]?)?(scale|scaling|factor|scale_factor|multiplier|gain)|"
    r"(z|heights?|data|values?|topography|add)[ _-]?offset",
    re.I,
)
_UNIT = re.compile(r"((z|heights?|data|values?)[ _-]?)?units?", re.I)
_X = re.compile(r"(x|lon|col|fast|horizontal)(?![a-wyz])|(lon|col)", re.I)
_Y = re.compile(r"(y|lat|row|slow|vertical|line)(?![a-xz])|(lat|row|line)", re.I)
_UNEVEN = 1e-3
_OF_DIMENSIONS = ("DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates")
_DIMENSIONS = ("_ARRAY_DIMENSIONS", "axes")
_NO_COORDINATE = b"This is a netCDF dimension but not"


Read = Callable[[], Array]


@dataclass(frozen=True)
class Coordinate:
    """The positions of the pixels along one dimension of an array.

    ``values`` contains the positions, in ``unit``. If the file states only the length of the array along this
    dimension, ``values`` is None and ``length`` contains this length. ``axis`` is the name of the axis, such
    as "x", if the attributes of the positions state it. Otherwise it is empty.
    """

    values: Array | None
    unit: str | None
    length: float | None = None
    axis: str = ""

    def extent(self, count: int) -> float | None:
        """Return the length from edge to edge of ``count`` pixels, or None if it is unknown.

        Raises:
            InputError: the steps are uneven.
        """
        if self.length is not None:
            return self.length
        if self.values is None or len(self.values) != count or count < 2:
            return None
        steps = np.diff(self.values)
        if not np.allclose(steps, steps.mean(), rtol=_UNEVEN, atol=0) or not steps.mean():
            raise InputError("coordinates", got="uneven steps", wanted="even steps")
        return abs(float(steps.mean())) * count


@dataclass(frozen=True)
class Held:
    """An array in a file. Its values are read only when needed. The object contains the array's type and
    shape, a function that reads its values, and what the file says about the array.

    ``dims`` contains the names of the array's two dimensions. ``coordinates`` maps names of dimensions to
    their coordinates, and may include dimensions of other arrays in the file. ``around`` contains the scalars
    that are stored beside the array, and the attributes of the groups that enclose the array.
    """

    dtype: np.dtype
    shape: Shape
    read: Read
    attributes: Facts = field(default_factory=dict)
    dims: tuple[str, ...] = ("", "")
    coordinates: Mapping[str, Coordinate] = field(default_factory=dict)
    around: Facts = field(default_factory=dict)

    @classmethod
    def in_memory(cls, values: Array, *described: Any) -> Held:
        """Make the object of an array that has already been read. ``described`` contains, in order, the
        values of those fields of ``Held`` that follow the field ``read``.
        """
        native = np.array(values, dtype=values.dtype.newbyteorder("="))
        return cls(native.dtype, native.shape, partial(np.array, native), *described)

    @property
    def is_map(self) -> bool:
        """Return whether the array has at least two rows and two columns of numbers."""
        return self.dtype.kind in f"{_NUMBERS}c" and len(self.shape) == 2 and min(self.shape) > 1


def array_channel(name: str, held: Held) -> Channel:
    """Make the channel of a two-dimensional array. The array is indexed [y, x] unless the names of its
    dimensions say otherwise.

    In the channel, x grows to the right. The rows keep the order of the file, so y may grow downwards or
    upwards.

    Raises:
        InputError: the array has attributes that may scale its values in an unknown way (the message names
            them), its values are not real numbers, or its coordinates are not evenly spaced.
    """
    says = {key: _plain(value) for key, value in held.attributes.items()}
    beside = {key: _plain(value) for key, value in held.around.items()}
    counts = held.dtype.kind in "ui"
    unknown = [f"{key} = {value}" for key, value in says.items() if _changes(key, value, counts)]
    unknown += [
        f"{key} = {value}"
        for key, value in beside.items()
        if _SCALE.fullmatch(key) and isinstance(value, int | float) and value not in (0, 1)
    ]
    if unknown:
        raise InputError(
            "values", got=", ".join(unknown), wanted="scale_factor and add_offset, or plain values"
        )
    if held.dtype.kind not in _NUMBERS:
        raise InputError("values", got=held.dtype, wanted="integers or real numbers")
    (y, x), turned = _axes(held)
    shape = held.shape[::-1] if turned else held.shape
    along = [held.coordinates.get(dim, Coordinate(None, None)) for dim in (y, x)]
    extents = [one.extent(count) for one, count in zip(along, shape, strict=True)]
    units = [one.unit for one in along]
    size_um = extent = None
    if extents[0] and extents[1]:
        if all(unit is not None and is_length(unit) for unit in units):
            size_um = extents[0] * um_per(str(units[0])), extents[1] * um_per(str(units[1]))
        elif units == [None, None]:
            extent = (extents[0], extents[1])
    x_um = along[1].values
    mirrored = x_um is not None and len(x_um) == shape[1] and bool(x_um[0] > x_um[-1])
    unit = next((one[key] for one in (says, beside) for key in one if _UNIT.fullmatch(key)), None)
    scaled = any(key in says for key in _APPLIED)
    return Channel(
        name=name,
        shape=shape,
        unit=str(unit) if unit not in (None, "", "1") else None,
        size_um=size_um,
        load=partial(_values, held.read, says, turned, mirrored),
        full_scale=float(np.iinfo(held.dtype).max) if counts and not scaled else None,
        header={key: str(value) for key, value in says.items()},
        x_is=f"the {'first' if turned else 'second'} index" + (f", {x}" if x else ""),
        extent=extent,
    )


def _axes(held: Held) -> tuple[tuple[str, ...], bool]:
    """Return the names of the dimensions along y and x, and whether the array's first index runs along x.

    If neither dimension has coordinates, the function looks for two coordinates named like x and y, such as
    "lon" and "lat". It returns their names if their lengths match the shape of the array.
    """
    known = held.coordinates
    first, second = ((known[dim].axis if dim in known else "") or dim for dim in held.dims)
    turned = bool((_X.match(first) and not _X.match(second)) or (_Y.match(second) and not _Y.match(first)))
    if not any(dim in known for dim in held.dims):
        lengths = {name: len(one.values) for name, one in known.items() if one.values is not None}
        y, x = (next((name for name in lengths if axis.match(name)), "") for axis in (_Y, _X))
        for other in (turned, not turned):
            if y and x and (lengths[y], lengths[x]) == (held.shape[::-1] if other else held.shape):
                return (y, x), other
    return held.dims[::-1] if turned else held.dims, turned


def _changes(key: str, value: Any, counts: bool) -> bool:
    if key in (*_APPLIED, *_MISSING, *_RANGE) or not isinstance(value, int | float | Array | list):
        return False
    return bool(_UNKNOWN.search(key) or (counts and _OF_COUNTS.fullmatch(key)))


def _plain(value: Any) -> Any:
    """Convert an attribute's value to a number, a text, or a list of numbers."""
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    if isinstance(value, Array):
        return _plain(value.reshape(-1)[0]) if value.size == 1 else value.tolist()
    return value.item() if isinstance(value, np.generic) else value


def _values(raw: Read, says: Facts, turned: bool, mirrored: bool) -> Loaded:
    """Read the values, set missing pixels to NaN, and apply scale and offset.

    The numbers that mark missing pixels are compared with the stored values, before scale and offset are
    applied.
    """
    low, high = says.get("valid_range", (says.get("valid_min", -np.inf), says.get("valid_max", np.inf)))
    missing = [float(one) for key in _MISSING if key in says for one in np.atleast_1d(says[key])]
    values = np.asarray(raw(), dtype=float)
    bad = (values < low) | (values > high) | np.isin(values, missing)
    values = values * float(says.get("scale_factor", 1.0)) + float(says.get("add_offset", 0.0))
    values[bad] = np.nan
    values = values.T if turned else values
    return np.ascontiguousarray(values[:, :: -1 if mirrored else 1]), None


def channels_of(arrays: Mapping[str, Held], around: Facts | None = None) -> list[Channel]:
    """Make one channel per two-dimensional array in a file without groups.

    One-dimensional arrays are taken as coordinates of the two-dimensional arrays (maps). Scalars, such as a
    unit, apply to all maps. ``around`` contains the attributes of the whole file.
    """
    lines = {name: _coordinate(one.read(), one.attributes) for name, one in arrays.items() if _is_line(one)}
    single = {name: one.read().ravel()[0] for name, one in arrays.items() if _size(one) == 1}
    masks = _masks(arrays.items())

    def channel(name: str, one: Held) -> Channel:
        _refuse_mask(one.shape, masks)
        return array_channel(name, replace(one, coordinates=lines, around={**(around or {}), **single}))

    maps = ((name, one) for name, one in arrays.items() if one.is_map)
    return [one_by_one(name, partial(channel, name, one)) for name, one in maps]


def read_hdf5(path: Path, file: Any) -> list[Channel]:
    """Read one channel per two-dimensional dataset of an open HDF5 file.

    MATLAB stores arrays column by column. In MATLAB's files, the first index therefore runs along x.
    """
    datasets: list[Any] = []
    file.visititems(
        lambda name, item: datasets.append(item) if len(getattr(item, "shape", ())) == 2 else None
    )
    matlab = b"MATLAB" in path.open("rb").read(16)
    masks = _masks((item.name, item) for item in datasets)

    def channel(item: Any) -> Channel:
        _refuse_mask(item.shape, masks)
        return array_channel(item.name.strip("/"), _hdf5_array(path, item, matlab))

    maps = [item for item in datasets if min(item.shape) > 1 and item.dtype.kind in _NUMBERS]
    return [one_by_one(item.name.strip("/"), partial(channel, item)) for item in maps]


def _masks(arrays: Iterable[tuple[str, Any]]) -> dict[Shape, str]:
    """Return the names of the arrays that are masks (of type bool), keyed by the shape of the array."""
    return {one.shape: name for name, one in arrays if one.dtype.kind == "b"}


def _refuse_mask(shape: Shape, masks: Mapping[Shape, str]) -> None:
    """Reject a map if the file has a mask of the same shape, because the file does not say whether the mask
    marks valid or missing pixels.
    """
    if shape in masks:
        raise InputError(f"mask {masks[shape]!r}", wanted="no mask, and NaN in unmeasured pixels")


def _hdf5_array(path: Path, item: Any, matlab: bool) -> Held:
    scales = [list(item.dims[axis].values()) for axis in (0, 1)]
    dims = [
        item.dims[k].label or (at[0].name.rsplit("/", 1)[-1] if at else "") for k, at in enumerate(scales)
    ]
    group = item.parent
    if matlab:
        dims = ["x", "y"]
    elif not any(dims):
        stated = next((at[key] for at in (item.attrs, group.attrs) for key in _DIMENSIONS if key in at), "")
        names = re.split(r"[\s,:]+", stated) if isinstance(stated := _plain(stated), str) else stated
        dims = [_plain(name) for name in names] if len(names) == len(dims) else dims
    along = {
        dim: _coordinate(at[0][()], at[0].attrs)
        for dim, at in zip(dims, scales, strict=True)
        if at and not bytes(at[0].attrs.get("NAME", b"")).startswith(_NO_COORDINATE)
    }
    near = {name: one for name, one in group.items() if getattr(one, "size", None)}
    lines = {name: _coordinate(one[()], one.attrs) for name, one in near.items() if _is_line(one)}
    around = {name: one[()] for name, one in near.items() if one.size == 1}
    while group.name != "/":
        around = {**group.attrs, **around}
        group = group.parent
    around = {**group.attrs, **around}
    attributes = {key: value for key, value in item.attrs.items() if key not in _OF_DIMENSIONS}
    read = partial(dataset, path, item.name)
    return Held(item.dtype, item.shape, read, attributes, tuple(dims), along or lines, around)


def _is_line(array: Any) -> bool:
    """Return whether an array contains numbers along a single dimension. Dimensions of length 1 do not count,
    because MATLAB stores a vector as a matrix with one row or column.
    """
    return array.dtype.kind in _NUMBERS and _size(array) > 1 and max(array.shape) == _size(array)


def _size(array: Any) -> int:
    return int(np.prod(array.shape))


def dataset(path: Path, name: str) -> Array:
    """Read the values of a dataset in an HDF5 file."""
    import h5py

    with h5py.File(path) as file:
        return file[name][()]


def _coordinate(values: Array, attributes: Facts) -> Coordinate:
    unit = attributes.get("units", attributes.get("unit"))
    length = attributes.get("length")
    line = np.ravel(values)
    numbers = line.astype(float) if line.dtype.kind in _NUMBERS else None
    axis = str(_plain(attributes.get("axis", attributes.get("standard_name", ""))))
    return Coordinate(
        numbers,
        None if unit is None else str(_plain(unit)),
        None if length is None else float(_plain(length)),
        axis.removeprefix("projection_"),
    )


def read_netcdf(path: Path) -> list[Channel]:
    """Read one channel per two-dimensional variable of a NetCDF 3 file.

    Scale, unit and missing pixels are taken from the attributes that the CF conventions define.
    """
    from scipy.io import netcdf_file

    with netcdf_file(path, "r", mmap=False) as file:
        held = {
            name: Held.in_memory(
                np.array(one[:]) if one.shape else np.array(one.getValue()), one._attributes, one.dimensions
            )
            for name, one in file.variables.items()
        }
        return channels_of(held, dict(file._attributes))


def read_matlab(path: Path) -> list[Channel]:
    """Read one channel per matrix of a MATLAB file. A row of the matrix is a row of the map."""
    if path.open("rb").read(len(_MATLAB_7)) == _MATLAB_7:
        import h5py

        with h5py.File(path) as file:
            return read_hdf5(path, file)
    from scipy.io import loadmat

    found = {name: one for name, one in loadmat(path).items() if isinstance(one, Array)}
    arrays = {name: Held.in_memory(one) for name, one in found.items() if not one.dtype.hasobject}
    return channels_of(arrays)


_PARSERS = ("scipy.io", "h5py")
NETCDF_READER = Reader(
    "netcdf", lambda path, head: head.startswith((b"CDF\x01", b"CDF\x02")), read_netcdf, _PARSERS
)
MATLAB_READER = Reader("matlab", lambda path, head: head.startswith(b"MATLAB "), read_matlab, _PARSERS)
