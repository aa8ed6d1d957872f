"""Define the record of a build, the file ``build.json``."""

from pathlib import Path
from typing import Any, ClassVar

from litho_data.foundation.results import Result
from litho_data.making.verdict import Finding
from litho_data.store.schema import DatasetId


class BuildResult(Result):
    """The record of a build. It says which scans are in the store, which are not, and what should be fixed in
    the dataset.

    ``n_scans`` and ``n_references`` are the numbers of scans and of reference scans in the store. ``reused``
    is the number of scans and reference scans that an earlier, interrupted build had finished. ``skipped``
    and ``unpaired`` map each id that is not in the store to the reason. ``findings`` lists what to fix, worst
    first.
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
    """Return the folder of a store's report, which is ``<name>-report`` beside the store."""
    return folder_beside(out, "report")


def folder_beside(out: str | Path, what: str) -> Path:
    """Return the folder ``<name>-<what>`` beside a store."""
    return Path(out).parent / f"{Path(out).name.removesuffix('.zarr')}-{what}"
