"""Score a finished design with independent judges, and write the folder of the score."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.score import MeasuredSource, PhotoSource, ScoreResult, judge_design
from litho_design.optics.thin_element import ElementKind
from litho_design.optimisation.stitching import Stitching
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printers
from litho_design.reports.score import write_score_report
from litho_design.tasks.design import Design
from litho_design.workflows.large import score_rings


def score(
    design: str | Path | LoadedDesign,
    out: str | Path,
    *,
    judges: Iterable[str | Printer] = (),
    scan: MeasuredSource | None = None,
    camera: PhotoSource | None = None,
    element: ElementKind | None = None,
    stitch: Stitching | None = None,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> ScoreResult:
    """Score the layout of a design by every judge, and write ``score.json`` and a report.

    A lens in rings (``lens --large``) is printed and scored along its radius.

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
        stitch: write fields that the prints of the judges are made of, each off its place.
        device: where prints and waves are computed; ignored for a design that is loaded.
        extrapolate: accept heights beyond a judge's calibration; recorded in the result.

    Raises:
        InputError: nothing to judge with, an incomplete or altered design folder, a measurement that
            does not match it, or an ``out`` that holds another kind of result.
    """
    if not isinstance(design, LoadedDesign) and Design.read(design).in_rings:
        if any(one is not None for one in (scan, camera, element, stitch)):
            given = "a scan, a photograph, another element or write fields"
            raise InputError("score of a lens in rings", got=given, wanted="models as judges")
        return score_rings(design, out, judges=judges, device=device, extrapolate=extrapolate)
    loaded = (
        design if isinstance(design, LoadedDesign) else LoadedDesign(design, device=device, element=element)
    )
    record = loaded.record
    printers = load_printers(judges, record.layout, device=loaded.device, extrapolate=extrapolate)
    if not printers and scan is None and camera is None:
        raise InputError("score", got="nothing to judge with", wanted="a judge, a scan or a photograph")
    with growing_folder(out, ScoreResult.FILE_NAME):
        judgement = judge_design(loaded, list(printers.values()), scan, camera, stitch)
        result = ScoreResult.of(loaded.folder, record, judgement.scores)
        wanted = {} if loaded.target is None else {"wanted": loaded.target.cpu().numpy()}
        shown = wanted | {title: loaded.display(image) for title, image in judgement.pictures.items()}
        write_score_report(Path(out), result, shown, loaded.window_um, judgement.photos, loaded.frame_um)
        result.write(out)
    return result
