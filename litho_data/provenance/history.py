"""``history``: where the arrays of a scan come from, and the records in a store that say so."""

import json
from collections.abc import Iterator
from pathlib import Path

from litho_data.build.step import Step
from litho_data.cards.fetch import known_folders
from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.kinds import Array
from litho_data.store.access import group_of, read_table
from litho_data.store.read import Store, open_store
from litho_data.store.schema import SCAN_VARIABLES

_HASH_DIGITS = 12
Recorded = dict[str, list[tuple[str, Step]]]
"""Steps of every scan in order, each with its recorded id."""


def history(store_path: str | Path, scan_id: str | None = None) -> str:
    """The chain of one scan as text, from the raw files to the arrays, with all parameters and hashes.

    Without a scan: one line per scan, from its raw files through the operations to its registered height.

    Raises:
        InputError: no such store or scan.
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
    """Recorded steps of every scan in order, each with its recorded id.

    Raises:
        InputError: a store without provenance, or a record that is no JSON.
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
    """The recorded steps of one scan; InputError if there is no such scan."""
    require_known("scan", scan_id, recorded)
    return recorded[scan_id]


def raw_folder(store: Store, data_dir: str | Path | None = None) -> Path | None:
    """Folder of the raw files of a store; None if they cannot be found.

    Raises:
        InputError: ``data_dir`` is given and is no folder.
    """
    if data_dir is not None:
        return require_folder(data_dir)
    names = [row["path"] for row in store.manifest["files"] if row["status"] == "ok"]
    recorded = store.path.parent / store.manifest["build"]["data_dir"]
    for folder in (recorded, *known_folders(store.name)):
        if any((folder / name).is_file() for name in names):
            return folder.resolve()
    return None


def require_folder(data_dir: str | Path) -> Path:
    """The folder that the user named; InputError if there is none."""
    if not Path(data_dir).is_dir():
        raise InputError("folder of raw files", got=str(data_dir), wanted="an existing folder")
    return Path(data_dir)


def stored_array(store: Store, scan_id: str, name: str) -> Array | None:
    """A scan's array by name, from the arrays over all scans or from its own group.

    None for the layout of a reference scan, which is not kept.

    Raises:
        InputError: no such array, or a stored chunk that does not decode.
    """
    if name in {variable.name for variable in SCAN_VARIABLES}:
        return store.scan_frame(scan_id, name)
    return store.sample(name, store.ids.index(scan_id)) if scan_id in store.ids else None
