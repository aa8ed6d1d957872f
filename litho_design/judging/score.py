"""Score a design by printers that it was not designed with; always the layout that would be printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.outputs import require_own_folder
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts, run_facts
from litho_design.judging.camera import CameraRecord, photo_score, photographed_image
from litho_design.judging.judge import Judging
from litho_design.judging.measured import MeasuredRecord, measured_print
from litho_design.lens.photo import score_lens_photo
from litho_design.optics import Optics
from litho_design.optimisation.parametrise import LayoutSettings
from litho_design.printers.printer import Printer, PrinterRecord
from litho_design.reports.score import write_score_report
from litho_design.tasks.design import LEVELS_FILE, Design


@dataclass(frozen=True)
class MeasuredSource:
    """A height map of the printed part; unit and size only for files that do not carry them."""

    path: Path
    unit: str | None = None
    size_um: tuple[float, float] | None = None


@dataclass(frozen=True)
class PhotoSource:
    """A photograph of the image, its pixel in the image plane, its dark level if it is known.

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


def score_design(
    folder: str | Path,
    judges: Sequence[Printer],
    out: str | Path,
    *,
    scan: MeasuredSource | None = None,
    camera: PhotoSource | None = None,
    device: str | torch.device = "cpu",
) -> ScoreResult:
    """Score the layout of a design by every judge, and write ``score.json`` and a report.

    Args:
        folder: design folder.
        judges: printers; those with the weights of the design's own model are marked as not independent.
        scan: a measured height map of the printed part.
        camera: a photograph of the printed hologram's image, or of an object through the printed lens;
            with ``scan`` it is deconvolved with the PSF of the measured print too.

    Raises:
        InputError: an incomplete or altered design folder, a measurement that does not belong to it, or
            an ``out`` that holds another kind of result.
    """
    printed_um: Tensor | None = None
    photos: dict[str, np.ndarray] = {}
    require_own_folder(out, ScoreResult.FILE_NAME)
    judging = Judging(folder, device=device)
    design = judging.design
    scores, pictures = [], {"in design": judging.image(judging.expected_um)}
    for judge in judges:
        height, record = judging.printed_um(judge), judge.record()
        independent = record.sha256 != design.printer.sha256
        scores.append(_height_score(judging, "model", record, independent, height))
        pictures[f"printed by {record.name}"] = judging.image(height)
    if scan is not None:
        printed_um, measured = measured_print(judging, scan.path, unit=scan.unit, size_um=scan.size_um)
        scores.append(_height_score(judging, "scan", measured, True, printed_um))
        pictures[f"measured print {measured.name}"] = judging.image(printed_um)
    if camera is not None:
        if judging.target is None:
            lens_figures, photo, photos = score_lens_photo(
                judging, camera.path, camera.pitch_um, camera.imaged,
                dark_level=camera.dark_level, printed_um=printed_um,
            )  # fmt: skip
            scores.append(_camera_score(photo, lens_figures))
        else:
            image, photo = _hologram_photo(judging, camera)
            scores.append(_camera_score(photo, photo_score(image, judging.target)))
            pictures[f"photograph {photo.name}"] = image
    result = ScoreResult(
        **run_facts(),
        design=str(folder),
        design_sha256=file_sha256(Path(folder) / Design.FILE_NAME),
        layout_sha256=design.files[LEVELS_FILE],
        task=design.task,
        designed_with=design.printer,
        layout=design.layout,
        optics=design.optics,
        seeds=[int(design.settings["search"]["seed"])],
        reference_efficiency=design.reference_efficiency,
        designed=design.predicted,
        scores=scores,
    )
    shown = {name: judging.display(image) for name, image in pictures.items()}
    write_score_report(Path(out), result, shown, judging.window_um, photos, judging.frame_um)
    result.write(out)
    return result


def _hologram_photo(judging: Judging, camera: PhotoSource) -> tuple[np.ndarray, CameraRecord]:
    if camera.imaged is not None:
        raise InputError(
            "photographed object", got="the design of a hologram", wanted="a lens", hint="no --camera-object"
        )
    wanted, pitch_um = judging.image(judging.expected_um), judging.design.layout.pitch_um
    return photographed_image(wanted, pitch_um, camera.path, camera.pitch_um, dark_level=camera.dark_level)


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
    judging: Judging,
    kind: Literal["model", "scan"],
    judge: PrinterRecord | MeasuredRecord,
    independent: bool,
    height: Tensor,
) -> JudgedScore:
    difference = height - judging.expected_um
    return JudgedScore(
        kind=kind,
        judge=judge,
        independent=independent,
        mean_height_difference_um=float(difference.mean()),
        rms_height_difference_um=float(difference.square().mean().sqrt()),
        figures=judging.figures(height).model_dump(),
    )
