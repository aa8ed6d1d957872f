"""What every result says about the run that made it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from litho_data.foundation.results import Record
from litho_data.provenance.steps import code_commit, code_record


class RunInfo(Record):
    """Command line, code and scans behind a result."""

    command: str
    commit: str
    versions: dict[str, str]
    seeds: list[int]
    n_scans: int
    dropped: list[str]


def run_info(seeds: Sequence[int], n_scans: int, dropped: Sequence[str] = ()) -> RunInfo:
    """The current run; ``dropped`` lists scans left out, with the reason."""
    program = Path(sys.argv[0]).name if sys.argv and sys.argv[0] else "python"
    return RunInfo(
        command=shlex.join([program, *sys.argv[1:]]),
        commit=code_commit(),
        versions=code_record()["versions"],
        seeds=list(seeds),
        n_scans=n_scans,
        dropped=list(dropped),
    )
