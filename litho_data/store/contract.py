"""What a store must hold before anything is read from it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.store.access import array_of, group_of, has_child, values_of
from litho_data.store.schema import SAMPLE_VARIABLES

if TYPE_CHECKING:
    import zarr


def checked_attributes(root: zarr.Group, path: Path) -> dict[str, Any]:
    """Name, pitch, level height, number of levels and write table of a store; InputError if one is wrong."""
    attributes = dict(root.attrs)
    checked: dict[str, Any] = {
        "name": str(attributes.get("name", path.stem)),
        "write": attributes.get("write"),
    }
    for key in ("pitch_um", "level_height_um"):
        value = attributes.get(key)
        if not isinstance(value, int | float) or not math.isfinite(value) or value <= 0:
            raise InputError(f"attribute {key} of {path}", got=repr(value), wanted="a positive number in µm")
        checked[key] = float(value)
    levels = attributes.get("levels")
    if not isinstance(levels, int) or not 2 <= levels <= 256:
        raise InputError(
            f"attribute levels of {path}", got=repr(levels), wanted="a whole number from 2 to 256"
        )
    return {**checked, "levels": levels}


def checked_arrays(root: zarr.Group, path: Path) -> dict[str, zarr.Array]:
    """The arrays over all scans by name; InputError where one is missing or of another shape or type."""
    names = (*(variable.name for variable in SAMPLE_VARIABLES), "scan", "print", "order")
    arrays = {name: array_of(root, name) for name in names}
    count, field = arrays["scan"].shape[0], arrays["mask_level"].shape[1:]
    for variable in SAMPLE_VARIABLES:
        array = arrays[variable.name]
        wanted = (count, 3, 3) if variable.name == "scan_to_layout" else (count, *field)
        if array.shape != wanted or array.dtype != np.dtype(variable.dtype):
            got, wanted_text = f"{array.dtype} {array.shape}", f"{variable.dtype} {wanted}"
            raise InputError(f"array {variable.name} of {path}", got=got, wanted=wanted_text)
    return arrays


def true_shapes(root: zarr.Group, count: int, padded: tuple[int, ...]) -> list[tuple[int, int]]:
    """(ny, nx) of every scan without its padding."""
    if not has_child(root, "quality"):
        return [(padded[0], padded[1])] * count
    quality = group_of(root, "quality")
    rows, columns = values_of(quality, "layout_ny"), values_of(quality, "layout_nx")
    return [(int(ny), int(nx)) for ny, nx in zip(rows, columns, strict=True)]
