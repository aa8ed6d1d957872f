"""Unpack files that contain another file, i.e. gzip files and Digital Surf's compressed surfaces."""

import gzip
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from litho_data.foundation import InputError
from litho_data.readers.reader import DAMAGED

_GZIP = b"\x1f\x8b"
_SURF, _PACKED_SURF = b"DIGITAL SURF", b"DSCOMPRESSED"
_MOST_BYTES = 1 << 30
_PIECE = 1 << 20
# Digital Surf's header has 512 bytes. It is followed by a comment and a private zone, whose sizes are stored
# in the header from byte 334 on.
_SURF_HEADER, _SURF_ZONES, _MOST_STREAMS = 512, 334, 4096


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """If the file is packed, yield the path of a temporary file with the unpacked content. Otherwise, yield
    the given path.

    Raises:
        InputError: the file is damaged, or its content is larger than 1 GiB.
    """
    with path.open("rb") as stream:
        head = stream.read(len(_PACKED_SURF))
    unpack = _unpack_surf if head == _PACKED_SURF else _unpack_gzip if head.startswith(_GZIP) else None
    if unpack is None:
        yield path
        return
    with TemporaryDirectory() as folder:
        content = Path(folder) / path.name.removesuffix(".gz")
        try:
            unpack(path, content)
        except (OSError, EOFError, zlib.error, struct.error) as error:
            got = str(error) or type(error).__name__
            raise InputError("cannot be unpacked", got=got, hint=DAMAGED) from error
        yield content


def _unpack_gzip(path: Path, content: Path) -> None:
    with gzip.open(path) as source, content.open("wb") as target:
        while piece := source.read(_PIECE):
            target.write(piece)
            if target.tell() > _MOST_BYTES:
                raise InputError("content", got="more than 1 GiB", wanted="one scan")


def _unpack_surf(path: Path, content: Path) -> None:
    """Write an unpacked copy of a compressed Digital Surf file.

    The copy consists of the header, the comment, the private zone and the unpacked streams. In the compressed
    file, the private zone is followed by the number of streams, their sizes, and the compressed streams.
    """
    raw = path.read_bytes()
    start = _SURF_HEADER + sum(struct.unpack_from("<2H", raw, _SURF_ZONES))
    (count,) = struct.unpack_from("<I", raw, start)
    if count > _MOST_STREAMS:
        raise zlib.error(f"{count} streams")
    sizes = list(struct.iter_unpack("<2I", raw[start + 4 : start + 4 + 8 * count]))
    position, whole = start + 4 + 8 * count, [_SURF, raw[len(_SURF) : start]]
    for plain, packed in sizes:
        if plain > _MOST_BYTES:
            raise InputError("content", got="more than 1 GiB", wanted="one scan")
        stream = zlib.decompress(raw[position : position + packed])
        if len(sizes) != count or len(stream) != plain:
            raise zlib.error(f"{len(stream)} bytes, wanted {plain}")
        whole.append(stream)
        position += packed
    content.write_bytes(b"".join(whole))
