"""The facts about a run: command, commit, versions, seeds and scans. Every result states them for the run
that made it.
"""

import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from litho_data.foundation.plugins import SOURCES, plugin_versions
from litho_data.foundation.results import Record

_PACKAGES = ("litholoop", "numpy", "scipy", "torch", "opencv-python-headless", "xarray", "zarr")
_COMMAND: ContextVar[str] = ContextVar("command", default="")


class RunFacts(Record):
    """The command line and the version of the code that made a result.

    ``command`` is empty for a result made from Python. ``dirty`` says whether the source differed from the
    commit. ``dirty`` is None if the code did not run from a Git checkout, or if an older version wrote the
    result.
    """

    command: str = ""
    commit: str = ""
    dirty: bool | None = None
    versions: dict[str, str] = Field(default_factory=dict)


class RunInfo(RunFacts):
    """The command line, code, seeds and scans of a result. ``dropped`` lists the scans that were left out,
    each with the reason.
    """

    seeds: list[int]
    n_scans: int
    dropped: list[str]


def run_info(seeds: Sequence[int], n_scans: int, dropped: Sequence[str] = ()) -> RunInfo:
    """Return the facts of the current run; see :class:`RunInfo`."""
    return RunInfo(**run_facts(), seeds=list(seeds), n_scans=n_scans, dropped=list(dropped))


def run_facts() -> dict[str, Any]:
    """Return the fields of :class:`RunFacts` for the current run."""
    software = software_record()
    return {**software, "command": _COMMAND.get(), "commit": software["commit"] or ""}


@contextmanager
def running_command(command: str) -> Iterator[None]:
    """Record a command line in all results that are made inside the ``with`` block. Library code cannot find
    out the command line by itself.
    """
    token = _COMMAND.set(command)
    try:
        yield
    finally:
        _COMMAND.reset(token)


def software_record() -> dict[str, Any]:
    """Return the software of this process: the ``versions`` of packages, BLAS library and plug-ins, and the
    ``commit`` and ``dirty`` state of the checkout.
    """
    software = _software()
    return {**software, "versions": {**software["versions"], **plugin_versions()}}


@cache
def _software() -> dict[str, Any]:
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    versions = {"python": platform.python_version(), "platform": sys.platform}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    versions["blas"] = f"{blas['name']} {blas['version']}"
    return {"versions": versions, **checkout_state(Path(__file__).parents[2])}


def checkout_state(folder: Path) -> dict[str, Any]:
    """Return the ``commit`` of a checkout and whether it is ``dirty``, that is, whether any file of the
    packages is changed or untracked.

    If the folder is not a Git checkout, for example because the package was installed from a wheel, both
    values are None.
    """
    if not (folder / ".git").exists():
        return {"commit": None, "dirty": None}
    try:
        commit = _git(folder, "rev-parse", "HEAD").strip()
        changes = _git(folder, "status", "--porcelain", "--", *SOURCES)
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "dirty": None}
    return {"commit": commit, "dirty": bool(changes.strip())}


def _git(folder: Path, *arguments: str) -> str:
    return subprocess.run(
        ["git", "-C", folder, *arguments], capture_output=True, text=True, check=True
    ).stdout
