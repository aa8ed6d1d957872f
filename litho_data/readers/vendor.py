"""Instrument makers' formats (IBW, SPM, JPK, X3P, SUR, …) through SurfaceTopography."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.readers.confined import confined
from litho_data.readers.reader import Channel, Loaded, Reader, extent_um, foreign_parser, with_unique_names
from litho_data.scan import Axis

# Left out: formats with readers of our own, plain text, and two without a signature, which would accept
# any bytes of the right length as a map.
_NOT_OURS = {"npy", "npz", "gwy", "asc", "xyz", "hgt", "nms"}
IMPORTS = ("SurfaceTopography.IO", "igor2.binarywave")
_HEAD_BYTES = 512
_ZIP = (b"PK\x03\x04",)
# How files start whose readers in SurfaceTopography find that out by trying; igor2 knows four versions.
_STARTS = {
    "di": (b"\\*File list", b"?*File list"),
    "ibw": tuple(bytes(pair) for n in (1, 2, 3, 5) for pair in ((n, 0), (0, n))),
    "opdx": (b"VCA DATA",),
    "oir": (b"OLYMPUSRAWFORMAT",),
    "mnt": (b"\xd0\xcf\x11\xe0",),
    **dict.fromkeys(("mitutoyo", "nmm", "plux", "poir", "qep", "x3p"), _ZIP),
}
_IGOR_5_SIZES = "15I"
_ANGLE_TOLERANCE_DEG = 1.0
_NANOSCOPE_END = b"\\*File list end"
_LONGEST_HEADER = 1 << 20


def read_channels(path: Path) -> list[Channel]:
    """The two-dimensional channels of an instrument's file, in the order of the file.

    Raises:
        InputError: no reader recognises the file, it is damaged, or it holds no map.
    """
    kind = _recognise(path)
    header = _vendor_header(path, kind)
    with foreign_parser(path, kind), _open(path, kind) as reader:
        maps = [info for info in reader.channels if info.dim == 2 and min(info.nb_grid_pts) > 1]
        channels = [_channel(path, kind, info, header) for info in maps]
    if not channels:
        raise InputError(f"{path} ({kind}) holds no two-dimensional channel")
    names = _layer_names(path, kind)
    if len(names) == len(channels) == 1 and names[0]:
        channels = [replace(channels[0], name=names[0])]
    return with_unique_names(channels)


def _recognise(path: Path) -> str:
    """SurfaceTopography's name of the format: the first whose reader opens the file.

    Raises:
        InputError: unknown, or the one format whose signature the file carries cannot be read.
    """
    from SurfaceTopography.IO import readers
    from SurfaceTopography.IO.Reader import MagicMatch

    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    answers = {
        reader.format(): reader.can_read(head) for reader in readers if reader.format() not in _NOT_OURS
    }
    signed = [
        kind
        for kind, answer in answers.items()
        if (head.startswith(_STARTS[kind]) if kind in _STARTS else answer == MagicMatch.YES)
    ]
    unsigned = [
        kind for kind, answer in answers.items() if answer == MagicMatch.MAYBE and kind not in _STARTS
    ]
    refusals = []
    for kind in signed or unsigned:
        try:
            if kind == "ibw":
                _require_whole_igor_file(path, head)
            with foreign_parser(path, kind), _open(path, kind):
                return kind
        except InputError as error:
            refusals.append(error)
    if len(refusals) == 1 or len(signed) == 1:
        raise refusals[0]
    raise InputError(f"{path}: format", got=f"unknown content {head[:8]!r}", wanted="a known AFM format")


def _require_whole_igor_file(path: Path, head: bytes) -> None:
    """igor2 trusts the sizes in the header of version 5 and walks through gigabytes of labels."""
    order = {b"\5\0": "<", b"\0\5": ">"}.get(head[:2])
    if order is None:
        return
    stated = sum(struct.unpack_from(f"{order}{_IGOR_5_SIZES}", head.ljust(64, b"\0"), 4)) + 64
    if stated > path.stat().st_size:
        raise InputError(
            f"cannot read {path} as ibw",
            got=f"{path.stat().st_size} bytes",
            wanted=f"the {stated} of its header",
            hint="the file may be damaged",
        )


def _open(path: Path, kind: str) -> AbstractContextManager[Any]:
    from SurfaceTopography.IO import open_topography

    return closing(open_topography(str(path), format=kind))


def _channel(path: Path, kind: str, info: Any, header: dict[str, str]) -> Channel:
    nx, ny = info.nb_grid_pts
    sizes = info.physical_sizes
    lateral_unit, unit = info.lateral_unit, info.unit
    if isinstance(unit, tuple):  # how a Nanoscope channel says that its values are no lengths
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
    )


def _load(path: Path, kind: str, index: int, without_size: bool) -> Loaded:
    """Heights with row 0 on top: SurfaceTopography indexes [x, y] with y downwards."""
    # A size is required even if the file has none; heights do not depend on it.
    arguments = {"physical_sizes": (1.0, 1.0)} if without_size else {}
    with foreign_parser(path, kind), _open(path, kind) as reader:
        heights = reader.topography(channel_index=index, **arguments).heights()
        values = np.ma.filled(np.ma.asarray(heights, dtype=np.float64), np.nan)
    return np.ascontiguousarray(values.T), None


def _flatten(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{name}/")
        else:
            yield name, str(value)


def _vendor_header(path: Path, kind: str) -> dict[str, str]:
    """The header of an Igor wave or a Nanoscope file, word by word; empty for other formats.

    SurfaceTopography passes these headers on only in part.
    """
    if kind == "ibw":
        return _igor_note(path)
    return _nanoscope_header(path) if kind == "di" else {}


def _fast_axis(header: dict[str, str]) -> Axis | None:
    """``"x"`` if an Asylum note gives a scan angle of 0° or 180°.

    At other angles the lines of the file may follow the scanner or the scan; the caller has to know.
    """
    try:
        angle = float(header["ScanAngle"]) % 180
    except (KeyError, ValueError):
        return None
    return "x" if min(angle, 180 - angle) < _ANGLE_TOLERANCE_DEG else None


def _layer_names(path: Path, kind: str) -> list[str]:
    """The labels of an Igor wave's layers: SurfaceTopography drops the label of a single one."""
    if kind != "ibw":
        return []
    return [label.decode("utf-8", errors="replace").strip("\0 ") for label in _igor_wave(path)["labels"][2]]


def _igor_wave(path: Path) -> dict[str, Any]:
    from igor2 import binarywave

    with foreign_parser(path, "ibw"):
        return {"note": b"", "labels": [[], [], [], []]} | binarywave.load(str(path))["wave"]


def _igor_note(path: Path) -> dict[str, str]:
    text = _igor_wave(path)["note"].decode("utf-8", errors="replace")
    note = {}
    for number, line in enumerate(text.splitlines(), start=1):
        key, colon, value = line.partition(":")
        note[key.strip() if colon else f"line {number}"] = value.strip() if colon else line
    return {key: value for key, value in note.items() if key and value}


def _nanoscope_header(path: Path) -> dict[str, str]:
    """``section/key`` for every entry; sections of one name are numbered."""
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


# Asked last: which of its many formats a file is in, SurfaceTopography finds out by trying.
READER = Reader("vendor", lambda path, head: True, confined(read_channels, IMPORTS))
