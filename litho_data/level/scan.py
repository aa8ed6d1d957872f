"""Level one scan, and either return the levelled heights and the removed surface or write them to files."""

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from litho_data.foundation import YX, Array, InputError, array_sha256, atomic_file, file_sha256
from litho_data.foundation.results import Result
from litho_data.foundation.run_facts import RunFacts, run_facts
from litho_data.level import Recipe
from litho_data.readers.gsf import gsf_bytes
from litho_data.scan import Scan

SUFFIXES = (".gsf", ".npy")
_DIMS = ("y", "x")


class LevelRecord(RunFacts, Result):
    """Record of how one scan was levelled: the source file, the recipe and the results. It is stored beside
    the levelled file as ``<file>.json``.
    """

    SCHEMA: ClassVar[str] = "litho-data/level/1"
    FILE_NAME: ClassVar[str] = "level.json"

    source: str
    source_sha256: str
    channel: str
    pitch_um: YX | None
    recipe: dict[str, Any]
    levelled: str
    levelled_sha256: str
    removed: str
    removed_sha256: str


def level_scan(scan: Scan, recipe: Recipe | str | Path) -> tuple[Scan, Array]:
    """Level a scan with a recipe, which is given as an object or as a TOML file.

    Returns:
        The scan with levelled heights, and the removed surface in µm, shape (ny, nx). The levelled heights
        and the removed surface add up to the input.

    Raises:
        InputError: the recipe is invalid, or a step cannot be applied.
    """
    steps = recipe if isinstance(recipe, Recipe) else Recipe.from_toml(recipe)
    levelled, removed = steps.apply(scan)
    return replace(scan, height_um=levelled), removed


def write_levelled(scan: Scan, recipe: Recipe, out: str | Path) -> LevelRecord:
    """Level a scan. Write the levelled heights to ``out``, the removed surface to ``<out
    stem>.removed<suffix>`` and the record to ``<out>.json``.

    Args:
        scan: a scan that was read from a file.
        recipe: the levelling steps.
        out: a ``.gsf`` or ``.npy`` file.

    Raises:
        InputError: a step cannot be applied, ``out`` has another suffix, or the scan's own file would be
            overwritten.
    """
    target = Path(out)
    removed_file = target.with_name(f"{target.stem}.removed{target.suffix}")
    for file in (target, removed_file):
        if file.exists() and file.samefile(scan.source):
            raise InputError("output", got=f"{file}, which is the scan itself", wanted="another file")
    levelled, removed = recipe.apply(scan)
    source_sha256 = file_sha256(scan.source)
    write_heights(target, levelled, pitch_um=scan.pitch_um, title=f"{scan.name} levelled")
    write_heights(removed_file, removed, pitch_um=scan.pitch_um, title=f"{scan.name} removed")
    record = LevelRecord(
        **run_facts(),
        source=scan.source,
        source_sha256=source_sha256,
        channel=scan.channel,
        pitch_um=scan.pitch_um,
        recipe=recipe.canonical(),
        levelled=target.name,
        levelled_sha256=array_sha256(levelled, "µm", _DIMS),
        removed=removed_file.name,
        removed_sha256=array_sha256(removed, "µm", _DIMS),
    )
    with atomic_file(target.with_name(f"{target.name}.json")) as temporary:
        temporary.write_text(record.model_dump_json(by_alias=True, indent=1) + "\n", encoding="utf-8")
    return record


def write_heights(
    path: str | Path,
    height_um: Array,
    *,
    pitch_um: YX | None,
    title: str = "",
) -> Path:
    """Write a height map in the format that the file's suffix names.

    A ``.gsf`` file contains the heights in metres as float32, the size of the scan and the title. Gwyddion
    can open it. A ``.npy`` file contains only the heights, as float64 in µm. Missing pixels are NaN in both.

    Raises:
        InputError: the file has another suffix.
    """
    file = Path(path)
    if file.suffix not in SUFFIXES:
        raise InputError(f"{file}: file type", got=repr(file.suffix), wanted=" or ".join(SUFFIXES))
    with atomic_file(file) as temporary, temporary.open("wb") as stream:
        if file.suffix == ".npy":
            np.save(stream, np.asarray(height_um, dtype=float))
        else:
            stream.write(gsf_bytes(height_um, pitch_um, title))
    return file
