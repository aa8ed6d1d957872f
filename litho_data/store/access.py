"""Typed, checked access to Zarr groups and arrays; damaged bytes become one clear error."""

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
    """The root group of a store, read-only, without trusting consolidated metadata.

    Raises:
        InputError: no such path, or not a Zarr v3 group.
    """
    import zarr
    from zarr.storage import ZipStore

    location = Path(path)
    if not location.exists():
        raise InputError(
            "dataset store", got=f"{location}, which does not exist", wanted="a .zarr folder or .zarr.zip"
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
    """The child group of that name.

    Raises:
        InputError: there is none.
    """
    import zarr

    return _of_kind(parent, name, zarr.Group, "group")


def array_of(parent: zarr.Group, name: str) -> zarr.Array[Any]:
    """The child array of that name.

    Raises:
        InputError: there is none.
    """
    import zarr

    return _of_kind(parent, name, zarr.Array, "array")


def has_child(parent: zarr.Group, name: str) -> bool:
    """Whether there is a child of that name.

    Raises:
        InputError: there is one, with damaged metadata.
    """
    return _child(parent, name) is not None


def values_of(parent: zarr.Group, name: str) -> Array:
    """All values of a child array.

    Raises:
        InputError: no such array, or a stored chunk that does not decode.
    """
    return decoded(array_of(parent, name), ..., f"{name} of {parent.store_path}")


def decoded(array: zarr.Array[Any], selection: Any, what: str) -> Array:
    """A selection of an array.

    Raises:
        InputError: a stored chunk that does not decode; the message names its array.
    """
    try:
        return np.asarray(array[selection])
    except Exception as error:  # each codec raises its own type for damaged bytes
        raise InputError(
            f"{what} does not decode", got=str(error), hint="the stored chunk is damaged"
        ) from error


def groups_in(parent: zarr.Group) -> dict[str, zarr.Group]:
    """All child groups by name.

    Raises:
        InputError: a child with damaged metadata.
    """
    import zarr

    return {name: child for name, child in _children(parent).items() if isinstance(child, zarr.Group)}


def read_table(group: zarr.Group, first: str) -> pd.DataFrame:
    """The one-dimensional arrays of a group as a table, with the column ``first`` in front.

    Raises:
        InputError: damaged metadata or chunks, or columns of different lengths.
    """
    import pandas as pd
    import zarr

    names = [name for name, child in _children(group).items() if isinstance(child, zarr.Array)]
    columns = {name: _plain(values_of(group, name)) for name in sorted(names, key=lambda n: (n != first, n))}
    if len({values.shape for values in columns.values()}) > 1:
        raise InputError(f"table {group.store_path}", got="columns of different lengths", wanted="one length")
    return pd.DataFrame(columns)


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
