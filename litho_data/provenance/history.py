"""Trace the origin of a scan's arrays: ``history`` lists the recorded processing steps, and ``replay`` runs
these steps again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.cards.fetch import known_folders
from litho_data.commands.progress import progress
from litho_data.foundation import Array, InputError, file_sha256, require_known
from litho_data.making.operations import OPERATIONS
from litho_data.making.step import Step
from litho_data.store.access import group_of, read_table
from litho_data.store.read import Store, open_store
from litho_data.store.schema import SCAN_VARIABLES, VARIABLES

_HASH_DIGITS = 12
Recorded = dict[str, list[tuple[str, Step]]]
"""The recorded processing steps of every scan, keyed by scan id. Each list contains pairs (recorded id of the
step, step), in the order in which the steps were run.
"""


def history(store_path: str | Path, scan_id: str | None = None) -> str:
    """Return the recorded processing steps of one scan as text, in order from the raw files to the stored
    arrays, with their parameters and hashes.

    If no scan is given, the text has one line per scan, which names the raw files, the operations, and the
    array that the last operation made.

    Raises:
        InputError: there is no such store or scan.
    """
    store = open_store(store_path)
    recorded = read_steps(store)
    if scan_id is None:
        return "\n".join(_overview(recorded))
    lines = [f"{scan_id} in {store.path.name}, dataset {store.sha256[:_HASH_DIGITS]}"]
    for step_id, step in steps_of(recorded, scan_id):
        lines.append(f"{step.op} (version {step.op_version}, step {step_id[:_HASH_DIGITS]})")
        lines += [f"   from {one['name']}  {one['sha256'][:_HASH_DIGITS]}" for one in step.inputs]
        lines += [
            f"   with {key} = {json.dumps(value, ensure_ascii=False)}" for key, value in step.params.items()
        ]
        for one in step.outputs:
            kind = f"{one['dtype']} {' x '.join(map(str, one['shape']))} [{one['unit']}]"
            lines.append(f"   made {one['name']}  {one['sha256'][:_HASH_DIGITS]}  {kind}")
    return "\n".join(lines)


def _overview(recorded: Recorded) -> Iterator[str]:
    for scan_id, steps in recorded.items():
        made: set[str] = set()
        raw = []
        for _, step in steps:
            raw += [
                f"{one['name']} {one['sha256'][:_HASH_DIGITS]}"
                for one in step.inputs
                if one["name"] not in made
            ]
            made |= {one["name"] for one in step.outputs}
        last = steps[-1][1].outputs[0]
        chain = " -> ".join(step.op for _, step in steps)
        yield f"{scan_id}: {', '.join(raw)} -> {chain} -> {last['name']} {last['sha256'][:_HASH_DIGITS]}"


def read_steps(store: Store) -> Recorded:
    """Return the processing steps recorded in a store as a dict keyed by scan id. The values are lists of
    pairs (recorded id of the step, step), in the order in which the steps were run.

    Raises:
        InputError: the store has no provenance, or a record is invalid.
    """
    steps: Recorded = {}
    for row in read_table(group_of(store.root, "provenance"), "scan").to_dict("records"):
        try:
            steps.setdefault(row["scan"], []).append(
                (row["step_id"], Step.from_record(json.loads(row["record"])))
            )
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"record of step {row['op']} of scan {row['scan']}", got=str(error)) from error
    return steps


def steps_of(recorded: Recorded, scan_id: str) -> list[tuple[str, Step]]:
    """Return the recorded processing steps of one scan, or raise InputError if there is no such scan."""
    require_known("scan", scan_id, recorded)
    return recorded[scan_id]


def raw_folder(store: Store, data_dir: str | Path | None = None) -> Path | None:
    """Return the folder of a store's raw files. If ``data_dir`` is None, the folder that the build recorded
    and the known folders of the dataset are tried. If these folders contain no raw file, the result is None.

    Raises:
        InputError: ``data_dir`` is given but is not a folder.
    """
    if data_dir is not None:
        return require_folder(data_dir)
    names = [row["path"] for row in store.manifest["files"] if row["status"] == "ok"]
    recorded = store.path.resolve().parent / store.manifest["build"]["data_dir"]
    for folder in (recorded, *known_folders(store.name)):
        if any((folder / name).is_file() for name in names):
            return folder.resolve()
    return None


def require_folder(data_dir: str | Path) -> Path:
    """Return the folder that the user named, or raise InputError if it does not exist."""
    if not Path(data_dir).is_dir():
        raise InputError("folder of raw files", got=str(data_dir), wanted="an existing folder")
    return Path(data_dir)


def stored_array(store: Store, scan_id: str, name: str) -> Array | None:
    """Read one array of a scan by name. The store holds it either as part of an array over all scans or in
    the group of this scan.

    Return None for the layout of a reference scan, which is not stored.

    Raises:
        InputError: there is no such array, or a stored chunk cannot be decoded.
    """
    if name in {variable.name for variable in SCAN_VARIABLES}:
        return store.scan_frame(scan_id, name)
    return store.sample(name, store.ids.index(scan_id)) if scan_id in store.ids else None


if TYPE_CHECKING:
    import pandas as pd


def replay(
    store_path: str | Path,
    scan_ids: Sequence[str] | None = None,
    *,
    arrays: Sequence[str] | None = None,
    data_dir: str | Path | None = None,
) -> pd.DataFrame:
    """Recompute arrays from the raw files with the recorded parameters, and compare them with the stored
    arrays.

    Args:
        store_path: path of the store.
        scan_ids: scans to recompute; by default all.
        arrays: names of the arrays to compare; by default all. All recorded steps of the scans are run in any
            case.
        data_dir: folder of the raw files, as in ``verify``.

    Returns:
        A table with one row per array and the columns ``scan``, ``array``, ``max_abs_difference`` (inf if the
        shapes differ, or if a pixel is NaN in only one of the two arrays), ``unit``, ``same_hash``.

    Raises:
        InputError: there is no such store, scan or array, or raw files are missing or have changed.
    """
    import pandas as pd

    store = open_store(store_path)
    recorded = read_steps(store)
    folder = raw_folder(store, data_dir)
    if folder is None:
        raise InputError("raw files of the store", got="none found", wanted="their folder, given as data_dir")
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
    """Run recorded steps again, with the raw files in ``folder`` and the outputs of earlier steps as inputs.
    Yield the name and the values of each array as soon as a step has made it.
    """
    made: dict[str, Array] = {}
    for step in steps:
        if step.op not in OPERATIONS:
            raise InputError("operation", got=repr(step.op), wanted=f"one of {', '.join(OPERATIONS)}")
        files = {one["name"]: folder / one["name"] for one in step.inputs if one["name"] not in VARIABLES}
        for one in step.inputs:
            if one["name"] in files:
                _require_same(files[one["name"]], one["sha256"])
        _, arrays, _ = OPERATIONS[step.op].run(step.params, files, made)
        made |= arrays
        yield from arrays.items()


def _require_same(path: Path, sha256: str) -> None:
    if not path.is_file():
        raise InputError(
            f"raw file {path}", got="no such file", wanted="the file from which the store was built"
        )
    if file_sha256(path) != sha256:
        raise InputError(
            f"raw file {path}", got="another SHA-256", wanted="the file from which the store was built"
        )


def _largest_difference(stored: Array, made: Array) -> float:
    if stored.shape != made.shape:
        return float("inf")
    a, b = (array.astype(float) for array in (stored, made))
    if not np.array_equal(np.isnan(a), np.isnan(b)):
        return float("inf")
    return float(np.nanmax(np.abs(a - b), initial=0.0))
