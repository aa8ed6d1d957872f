"""Check that each row of a table shows one object of the record, and that each column shows the field that it
names.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any


def require_tables_equal_record(
    folder: Path,
    record: str,
    names: Mapping[str, Mapping[str, str]],
    *,
    pivoted: Collection[str] = (),
    besides: str = "noise floor",
) -> None:
    """Fail if a row of a CSV file in the folder does not match any object of the record.

    Args:
        names: for each table, the fields of columns that are not named like their field; "" for a column that
            is made from several fields.
        pivoted: tables whose rows are not objects; other tests check them.
        besides: how those rows begin that describe the whole record. These rows are not checked.
    """
    objects = list(_objects(json.loads((folder / record).read_text(encoding="utf-8")), {}))
    fields = {name for one in objects for name in one}
    for file in sorted(one for one in folder.glob("*.csv") if one.name not in pivoted):
        named = names.get(file.name, {})
        with file.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert rows, f"{file.name} is empty"
        assert all(rows[0]), f"{file.name} has a column without a name"
        own = {column: named.get(column, column) for column in rows[0]}
        own = {column: field for column, field in own.items() if field and any(row[column] for row in rows)}
        unknown = sorted(set(own.values()) - fields)
        assert not unknown, f"{file.name}: {unknown} are no fields of {record}"
        for number, row in enumerate(rows):
            if next(iter(row.values())).startswith(besides):
                continue
            stated = {field: row[column] for column, field in own.items() if row[column] != ""}
            assert any(_agrees(one, stated) for one in objects), f"{file.name}, row {number}: {stated}"


def require_figures_by_column(file: Path, columns: Mapping[str, Mapping[str, float]]) -> None:
    """Fail if a cell is not the number that its row names, for the print that its column names.

    Args:
        columns: the numbers of each print, by the title of its column.
    """
    with file.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert rows, f"{file.name} is empty"
    assert set(rows[0]) - {"name", "meaning"} == set(columns), f"{file.name} has the wrong columns"
    for row in rows:
        for title, figures in columns.items():
            value = figures.get(row["name"], math.nan)
            same = row[title] == "" if math.isnan(value) else _same(value, row[title])
            assert same, f"{file.name}: wrong value for {row['name']} of {title}"


def _objects(value: Any, above: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield each object of a record, joined with the plain fields of the objects that contain it."""
    if isinstance(value, list):
        for one in value:
            yield from _objects(one, above)
    elif isinstance(value, dict):
        plain = dict(_flat(value))
        own = {**above, **plain}
        yield own
        parts = {name: one for name, one in value.items() if isinstance(one, dict | list)}
        for part in parts.values():
            yield from _objects(part, own)
            # An object without inner objects is also yielded with the plain fields of the object around it.
            if isinstance(part, dict) and all(not isinstance(one, dict | list) for one in part.values()):
                yield {**own, **part}


def _flat(value: Mapping[str, Any], of: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all fields. Names of fields of inner objects are prefixed with the name of the object."""
    for name, one in value.items():
        if isinstance(one, dict):
            yield from _flat(one, f"{of}{name}_")
        else:
            yield f"{of}{name}", one


def _agrees(one: Mapping[str, Any], stated: Mapping[str, str]) -> bool:
    return all(name in one and _same(one[name], text) for name, text in stated.items())


def _same(value: Any, text: str) -> bool:
    if isinstance(value, bool) or value is None:
        return text == ("–" if value is None else str(value))
    if isinstance(value, int | float):
        return math.isclose(value, _number(text), rel_tol=1e-9, abs_tol=1e-12)
    if isinstance(value, list):
        ends = text.split(" … ")
        if len(ends) == len(value) == 2:
            # An interval that is rounded for readers.
            pairs = zip(value, ends, strict=True)
            return all(
                abs(one - _number(end)) <= 0.51 * 0.1 ** len(end.partition(".")[2]) for one, end in pairs
            )
        return text in (", ".join(map(str, value)), str(len(value)))
    return text == str(value)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
