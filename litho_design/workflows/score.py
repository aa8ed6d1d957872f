"""Score a finished design with independent judges, and write the folder of the score."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.outputs import require_own_folder
from litho_data.foundation.run_facts import run_facts
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.score import MeasuredSource, PhotoSource, ScoreResult, judge_design
from litho_design.optics.thin_element import ElementKind
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printers
from litho_design.reports.score import write_score_report
from litho_design.tasks.design import LEVELS_FILE, Design


def score(
    design: str | Path | LoadedDesign,
    out: str | Path,
    *,
    judges: Iterable[str | Printer] = (),
    scan: MeasuredSource | None = None,
    camera: PhotoSource | None = None,
    element: ElementKind | None = None,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> ScoreResult:
    """Score the layout of a design by every judge, and write ``score.json`` and a report.

    Args:
        design: its folder, or what ``load_design`` gives.
        out: folder of the score.
        judges: printers, or NAME=MODEL, MODEL or ``none``; MODEL may be ``truth`` of a virtual fab. Those
            with the weights of the design's own model are marked as not independent.
        scan: a measured height map of the printed part.
        camera: a photograph of the printed hologram's image, or of an object through the printed lens;
            with ``scan`` it is deconvolved with the PSF of the measured print too.
        element: ``thick`` judges every print by the wave propagation method; ignored for a design that is
            loaded.
        device: where prints and waves are computed; ignored for a design that is loaded.
        extrapolate: accept heights beyond a judge's calibration; recorded in the result.

    Raises:
        InputError: nothing to judge with, an incomplete or altered design folder, a measurement that
            does not match it, or an ``out`` that holds another kind of result.
    """
    require_own_folder(out, ScoreResult.FILE_NAME)
    loaded = (
        design if isinstance(design, LoadedDesign) else LoadedDesign(design, device=device, element=element)
    )
    record = loaded.record
    printers = load_printers(judges, record.layout, device=loaded.device, extrapolate=extrapolate)
    if not printers and scan is None and camera is None:
        raise InputError("score", got="nothing to judge with", wanted="a judge, a scan or a photograph")
    judgement = judge_design(loaded, list(printers.values()), scan, camera)
    result = ScoreResult(
        **run_facts(),
        design=str(loaded.folder),
        design_sha256=file_sha256(loaded.folder / Design.FILE_NAME),
        layout_sha256=record.files[LEVELS_FILE],
        task=record.task,
        designed_with=record.printer,
        layout=record.layout,
        optics=record.optics,
        seeds=[int(record.settings["search"]["seed"])],
        reference_efficiency=record.reference_efficiency,
        designed=record.predicted,
        baselines=record.baselines,
        scores=judgement.scores,
    )
    shown = {title: loaded.display(image) for title, image in judgement.pictures.items()}
    write_score_report(Path(out), result, shown, loaded.window_um, judgement.photos, loaded.frame_um)
    result.write(out)
    return result
