"""Instrument makers' formats (IBW, SPM, JPK, X3P, SUR, …) through SurfaceTopography."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import is_length, um_per
from litho_data.readers.reader import Channel, Loaded, Reader, foreign_parser, with_unique_names
from litho_data.scan import Axis

# Left out: formats with readers of our own, plain text, and two without a signature, which would accept
# any bytes of the right length as a map.
_NOT_OURS = {"npy", "npz", "gwy", "asc", "xyz", "hgt", "nms"}
_HEAD_BYTES = 512
# Deflate, the strongest compression in use, packs at most 1032 bytes into one byte.
_MOST_PIXELS_PER_BYTE = 1032
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
        channels = [_channel(path, kind, info, header) for info in reader.channels if info.dim == 2]
    size = path.stat().st_size
    for channel in channels:
        if channel.shape[0] * channel.shape[1] > _MOST_PIXELS_PER_BYTE * size:
            got = f"{size} bytes for {channel.shape[0]} x {channel.shape[1]} pixels"
            raise InputError(f"{path} ({kind})", got=got, wanted="more", hint="the file may be damaged")
    if not channels:
        raise InputError(f"{path} ({kind}) holds no two-dimensional channel")
    names = _layer_names(path, kind)
    if len(names) == len(channels) == 1 and names[0]:
        channels = [replace(channels[0], name=names[0])]
    return with_unique_names(channels)


def _recognise(path: Path) -> str:
    """SurfaceTopography's name of the format: the first whose reader opens the file."""
    from SurfaceTopography.IO import readers
    from SurfaceTopography.IO.Reader import MagicMatch

    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    refusals = []
    for kind, can_read in ((reader.format(), reader.can_read) for reader in readers):
        if kind in _NOT_OURS or can_read(head) == MagicMatch.NO:
            continue
        try:
            with foreign_parser(path, kind), _open(path, kind):
                return kind
        except InputError as error:
            refusals.append(error)
    if len(refusals) == 1:
        raise refusals[0]
    raise InputError(f"{path}: format", got=f"unknown content {head[:8]!r}", wanted="a known AFM format")


def _open(path: Path, kind: str) -> AbstractContextManager[Any]:
    from SurfaceTopography.IO import open_topography

    return closing(open_topography(str(path), format=kind))


def _channel(path: Path, kind: str, info: Any, header: dict[str, str]) -> Channel:
    nx, ny = info.nb_grid_pts
    sizes = info.physical_sizes
    unit = info.unit if info.is_height_channel else info.data_unit or "not a length"
    lateral_unit = info.lateral_unit
    return Channel(
        name=str(info.name),
        shape=(int(ny), int(nx)),
        unit=unit,
        size_um=_size_um(sizes, lateral_unit),
        load=lambda: _load(path, kind, info.index, sizes is None),
        fast_axis=_fast_axis(header),
        header=header or dict(_flatten(info.info.get("raw_metadata", info.info))),
    )


def _size_um(sizes: Any, unit: str | None) -> tuple[float, float] | None:
    if sizes is None or unit is None or not is_length(unit):
        return None
    size = float(sizes[1]) * um_per(unit), float(sizes[0]) * um_per(unit)
    return size if all(np.isfinite(size)) and min(size) > 0 else None


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
READER = Reader("vendor", lambda path, head: True, read_channels)
