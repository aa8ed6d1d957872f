"""Score a design as others print, measure or photograph it; always the layout that would be printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts
from litho_design.images.photograph import CameraRecord
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.measured import MeasuredRecord, measured_print
from litho_design.judging.photographs import score_hologram_photo, score_lens_photo
from litho_design.optics import Optics
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer, PrinterRecord


@dataclass(frozen=True)
class MeasuredSource:
    """A height map of the printed part; unit and size for files that do not state them."""

    path: Path
    unit: str | None = None
    size_um: tuple[float, float] | None = None


@dataclass(frozen=True)
class PhotoSource:
    """A photograph, its pixel in the image plane, and its dark level if known.

    ``imaged`` is the object in front of a lens: a name of the design's objects, or a picture's path.
    """

    path: Path
    pitch_um: float
    dark_level: float | None = None
    imaged: str | None = None


class JudgedScore(Record):
    """The figures of one judge: a model, a measured print, or a photographed image."""

    kind: Literal["model", "scan", "camera"]
    judge: PrinterRecord | MeasuredRecord | CameraRecord
    independent: bool
    mean_height_difference_um: float | None
    rms_height_difference_um: float | None
    figures: dict[str, float]


class ScoreResult(RunFacts, Result):
    """score.json."""

    SCHEMA: ClassVar[str] = "litho-design/score/1"
    FILE_NAME: ClassVar[str] = "score.json"

    schema_: Literal["litho-design/score/1"] = Field(default="litho-design/score/1", alias="schema")
    design: str
    design_sha256: str
    layout_sha256: str
    task: str
    designed_with: PrinterRecord
    layout: LayoutSettings
    optics: Optics
    seeds: list[int]
    reference_efficiency: float | None
    designed: dict[str, float]
    scores: list[JudgedScore]


@dataclass(frozen=True)
class Judgement:
    """The verdicts of several judges on one design.

    Attributes:
        scores: one per judge.
        pictures: image or PSF (m, m) behind each print, share of the incident power per pixel, by title.
        photos: object, photograph and reconstructions (n, n) of a lens, by title.
    """

    scores: list[JudgedScore]
    pictures: dict[str, np.ndarray]
    photos: dict[str, np.ndarray]


def judge_design(
    loaded: LoadedDesign,
    judges: Sequence[Printer],
    scan: MeasuredSource | None = None,
    camera: PhotoSource | None = None,
) -> Judgement:
    """Score the layout of a design as printed by models, as measured, and as photographed.

    Args:
        judges: printers; those with the weights of the design's own model are marked as not independent.
        scan: a measured height map of the printed part.
        camera: a photograph of the printed hologram's image, or of an object through the printed lens;
            with ``scan`` it is deconvolved with the PSF of the measured print too.

    Raises:
        InputError: a measurement that does not match the design.
    """
    scores, pictures = [], {"in design": loaded.image(loaded.expected_um)}
    printed_um: Tensor | None = None
    photos: dict[str, np.ndarray] = {}
    for judge in judges:
        height, record = loaded.printed_um(judge), judge.record()
        independent = record.sha256 != loaded.record.printer.sha256
        scores.append(_height_score(loaded, "model", record, independent, height))
        pictures[f"printed by {record.name}"] = loaded.image(height)
    if scan is not None:
        printed_um, measured = measured_print(loaded, scan.path, unit=scan.unit, size_um=scan.size_um)
        scores.append(_height_score(loaded, "scan", measured, True, printed_um))
        pictures[f"measured print {measured.name}"] = loaded.image(printed_um)
    if camera is not None and loaded.target is None:
        lens_score, photo, photos = score_lens_photo(
            loaded, camera.path, camera.pitch_um, camera.imaged,
            dark_level=camera.dark_level, printed_um=printed_um,
        )  # fmt: skip
        scores.append(_camera_score(photo, lens_score))
    elif camera is not None:
        if camera.imaged is not None:
            raise InputError(
                "photographed object",
                got="the design of a hologram",
                wanted="a lens",
                hint="no --camera-object",
            )
        score, photo, image = score_hologram_photo(
            loaded, camera.path, camera.pitch_um, dark_level=camera.dark_level
        )
        scores.append(_camera_score(photo, score))
        pictures[f"photograph {photo.name}"] = image
    return Judgement(scores, pictures, photos)


def _camera_score(photo: CameraRecord, figures: Record) -> JudgedScore:
    return JudgedScore(
        kind="camera",
        judge=photo,
        independent=True,
        mean_height_difference_um=None,
        rms_height_difference_um=None,
        figures=figures.model_dump(exclude_none=True),
    )


def _height_score(
    loaded: LoadedDesign,
    kind: Literal["model", "scan"],
    judge: PrinterRecord | MeasuredRecord,
    independent: bool,
    height: Tensor,
) -> JudgedScore:
    difference = height - loaded.expected_um
    return JudgedScore(
        kind=kind,
        judge=judge,
        independent=independent,
        mean_height_difference_um=float(difference.mean()),
        rms_height_difference_um=float(difference.square().mean().sqrt()),
        figures=loaded.score(height).model_dump(),
    )
