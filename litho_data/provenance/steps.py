"""The record of one operation on one scan, by which its arrays can be traced and made again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from litho_data.foundation.hashes import record_sha256


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
