"""Read instrument makers' formats (IBW, SPM, JPK, X3P, SUR, …) with the library SurfaceTopography."""

import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation import Array, Facts, InputError, table_beside
from litho_data.readers.reader import (
    DAMAGED,
    Channel,
    Loaded,
    Reader,
    extent_um,
    foreign_parser,
    one_by_one,
    unknown_content,
)
from litho_data.readers.tiff import is_tiff, maker_of
from litho_data.scan import Axis

_HEAD_BYTES = 512
_FORMATS = table_beside(__file__, "formats.toml")
_STARTS = {
    kind: tuple(one.encode("latin-1") for one in starts) for kind, starts in _FORMATS["starts"].items()
}
_ZIP, _HDF5 = b"PK\x03\x04", b"\x89HDF\r\n\x1a\n"
# Sensofar's PLU begins with the date of the measurement.
_PLU = re.compile(rb"\w{3} \w{3} [ \d]\d \d\d:\d\d:\d\d \d{4}\0")
# The kinds of Digital Surf files that contain anything but exactly one surface (series, layers, pictures,
# curves, spectra), and the position in the file where the kind is stored.
_NO_SURFACES, _SURFACE_KIND_AT = (3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 15, 20, 21), 18
_IGOR_HEADERS = {1: 8 + 110, 2: 16 + 110, 3: 20 + 110, 5: 64 + 320}
_IGOR_5_SIZES = "15I"
_ANGLE_TOLERANCE_DEG = 1.0
_NANOSCOPE_END = b"\\*File list end"
_LONGEST_HEADER = 1 << 20


def read_channels(path: Path) -> list[Channel]:
    """Return the two-dimensional channels of an instrument's file, in the order of the file.

    Raises:
        InputError: no format recognises the file, or the file is damaged.
    """
    kind = _recognise(path)
    header = _vendor_header(path, kind)
    with _open(path, kind) as reader:
        maps = [info for info in reader.channels if info.dim == 2 and min(info.nb_grid_pts) > 1]
        channels = [one_by_one(str(one.name), partial(_channel, path, kind, one, header)) for one in maps]
    names = _layer_names(path, kind)
    if len(names) == len(channels) == 1 and names[0]:
        channels = [replace(channels[0], name=names[0])]
    return channels


def _kinds(path: Path, head: bytes) -> tuple[str, ...]:
    """Return SurfaceTopography's names of the formats whose signature the file has."""
    signed = tuple(kind for kind, starts in _STARTS.items() if head.startswith(starts))
    if is_tiff(head):
        signed = (maker,) if (maker := maker_of(path)) else ()
    elif head.startswith(_ZIP):
        signed = tuple(_FORMATS["kinds"]["in_zip"])
    elif head.startswith(_HDF5):
        signed = ("datx",)
    elif _PLU.match(head):
        signed = ("plu",)
    elif not signed and _is_igor(head):
        signed = ("ibw",)
    return signed


def _is_igor(head: bytes) -> bool:
    """Return whether a file begins with the header of an Igor wave. The header must have a known version
    number. Its checksum must be correct, except in version 5, where it is not tested.
    """
    order = "<" if head[1:2] == b"\0" else ">"
    version = int.from_bytes(head[:2], "little" if order == "<" else "big")
    size = _IGOR_HEADERS.get(version, 0)
    words = np.frombuffer(head[:size], f"{order}i2") if size and len(head) >= size else np.ones(1, int)
    return version == 5 or int(words.sum(dtype=np.int64)) % 65536 == 0


def _recognise(path: Path) -> str:
    """Return the name that SurfaceTopography uses for the file's format.

    Several formats may share a signature. The readers of these formats try to open the file, one after the
    other, and the result is the format of the first reader that succeeds.

    Raises:
        InputError: the file has no known signature, or no reader for its signature can open it.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    refusals = []
    for kind in _kinds(path, head):
        try:
            if kind == "ibw":
                _require_whole_igor_file(path, head)
            found = int.from_bytes(head[_SURFACE_KIND_AT : _SURFACE_KIND_AT + 2], "little")
            if kind == "sur" and found in _NO_SURFACES:
                raise InputError("kind of studiable", got=found, wanted="one surface (2)")
            with foreign_parser(kind), _open(path, kind):
                return kind
        except InputError as error:
            refusals.append(error)
    if len(refusals) == 1:
        raise refusals[0]
    raise unknown_content(head)


def _require_whole_igor_file(path: Path, head: bytes) -> None:
    """Reject an Igor wave of version 5 whose file is shorter than its header states. The library igor2 does
    not check the sizes in such headers, so it could try to read gigabytes.
    """
    order = {b"\5\0": "<", b"\0\5": ">"}.get(head[:2])
    if order is None:
        return
    stated = sum(struct.unpack_from(f"{order}{_IGOR_5_SIZES}", head.ljust(64, b"\0"), 4)) + 64
    if stated > path.stat().st_size:
        raise InputError(
            "cannot be read as ibw",
            got=f"{path.stat().st_size} bytes",
            wanted=f"{stated} bytes, as its header states",
            hint=DAMAGED,
        )


def _open(path: Path, kind: str) -> AbstractContextManager[Any]:
    from SurfaceTopography.IO import open_topography

    return closing(open_topography(str(path), format=kind))


def _channel(path: Path, kind: str, info: Any, header: dict[str, str]) -> Channel:
    nx, ny = info.nb_grid_pts
    sizes = info.physical_sizes
    lateral_unit, unit = info.lateral_unit, info.unit
    if isinstance(unit, tuple):  # a Nanoscope channel whose values are not lengths has two units
        lateral_unit, unit = unit[0], unit[1] or "not a length"
    elif not info.is_height_channel:
        unit = info.data_unit or "not a length"
    return Channel(
        name=str(info.name),
        shape=(int(ny), int(nx)),
        unit=unit,
        size_um=None if sizes is None else extent_um(sizes[1], sizes[0], lateral_unit),
        load=partial(_load, path, kind, info.index, sizes is None),
        fast_axis=_fast_axis(header),
        header=header or dict(_flatten(info.info.get("raw_metadata", info.info))),
        notes=(f"read by SurfaceTopography as {kind}, a format that no test of this project covers",)
        if kind in _FORMATS["kinds"]["untested"]
        else (),
    )


def _load(path: Path, kind: str, index: int, without_size: bool) -> Loaded:
    """Load the heights as an array indexed [y, x] with row 0 at the top.

    SurfaceTopography returns an array indexed [x, y] in which y grows downwards, so the array is transposed.
    """
    # SurfaceTopography requires a size even if the file states none. The heights do not depend on this size.
    arguments = {"physical_sizes": (1.0, 1.0)} if without_size else {}
    with _open(path, kind) as reader:
        heights = reader.topography(channel_index=index, **arguments).heights()
        values: Array = np.ma.filled(np.ma.asarray(heights, dtype=float), np.nan)
    return np.ascontiguousarray(values.T), None


def _flatten(content: Facts, prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{name}/")
        else:
            yield name, str(value)


def _vendor_header(path: Path, kind: str) -> dict[str, str]:
    """Return the complete header of an Igor wave or a Nanoscope file. SurfaceTopography returns only parts of
    these headers. For other formats, return an empty dictionary.
    """
    if kind == "ibw":
        return _igor_note(path)
    return _nanoscope_header(path) if kind == "di" else {}


def _fast_axis(header: dict[str, str]) -> Axis | None:
    """Return ``"x"`` if the header of an Asylum file gives a scan angle of 0° or 180°. Otherwise return None.

    At other angles, the file does not say whether the scan lines run along an axis of the scanner or along an
    axis of the scan. The caller must then state the fast axis.
    """
    try:
        angle = float(header["ScanAngle"]) % 180
    except (KeyError, ValueError):
        return None
    return "x" if min(angle, 180 - angle) < _ANGLE_TOLERANCE_DEG else None


def _layer_names(path: Path, kind: str) -> list[str]:
    """Return the labels of the layers of an Igor wave. For other formats, the list is empty.

    The labels are read here because SurfaceTopography drops the label if there is only one layer.
    """
    if kind != "ibw":
        return []
    return [label.decode("utf-8", errors="replace").strip("\0 ") for label in _igor_wave(path)["labels"][2]]


def _igor_wave(path: Path) -> dict[str, Any]:
    from igor2 import binarywave

    return {"note": b"", "labels": [[], [], [], []]} | binarywave.load(str(path))["wave"]


def _igor_note(path: Path) -> dict[str, str]:
    text = _igor_wave(path)["note"].decode("utf-8", errors="replace")
    note = {}
    for number, line in enumerate(text.splitlines(), start=1):
        key, colon, value = line.partition(":")
        note[key.strip() if colon else f"line {number}"] = value.strip() if colon else line
    return {key: value for key, value in note.items() if key and value}


def _nanoscope_header(path: Path) -> dict[str, str]:
    """Return the entries of a Nanoscope header, keyed by ``section/key``. If sections have the same name, a
    number is added to the name.
    """
    with path.open("rb") as stream:
        raw = stream.read(_LONGEST_HEADER)
    text = raw[: max(raw.find(_NANOSCOPE_END), 0)].decode("latin-1")
    header: dict[str, str] = {}
    seen: dict[str, int] = {}
    section = ""
    for line in text.splitlines():
        entry = line.removeprefix("\\")
        if entry.startswith("*"):
            name = entry[1:]
            seen[name] = seen.get(name, 0) + 1
            section = name if seen[name] == 1 else f"{name} #{seen[name]}"
        elif entry:
            key, _, value = entry.partition(": ")
            header[f"{section}/{key}"] = value
    return header


READER = Reader(
    "vendor",
    lambda path, head: bool(_kinds(path, head)),
    read_channels,
    ("SurfaceTopography.IO", "igor2.binarywave"),
)
