"""Read and write files in the format Gwyddion Simple Field (GSF). A file consists of a text header, one to
four NUL bytes, and the rows of the field as little-endian float32.
"""

from pathlib import Path

import numpy as np

from litho_data.foundation import YX, Array, InputError
from litho_data.readers.reader import Channel, Reader, extent_um
from litho_data.readers.text_blocks import refuse_scales

_MAGIC = b"Gwyddion Simple Field 1.0\n"
_ITEM = 4
_UM_PER_M = 1e6


def read_channels(path: Path) -> list[Channel]:
    """Return the only channel of a GSF file. The channel has a unit and a size only if the header states
    them.

    Raises:
        InputError: the file is not a GSF file, its header lacks XRes or YRes or contains a scale factor of
            unknown meaning, or the length of the data is wrong.
    """
    raw = path.read_bytes()
    if not raw.startswith(_MAGIC):
        raise InputError("not a Gwyddion Simple Field", got=repr(raw[:25]), wanted=repr(_MAGIC))
    header_end = raw.find(b"\0")
    header = _parse_header(raw[len(_MAGIC) : header_end if header_end >= 0 else None])
    refuse_scales(header)
    shape = (_count(header, "YRes"), _count(header, "XRes"))
    # The data start at a multiple of four bytes. At least one NUL precedes them, even if the header itself
    # ends at such a multiple.
    start = (header_end // _ITEM + 1) * _ITEM
    wanted = shape[0] * shape[1] * _ITEM
    if header_end < 0 or len(raw) - start != wanted:
        raise InputError(
            "bytes of data",
            got=0 if header_end < 0 else len(raw) - start,
            wanted=f"{wanted} for {shape[0]} x {shape[1]} pixels",
            hint="the file may be truncated",
        )
    values = np.frombuffer(raw, dtype="<f4", offset=start).reshape(shape)
    return [
        Channel(
            name=header.get("Title", "field"),
            shape=shape,
            unit=header.get("ZUnits"),
            size_um=_size_um(header),
            load=lambda: (values, None),
            header=header,
        )
    ]


def _parse_header(text: bytes) -> dict[str, str]:
    header = {}
    for number, line in enumerate(text.decode("utf-8", errors="replace").splitlines(), start=2):
        key, equals, value = line.partition("=")
        if line.strip() and not equals:
            raise InputError(f"line {number}", got=repr(line[:40]), wanted="name = value")
        if equals:
            header[key.strip()] = value.strip()
    return header


def _count(header: dict[str, str], key: str) -> int:
    text = header.get(key)
    if text is None or not text.isascii() or not text.isdigit() or len(text) > 9:
        raise InputError(key, got=text, wanted="a number of pixels")
    return int(text)


def _size_um(header: dict[str, str]) -> YX | None:
    try:
        return extent_um(float(header["YReal"]), float(header["XReal"]), header.get("XYUnits"))
    except (KeyError, ValueError):
        return None


def gsf_bytes(height_um: Array, pitch_um: YX | None, title: str = "") -> bytes:
    """Return the bytes of a GSF file. Heights are stored as float32 in metres.

    Args:
        height_um: heights in µm, shape (ny, nx), NaN where not measured.
        pitch_um: pitch (y, x) in µm. With None, the file does not state the size of the field.
        title: name of the field.
    """
    ny, nx = height_um.shape
    fields = {"XRes": str(nx), "YRes": str(ny), "ZUnits": "m", "Title": " ".join(title.split())}
    if pitch_um is not None:
        size_m = {"XReal": nx * pitch_um[1] / _UM_PER_M, "YReal": ny * pitch_um[0] / _UM_PER_M}
        fields |= {"XYUnits": "m"} | {key: repr(float(size)) for key, size in size_m.items()}
    text = _MAGIC + "".join(f"{key} = {value}\n" for key, value in fields.items() if value).encode()
    return text + b"\0" * (_ITEM - len(text) % _ITEM) + (height_um / _UM_PER_M).astype("<f4").tobytes()


READER = Reader("gsf", lambda path, head: head.startswith(_MAGIC[:21]), read_channels)
