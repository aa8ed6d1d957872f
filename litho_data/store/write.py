"""Write a dataset store. Each chunk contains one scan and has a checksum."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation import Array, Facts, Shape
from litho_data.store.schema import (
    LAYOUT_VARIABLES,
    MIXED_UNITS,
    OPTIONAL_COLUMNS,
    SAMPLE_VARIABLES,
    SCAN_VARIABLES,
    SIGMA,
    TEXT_COLUMNS,
    VARIABLES,
)

if TYPE_CHECKING:
    import pandas as pd
    import zarr

PADDING = {"mask_level": 0, "height_um": np.nan, "valid": False, "height_sigma_um": np.nan}
"""Values with which the arrays of smaller layouts are padded to the size of the largest layout, keyed by
array name.
"""
# Names of the arrays that can be shown as the OME-Zarr image of a scan, in order of preference.
SHOWN = ("micrograph", "levelled_height_um", "raw_height_um")
_OWN_FRAME = {"y": "scan_y", "x": "scan_x"}


def write_scan_group(
    root: zarr.Group, scan_id: str, arrays: Mapping[str, Array], use: str, pitch_um: Sequence[float]
) -> None:
    """Write the group ``scans/<id>``. It contains the arrays of a scan that lie on the scan's own pixel grid.
    The group is also an OME-Zarr image.

    Args:
        root: the open root group of the store.
        scan_id: name of the scan.
        arrays: arrays of the scan, keyed by name. Those that are not listed in ``SCAN_VARIABLES`` are
            ignored.
        use: purpose of the scan, as in the column ``use`` of the card's table.
        pitch_um: pixel pitch of the scan along y and x, µm.
    """
    shown = next(name for name in SHOWN if name in arrays)
    attributes = {"use": use, "ome": _ome(scan_id, shown, pitch_um)}
    group = root.create_group(f"scans/{scan_id}", overwrite=True, attributes=attributes)
    for variable in SCAN_VARIABLES:
        if variable.name in arrays:
            array = arrays[variable.name]
            described = {"dtype": variable.dtype, "chunks": array.shape}
            _create(group, variable.name, array.shape, **described)[...] = array


def _ome(name: str, path: str, pitch_um: Sequence[float]) -> dict[str, Any]:
    """Return the OME-NGFF 0.5 description of an image. The axes of the image have the names of the array's
    dimensions.
    """
    axes = [{"name": _OWN_FRAME[axis], "type": "space", "unit": "micrometer"} for axis in "yx"]
    scale = [{"type": "scale", "scale": [float(one) for one in pitch_um]}]
    dataset = {"path": path, "coordinateTransformations": scale}
    return {"version": "0.5", "multiscales": [{"name": name, "axes": axes, "datasets": [dataset]}]}


def write_samples(
    root: zarr.Group,
    scans: Sequence[Facts],
    load: Callable[[str], Mapping[str, Array]],
    pitch_um: float,
) -> None:
    """Write the arrays that have one entry per scan. One scan is written at a time.

    Args:
        root: the open root group of the store.
        scans: one dict per scan with ``id``, ``print``, ``order``, ``shape`` (ny, nx), ``columns`` (optional
            numbers and words) and ``arrays`` (names of the arrays that were made from the scan).
        load: function that takes the id of a scan and returns the arrays of this scan on the layout grid.
        pitch_um: pitch of the layout grid, µm.
    """
    ny, nx = (max(scan["shape"][axis] for scan in scans) for axis in (0, 1))
    field_shape = {"y": ny, "x": nx, "row": 3, "column": 3}
    with_sigma = all(SIGMA.name in scan["arrays"] for scan in scans)
    arrays, first = {}, load(scans[0]["id"])
    for variable in LAYOUT_VARIABLES if with_sigma else SAMPLE_VARIABLES:
        sample = tuple(field_shape[dim] for dim in variable.sample_dims)
        described = {"dtype": variable.stored_as(first[variable.name]), "chunks": (1, *sample)}
        arrays[variable.name] = _create(root, variable.name, (len(scans), *sample), **described)
    arrays["height_um"].attrs["ancillary_variables"] = f"valid {SIGMA.name}" if with_sigma else "valid"
    for row, scan in enumerate(scans):
        loaded = load(scan["id"])
        for name, array in arrays.items():
            array[row] = _padded(name, loaded[name], array.shape[1:])

    write_strings(root, "scan", [scan["id"] for scan in scans], "scan")
    write_strings(root, "print", [scan["print"] for scan in scans], "scan")
    orders = np.array([scan["order"] for scan in scans], dtype=np.int64)
    write_numbers(root, "order", orders, "scan", attributes={"long_name": "position in the writing order"})
    for name in OPTIONAL_COLUMNS:
        if any(name in scan["columns"] for scan in scans):
            values = [scan["columns"].get(name, np.nan) for scan in scans]
            unit = {"units": "um" if name.endswith("_um") else "degree" if name.endswith("_deg") else "1"}
            write_numbers(root, name, np.array(values), "scan", attributes=unit)
    for name in TEXT_COLUMNS:
        if any(name in scan["columns"] for scan in scans):
            write_strings(root, name, [str(scan["columns"].get(name, "")) for scan in scans], "scan")
    for axis, count in (("y", ny), ("x", nx)):
        described = {"long_name": f"{axis} of the pixel centres, layout frame", "units": "um"}
        centres = pixel_centres_um(count, pitch_um)
        write_numbers(root, f"{axis}_um", centres, axis, attributes=described)
        # By the CF conventions, only one of an array's coordinates per dimension may have the attribute
        # ``axis``.
        write_numbers(root, axis, centres, axis, attributes={**described, "axis": axis.upper()})


def pixel_centres_um(count: int, pitch_um: float) -> Array:
    """Return the coordinates, in µm, of the centres of ``count`` pixels along one axis."""
    return (np.arange(count) + 0.5) * pitch_um


def write_table(
    root: zarr.Group, name: str, table: pd.DataFrame, dim: str, attributes: dict[str, Any] | None = None
) -> None:
    """Write a table as a group of one-dimensional arrays over ``dim``; all strings are encoded in UTF-8.

    All columns of the same type share one array in memory, because creating an array for each column would
    take three times as long. The columns are written to this array one after another. After each column, the
    files of the array are copied to the store.
    """
    import zarr
    from zarr.storage import MemoryStore

    root.create_group(name, attributes=attributes or {})
    store: Any = root.store
    files: dict[str, Any] = {}
    scratch, made = zarr.create_group(MemoryStore(files), zarr_format=3), {}
    for column in table.columns:
        values = table[column].to_numpy()
        numeric = values.dtype.kind in "biuf"
        dtype = values.dtype.name if numeric else "string"
        if dtype not in made:
            made[dtype] = _column(scratch, dtype, len(values), dim, dtype)
        made[dtype][...] = values if numeric else np.array([str(value) for value in values], dtype=object)
        for key in [key for key in files if key.startswith(f"{dtype}/")]:
            file = store.root / root.path / name / str(column) / key.removeprefix(f"{dtype}/")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(files[key].to_bytes())


def write_strings(group: zarr.Group, name: str, values: Sequence[str], dim: str) -> None:
    """Write a one-dimensional array of UTF-8 strings."""
    _column(group, name, len(values), dim, "string")[...] = np.array(values, dtype=object)


def write_numbers(
    group: zarr.Group, name: str, values: Array, dim: str, attributes: Facts | None = None
) -> None:
    """Write a one-dimensional array of numbers."""
    _column(group, name, len(values), dim, values.dtype, attributes=dict(attributes or {}))[...] = values


def _column(group: zarr.Group, name: str, size: int, dim: str, dtype: Any, **more: Any) -> zarr.Array[Any]:
    return _array(
        group, name, shape=(size,), chunks=(max(size, 1),), dtype=dtype, dimension_names=(dim,), **more
    )


def _array(group: zarr.Group, name: str, **described: Any) -> zarr.Array[Any]:
    """Create an array. Its bytes are shuffled and then compressed by Zstandard, and a checksum reveals
    damage.

    Chunks that contain only fill values are written too. By default, zarr writes no file for such a chunk.
    The chunk could then not be distinguished from a lost one.
    """
    from zarr.codecs import BloscCodec, Crc32cCodec

    packed = [BloscCodec(cname="zstd", clevel=5, shuffle="shuffle"), Crc32cCodec()]
    return group.create_array(name, compressors=packed, config={"write_empty_chunks": True}, **described)


def consolidate(root: zarr.Group) -> None:
    """Copy all metadata into the root's document, so that xarray can open the store with one read."""
    import zarr

    with warnings.catch_warnings():
        # zarr-python warns that some readers may not support consolidated metadata. Such readers use the
        # separate documents.
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        zarr.consolidate_metadata(root.store)


def _create(group: zarr.Group, name: str, shape: Shape, **layout: Any) -> zarr.Array[Any]:
    variable = VARIABLES[name]
    unit = {"comment": MIXED_UNITS[name]} if name in MIXED_UNITS else {"units": variable.unit}
    attributes = {**unit, "long_name": variable.long_name}
    if variable.dims[:2] == ("scan", "y"):
        attributes["coordinates"] = "print order y_um x_um"
    # A scan's own pixel grid and the layout grid differ in size, so their dimensions need different names
    # within one store.
    frame = {} if variable.dims[0] == "scan" else _OWN_FRAME
    names = tuple(frame.get(dim, dim) for dim in variable.dims)
    return _array(
        group,
        name,
        shape=shape,
        fill_value=np.nan if variable.dtype.startswith("float") else 0,
        dimension_names=names,
        attributes=attributes,
        **layout,
    )


def _padded(name: str, sample: Array, shape: Shape) -> Array:
    """Pad one scan's array to the common shape. The array lies in the upper left corner, and all other pixels
    have the value from ``PADDING``.
    """
    if sample.shape == shape:
        return sample
    whole = np.full(shape, PADDING[name], dtype=sample.dtype)
    whole[: sample.shape[0], : sample.shape[1]] = sample
    return whole
