"""The sidecar of an exported file. It contains the heights, sizes and hashes that the file itself
cannot contain.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Result
from litho_design.exports.job import Format, GdsLayers, Gwl, PrintJob
from litho_design.exports.marks import Marks
from litho_design.optics.stroke import Stroke
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import PrinterRecord
from litho_design.printers.training import OutOfDistribution
from litho_design.tasks.design import Design

# Fields that a sidecar copies from the record of its design.
_OF_DESIGN = ("printer", "stroke", "out_of_distribution", "predicted", "settings")


class Sidecar(Result):
    """The contents of the file <file>.json that accompanies an exported file. The fields that describe a
    design are None if there is no design.
    """

    SCHEMA: ClassVar[str] = "litho-design/export/2"
    FILE_NAME: ClassVar[str] = "export.json"
    FORMER: ClassVar[frozenset[str]] = frozenset({"printability"})

    file: str
    file_sha256: str
    format: Format
    layout_sha256: str
    # Shape of the whole file, including marks.
    shape_px: tuple[int, int]
    pitch_um: float
    cell_px: int
    size_um: tuple[float, float]
    levels: int
    level_height_um: float
    nominal_height_um: list[float]
    maximum_height_um: float
    pedestal_um: float
    slicing_um: float
    hatching_um: float
    # Grey value of every level, for greyscale formats. If grey values are linear in height,
    # ``white_height_um`` is the height that belongs to the highest grey value of the format.
    greys: list[int] | None
    white_height_um: float | None
    gds_layers: GdsLayers | None
    gwl: Gwl | None
    row_0: Literal["top"] = "top"
    x_direction: Literal["right"] = "right"
    y_direction: Literal["down in images, up in stl, gds, dxf and gwl"] = (
        "down in images, up in stl, gds, dxf and gwl"
    )
    origin: Literal["lower left corner of the element"] = "lower left corner of the element"
    marks: Marks | None = None
    polarity: Literal["higher level is higher resist"] = "higher level is higher resist"
    design_sha256: str | None = None
    printer: PrinterRecord | None = None
    stroke: Stroke | None = None
    out_of_distribution: OutOfDistribution | None = None
    predicted: dict[str, float] | None = None
    settings: dict[str, Any] | None = None


def cell_of(layout: LayoutSettings) -> int:
    """Return the side, in pixels, of the square cells of a layout. For a ring layout, which has no cells,
    return 1.
    """
    return 1 if layout.symmetry == "radial" else layout.cell_px


def of_layout(layout: LayoutSettings, shape_px: tuple[int, int]) -> dict[str, Any]:
    """Return the fields of the sidecar that describe an exported map with the shape ``shape_px``."""
    return {
        "shape_px": shape_px,
        "pitch_um": layout.pitch_um,
        "cell_px": cell_of(layout),
        "size_um": (shape_px[0] * layout.pitch_um, shape_px[1] * layout.pitch_um),
        "levels": layout.levels,
        "level_height_um": layout.level_height_um,
        "nominal_height_um": [level * layout.level_height_um for level in range(layout.levels)],
        "maximum_height_um": (layout.levels - 1) * layout.level_height_um,
    }


def of_job(job: PrintJob, format: Format) -> dict[str, Any]:
    """Return the fields of the sidecar that describe a print job. Fields that apply only to other formats are
    None.
    """
    return {
        **job.model_dump(include={"pedestal_um", "slicing_um", "hatching_um"}),
        "gds_layers": job.gds_layers if format == "gds" else None,
        "gwl": job.gwl if format == "gwl" else None,
    }


def of_design(folder: Path | None, design: Design | None) -> dict[str, Any]:
    """Return the fields of the sidecar that come from a design, or an empty dict if there is no design."""
    if folder is None or design is None:
        return {}
    shared = {name: getattr(design, name) for name in _OF_DESIGN}
    return {"design_sha256": file_sha256(folder / Design.FILE_NAME), **shared}


def sidecar_path(file: Path) -> Path:
    """Return the path of the sidecar of a file."""
    return file.with_name(file.name + ".json")


def read_sidecar(file: Path) -> Sidecar:
    """Read the sidecar of an exported file and check the file against it.

    Raises:
        InputError: there is no sidecar, or the file was changed after the export.
    """
    sidecar = Sidecar.read(sidecar_path(file))
    if file_sha256(file) != sidecar.file_sha256:
        raise InputError(
            f"file {file}",
            got="content that changed after the export",
            wanted=f"content with the SHA-256 {sidecar.file_sha256[:12]}…",
        )
    return sidecar
