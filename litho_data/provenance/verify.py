"""Verify that a store and its raw files have not changed since the store was built."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from litho_data.commands.progress import progress
from litho_data.foundation import Facts, InputError, damaged, file_sha256, record_sha256
from litho_data.making.assemble import root_attributes, table_sha256
from litho_data.making.operations import OPERATIONS
from litho_data.provenance.history import Recorded, raw_folder, read_steps, require_folder, stored_array
from litho_data.store.access import array_of, decoded, group_of, has_child, open_root, read_table
from litho_data.store.contract import file_names, missing_files, read_documents
from litho_data.store.read import Store
from litho_data.store.schema import STORE_SCHEMA, VARIABLES
from litho_data.store.write import PADDING

F = TypeVar("F")


@dataclass(frozen=True)
class Finding:
    """One change since the build: the place where it was found, and what is wrong there."""

    where: str
    problem: str

    def __str__(self) -> str:
        return f"{self.where}: {self.problem}"


@dataclass(frozen=True)
class Verification:
    """The result of ``verify``. ``findings`` report damage or changes; ``notes`` are other remarks."""

    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    n_arrays: int
    n_steps: int
    n_raw_files: int


def verify(store_path: str | Path, data_dir: str | Path | None = None) -> Verification:
    """Recompute all hashes of a store and compare them with those that the build recorded.

    Args:
        store_path: a ``.zarr`` folder or ``.zarr.zip`` file.
        data_dir: folder of the raw files. By default, the folder that the build recorded (relative to the
            store), ``$LITHO_DATA_DIR/<name>`` and the user cache are tried. If no folder contains the files,
            ``notes`` states this.

    Raises:
        InputError: there is no store at the path, or ``data_dir`` does not exist.
    """
    path = Path(store_path)
    if open_root(path).attrs.get("schema") != STORE_SCHEMA:
        raise InputError(f"{path} has no provenance", wanted="a store made by litho-data build")
    if data_dir is not None:
        require_folder(data_dir)
    findings = [*_guarded(_documents(path)), *_guarded(_missing(path))]
    try:
        # `open_store` is not used here, because it refuses a store with findings.
        store = Store(open_root(path), path)
        history = read_steps(store)
        manifest = store.manifest
        if "card" not in manifest:
            raise InputError(f"manifest of {path}", got="none", wanted="the manifest of its build")
        folder = raw_folder(store, data_dir)
    except InputError as error:
        return Verification((*findings, Finding("store", str(error))), (), 0, 0, 0)
    arrays = list(progress(_guarded(_arrays(store, history)), "hashing arrays"))
    findings += [finding for finding in arrays if finding]
    for check in (_attributes, _tables, _padding):
        findings += _guarded(check(store))
    findings += _guarded(_steps(store, history))
    notes = list(_other_code(history))
    files = [row for row in manifest["files"] if row["sha256"]]
    if folder is None:
        files = []
        notes.append("the raw files were not found, so they were not checked; give their folder as data_dir")
    else:
        findings += [
            finding for row in progress(files, "hashing raw files") for finding in _raw_file(folder, row)
        ]
    n_steps = sum(len(steps) for steps in history.values())
    return Verification(tuple(findings), tuple(notes), len(arrays), n_steps, len(files))


def _missing(path: Path) -> Iterator[Finding]:
    for name in missing_files(path):
        yield Finding(f"file {name}", "is declared but missing")


def _documents(path: Path) -> Iterator[Finding]:
    """Yield a finding for each metadata document that is damaged or differs from its copy in the root
    document.
    """
    documents: dict[str, Any] = {}
    for name, content in read_documents(path, file_names(path)):
        try:
            documents[name] = json.loads(content)
        except ValueError as error:
            yield Finding(f"metadata {name}", f"is not JSON ({error})")
    root = documents.get("zarr.json", {})
    copies = (root.get("consolidated_metadata") or {}).get("metadata", {})
    for name in sorted({f"{key}/zarr.json" for key in copies} | set(documents) - {"zarr.json"}):
        copy = copies.get(name.removesuffix("/zarr.json"))
        single = documents.get(name)
        if isinstance(copy, dict) and isinstance(single, dict):
            copy, single = (
                {k: v for k, v in one.items() if k != "consolidated_metadata"} for one in (copy, single)
            )
        if copy != single:
            yield Finding(f"metadata {name}", "differs from its copy in the store's zarr.json")


def _guarded(check: Iterator[F]) -> Iterator[F | Finding]:
    """Yield what a check yields. If the check ends because its data cannot be read, yield one more finding,
    which states this.
    """
    try:
        with damaged("data that a check needs"):
            yield from check
    except InputError as error:
        yield Finding("store", str(error))


def _attributes(store: Store) -> Iterator[Finding]:
    """Yield a finding for each attribute of the root group that differs from the value computed from the
    manifest and the arrays.
    """
    attributes = dict(store.root.attrs)
    sha256 = attributes.get("dataset_sha256")
    try:
        sha256 = store.sha256
    except InputError as error:
        yield Finding("store", str(error))
    wanted = root_attributes(store.manifest, str(sha256), str(attributes.get("manifest_sha256")))
    for name in sorted({*wanted, *attributes}):
        if attributes.get(name) != wanted.get(name):
            yield Finding(
                f"attribute {name}", f"is {attributes.get(name)!r}, but the build wrote {wanted.get(name)!r}"
            )


def _tables(store: Store) -> Iterator[Finding]:
    """Yield a finding for each table that does not match its hash in the manifest, and one if the manifest
    does not match its hash in the root group.
    """
    manifest = {key: value for key, value in store.manifest.items() if key not in ("build", "files")}
    files = read_table(group_of(store.root, "manifest"), "path")
    if record_sha256([manifest, table_sha256(files)]) != store.root.attrs.get("manifest_sha256"):
        yield Finding("manifest", "does not match its hash in the store")
    for name in ("quality", "provenance"):
        if table_sha256(read_table(group_of(store.root, name), "scan")) != manifest.get(f"{name}_sha256"):
            yield Finding(f"table {name}", "does not match its hash in the manifest")


def _steps(store: Store, history: Recorded) -> Iterator[Finding]:
    """Yield a finding for each step whose id does not match its content, for each input that is neither a raw
    file nor the output of an earlier step, and for each scan without recorded steps.
    """
    raw = {row["path"]: row["sha256"] for row in store.manifest["files"]}
    for scan_id, steps in history.items():
        made: dict[str, str] = {}
        for recorded_id, step in steps:
            where = f"step {step.op} of scan {scan_id}"
            if step.id != recorded_id:
                yield Finding(where, "operation, parameters or inputs do not match its id")
            for one in step.inputs:
                known = made.get(one["name"], raw.get(one["name"]))
                if one["sha256"] != known:
                    yield Finding(
                        where, f"input {one['name']} is neither the output of an earlier step nor a raw file"
                    )
            made |= {one["name"]: one["sha256"] for one in step.outputs}
    for scan_id in store.ids:
        if scan_id not in history:
            yield Finding(f"scan {scan_id}", "has no provenance")


def _arrays(store: Store, history: Recorded) -> Iterator[Finding | None]:
    """For every array of every scan, yield a finding if the hash of the array has changed and None if it has
    not.
    """
    for scan_id, steps in history.items():
        for name, wanted in ((one["name"], one["sha256"]) for _, step in steps for one in step.outputs):
            yield _array(store, scan_id, name, wanted)


def _array(store: Store, scan_id: str, name: str, wanted: str) -> Finding | None:
    where = f"{name} of scan {scan_id}"
    try:
        array = stored_array(store, scan_id, name)
    except InputError as error:
        return Finding(where, str(error))
    if array is None:
        return None
    same = VARIABLES[name].sample_sha256(array) == wanted
    return None if same else Finding(where, "values differ from those that were built")


def _padding(store: Store) -> Iterator[Finding]:
    for name, fill in PADDING.items():
        if not has_child(store.root, name):
            continue
        array = array_of(store.root, name)
        for row, scan_id in enumerate(store.ids):
            ny, nx = store.shapes[row]
            if (ny, nx) == array.shape[1:]:
                continue
            field = decoded(array, row, f"{name} of scan {scan_id}")
            rest = np.concatenate([field[ny:].ravel(), field[:ny, nx:].ravel()])
            if not np.array_equal(rest, np.full_like(rest, fill), equal_nan=True):
                yield Finding(f"{name} of scan {scan_id}", "padding is not empty")


def _other_code(history: Recorded) -> Iterator[str]:
    used = {(step.op, step.code_sha256) for recorded in history.values() for _, step in recorded}
    other = {op for op, code in used if op not in OPERATIONS or code != OPERATIONS[op].code_sha256}
    if other:
        operations = ", ".join(sorted(other))
        yield (
            f"the code of these operations has changed since the build: {operations}; "
            "replay shows whether the arrays change"
        )


def _raw_file(folder: Path, row: Facts) -> Iterator[Finding]:
    path = folder / row["path"]
    if not path.is_file():
        yield Finding(f"raw file {row['path']}", f"is not in {folder}")
    elif file_sha256(path) != row["sha256"]:
        yield Finding(f"raw file {row['path']}", "has changed since the build")
