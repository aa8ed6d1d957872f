"""Read NumPy arrays from ``.npy`` and ``.npz`` files. Pickled objects are never loaded."""

import zipfile
from functools import partial
from pathlib import Path

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.readers.arrays import Held, array_channel, channels_of
from litho_data.readers.reader import MOST_BYTES_PER_PACKED_BYTE, Channel, Reader, foreign_parser

_ZIP_MAGIC = b"PK\x03\x04"
_NAME_AT = 30
_READ_HEADER = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_channels(path: Path) -> list[Channel]:
    """Return the only channel of a ``.npy`` file. The file states neither unit nor size.

    Raises:
        InputError: the file is damaged, or does not contain a two-dimensional array of real numbers.
    """
    array = load_array(path)
    if array.ndim != 2:
        raise InputError("shape", got=array.shape, wanted="two dimensions (ny, nx)")
    return [array_channel("array", Held(array.dtype, array.shape, partial(np.array, array)))]


def read_archive(path: Path) -> list[Channel]:
    """Return one channel per two-dimensional array of numbers in an ``.npz`` file.

    The unit and the axes are taken from scalars and one-dimensional arrays in the same file, as for a MATLAB
    file. Other arrays are skipped.

    Raises:
        InputError: the file is damaged.
    """
    held: dict[str, Held] = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as stream:
                shape, _, dtype = _READ_HEADER[np.lib.format.read_magic(stream)](stream)
                whole = stream.tell() + np.prod(shape, dtype=float) * dtype.itemsize == member.file_size
            if not whole or member.file_size > MOST_BYTES_PER_PACKED_BYTE * member.compress_size:
                raise InputError(member.filename, got=f"{member.file_size} bytes", wanted=shape)
            name = member.filename.removesuffix(".npy")
            if not dtype.hasobject:
                held[name] = Held(dtype, shape, partial(_member, path, name))
    return channels_of(held)


def _member(path: Path, name: str) -> Array:
    with np.load(path, allow_pickle=False) as archive:
        return archive[name]


def load_array(path: Path) -> Array:
    """Return the array of a ``.npy`` file as a memory map. The values are read only when they are used.

    Raises:
        InputError: the file is damaged or contains pickled objects, or its values are not real numbers.
    """
    with foreign_parser("NPY"):
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(array, Array) or array.dtype.kind not in "uif":
        raise InputError(
            "type of the values",
            got=getattr(array, "dtype", type(array).__name__),
            wanted="integers or real numbers",
        )
    return array


def _is_archive(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is a ZIP archive whose first member is a ``.npy``
    file.

    The name of the first member follows a header of 30 bytes.
    """
    length = int.from_bytes(head[26:28], "little")
    return head.startswith(_ZIP_MAGIC) and head[_NAME_AT : _NAME_AT + length].endswith(b".npy")


ARCHIVE_READER = Reader("npz", lambda path, head: _is_archive(head), read_archive)
READER = Reader("npy", lambda path, head: head.startswith(b"\x93NUMPY"), read_channels)
