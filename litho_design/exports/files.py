"""Export a layout in one of several formats, and import the levels from exported files without loss."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from litho_data.commands.settings import changed
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.hashes import array_sha256, file_sha256
from litho_data.foundation.quantities import LEVEL_HEIGHT_UM, PITCH_UM
from litho_data.readers.exported import exported_levels, exported_rows
from litho_design.elements.element import Element
from litho_design.exports.dxf import write_dxf
from litho_design.exports.gds import write_gds
from litho_design.exports.gwl import write_gwl
from litho_design.exports.image import (
    linear_greys,
    measured_greys,
    write_image,
    write_tiff,
)
from litho_design.exports.job import Format, PrintJob
from litho_design.exports.marks import Marks, with_marks
from litho_design.exports.rows import LevelRows, bands_of, layout_rows
from litho_design.exports.sidecar import (
    Sidecar,
    cell_of,
    of_design,
    of_job,
    of_layout,
    read_sidecar,
    sidecar_path,
)
from litho_design.exports.stl import write_stl
from litho_design.judging.loaded import LoadedDesign
from litho_design.printers.layout import LayoutSettings
from litho_design.tasks.design import Design

_SUFFIX: dict[str, str] = {
    "png16": ".png", "bmp": ".bmp", "tiff": ".tif", "stl": ".stl", "gds": ".gds", "dxf": ".dxf",
    "gwl": ".gwl",
}  # fmt: skip
_GREY_BITS = {"png16": 16, "bmp": 8, "dxf": 8}
_IN_PIECES = ("tiff", "gds")
# Largest number of pixels of a layout for the formats that are written in one piece, not band by band. With
# more pixels, more than about 3 GiB of memory would be needed to write an image, and even more to write a
# solid.
_MOST_PX_WHOLE = 16384**2
_BAND_PX = 128


@dataclass(frozen=True)
class _Source:
    """A layout to export: its levels of shape (ny, nx), its geometry and hash, and the design from which it
    comes.
    """

    levels: LevelRows
    layout: LayoutSettings
    sha256: str
    folder: Path | None = None
    design: Design | None = None


def export(
    design: str | Path | LoadedDesign | Element | np.ndarray,
    format: Format,
    out: str | Path,
    *,
    pitch_um: float = 0.1,
    level_height_um: float = 0.1,
    dose_curve: str | Path | None = None,
    marks: bool = False,
    **job: Any,
) -> Path:
    """Write a layout as a file for the printer, and the sidecar ``<file>.json``, which describes the file.

    Before the export finishes, the file is read back and compared with the layout. ``tiff`` and ``gds`` are
    written and read one band of rows at a time, so memory does not grow with the number of rows.

    Args:
        design: a design (its folder, or the result of ``load_design``), an ``Element``, an array of shape
            (ny, nx), or a file NAME.npy with such an array. Arrays of integers are levels. Arrays of floats
            are heights in µm, which are rounded to the nearest level. Floats that are all whole numbers are
            refused, because they could be levels or heights.
        format: png16, bmp, tiff, stl, gds, dxf or gwl.
        out: folder of the export; it may already hold exports of the same layout in other formats.
        pitch_um, level_height_um: side of a pixel and height of a level, used only for arrays. Designs and
            elements contain their own values.
        dose_curve: for the formats with grey values (bmp, png16 and dxf), a CSV file with the columns
            ``grey,height_um``, which states the printed heights of grey values. Without a dose curve, the
            grey value is linear in height.
        marks: add an orientation mark and a flat witness area beside the element (see ``with_marks``).
        job: changes to the default settings of ``PrintJob``, such as ``pedestal_um=2`` or ``gwl={"mode":
            "piezo"}``.

    Returns:
        Path of the exported file.

    Raises:
        InputError: the design is incomplete, the format cannot represent the layout or would need too much
            memory, or the settings of the print job do not suit the layout. The error is also raised if the
            element is too small for marks, or ``out`` contains other files.
    """
    require_known("format", format, _SUFFIX)
    made = changed(PrintJob(), job)
    PITCH_UM.require("pitch_um", pitch_um)
    LEVEL_HEIGHT_UM.require("level_height_um", level_height_um)
    source = _source(design, pitch_um, level_height_um)
    layout, levels = source.layout, source.levels
    if format not in _IN_PIECES and levels.shape[0] * levels.shape[1] > _MOST_PX_WHOLE:
        got = f"{format} of {levels.shape[0]} x {levels.shape[1]} px"
        raise InputError(
            "format of a large element", got=got, wanted="tiff or gds, which are written in parts"
        )
    found: Marks | None = None
    if marks:
        if source.design is None:
            wanted = "the folder of a design, whose model states how far the printer reaches"
            raise InputError("marks", got="levels without a design", wanted=wanted)
        guard_um, heights = source.design.printer.guard_um, source.design.stroke.printed_height_um
        levels, found = with_marks(levels, layout, guard_um, heights)
    greys, white_um, bits = None, None, _GREY_BITS.get(format)
    if bits is not None and dose_curve is not None:
        greys = measured_greys(layout, bits, dose_curve)
    elif bits is not None:
        greys = linear_greys(layout, bits)
        white_um = (2**bits - 1) / greys[1] * layout.level_height_um
    name, place = f"layout{_SUFFIX[format]}", Path(out)
    _require_same_layout(place, name, source.sha256)
    with (
        growing_folder(place, f"{name}.json", holds="layout*"),
        TemporaryDirectory(prefix=".layout.", suffix=".partial", dir=place) as temporary,
    ):
        file = Path(temporary) / name
        _write(file, format, levels, layout, made, greys, found)
        record = Sidecar(
            file=name,
            file_sha256=file_sha256(file),
            format=format,
            layout_sha256=source.sha256,
            greys=greys,
            white_height_um=white_um,
            marks=found,
            **of_layout(layout, (levels.shape[0], levels.shape[1])),
            **of_job(made, format),
            **of_design(source.folder, source.design),
        )
        record.write(temporary).rename(sidecar_path(file))
        back = exported_rows(file, record.model_dump())
        if not all(np.array_equal(back[rows], levels[rows]) for rows in bands_of(levels, _BAND_PX)):
            raise AssertionError(f"the {format} file does not contain the layout that was exported")
        # The sidecar is moved to the folder last. If the export is interrupted before that, the exported file
        # has no sidecar or an outdated one, so ``import_levels`` refuses it.
        for part in sorted(Path(temporary).iterdir(), key=lambda part: part.suffix == ".json"):
            part.replace(place / part.name)
    return place / name


def import_levels(file: str | Path) -> tuple[np.ndarray, Sidecar]:
    """Return the level map of an exported file and the sidecar of the file.

    The level map is a uint8 array of shape (ny, nx) with row 0 at the top.

    Raises:
        InputError: there is no sidecar, or the file was changed after the export.
    """
    path = Path(file)
    sidecar = read_sidecar(path)
    return exported_levels(path, sidecar.model_dump()), sidecar


def _source(given: Any, pitch_um: float, level_height_um: float) -> _Source:
    given = given.folder if isinstance(given, LoadedDesign) else given
    in_file = isinstance(given, str | Path)
    if in_file and Path(given).suffix != ".npy":
        record = Design.read(given)
        return _Source(layout_rows(given), record.layout, record.layout_sha256, Path(given), record)
    if isinstance(given, Element):
        levels, layout = given.levels(), given.layout
    else:
        levels = _levels(_loaded(given) if in_file else given, level_height_um)
        layout = LayoutSettings(
            size_px=max(4, *levels.shape), pitch_um=pitch_um, cell_um=pitch_um,
            levels=max(2, int(levels.max()) + 1), level_height_um=level_height_um,
        )  # fmt: skip
    return _Source(levels, layout, array_sha256(levels, "level", ("y", "x")))


def _loaded(file: str | Path) -> Any:
    try:
        return np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"array {file}", got=str(error), wanted="levels or heights in µm") from None


def _levels(array: Any, level_height_um: float) -> np.ndarray:
    """Convert an array of levels, or of heights in µm, to uint8 levels of shape (ny, nx)."""
    if not isinstance(array, np.ndarray):
        wanted = "a design's folder, an Element, or an array of levels or heights in µm"
        raise InputError("layout to export", got=type(array).__name__, wanted=wanted)
    if array.ndim != 2 or not array.size or array.dtype.kind not in "buif" or not np.isfinite(array).all():
        got = f"{array.dtype} of shape {array.shape}"
        raise InputError("array to export", got=got, wanted="a map of finite levels or heights in µm")
    levels = np.rint(array / level_height_um) if array.dtype.kind == "f" else array
    if (levels != array).any() and (array == np.rint(array)).all():
        raise InputError(
            "array to export",
            got=f"{array.dtype} with whole numbers from {array.min():g} to {array.max():g}",
            wanted="integers for levels, or heights in µm that are not all whole numbers",
            hint="make levels integers with astype(int); divide heights by the level height and round them "
            "to integer levels",
        )
    if levels.min() < 0 or levels.max() > 255:
        got = f"levels from {levels.min():g} to {levels.max():g}"
        raise InputError(
            "array to export", got=got, wanted="0 to 255", hint="choose another --level-height-um"
        )
    return np.ascontiguousarray(levels, np.uint8)


def _require_same_layout(place: Path, name: str, layout_sha256: str) -> None:
    for older in sorted(place.glob("layout.*.json")):
        if older.name != f"{name}.json" and Sidecar.read(older).layout_sha256 != layout_sha256:
            raise InputError(
                "output",
                got=f"{older}, an export of another layout",
                wanted="a folder without exports of other layouts",
            )


def _write(
    file: Path,
    format: Format,
    levels: LevelRows,
    layout: LayoutSettings,
    job: PrintJob,
    greys: list[int] | None,
    marks: Marks | None,
) -> None:
    pitch_um, step_um = layout.pitch_um, layout.level_height_um
    match format:
        case "stl":
            cell_px = cell_of(layout)
            cells = levels[::cell_px][:, ::cell_px]
            write_stl(file, cells, cell_px * pitch_um, step_um, job.pedestal_um)
        case "gds":
            write_gds(file, levels, pitch_um, job.gds_layers, None if marks is None else marks.parts())
        case "tiff":
            write_tiff(file, levels, pitch_um, step_um)
        case "gwl":
            write_gwl(file, levels, pitch_um, step_um, job)
        case "dxf":
            write_dxf(file, levels, pitch_um, greys or [])
        case _:
            write_image(file, levels[:], greys or [], step_um)
