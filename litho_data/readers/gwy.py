"""Gwyddion's own files: every data field is a channel, and a mask stays a mask."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import is_length, um_per
from litho_data.readers.channel import Channel, with_unique_names
from litho_data.readers.foreign import foreign_parser
from litho_data.readers.gwy_structure import check_structure

_FIELD_KEY = re.compile(r"/(\d+)/data")


def read_channels(path: Path) -> list[Channel]:
    """One channel per data field; heights under a mask are kept, and the mask beside them.

    A pixel counts as masked where the mask is above zero. The metadata that Gwyddion keeps for a
    channel is its header.

    Raises:
        InputError: damaged file, or a field whose data do not fit its size.
    """
    import gwyfile

    check_structure(path)
    with foreign_parser(path, "GWY"):
        container = gwyfile.load(str(path))
        keys = sorted(
            (key for key in container if _FIELD_KEY.fullmatch(key)), key=lambda key: int(key.split("/")[1])
        )
        return with_unique_names([_channel(path, container, key) for key in keys])


def _channel(path: Path, container: Any, key: str) -> Channel:
    number = key.split("/")[1]
    field = container[key]
    shape = (int(field["yres"]), int(field["xres"]))
    values = _pixels(path, key, field, shape)
    mask_field = container.get(f"/{number}/mask")
    mask = None if mask_field is None else _pixels(path, f"/{number}/mask", mask_field, shape) > 0
    return Channel(
        name=str(container.get(f"{key}/title", f"channel {number}")),
        shape=shape,
        unit=_unit(field, "si_unit_z"),
        size_um=_size_um(field),
        load=lambda: (values, mask),
        header=_header(container.get(f"/{number}/meta")),
    )


def _pixels(path: Path, key: str, field: Any, shape: tuple[int, int]) -> np.ndarray:
    data = np.asarray(field["data"], dtype=np.float64)
    if data.size != shape[0] * shape[1]:
        raise InputError(f"{path} {key}: values", got=data.size, wanted=f"{shape[0]} x {shape[1]}")
    return data.reshape(shape)


def _unit(field: Any, key: str) -> str | None:
    """None where Gwyddion states no unit, which it also uses for pure numbers."""
    unit = field.get(key)
    return None if unit is None else str(unit.get("unitstr", "")) or None


def _size_um(field: Any) -> tuple[float, float] | None:
    unit = _unit(field, "si_unit_xy")
    if unit is None or not is_length(unit):
        return None
    size = float(field["yreal"]) * um_per(unit), float(field["xreal"]) * um_per(unit)
    return size if all(np.isfinite(size)) and min(size) > 0 else None


def _header(meta: Any) -> dict[str, str]:
    return {} if meta is None else {str(key): str(value) for key, value in meta.items()}
