"""Record the runs of benchmarks, write their result files, and insert their texts into the documentation."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from litho_data.commands.progress import command_line
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file
from litho_data.foundation.hashes import record_sha256
from litho_data.foundation.run_facts import run_facts

NOT_MEASURED = "Not measured yet."


def options(doc: str | None, publishing: str = "", out: Path | None = None) -> argparse.ArgumentParser:
    """Return a parser of options for a benchmark. It has the option ``--publish`` if ``publishing`` is given,
    and ``--out`` if ``out`` is given.

    Args:
        doc: description of the benchmark.
        publishing: help text of ``--publish``.
        out: default of ``--out``.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if out is not None:
        parser.add_argument("--out", type=Path, default=out, help="JSON file to write")
    if publishing:
        parser.add_argument("--publish", action="store_true", help=publishing)
    return parser


def usable_cores() -> int:
    """Return the number of cores on which this process may run."""
    return len(os.sched_getaffinity(0))


def origin() -> dict[str, Any]:
    """Return the command line, the commit and the versions of software with which a result is made."""
    return {**run_facts(), "command": command_line()}


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write the record of a result as JSON."""
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def place_for(folder: Path, name: str, **made_of: Any) -> Path:
    """Return the place in a folder at which a result is kept. Its name contains a hash of ``made_of``, the
    options and data on which the result depends, so a result that was made of others is not used.
    """
    return folder / f"{name}-{record_sha256(made_of)[:12]}"


def kept(file: Path, make: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """Return the record in a file. If the file does not exist, the record is made and written first."""
    if not file.exists():
        write_record(file, make())
    return json.loads(file.read_text(encoding="utf-8"))


def conclude(
    record: Mapping[str, Any], text: str, out: Path, page: Path, name: str, *, published: bool
) -> None:
    """Write the record of a benchmark to ``out``, and print its text. If ``published`` is true, also insert
    the text into a page of the documentation.

    Raises:
        InputError: the page lacks the marks between which the text is inserted (see ``publish``).
    """
    write_record(out, record)
    print(text)
    if published:
        publish(page, name, text)


def publish(page: Path, name: str, text: str) -> None:
    """Replace the text between the two marks called ``name`` in a Markdown page.

    Raises:
        InputError: the page lacks one of the marks, or they are in the wrong order.
    """
    before, _, after = _parts(page, name)
    with atomic_file(page) as temporary:
        temporary.write_text(f"{before}\n{text}\n{after}", encoding="utf-8")


def published(page: Path, name: str) -> str:
    """Return the text between the two marks called ``name`` in a Markdown page.

    Raises:
        InputError: the page lacks one of the marks, or they are in the wrong order.
    """
    return _parts(page, name)[1].strip("\n")


def _parts(page: Path, name: str) -> tuple[str, str, str]:
    """Split a page at its two marks into three texts: the text up to and including the first mark, the text
    between the marks, and the text from the second mark on.
    """
    start, end = f"<!-- {name}: written by the benchmark -->", f"<!-- end of {name} -->"
    before, found, rest = page.read_text(encoding="utf-8").partition(start)
    inside, found_end, after = rest.partition(end)
    if not found or not found_end:
        raise InputError(f"marks in {page}", got="one or both are missing", wanted=f"{start} … {end}")
    return before + start, inside, end + after
