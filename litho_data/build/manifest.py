"""The list of raw files of a store: what each is, what became of it, and what it says about itself."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from litho_data.foundation.hashes import file_sha256

if TYPE_CHECKING:
    import pandas as pd


def files_table(
    files: Mapping[str, Mapping[str, Path]],
    records: Mapping[str, Mapping[str, Any]],
    skipped: Mapping[str, str],
    unpaired: Mapping[str, str],
) -> pd.DataFrame:
    """One row per raw file, sorted by id.

    Args:
        files: per id, the files by their recorded name.
        records: of the finished scans.
        skipped: per id, why it is not in the store; ``unpaired``: per id, which file is missing.

    Returns:
        Columns ``path``, ``scan``, ``status`` (ok, skipped, unpaired), ``reason``, ``use``, ``sha256`` of the
        bytes that were used (empty for a file that cannot be read), ``size_bytes``, and ``read``, JSON with
        reader, unit, channel, pitch and the vendor's header word by word.
    """
    import pandas as pd

    rows = []
    for scan_id in sorted(files):
        record = records.get(scan_id)
        status = "ok" if record else "skipped" if scan_id in skipped else "unpaired"
        for name, path in files[scan_id].items():
            sha256, size = _identity(path)
            row = {"path": name, "scan": scan_id, "status": status}
            row["reason"] = skipped.get(scan_id, unpaired.get(scan_id, ""))
            row["use"] = record["use"] if record else ""
            row["sha256"] = (_used_sha256(record, name) if record else "") or sha256
            rows.append(
                {**row, "size_bytes": size, "read": json.dumps(_facts(record, name), ensure_ascii=False)}
            )
    return pd.DataFrame(rows)


def _identity(path: Path) -> tuple[str, int]:
    try:
        return file_sha256(path), path.stat().st_size
    except OSError:
        return "", 0


def _used_sha256(record: Mapping[str, Any], name: str) -> str:
    hashes = {one["name"]: one["sha256"] for step in record["steps"] for one in step["inputs"]}
    return hashes.get(name, "")


def _facts(record: Mapping[str, Any] | None, name: str) -> dict[str, Any]:
    """What the reader found out about a scan file; nothing for a layout."""
    for step in record["steps"] if record else ():
        if step["op"] == "read-scan" and step["inputs"][0]["name"] == name and record:
            return dict(record["read"])
    return {}
