"""The sidecar of an exported file: the heights, sizes and hashes that the file itself cannot hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Result
from litho_design.exports.marks import Marks
from litho_design.printers.layout import Printability
from litho_design.printers.training import OutOfDistribution
from litho_design.tasks.design import Design

Format = Literal["png16", "bmp", "tiff", "stl", "gds"]


class Sidecar(Result):
    """<file>.json beside an exported file."""

    SCHEMA: ClassVar[str] = "litho-design/export/1"
    FILE_NAME: ClassVar[str] = "export.json"

    schema_: Literal["litho-design/export/1"] = Field(default="litho-design/export/1", alias="schema")
    file: str
    file_sha256: str
    format: Format
    design_sha256: str
    layout_sha256: str
    model_name: str
    model_sha256: str
    extrapolated: bool
    # Of the whole file, marks included.
    shape_px: tuple[int, int]
    pitch_um: float
    size_um: tuple[float, float]
    levels: int
    level_height_um: float
    nominal_height_um: list[float]
    predicted_height_um: list[float]
    predicted_gain: float
    predicted_offset_um: float
    maximum_height_um: float
    pedestal_um: float
    slicing_um: float
    hatching_um: float
    grey_per_level: int | None
    gds_layers: Literal["cumulative", "exclusive"] | None
    row_0: Literal["top"] = "top"
    x_direction: Literal["right"] = "right"
    y_direction: Literal["down in the layout, up in stl and gds"] = "down in the layout, up in stl and gds"
    origin: Literal["lower left corner of the element"] = "lower left corner of the element"
    # Absent in older files, and where only the element is exported.
    marks: Marks | None = None
    polarity: Literal["higher level is higher resist"] = "higher level is higher resist"
    wavelength_um: float
    index_step: float
    distance_um: float
    minimum_feature_um: float
    printability: Printability
    out_of_distribution: OutOfDistribution | None
    predicted: dict[str, float]
    seeds: list[int]
    settings: dict[str, Any]


def make_sidecar(
    design_folder: Path,
    design: Design,
    file: Path,
    kind: Format,
    *,
    pedestal_um: float,
    slicing_um: float,
    hatching_um: float,
    grey_per_level: int | None = None,
    gds_layers: Literal["cumulative", "exclusive"] | None = None,
    shape_px: tuple[int, int],
    marks: Marks | None = None,
) -> Sidecar:
    """The sidecar of ``file``, a map of ``shape_px``."""
    layout, optics, stroke = design.layout, design.optics, design.stroke
    return Sidecar(
        file=file.name,
        file_sha256=file_sha256(file),
        format=kind,
        design_sha256=file_sha256(design_folder / Design.FILE_NAME),
        layout_sha256=design.layout_sha256,
        model_name=design.printer.name,
        model_sha256=design.printer.sha256,
        extrapolated=design.printer.extrapolated,
        shape_px=shape_px,
        pitch_um=layout.pitch_um,
        size_um=(shape_px[0] * layout.pitch_um, shape_px[1] * layout.pitch_um),
        marks=marks,
        levels=layout.levels,
        level_height_um=layout.level_height_um,
        nominal_height_um=[level * layout.level_height_um for level in range(layout.levels)],
        predicted_height_um=stroke.printed_height_um,
        predicted_gain=stroke.print_gain,
        predicted_offset_um=stroke.printed_height_um[0],
        maximum_height_um=(layout.levels - 1) * layout.level_height_um,
        pedestal_um=pedestal_um,
        slicing_um=slicing_um,
        hatching_um=hatching_um,
        grey_per_level=grey_per_level,
        gds_layers=gds_layers,
        wavelength_um=optics.wavelength_um,
        index_step=optics.index_step,
        distance_um=optics.distance_um,
        minimum_feature_um=design.printability.smallest_ring_um or design.printability.smallest_feature_um,
        printability=design.printability,
        out_of_distribution=design.out_of_distribution,
        predicted=design.predicted,
        seeds=[int(design.settings["search"]["seed"])],
        settings=design.settings,
    )


def sidecar_path(file: Path) -> Path:
    """Where the sidecar of a file lies."""
    return file.with_name(file.name + ".json")


def read_sidecar(file: Path) -> Sidecar:
    """The sidecar of an exported file, checked against the file.

    Raises:
        InputError: no sidecar, or a file that was changed after the export.
    """
    sidecar = Sidecar.read(sidecar_path(file))
    if file_sha256(file) != sidecar.file_sha256:
        raise InputError(
            f"file {file}", got="other bytes than were exported", wanted=sidecar.file_sha256[:12]
        )
    return sidecar
