"""The record of a build, ``build.json``."""

from pathlib import Path
from typing import Any, ClassVar

from litho_data.foundation.results import Result
from litho_data.making.verdict import Finding
from litho_data.store.schema import DatasetId


class BuildResult(Result):
    """The scans that a build made or left out; ``reused`` counts those that an earlier build had finished.

    ``skipped`` and ``unpaired`` map ids that are not in the store to the reasons. ``findings`` lists what to
    fix, worst first.
    """

    SCHEMA: ClassVar[str] = "litho-data/build/1"
    FILE_NAME: ClassVar[str] = "build.json"

    store: str
    dataset: DatasetId
    n_scans: int
    n_references: int
    skipped: dict[str, str]
    unpaired: dict[str, str]
    reused: int
    findings: list[Finding]
    seconds: float
    workers: int
    software: dict[str, Any]


def report_folder(out: str | Path) -> Path:
    """Return the folder of a store's report: ``<name>-report`` beside the store."""
    return Path(out).parent / f"{Path(out).stem}-report"
