"""Complete a store to which all finished scans have been written. The module adds the arrays on the layout's
grid, the tables, the manifest, the attributes and the hashes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from litho_data.cards.card import Card
from litho_data.foundation import Array, Facts, array_sha256, file_sha256, record_sha256
from litho_data.foundation.hashes import canonical_json
from litho_data.making.jobs import Job
from litho_data.making.operations import READERS, no_recipe
from litho_data.store.partial import outputs_of
from litho_data.store.schema import SAMPLE_VARIABLES, STORE_SCHEMA, WRITE, dataset_facts, dataset_sha256
from litho_data.store.write import SHOWN, consolidate, write_samples, write_table

if TYPE_CHECKING:
    import pandas as pd
    import zarr

# Name of the group that lists the scans for OME-Zarr tools.
IMAGES = "o"


@dataclass(frozen=True)
class Source:
    """Everything from which a store is made.

    ``files`` contains, for each id, a mapping from the recorded names of its raw files to their paths. A
    recorded name is the path below the data folder. ``standards`` maps the recorded names of the calibration
    standards' raw files to their paths. ``recipe`` is the levelling recipe in canonical form. ``assumptions``
    lists the assumptions that were made because the card does not state a value. Two mappings contain the
    reasons why ids are left out, keyed by id: ``unpaired`` for ids without a complete pair of scan and
    layout, and ``refused`` for ids with an unusable file.
    """

    card: Card
    jobs: Sequence[Job]
    data_dir: Path
    files: Mapping[str, Mapping[str, Path]]
    recipe: Facts = field(default_factory=no_recipe)
    seed: int = 0
    standards: Mapping[str, Path] = field(default_factory=dict)
    assumptions: Sequence[str] = ()
    unpaired: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)


def assemble(
    root: zarr.Group,
    records: Sequence[Facts],
    load: Callable[[str], Mapping[str, Array]],
    source: Source,
    skipped: Mapping[str, str],
    build: Facts,
) -> str:
    """Write everything in a store except the groups ``scans/<id>``, which already exist. Return the hash of
    the dataset.

    Args:
        root: root group of the store.
        records: records of the finished scans, sorted by id, including reference scans (those whose ``use``
            is not "dataset").
        load: function that takes the id of a scan and returns the scan's arrays on the layout's grid, keyed
            by name.
        source: everything from which the records were made.
        skipped: reasons why scans are not in the store, keyed by the id of the scan.
        build: facts that are not part of any hash, such as time, folder and software.
    """
    scans = [_row(record) for record in records_of_use(records)]
    write_samples(root, scans, load, source.card.layout.pitch_um)
    quality, provenance = quality_table(records), provenance_table(records)
    write_table(root, "quality", quality, "scan")
    write_table(root, "provenance", provenance, "step")
    manifest = manifest_attributes(source, quality, provenance)
    files = files_table(source, {record["id"]: record for record in records}, skipped)
    write_table(root, "manifest", files, "file", {**manifest, "build": dict(build)})
    sha256 = dataset_sha256(
        facts_of_card(source.card), [_identity(record) for record in records_of_use(records)]
    )
    manifest_sha256 = record_sha256([manifest, table_sha256(files)])
    images = {"labels": [f"../scans/{record['id']}" for record in records]}
    root.create_group(IMAGES, attributes=images)
    root.attrs.update(root_attributes(manifest, sha256, manifest_sha256))
    consolidate(root)
    return sha256


def records_of_use(records: Sequence[Facts]) -> list[Facts]:
    """Return the records of the scans that belong to the dataset, in the given order. Records of reference
    scans are left out.
    """
    return [record for record in records if record["use"] == "dataset"]


def facts_of_card(card: Card) -> dict[str, Any]:
    """Return those values of a card that hold for all its scans. The dataset's hash includes these values."""
    write = card.write.model_dump(exclude_none=True) if card.write else None
    return dataset_facts(card.layout, card.scan.instrument, write)


def root_attributes(manifest: Facts, dataset_hash: str, manifest_hash: str) -> dict[str, Any]:
    """Return the attributes of the store's root group. They are the attributes that follow from the manifest,
    and the hashes of the dataset and of the manifest.

    All attributes are numbers or texts, which any format can store.
    """
    card = Card.model_validate(manifest["card"])
    facts = facts_of_card(card)
    # The keys of the table ``[write]`` get the prefix ``WRITE``.
    written = {f"{WRITE}{key}": value for key, value in facts.pop("write", {}).items()}
    operations = "read, level, register, resample" if manifest["recipe"] else "read, register, resample"
    return {
        "Conventions": "CF-1.11",
        "schema": STORE_SCHEMA,
        "name": card.name,
        "title": card.title or card.name,
        "license": card.license,
        "citation": card.citation,
        **facts,
        **written,
        # Programs for OME-Zarr look here for the group that lists the images.
        "labels": IMAGES,
        "assumptions": "; ".join(manifest["assumptions"]),
        "history": f"litho-data: {operations}; the steps of every array are in the group provenance",
        "dataset_sha256": dataset_hash,
        "manifest_sha256": manifest_hash,
    }


def manifest_attributes(source: Source, quality: pd.DataFrame, provenance: pd.DataFrame) -> dict[str, Any]:
    """Return the manifest without its table of files. It contains the card as it was parsed, the recipe, the
    seed, the assumptions, and the hashes of the tables.
    """
    content = {
        "card": source.card.model_dump(mode="json", exclude_none=True),
        "recipe": dict(source.recipe),
        "seed": source.seed,
        "assumptions": list(source.assumptions),
        "quality_sha256": table_sha256(quality),
        "provenance_sha256": table_sha256(provenance),
    }
    return json.loads(json.dumps(content))


def quality_table(records: Sequence[Facts]) -> pd.DataFrame:
    """Return a table with one row per scan of the dataset, which states how well the scan was registered. A
    value that could not be computed is NaN.
    """
    import pandas as pd

    rows = []
    for record in records_of_use(records):
        ny, nx = _shape_of(record, "mask_level")
        scan_ny, scan_nx = _shape_of(record, *SHOWN)
        pitch_y_um, pitch_x_um = record.get("pitch_um", record["read"]["pitch_um"])
        shape = {"layout_ny": ny, "layout_nx": nx, "scan_ny": scan_ny, "scan_nx": scan_nx}
        pitch = {"scan_pitch_y_um": pitch_y_um, "scan_pitch_x_um": pitch_x_um}
        rows.append({"scan": record["id"], **shape, **pitch, **record["quality"]})
    return pd.DataFrame(rows)


def provenance_table(records: Sequence[Facts]) -> pd.DataFrame:
    """Return the table of provenance, with one row per processing step of every scan. A row contains the
    step's id, its record as JSON, and the software that ran it.
    """
    import pandas as pd

    rows = [
        {
            "scan": record["id"],
            "op": step["op"],
            "step_id": step["id"],
            "record": canonical_json(step),
            "software": canonical_json(record["software"]),
        }
        for record in records
        for step in record["steps"]
    ]
    return pd.DataFrame(rows)


def table_sha256(table: pd.DataFrame) -> str:
    """Return the hash of a table's column names and values. The hash does not cover the column ``software``,
    which differs between installations.
    """
    columns = {}
    for name in sorted(str(column) for column in table.columns if column != "software"):
        values = table[name].to_numpy()
        numeric = values.dtype.kind in "biuf"
        columns[name] = (
            array_sha256(values, "1", ("row",)) if numeric else record_sha256([str(v) for v in values])
        )
    return record_sha256(columns)


def _row(record: Facts) -> dict[str, Any]:
    keys = ("id", "print", "order", "columns")
    made = [output["name"] for output in outputs_of(record)]
    return {**{key: record[key] for key in keys}, "shape": _shape_of(record, "mask_level"), "arrays": made}


def _identity(record: Facts) -> dict[str, Any]:
    hashes = {output["name"]: output["sha256"] for output in outputs_of(record)}
    names = [*(variable.name for variable in SAMPLE_VARIABLES), "bend_um"]
    arrays = {name: hashes[name] for name in names if name in hashes}
    return {**{key: record[key] for key in ("id", "print", "order")}, **record["columns"], "arrays": arrays}


def _shape_of(record: Facts, *names: str) -> tuple[int, int]:
    shape = next(output["shape"] for output in outputs_of(record) if output["name"] in names)
    return int(shape[0]), int(shape[1])


def files_table(source: Source, records: Mapping[str, Facts], skipped: Mapping[str, str]) -> pd.DataFrame:
    """Return the table of files, with one row per raw file, sorted by id.

    Args:
        source: everything from which the records were made. It states the raw files, and the ids that lack a
            scan or a layout.
        records: records of the finished scans, keyed by the id of the scan.
        skipped: reasons why scans are not in the store, keyed by the id of the scan.

    Returns:
        A table with the columns ``path``, ``scan``, ``status`` (ok, skipped or unpaired), ``reason``,
        ``use``, ``sha256``, ``size_bytes`` and ``read``. ``sha256`` is the hash of the bytes that were used,
        and is empty if the file cannot be read. ``read`` is JSON with the reader, the unit, the channel, the
        pitch and the complete header of the instrument's file.
    """
    import pandas as pd

    rows = []
    for scan_id in sorted(source.files):
        record = records.get(scan_id)
        status = "ok" if record else "skipped" if scan_id in skipped else "unpaired"
        for name, path in source.files[scan_id].items():
            sha256, size = _file_identity(path)
            row = {"path": name, "scan": scan_id, "status": status}
            row["reason"] = skipped.get(scan_id, source.unpaired.get(scan_id, ""))
            row["use"] = record["use"] if record else ""
            row["sha256"] = (_used_sha256(record, name) if record else "") or sha256
            rows.append(
                {**row, "size_bytes": size, "read": json.dumps(_facts(record, name), ensure_ascii=False)}
            )
    for name, path in source.standards.items():
        sha256, size = _file_identity(path)
        row = {"path": name, "scan": "", "status": "ok", "reason": "", "use": "calibration"}
        rows.append({**row, "sha256": sha256, "size_bytes": size, "read": "{}"})
    return pd.DataFrame(rows)


def _file_identity(path: Path) -> tuple[str, int]:
    try:
        return file_sha256(path), path.stat().st_size
    except OSError:
        return "", 0


def _used_sha256(record: Facts, name: str) -> str:
    hashes = {one["name"]: one["sha256"] for step in record["steps"] for one in step["inputs"]}
    return hashes.get(name, "")


def _facts(record: Facts | None, name: str) -> dict[str, Any]:
    """Return the facts that the reader found in a scan's file. For a layout's file, the result is empty."""
    for step in record["steps"] if record else ():
        if step["op"] in READERS and step["inputs"][0]["name"] == name and record:
            return dict(record["read"])
    return {}
