"""Nanonis SXM: a text header in sections, then float32 images, two directions per channel."""

import re
from functools import partial
from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Shape
from litho_data.readers.reader import DAMAGED, Channel, Loaded, Reader, extent_um

_MAGIC = b":NANONIS_VERSION:"
_END, _DATA = b":SCANIT_END:", b"\x1a\x04"
_SECTION = re.compile(r"^:([^:\n]*(?::[^:\n]+)*):[ \t]*$", re.MULTILINE)
_FORWARD, _BACKWARD = ("forward", "fwd"), ("backward", "bwd")
_ITEM, _ORDERS = 4, {"MSBFIRST": ">f4", "LSBFIRST": "<f4"}


def read_channels(path: Path) -> list[Channel]:
    """One channel per signal and direction; backward scans are mirrored to run along x.

    Pixels of an unfinished scan are NaN in the file.

    Raises:
        InputError: a header that does not describe the images, or fewer images than it describes.
    """
    raw = path.read_bytes()
    end = raw.find(_END)
    start = raw.find(_DATA, max(end, 0)) + len(_DATA)
    parts = _SECTION.split(raw[: max(end, 0)].decode("utf-8", errors="replace").replace("\r", ""))
    header = {key: text.strip() for key, text in zip(parts[1::2], parts[2::2], strict=True)}
    try:
        nx, ny = (int(one) for one in header["SCAN_PIXELS"].split())
        x_m, y_m = (float(one) for one in header["SCAN_RANGE"].split())
        rows = [line.strip().split("\t") for line in header["DATA_INFO"].splitlines()]
        titles = [one.strip().lower() for one in rows[0]]
        signals = [dict(zip(titles, (one.strip() for one in row), strict=False)) for row in rows[1:]]
        images = [(one["name"], one["unit"], way) for one in signals for way in _ways(one["direction"])]
    except (KeyError, ValueError, IndexError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: header of a Nanonis scan", got=got, hint=DAMAGED) from error
    kind, order = (*header.get("SCANIT_TYPE", "FLOAT").split(), "MSBFIRST")[:2]
    if kind != "FLOAT" or order not in _ORDERS:
        raise InputError(f"{path} (sxm): SCANIT_TYPE", got=header["SCANIT_TYPE"], wanted="FLOAT")
    wanted = len(images) * ny * nx * _ITEM
    if end < 0 or start < end or len(raw) - start < wanted:
        raise InputError(f"{path}: bytes of data", got=max(len(raw) - start, 0), wanted=wanted, hint=DAMAGED)
    upward = header.get("SCAN_DIR", "down").lower() == "up"
    return [
        Channel(
            name=name if way in _FORWARD else f"{name}, backward",
            shape=(ny, nx),
            unit=unit,
            size_um=extent_um(y_m, x_m, "m"),
            load=partial(
                _load, path, _ORDERS[order], start + k * ny * nx * _ITEM, (ny, nx), upward, way in _BACKWARD
            ),
            fast_axis="x",
            header=header,
        )
        for k, (name, unit, way) in enumerate(images)
    ]


def _ways(direction: str) -> tuple[str, ...]:
    """The directions of a signal's images, in the order of the file; ValueError if it is none."""
    if direction == "both":
        return "forward", "backward"
    if direction not in _FORWARD + _BACKWARD:
        raise ValueError(f"direction {direction!r}")
    return (direction,)


def _load(path: Path, kind: str, start: int, shape: Shape, upward: bool, backward: bool) -> Loaded:
    values = np.fromfile(path, kind, shape[0] * shape[1], offset=start).reshape(shape).astype(float)
    return np.ascontiguousarray(values[:: -1 if upward else 1, :: -1 if backward else 1]), None


READER = Reader("sxm", lambda path, head: head.startswith(_MAGIC), read_channels)
