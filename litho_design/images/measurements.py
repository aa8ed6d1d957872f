"""Measurements of a printed element: a height map of the element, or a photograph of the light behind it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass

from litho_data.commands.settings import setting

Levelling = Literal["none", "plane", "bow"]


@dataclass(frozen=True)
class MeasuredSource:
    """A height map of the printed part. If the file does not state the unit and the size, pass ``unit`` and
    ``size_um`` (the side of a square map, or the lengths along y and x).

    Some elements, such as a lens cap or a blaze, look the same at several positions or in several
    orientations, so the registration of their scans may fail. Align such a scan with the element and set
    ``aligned``.
    """

    path: Path = setting(..., "AFM height map of the printed part", option="--scan")
    unit: str | None = setting(
        None, "Unit of the scan's heights, if the file states none", option="--scan-unit"
    )
    size_um: float | tuple[float, float] | None = setting(
        None, "Side of the scan, µm, if the file states none", option="--scan-size-um"
    )
    levelling: Levelling = setting(
        "bow",
        "What is removed from the scan: nothing, a plane, or a second-order bow",
        option="--scan-levelling",
    )
    scale_sd: float = setting(
        0.02,
        "Relative standard uncertainty of the microscope's height scale",
        option="--scan-scale-sd",
    )
    aligned: bool = setting(
        False,
        "Treat the scan as already aligned with the pixels of the element, and do not register it",
        option="--scan-aligned",
    )
    tip_um: float | None = setting(
        None,
        "Radius of the tip, used to remove the widening that the tip causes (by default, the radius is "
        "estimated from the scan; 0 removes nothing)",
        unit="µm",
        option="--scan-tip-um",
    )


@dataclass(frozen=True)
class PhotoSource:
    """A photograph of a hologram's image, or of an object seen through a printed lens. The counts minus the
    dark level must be proportional to the light.
    """

    path: Path = setting(
        ...,
        "Photograph of the printed hologram's image, or of an object through the printed lens",
        option="--camera",
    )
    pitch_um: float = setting(
        ..., "Side of the photograph's pixels in the image plane", unit="µm", option="--camera-pitch-um"
    )
    dark_level: float | None = setting(
        None, "Dark level of the photograph, counts", option="--camera-dark-level"
    )
    imaged: str | None = setting(
        None,
        "Object in front of the lens: the name of one of the design's objects, or an image file",
        option="--camera-object",
    )
    orientation: str = setting(
        "identity",
        "Operation that makes the photograph upright: identity, rotate-90, rotate-180, rotate-270, flip-x, "
        "flip-y, transpose or anti-transpose; the photograph is refused if another one fits better",
        option="--camera-orientation",
    )
    power_counts: float | None = setting(
        None,
        "Sum of the counts, minus the dark level, that all light on the element gives at the same exposure; "
        "needed for efficiencies",
        option="--camera-power",
    )
    pitch_sd: float = setting(
        0.0,
        "Relative standard uncertainty of the pixel side, if the magnification is uncertain",
        option="--camera-pitch-sd",
    )
    flat: Path | None = setting(
        None,
        "Photograph of uniform light by the same camera, to correct vignetting",
        option="--camera-flat",
    )
