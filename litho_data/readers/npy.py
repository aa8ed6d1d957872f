"""NumPy arrays in ``.npy`` files; pickled objects are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.readers.reader import Channel, Reader, foreign_parser


def read_channels(path: Path) -> list[Channel]:
    """The one channel of a two-dimensional array; a ``.npy`` file states neither unit nor size.

    Raises:
        InputError: damaged file, or not a two-dimensional array of numbers.
    """
    array = load_array(path)
    if array.ndim != 2:
        raise InputError(f"{path}: shape", got=array.shape, wanted="two dimensions (ny, nx)")
    return [
        Channel(
            name="array",
            shape=(array.shape[0], array.shape[1]),
            unit=None,
            size_um=None,
            load=lambda: (np.array(array), None),
            full_scale=float(np.iinfo(array.dtype).max) if array.dtype.kind in "ui" else None,
            header={"dtype": str(array.dtype)},
        )
    ]


def load_array(path: Path) -> np.ndarray:
    """The array of a ``.npy`` file, mapped and not yet read.

    Raises:
        InputError: damaged file, pickled objects, or values that are not real numbers.
    """
    with foreign_parser(path, "NPY"):
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "uif":
        raise InputError(
            f"{path}: type of the values",
            got=getattr(array, "dtype", type(array).__name__),
            wanted="integers or real numbers",
        )
    return array


READER = Reader("npy", lambda path, head: head.startswith(b"\x93NUMPY"), read_channels, self_describing=False)
