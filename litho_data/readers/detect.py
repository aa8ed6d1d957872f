"""Which reader a file is for, judged by its content and never by its suffix."""

from __future__ import annotations

import re
from pathlib import Path

from litho_data.foundation.errors import InputError
from litho_data.readers.tiff import is_jpk

_HEAD_BYTES = 1 << 16
_MAGIC = (
    (b"Gwyddion Simple Field", "gsf"),
    (b"GWYP", "gwy"),
    (b"\x93NUMPY", "npy"),
    (b"\x89PNG\r\n\x1a\n", "image"),
    (b"BM", "image"),
)
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_NUMBER = re.compile(rb"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?nan", re.IGNORECASE)


def require_file(path: str | Path) -> Path:
    """The path, if it is a file with something in it.

    Raises:
        InputError: no such file, a folder, not readable, or empty.
    """
    file = Path(path)
    try:
        if not file.exists():
            raise InputError(f"no such file: {file}")
        if not file.is_file():
            raise InputError(f"{file} is not a file")
        with file.open("rb") as stream:
            if not stream.read(1):
                raise InputError(f"{file} is empty")
    except OSError as error:
        raise InputError(f"cannot open {file}", got=error.strerror) from error
    return file


def detect_format(path: Path) -> str:
    """``"text-matrix"``, ``"tiff"``, ``"npy"``, ``"gsf"``, ``"gwy"``, ``"image"``, else ``"vendor"``."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    for magic, name in _MAGIC:
        if head.startswith(magic):
            return name
    if head.startswith(_TIFF_MAGIC):
        return "vendor" if is_jpk(path) else "tiff"
    return "text-matrix" if _starts_with_numbers(head) else "vendor"


def _starts_with_numbers(head: bytes) -> bool:
    for line in head.removeprefix(b"\xef\xbb\xbf").splitlines():
        if line.strip() and not line.startswith(b"#"):
            cells = re.split(rb"[\s;]+|,\s*", line.strip(b" \t,;"))
            return len(cells) > 1 and _NUMBER.fullmatch(cells[0]) is not None
    return False
