"""Files packed with gzip are read as what they contain."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from litho_data.foundation.errors import InputError

_MAGIC = b"\x1f\x8b"
_MOST_BYTES = 1 << 30
_PIECE = 1 << 20


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """The file itself, or a temporary file with the content of a gzip file; messages name the gzip file.

    Raises:
        InputError: damaged, or more than 1 GiB inside.
    """
    with path.open("rb") as stream:
        packed = stream.read(len(_MAGIC)) == _MAGIC
    if not packed:
        yield path
        return
    with TemporaryDirectory() as folder:
        content = Path(folder) / path.name.removesuffix(".gz")
        _unpack(path, content)
        try:
            yield content
        except InputError as error:
            raise InputError(str(error).replace(str(content), str(path))) from error


def _unpack(path: Path, content: Path) -> None:
    try:
        with gzip.open(path) as source, content.open("wb") as target:
            while piece := source.read(_PIECE):
                target.write(piece)
                if target.tell() > _MOST_BYTES:
                    raise InputError(f"{path}: content", got="more than 1 GiB", wanted="one scan")
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(
            f"cannot unpack {path}", got=str(error) or type(error).__name__, hint="the file may be damaged"
        ) from error
