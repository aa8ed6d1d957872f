"""Headers that SurfaceTopography passes on only in part: read here word by word."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from litho_data.readers.foreign import foreign_parser
from litho_data.scan import Axis

_ANGLE_TOLERANCE_DEG = 1.0
_NANOSCOPE_END = b"\\*File list end"
_LONGEST_HEADER = 1 << 20


def vendor_header(path: Path, kind: str) -> dict[str, str]:
    """The header of an Igor wave or a Nanoscope file; empty for other formats."""
    if kind == "ibw":
        return _igor_note(path)
    return _nanoscope_header(path) if kind == "di" else {}


def fast_axis(header: dict[str, str]) -> Axis | None:
    """``"x"`` where an Asylum note gives a scan angle of 0° or 180°.

    At other angles the lines of the file may follow the scanner or the scan; the caller has to say.
    """
    try:
        angle = float(header["ScanAngle"]) % 180
    except (KeyError, ValueError):
        return None
    return "x" if min(angle, 180 - angle) < _ANGLE_TOLERANCE_DEG else None


def layer_names(path: Path, kind: str) -> list[str]:
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
