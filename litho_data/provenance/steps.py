"""What makes a number traceable: hashes of arrays and records of steps.

A hash covers what decides a result; times, hosts and code versions are recorded beside it, so that two builds
of the same files compare bit for bit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np


def array_sha256(array: np.ndarray, unit: str, dims: Sequence[str]) -> str:
    """Hash of a decoded array: type, shape, values, unit and dimension names, however it is chunked.

    Args:
        array: any numeric or boolean array; every NaN counts as the same NaN.
        unit: unit of the values as stored, "1" where there is none.
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
    """Hash of plain data (dicts, lists, strings, numbers): SHA-256 of its canonical JSON."""
    return hashlib.sha256(canonical_json(record).encode()).hexdigest()


def canonical_json(record: Any) -> str:
    """JSON with sorted keys and no spaces: equal data, equal text."""
    return json.dumps(record, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


@dataclass(frozen=True)
class Step:
    """One operation on one scan: what went in, with which parameters, and what came out.

    ``inputs`` are ``{"name", "sha256"}`` (a file's name is its path below the data folder), ``outputs``
    are ``{"name", "sha256", "dtype", "shape", "unit", "dims"}``. ``code_sha256`` identifies the source that
    ran; it is recorded beside the identity, because moving a comment does not change a result.
    """

    op: str
    op_version: str
    params: Mapping[str, Any]
    inputs: tuple[Mapping[str, str], ...]
    outputs: tuple[Mapping[str, Any], ...]
    code_sha256: str

    @property
    def id(self) -> str:
        """Hash of operation, version, parameters and input hashes: equal ids must give equal outputs."""
        inputs = [[one["name"], one["sha256"]] for one in self.inputs]
        return record_sha256([self.op, self.op_version, self.params, inputs])

    def to_record(self) -> dict[str, Any]:
        """Plain data, with the id."""
        return {"id": self.id, **asdict(self)}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Step:
        """The step of a record; the recorded id is not taken over, so that it can be compared."""
        fields = {key: value for key, value in record.items() if key != "id"}
        return cls(**{**fields, "inputs": tuple(fields["inputs"]), "outputs": tuple(fields["outputs"])})


def source_sha256(*paths: Path) -> str:
    """Hash of Python source files; a folder stands for all ``.py`` files below it, in sorted order."""
    digest = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
