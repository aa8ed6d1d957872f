"""``replay``: computing arrays again from the raw files with the recorded parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.build.operations import OPERATIONS
from litho_data.build.step import Step
from litho_data.foundation.commands import progress
from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.kinds import Array
from litho_data.provenance.history import raw_folder, read_steps, steps_of, stored_array
from litho_data.store.read import open_store
from litho_data.store.schema import VARIABLES

if TYPE_CHECKING:
    import pandas as pd


def replay(
    store_path: str | Path,
    scan_ids: Sequence[str] | None = None,
    *,
    arrays: Sequence[str] | None = None,
    data_dir: str | Path | None = None,
) -> pd.DataFrame:
    """Compute arrays again from the raw files with the recorded parameters, and compare.

    Args:
        store_path: the store.
        scan_ids: which scans, by default all.
        arrays: which arrays, by default all; the steps they need run in any case.
        data_dir: folder of the raw files, as in ``verify``.

    Returns:
        One row per array: ``scan``, ``array``, ``max_abs_difference`` (inf if only one of the two has a
        number at some pixel), ``unit``, ``same_hash``.

    Raises:
        InputError: no such store, scan or array, or raw files that are missing or have changed.
    """
    import pandas as pd

    store = open_store(store_path)
    recorded = read_steps(store)
    folder = raw_folder(store, data_dir)
    if folder is None:
        raise InputError(
            "raw files of the store", got="none found", wanted="data_dir", hint="say where they are"
        )
    for name in arrays or ():
        require_known("array", name, VARIABLES)
    rows = []
    for scan_id in progress(list(scan_ids or recorded), "replaying"):
        steps = [step for _, step in steps_of(recorded, scan_id)]
        for name, made in _recomputed(steps, folder):
            stored = stored_array(store, scan_id, name)
            if stored is None or (arrays and name not in arrays):
                continue
            variable = VARIABLES[name]
            rows.append(
                {
                    "scan": scan_id,
                    "array": name,
                    "max_abs_difference": _largest_difference(stored, made),
                    "unit": variable.unit,
                    "same_hash": variable.sample_sha256(stored) == variable.sample_sha256(made),
                }
            )
    return pd.DataFrame(rows)


def _recomputed(steps: Sequence[Step], folder: Path) -> Iterator[tuple[str, Array]]:
    """Arrays in the order in which they are made, each step from the outputs of the steps before it."""
    made: dict[str, Array] = {}
    for step in steps:
        if step.op not in OPERATIONS:
            raise InputError("operation", got=repr(step.op), wanted=f"one of {', '.join(OPERATIONS)}")
        files = {one["name"]: folder / one["name"] for one in step.inputs if one["name"] not in VARIABLES}
        for one in step.inputs:
            if one["name"] in files:
                _require_same(files[one["name"]], one["sha256"])
        inputs = {one["name"]: made[one["name"]] for one in step.inputs if one["name"] not in files}
        done = OPERATIONS[step.op].run(step.params, files, inputs)
        made |= done.arrays
        yield from done.arrays.items()


def _require_same(path: Path, sha256: str) -> None:
    if not path.is_file():
        raise InputError(f"raw file {path}", got="none", wanted="the file that the store was built from")
    if file_sha256(path) != sha256:
        raise InputError(
            f"raw file {path}", got="another SHA-256", wanted="the file that the store was built from"
        )


def _largest_difference(stored: Array, made: Array) -> float:
    if stored.shape != made.shape:
        return float("inf")
    a, b = (array.astype(float) for array in (stored, made))
    if not np.array_equal(np.isnan(a), np.isnan(b)):
        return float("inf")
    return float(np.nanmax(np.abs(a - b), initial=0.0))
