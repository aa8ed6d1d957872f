"""``build.json``: the record of a build."""

from pathlib import Path
from typing import Any, ClassVar

from litho_data.foundation.results import Record, Result
from litho_data.making.verdict import Finding
from litho_data.store.schema import DatasetId


class LeftOut(Record):
    """An id that is not in the store, with the reason."""

    id: str
    reason: str


class BuildResult(Result):
    """Scans that a build made or left out; ``reused`` scans were finished by an earlier build.

    ``findings``: things to fix, worst first.
    """

    SCHEMA: ClassVar[str] = "litho-data/build/1"
    FILE_NAME: ClassVar[str] = "build.json"

    store: str
    dataset: DatasetId
    n_scans: int
    n_references: int
    skipped: list[LeftOut]
    unpaired: list[LeftOut]
    reused: int
    findings: list[Finding]
    seconds: float
    workers: int
    software: dict[str, Any]


def report_folder(out: str | Path) -> Path:
    """Folder of a store's report: ``<name>-report`` beside the store."""
    return Path(out).parent / f"{Path(out).stem}-report"
