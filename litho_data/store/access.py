"""Typed functions that read Zarr groups and arrays. They raise a clear InputError if stored bytes are
damaged.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from litho_data.foundation import Array, InputError

if TYPE_CHECKING:
    import pandas as pd
    import zarr

T = TypeVar("T")


def open_root(path: str | Path) -> zarr.Group:
    """Open the root group of a store read-only, without using its consolidated metadata.

    Raises:
        InputError: the path does not exist, or is not a Zarr v3 group.
    """
    import zarr
    from zarr.storage import ZipStore

    location = Path(path)
    if not location.exists():
        raise InputError(
            "dataset store",
            got=f"{location}, which does not exist",
            wanted="an existing .zarr folder or .zarr.zip file",
        )
    try:
        source = ZipStore(location, mode="r") if location.is_file() else location
        return zarr.open_group(source, mode="r", zarr_format=3, use_consolidated=False)
    except Exception as error:  # zarr lets the errors of its metadata parsers through
        raise InputError(
            f"cannot open {location} as a dataset store",
            got="no Zarr v3 group",
            wanted="a store made by `litho-data build`",
        ) from error


def group_of(parent: zarr.Group, name: str) -> zarr.Group:
    """Return the child group ``name`` of a group.

    Raises:
        InputError: there is no group with this name.
    """
    import zarr

    return _of_kind(parent, name, zarr.Group, "group")


def array_of(parent: zarr.Group, name: str) -> zarr.Array[Any]:
    """Return the child array ``name`` of a group.

    Raises:
        InputError: there is no array with this name.
    """
    import zarr

    return _of_kind(parent, name, zarr.Array, "array")


def has_child(parent: zarr.Group, name: str) -> bool:
    """Return whether a group has a child group or array ``name``.

    Raises:
        InputError: the child exists, but its metadata is damaged.
    """
    return _child(parent, name) is not None


def values_of(parent: zarr.Group, name: str) -> Array:
    """Return all values of the child array ``name`` of a group.

    Raises:
        InputError: there is no such array, or a stored chunk cannot be decoded.
    """
    return _all_of(parent, name, array_of(parent, name))


def values_if_any(parent: zarr.Group, name: str) -> Array | None:
    """Return all values of the child array ``name`` of a group, or None if there is no such child.

    Raises:
        InputError: the child is a group, its metadata are damaged, or a stored chunk cannot be decoded.
    """
    import zarr

    child = _child(parent, name)
    if child is None:
        return None
    return _all_of(parent, name, child) if isinstance(child, zarr.Array) else values_of(parent, name)


def decoded(array: zarr.Array[Any], selection: Any, what: str) -> Array:
    """Read a selection of an array; error messages refer to the array as ``what``.

    Raises:
        InputError: a stored chunk cannot be decoded.
    """
    try:
        return np.asarray(array[selection])
    except Exception as error:  # each codec raises its own type for damaged bytes
        raise InputError(
            f"{what} cannot be decoded", got=str(error), hint="the stored chunk is damaged"
        ) from error


def groups_in(parent: zarr.Group) -> dict[str, zarr.Group]:
    """Return all child groups of a group, keyed by name.

    Raises:
        InputError: a child has damaged metadata.
    """
    import zarr

    return {name: child for name, child in _children(parent).items() if isinstance(child, zarr.Group)}


def read_table(group: zarr.Group, first: str) -> pd.DataFrame:
    """Read the one-dimensional arrays of a group as the columns of a table. The column named ``first`` comes
    first, and the others follow in alphabetical order.

    Raises:
        InputError: metadata or chunks are damaged, or the columns have different lengths.
    """
    import pandas as pd
    import zarr

    arrays = {name: child for name, child in _children(group).items() if isinstance(child, zarr.Array)}
    names = sorted(arrays, key=lambda name: (name != first, name))
    columns = {name: _plain(_all_of(group, name, arrays[name])) for name in names}
    if len({values.shape for values in columns.values()}) > 1:
        raise InputError(
            f"table {group.store_path}", got="columns of different lengths", wanted="equal lengths"
        )
    return pd.DataFrame(columns)


def _all_of(parent: zarr.Group, name: str, array: zarr.Array[Any]) -> Array:
    return decoded(array, ..., f"{name} of {parent.store_path}")


def _children(parent: zarr.Group) -> dict[str, Any]:
    try:
        return dict(parent.members())
    except Exception as error:  # zarr lets the errors of its metadata parsers through
        raise InputError(f"metadata in {parent.store_path} is damaged", got=str(error)) from error


def _child(parent: zarr.Group, name: str) -> Any:
    try:
        return parent.get(name)
    except Exception as error:  # zarr lets the errors of its metadata parsers through
        raise InputError(f"metadata of {name} in {parent.store_path} is damaged", got=str(error)) from error


def _of_kind(parent: zarr.Group, name: str, kind: type[T], what: str) -> T:
    child = _child(parent, name)
    if not isinstance(child, kind):
        wanted = "a store made by litho-data"
        raise InputError(f"{what} {name} of {parent.store_path}", got="none", wanted=wanted)
    return child


def _plain(values: Array) -> Array:
    return np.array([str(value) for value in values], dtype=object) if values.dtype.kind in "OTU" else values
