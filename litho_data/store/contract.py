"""Check a store when it is opened. A store is refused if it lacks a file that its metadata declare, or if a
value is out of range.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from litho_data.foundation import Array, Facts, InputError, damaged, require_known
from litho_data.foundation.names import require_plain_name
from litho_data.foundation.quantities import (
    HEIGHT_UM,
    LENGTH_UM,
    LEVEL_HEIGHT_UM,
    LEVELS,
    ORDER,
    PITCH_UM,
    Range,
)
from litho_data.store.access import array_of, group_of, has_child, values_if_any, values_of
from litho_data.store.schema import (
    LAYOUT_VARIABLES,
    OPTIONAL_COLUMNS,
    SAMPLE_VARIABLES,
    SIGMA,
    TEXT_COLUMNS,
    WRITE,
    Instrument,
    Surround,
)
from litho_data.store.write import pixel_centres_um

if TYPE_CHECKING:
    import zarr

_DOCUMENT = "zarr.json"
_LEADS_OUT = re.compile(r"(^|/)\.\.(/|$)|[\\:\x00]")


def require_complete(path: Path) -> None:
    """Refuse a store if one of its files is missing. Without this check, zarr would read zeros or NaN in
    place of the file.

    Raises:
        InputError: a file is missing; the message names the first one.
    """
    for name in missing_files(path):
        raise InputError(
            f"store {path}",
            got=f"no {name}",
            wanted="every file that it declares",
            hint="copy or build the store again; a program that copies it must write empty chunks too",
        )


def missing_files(path: Path) -> Iterator[str]:
    """Yield the names of missing metadata documents and chunks. A file is missing if the metadata of the
    store declare it but it does not exist.
    """
    names = file_names(path)
    with damaged(f"metadata of {path}"):
        documents = {name: json.loads(content) for name, content in read_documents(path, names)}
        root = documents[_DOCUMENT]
        declared = {
            f"{name}/{_DOCUMENT}" for name in (root.get("consolidated_metadata") or {}).get("metadata", {})
        }
        yield from sorted(declared - documents.keys())
        groups = [name for name, document in documents.items() if document["node_type"] == "group"]
        for name, document in documents.items():
            left_out = groups == [_DOCUMENT] and _may_be_left_out(name, document)
            if document["node_type"] == "array" and not left_out:
                folder = name.removesuffix(_DOCUMENT)
                yield from (folder + chunk for chunk in _chunks(document) if folder + chunk not in names)


def _may_be_left_out(name: str, document: Facts) -> bool:
    """Return whether the chunk of this array may be missing if the store is a copy made by xarray.

    When xarray copies a store, it writes no groups, and no chunks that contain only fill values. The chunk of
    an optional column contains only fill values if no scan of the copy has a value. The chunk of the column
    ``order`` contains only fill values if the copy has a single scan, whose order is 0.
    """
    column = name.removesuffix(f"/{_DOCUMENT}")
    return column in (*OPTIONAL_COLUMNS, *TEXT_COLUMNS) or (column == "order" and document["shape"] == [1])


def file_names(path: Path) -> set[str]:
    """Return the names of all files in a store (a folder or a zip file), with forward slashes.

    Raises:
        InputError: a name in the zip file points outside the store.
    """
    if path.is_dir():
        found = (os.path.join(folder, name) for folder, _, names in os.walk(path) for name in names)
        start = len(os.path.join(path, ""))
        # A dangling link does not count as a file.
        return {file[start:].replace(os.sep, "/") for file in found if os.path.isfile(file)}
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    for name in names:
        if name.startswith("/") or _LEADS_OUT.search(name):
            raise InputError(f"store {path}", got=f"a file {name!r}", wanted="names inside the store")
    return set(names)


def read_documents(path: Path, names: set[str]) -> Iterator[tuple[str, bytes]]:
    """Yield pairs (name, content) for the metadata documents among the files of a store."""
    wanted = sorted(name for name in names if name.split("/")[-1] == _DOCUMENT)
    if path.is_dir():
        yield from ((name, (path / name).read_bytes()) for name in wanted)
        return
    with zipfile.ZipFile(path) as archive:
        yield from ((name, archive.read(name)) for name in wanted)


def _chunks(document: Facts) -> Iterator[str]:
    """Yield the names of the chunk files of an array, relative to its folder. ``document`` is the metadata
    document of the array.
    """
    sizes = document["chunk_grid"]["configuration"]["chunk_shape"]
    encoding = document["chunk_key_encoding"]
    with_c = encoding["name"] == "default"
    between = encoding.get("configuration", {}).get("separator", "/" if with_c else ".")
    counts = [math.ceil(length / size) for length, size in zip(document["shape"], sizes, strict=True)]
    for place in itertools.product(*map(range, counts)):
        numbers = [*(["c"] if with_c else []), *map(str, place)]
        yield between.join(numbers) or "0"


def checked_attributes(root: zarr.Group, path: Path) -> dict[str, Any]:
    """Return the name, pitch, level height, number of levels, ``write`` table and instrument that a store
    states in its attributes. Raise InputError if a value is invalid.
    """
    attributes = dict(root.attrs)
    name = str(attributes.get("name", path.name.partition(".")[0]))
    write = {key.removeprefix(WRITE): value for key, value in attributes.items() if key.startswith(WRITE)}
    checked: dict[str, Any] = {"name": require_plain_name(f"name of {path}", name), "write": write or None}
    for key, limits in (("pitch_um", PITCH_UM), ("level_height_um", LEVEL_HEIGHT_UM), ("levels", LEVELS)):
        value = attributes.get(key)
        whole = key == "levels"
        if not isinstance(value, int if whole else int | float) or not limits.holds(value):
            wanted = f"a {'whole ' if whole else ''}number from {limits}"
            raise InputError(f"attribute {key} of {path}", got=repr(value), wanted=wanted)
        checked[key] = value if whole else float(value)
    checked["instrument"] = attributes.get("instrument", "afm")
    require_known(f"instrument of {path}", checked["instrument"], get_args(Instrument))
    if "field_um" in write:
        LENGTH_UM.require(f"write_field_um of {path}", write["field_um"])
    return checked


def checked_arrays(root: zarr.Group, path: Path) -> dict[str, zarr.Array[Any]]:
    """Return the arrays that have one entry per scan, keyed by name. Raise InputError if one of these arrays
    is missing or has a wrong shape, type or dimensions.
    """
    names = (*(variable.name for variable in SAMPLE_VARIABLES), "scan", "print", "order")
    arrays = {name: array_of(root, name) for name in names}
    if has_child(root, SIGMA.name):
        arrays[SIGMA.name] = array_of(root, SIGMA.name)
    count, field = arrays["scan"].shape[0], arrays["mask_level"].shape[1:]
    for variable in LAYOUT_VARIABLES:
        if variable.name not in arrays:
            continue
        array = arrays[variable.name]
        wanted = (count, 3, 3) if variable.name == "scan_to_layout" else (count, *field)
        # xarray stores booleans as small integers, and records the original type in the attribute ``dtype``.
        as_integers = variable.dtype == array.attrs.get("dtype") == "bool"
        known = as_integers or str(array.dtype) in (variable.dtype, variable.wider)
        if array.shape != wanted or not known:
            got, wanted_text = f"{array.dtype} {array.shape}", f"{variable.dtype} {wanted}"
            raise InputError(f"array {variable.name} of {path}", got=got, wanted=wanted_text)
        dims: Any = array.metadata.to_dict()["dimension_names"]
        if tuple(dims or ()) != variable.dims:
            raise InputError(f"dimensions of {variable.name} of {path}", got=dims, wanted=variable.dims)
    return arrays


def require_own_pixels(root: zarr.Group, path: Path, shape: Sequence[int], pitch_um: float) -> None:
    """Refuse a copied store if its rows or columns of pixels were reordered, or if rows or columns other than
    the last ones were removed. The coordinates of the pixels show such changes.

    Positions in the store, such as the transforms of the scans, are relative to the first pixel. A copy may
    therefore leave out only the last rows and columns.

    Raises:
        InputError: the copy is refused; the message names the coordinate.
    """
    for name, count in (
        (f"{axis}{unit}", n) for axis, n in zip("yx", shape, strict=True) for unit in ("_um", "")
    ):
        found, wanted = values_if_any(root, name), pixel_centres_um(count, pitch_um)
        if found is None:
            continue
        if found.shape != wanted.shape or not np.allclose(found, wanted, rtol=1e-6, atol=0):
            got, shown = (f"{', '.join(f'{one:g}' for one in line[:3])}, …" for line in (found, wanted))
            hint = "a copy may omit scans and be cropped at the end, but not elsewhere"
            raise InputError(f"{name} of {path}", got=got, wanted=shown, hint=hint)


def checked_columns(root: zarr.Group, path: Path) -> dict[str, list[Any]]:
    """Return the columns of a store, keyed by name: ``scan`` (the ids), ``print``, ``order`` and all optional
    columns. Each column has one value per scan.

    Missing numbers are returned as None, and missing strings as "".

    Raises:
        InputError: there is no scan, an id occurs twice or contains a path, a column does not have one value
            per scan, or a number is out of range.
    """
    columns: dict[str, list[Any]] = {
        name: [require_plain_name(f"{name} of {path}", str(value)) for value in values_of(root, name)]
        for name in ("scan", "print")
    }
    ids = columns["scan"]
    if not ids:
        raise InputError(f"scans of {path}", got="none", wanted="at least one")
    if len(set(ids)) != len(ids):
        raise InputError(f"scan ids of {path}", got="duplicates", wanted="unique ids")
    order = values_of(root, "order")
    ORDER.require(f"order of {path}", order)
    columns["order"] = [int(value) for value in order]
    for name, limits in OPTIONAL_COLUMNS.items():
        columns[name] = [None] * len(ids)
        column = values_if_any(root, name)
        if column is not None:
            values = column.tolist()
            # NaN is not equal to itself, so this condition leaves it out.
            limits.require(f"{name} of {path}", [value for value in values if value == value])
            columns[name] = [float(value) if value == value else None for value in values]
    for name in TEXT_COLUMNS:
        texts = values_if_any(root, name)
        columns[name] = [""] * len(ids) if texts is None else [str(text) for text in texts]
    for word in columns["surround"]:
        require_known(f"surround of {path}", word, ("", *get_args(Surround)))
    for name, values in columns.items():
        if len(values) != len(ids):
            raise InputError(
                f"{name} of {path}", got=f"{len(values)} values", wanted=f"{len(ids)}, one per scan"
            )
    return columns


def true_shapes(root: zarr.Group, path: Path, count: int, padded: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return the shape (ny, nx) of every scan without its padding. Raise InputError if a shape exceeds the
    shape of the padded array.
    """
    if not has_child(root, "quality"):
        return [(padded[0], padded[1])] * count
    quality = group_of(root, "quality")
    sides = [values_of(quality, name) for name in ("layout_ny", "layout_nx")]
    for side, most in zip(sides, padded, strict=True):
        if len(side) != count or not Range(1, most).holds(side):
            got = ", ".join(map(str, side.tolist()[:3]))
            raise InputError(
                f"sizes of the layouts of {path}", got=got, wanted=f"{count} sizes from 1 to {most} px"
            )
    return [(int(ny), int(nx)) for ny, nx in zip(*sides, strict=True)]


def require_possible(samples: Mapping[str, Array], levels: int, what: str) -> None:
    """Refuse a scan if one of its levels or heights is out of range, its transform to the layout is not
    invertible, or none of its pixels was measured.

    Raises:
        InputError: the scan is refused; the message names the value.
    """
    highest = int(samples["mask_level"].max())
    if highest >= levels:
        raise InputError(f"level in the layout of {what}", got=highest, wanted=f"0 to {levels - 1}")
    measured = samples["height_um"][samples["valid"]]
    measured = measured[np.isfinite(measured)]
    if not measured.size:
        raise InputError(f"measured pixels of {what}", got="none", wanted="at least one")
    HEIGHT_UM.require(f"height_um of {what}", np.array([measured.min(), measured.max()]))
    transform = samples["scan_to_layout"]
    if not np.isfinite(transform).all() or abs(np.linalg.det(transform)) == 0:
        raise InputError(
            f"scan_to_layout of {what}", got=transform.tolist(), wanted="an invertible transform"
        )


def require_manifest(manifest: Facts, path: Path) -> None:
    """Refuse a manifest that lacks an entry which other functions read.

    A manifest that was not written by a build contains only the table of files. Fewer entries are then
    required.

    Raises:
        InputError: an entry is missing or has the wrong type; the message names the first one.
    """
    with damaged(f"manifest of {path}"):
        texts: list[Any] = []
        if built := set(manifest) > {"files"}:
            card, build = dict(manifest["card"]), dict(manifest["build"])
            dict(build["software"]["versions"])
            texts = [card["name"], build["data_dir"], build["started"]]
        for row in manifest["files"]:
            texts += [row[name] for name in ("path", "scan", "sha256", "read", *["status"] * built)]
            pitch = dict(json.loads(row["read"] or "{}")).get("pitch_um")
            if pitch is not None:
                PITCH_UM.require("pitch_um", [pitch[0], pitch[1]])
        if not all(isinstance(text, str) for text in texts):
            raise TypeError("a number where a string is required")
