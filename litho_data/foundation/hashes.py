"""Compute SHA-256 hashes of everything that can determine a result: files, arrays, plain data, source
code.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.kinds import Array

_BLOCK_BYTES = 1 << 20


def file_sha256(path: str | Path) -> str:
    """Return the hex SHA-256 of the bytes of one file."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def array_sha256(array: Array, unit: str, dims: Sequence[str]) -> str:
    """Return the hash of a decoded array. The hash covers the type, shape, values, unit and dimension names.
    It does not depend on how a file divides the array into chunks.

    Args:
        array: any numeric or boolean array; all bit patterns of NaN are treated as equal.
        unit: unit of the stored values; "1" if they have none.
        dims: one name per axis.

    Returns:
        Hex SHA-256 of ``little-endian dtype | shape | C-order bytes | unit | dims``.
    """
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    if little.dtype.kind == "f" and np.isnan(little).any():
        little = np.where(np.isnan(little), np.array(np.nan, little.dtype), little)
    digest = hashlib.sha256(f"{little.dtype.str}|{array.shape}|".encode())
    digest.update(little.tobytes())
    digest.update(f"|{unit}|{','.join(dims)}".encode())
    return digest.hexdigest()


def record_sha256(record: Any) -> str:
    """Return the hash of plain data (dicts, lists, strings, numbers): the SHA-256 of its canonical JSON."""
    return hashlib.sha256(canonical_json(record).encode()).hexdigest()


def canonical_json(record: Any) -> str:
    """Return JSON with sorted keys and no spaces, so that equal data give equal text."""
    return json.dumps(record, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def source_sha256(*paths: Path) -> str:
    """Return one hash of the names and contents of source files. A folder stands for all Python and TOML
    files below it, in sorted order.
    """
    digest = hashlib.sha256()
    for path in paths:
        for file in sorted([*path.rglob("*.py"), *path.rglob("*.toml")]) if path.is_dir() else [path]:
            digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
