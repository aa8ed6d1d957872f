"""Export of a design in one of the formats, and the exact import of what was exported."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.files import writable
from litho_data.foundation.outputs import require_replaceable_folder
from litho_design.exports.gds import GdsLayers, GdsRows, write_gds
from litho_design.exports.image import TiffRows, read_image_levels, write_bmp, write_png16, write_tiff
from litho_design.exports.marks import Marks, with_marks
from litho_design.exports.sidecar import Format, Sidecar, make_sidecar, read_sidecar, sidecar_path
from litho_design.exports.stl import read_stl_levels, write_stl
from litho_design.judging.loaded import LoadedDesign
from litho_design.large.rows import LevelRows, bands_of, layout_rows
from litho_design.tasks.design import Design

_SUFFIX: dict[str, str] = {"png16": ".png", "bmp": ".bmp", "tiff": ".tif", "stl": ".stl", "gds": ".gds"}
_IN_PIECES = ("tiff", "gds")
# What the other formats need of memory for it is some 3 GiB (images) and more (solids).
_MOST_PX_WHOLE = 16384**2
_BAND_PX = 128


def export(
    design: str | Path | LoadedDesign,
    format: Format,
    out: str | Path,
    *,
    pedestal_um: float = 1.0,
    slicing_um: float = 0.1,
    hatching_um: float = 0.1,
    gds_layers: GdsLayers = "cumulative",
    marks: bool = False,
) -> Path:
    """Write the layout of a design for the printer, and ``<file>.json`` beside it.

    The file is read back before the export counts as done. ``tiff`` and ``gds`` are written and read a band
    of rows at a time, so that memory does not grow with the height of an element.

    Args:
        design: its folder, or what ``load_design`` gives.
        format: png16, bmp, tiff, stl or gds.
        out: folder of the export; exports of the same layout in other formats stay in it.
        pedestal_um: base under level 0; part of the solid in STL, a note to the operator in other formats.
        slicing_um, hatching_um: settings of the print job, recorded in the sidecar.
        marks: also a mark of orientation and a flat witness beside the element (see ``with_marks``).

    Returns:
        Path of the exported file.

    Raises:
        InputError: an incomplete design, a format that cannot hold it or would need too much memory, job
            settings below zero, an element too small for marks, or a folder that holds something else.
    """
    require_known("format", format, _SUFFIX)
    job = {"pedestal_um": pedestal_um, "slicing_um": slicing_um, "hatching_um": hatching_um}
    for setting, value in job.items():
        # Only a closed solid needs a base.
        may_be_zero = setting == "pedestal_um" and format != "stl"
        if not 0 <= value < math.inf or (value == 0 and not may_be_zero):
            raise InputError(setting, got=f"{value:g} µm", wanted="a positive length")
    folder = design.folder if isinstance(design, LoadedDesign) else Path(design)
    record = Design.read(folder)
    levels = written = layout_rows(folder)
    if format not in _IN_PIECES and levels.shape[0] * levels.shape[1] > _MOST_PX_WHOLE:
        got = f"{format} of {levels.shape[0]} x {levels.shape[1]} px"
        raise InputError("format of a large element", got=got, wanted="tiff or gds, written in pieces")
    found: Marks | None = None
    if marks:
        guard_um, heights = record.printer.guard_um, record.stroke.printed_height_um
        written, found = with_marks(levels, record.layout, guard_um, heights)
    name = f"layout{_SUFFIX[format]}"
    require_replaceable_folder(out, "layout*")
    place = Path(out)
    _require_same_layout(place, name, record.layout_sha256)
    with writable(place):
        place.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="layout.", suffix=".partial", dir=place) as temporary:
        file = Path(temporary) / name
        step = _write(file, format, written, record, pedestal_um, gds_layers, found)
        sidecar = make_sidecar(
            folder, record, file, format, pedestal_um=pedestal_um, slicing_um=slicing_um,
            hatching_um=hatching_um, grey_per_level=step, gds_layers=gds_layers if format == "gds" else None,
            shape_px=(written.shape[0], written.shape[1]), marks=found,
        )  # fmt: skip
        sidecar.write(temporary).rename(sidecar_path(file))
        back = _rows(file, read_sidecar(file))
        if not all(np.array_equal(back[rows], written[rows]) for rows in bands_of(written, _BAND_PX)):
            raise AssertionError(f"{format} export does not read back as it was written")
        # The sidecar last: without it, or with an older one, the file is refused.
        for part in sorted(Path(temporary).iterdir(), key=lambda part: part.suffix == ".json"):
            part.replace(place / part.name)
    return place / name


def import_levels(file: str | Path) -> tuple[np.ndarray, Sidecar]:
    """The level map of an element from its exported file, uint8 (ny, nx), row 0 on top, and its sidecar.

    Raises:
        InputError: no sidecar, or a file that was changed.
    """
    path = Path(file)
    sidecar = read_sidecar(path)
    levels = _rows(path, sidecar)[:]
    if sidecar.marks is not None:
        top, bottom, left, right = sidecar.marks.element_px
        levels = levels[top:bottom, left:right].copy()
    return levels, sidecar


def _rows(path: Path, sidecar: Sidecar) -> LevelRows:
    """The map of a file, marks included."""
    if sidecar.format == "stl":
        cell_px = _cell_px(sidecar)
        shape = (sidecar.shape_px[0] // cell_px, sidecar.shape_px[1] // cell_px)
        cells = read_stl_levels(
            path, shape, cell_px * sidecar.pitch_um, sidecar.level_height_um, sidecar.pedestal_um
        )
        return cells.repeat(cell_px, 0).repeat(cell_px, 1)
    if sidecar.format == "gds":
        assert sidecar.gds_layers is not None
        return GdsRows(path, sidecar.shape_px, sidecar.pitch_um, sidecar.gds_layers)
    if sidecar.format == "tiff":
        return TiffRows(path)
    assert sidecar.grey_per_level is not None
    return read_image_levels(path, sidecar.grey_per_level)


def _require_same_layout(place: Path, name: str, layout_sha256: str) -> None:
    for older in sorted(place.glob("layout.*.json")):
        if older.name != f"{name}.json" and Sidecar.read(older).layout_sha256 != layout_sha256:
            raise InputError(
                "output", got=f"{older}, which is of another layout", wanted="a folder for this layout only"
            )


def _write(
    file: Path,
    kind: Format,
    levels: LevelRows,
    design: Design,
    pedestal_um: float,
    gds_layers: GdsLayers,
    marks: Marks | None,
) -> int | None:
    layout = design.layout
    if kind == "stl":
        cell_px = 1 if layout.symmetry == "radial" else layout.cell_px
        cells = levels[::cell_px][:, ::cell_px]
        write_stl(file, cells, cell_px * layout.pitch_um, layout.level_height_um, pedestal_um)
        return None
    if kind == "gds":
        parts = None if marks is None else marks.parts()
        write_gds(file, levels, layout.pitch_um, gds_layers, parts)
        return None
    if kind == "tiff":
        return write_tiff(file, levels, layout)
    return {"png16": write_png16, "bmp": write_bmp}[kind](file, levels[:], layout)


def _cell_px(sidecar: Sidecar) -> int:
    layout = sidecar.settings["layout"]
    return 1 if layout["symmetry"] == "radial" else round(layout["cell_um"] / layout["pitch_um"])
