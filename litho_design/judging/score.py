"""Score a design by the print that models predict, by a measured print, or by a photograph. The scored layout
always has integer levels, so it can be printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts, run_facts
from litho_design.images.measurements import MeasuredSource, PhotoSource
from litho_design.images.noise import corrected_scores
from litho_design.images.photograph import CameraRecord
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.measured import measured_print
from litho_design.judging.photographs import score_hologram_photo, score_lens_photo
from litho_design.lenses.task import LensTask
from litho_design.optics import Optics
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer, PrinterRecord
from litho_design.scans.record import MeasuredRecord
from litho_design.scans.variants import with_dust, with_more_noise, with_other_prints
from litho_design.tasks.design import Design


class JudgedScore(Record):
    """The scores of a design from one judge, which is a model, a measured print or a photographed image.

    ``uncertainty`` contains σ of each score (see ``corrected_scores``). It is None if the judge is a model.
    """

    FORMER: ClassVar[frozenset[str]] = frozenset({"stitching"})

    kind: Literal["model", "scan", "camera"]
    judge: PrinterRecord | MeasuredRecord | CameraRecord
    independent: bool
    mean_height_difference_um: float | None
    rms_height_difference_um: float | None
    figures: dict[str, float]
    uncertainty: dict[str, float] | None = None

    def remarks(self) -> list[str]:
        """Return remarks on the processing of a measurement, one phrase each. If the judge is a model, there
        are none.
        """
        return [] if isinstance(self.judge, PrinterRecord) else self.judge.remarks()


class ScoreResult(RunFacts, Result):
    """The contents of score.json."""

    SCHEMA: ClassVar[str] = "litho-design/score/1"
    FILE_NAME: ClassVar[str] = "score.json"

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
    baselines: dict[str, dict[str, float]] | None = None
    scores: list[JudgedScore]
    # Gain of the design over the best uncorrected layout (see ``Width.gain``). It is None if no uncorrected
    # layout was compared.
    gain: float | None = None

    @classmethod
    def of(cls, folder: Path, record: Design, scores: list[JudgedScore]) -> ScoreResult:
        """Make the result of this run, for the design in a folder."""
        return cls(
            **run_facts(),
            design=str(folder),
            design_sha256=file_sha256(folder / Design.FILE_NAME),
            layout_sha256=record.layout_sha256,
            task=record.task,
            designed_with=record.printer,
            layout=record.layout,
            optics=record.optics,
            seeds=[int(record.settings["search"]["seed"])],
            reference_efficiency=record.reference_efficiency,
            designed=record.predicted,
            baselines=record.baselines,
            scores=scores,
            gain=None if record.width is None else record.width.gain,
        )


@dataclass(frozen=True)
class Judgement:
    """The verdicts of several judges on one design.

    Attributes:
        scores: one per judge.
        pictures: mapping from titles to the images that reports show, shape (m, m): the target image, and the
            image or PSF behind each print.
        side_um: width of the images in ``pictures``, µm.
        photos: for a photograph taken through a printed lens, mapping from titles to images of shape (n, n):
            the object, the photograph and the reconstructions.
        frame_um: width of the images in ``photos``, µm.
    """

    scores: list[JudgedScore]
    pictures: dict[str, np.ndarray]
    side_um: float
    photos: dict[str, np.ndarray] = field(default_factory=dict)
    frame_um: float = 0.0


def judge_design(
    loaded: LoadedDesign,
    judges: Sequence[Printer],
    scan: MeasuredSource | None = None,
    camera: PhotoSource | None = None,
) -> Judgement:
    """Score the layout of a design by the predictions of models, a measured print and a photograph.

    Args:
        judges: printers. If a printer has the same weights as a model that the search used, its score is
            marked as not independent. The images behind their prints also determine how uncertain the
            position of a hologram's image in a photograph is.
        scan: a measured height map of the printed part.
        camera: a photograph of the printed hologram's image, or of an object through the printed lens. If
            ``scan`` is given, the photograph of an object is also deconvolved with the PSF of the measured
            print.

    Raises:
        InputError: a measurement does not match the design.
    """
    scores, images, pictures = [], [], {"in design": loaded.image(loaded.expected_um)}
    printed_um: Tensor | None = None
    photos: dict[str, np.ndarray] = {}
    for judge in judges:
        height, record = loaded.printed_um(judge), judge.record()
        scores.append(_print_score(loaded, record, height))
        images.append(loaded.image(height))
        pictures[f"printed by {record.name}"] = images[-1]
    if scan is not None:
        printed_um, measured, doubt_um = measured_print(loaded, scan)
        scores.append(_print_score(loaded, measured, printed_um, doubt_um))
        pictures[f"measured print {measured.name}"] = loaded.image(printed_um)
    if camera is not None:
        of_lens = isinstance(loaded.task, LensTask)
        if loaded.target is None and not of_lens:
            raise InputError(
                "photograph",
                got=f"a design of {loaded.task.name!r}",
                wanted="the design of a hologram or a lens",
            )
        photo = (
            score_lens_photo(loaded, camera, printed_um)
            if of_lens
            else score_hologram_photo(loaded, camera, images)
        )
        (photos if of_lens else pictures).update(photo.pictures)
        scores.append(
            JudgedScore(
                kind="camera",
                judge=photo.record,
                independent=True,
                mean_height_difference_um=None,
                rms_height_difference_um=None,
                figures=photo.figures.model_dump(exclude_none=True),
                uncertainty=photo.uncertainty,
            )
        )
    wanted = {} if loaded.target is None else {"target": loaded.target.cpu().numpy()}
    shown = wanted | {title: loaded.display(image) for title, image in pictures.items()}
    return Judgement(scores, shown, loaded.window_um, photos, loaded.frame_um)


def _print_score(
    loaded: LoadedDesign,
    judge: PrinterRecord | MeasuredRecord,
    height: Tensor,
    doubt_um: Tensor | None = None,
) -> JudgedScore:
    """Score a predicted or measured print, and compare its height with the designed height. ``doubt_um`` is
    given for a measured print (see ``measured_print``).
    """
    scored, sigma = loaded.score(height), None
    figures = scored.model_dump()
    measured = isinstance(judge, MeasuredRecord)
    if isinstance(judge, MeasuredRecord):
        assert doubt_um is not None
        noisy = with_more_noise(height, judge)
        variants = with_other_prints(height, judge, loaded.record.layout.pitch_um)
        dust = with_dust(height, doubt_um)
        figures, sigma = corrected_scores(loaded.score, scored, noisy, variants, dust)
    off = (height - loaded.expected_um).double()
    in_rings = loaded.record.in_rings
    area = loaded.bench.propagator.ring_area_um2.to(off) if in_rings else torch.ones_like(off)
    share = area / area.sum()
    searched = {loaded.record.printer.sha256, *loaded.record.ensemble_sha256}
    return JudgedScore(
        kind="scan" if measured else "model",
        judge=judge,
        independent=measured or judge.sha256 not in searched,
        mean_height_difference_um=float((off * share).sum()),
        rms_height_difference_um=float((off.square() * share).sum().sqrt()),
        figures=figures,
        uncertainty=sigma,
    )
