"""``history``: where the arrays of a scan come from."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from litho_data.provenance.records import read_steps, steps_of
from litho_data.provenance.steps import Step
from litho_data.store.read import open_store

_HASH_DIGITS = 12


def history(store_path: str | Path, scan_id: str | None = None) -> str:
    """The chain of one scan as text, from the raw files to the arrays, with all parameters and hashes.

    Without a scan: one line per scan, from its raw files over the operations to its registered height.

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


def _overview(recorded: dict[str, list[tuple[str, Step]]]) -> Iterator[str]:
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
