"""Score a finished design with independent judges, and write the folder of the score."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_design.images.photograph import PhotoSource
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.measured import MeasuredSource
from litho_design.judging.score import ScoreResult, judge_design
from litho_design.large.lens import judge_rings
from litho_design.large.score import judge_in_bands
from litho_design.optics.thin_element import ElementKind
from litho_design.optimisation.stitching import Stitching
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printers, models_at_hand
from litho_design.reports.score import write_score_report
from litho_design.tasks.design import Design


def score(
    design: str | Path | LoadedDesign,
    out: str | Path,
    *,
    judges: Iterable[str | Printer] | None = None,
    scan: MeasuredSource | None = None,
    camera: PhotoSource | None = None,
    element: ElementKind | None = None,
    stitch: Stitching | None = None,
    band_px: int | None = None,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> ScoreResult:
    """Score the layout of a design by every judge, and write ``score.json`` and a report.

    A lens of rings (``lens --large``) is printed and scored along its radius.

    Args:
        design: a design, as its folder or from ``load_design``.
        out: folder of the score.
        judges: printers, or NAME=MODEL, MODEL or ``none``; MODEL may be ``truth`` of a virtual fab. Those
            with the weights of the design's own model are marked as not independent. Without judge, scan and
            photograph, the zoo's models that were trained on the same prints judge.
        scan: a measured height map of the printed part.
        camera: a photograph of the printed hologram's image, or of an object through the printed lens;
            with ``scan`` it is deconvolved with the PSF of the measured print too.
        element: ``thick`` judges every print by the wave propagation method; ignored for a loaded design.
        stitch: displaced write fields of the judges' prints.
        band_px: most rows of a band, to print and score a large hologram band by band.
        device: where prints and waves are computed; ignored for a loaded design.
        extrapolate: accept heights beyond a judge's calibration; recorded in the result.

    Raises:
        InputError: nothing to judge with, an incomplete or altered design folder, a measurement that
            does not match it, or an ``out`` that holds another kind of result.
    """
    loaded = design if isinstance(design, LoadedDesign) else None
    folder = design.folder if isinstance(design, LoadedDesign) else Path(design)
    record = Design.read(folder) if loaded is None else loaded.record
    in_parts = band_px is not None or record.in_rings
    if in_parts and any(one is not None for one in (loaded, scan, camera, element)):
        given = "a scan, a photograph, another element or a design in memory"
        raise InputError("score of a large element", got=given, wanted="models that score it")
    if record.in_rings and (stitch is not None or band_px is not None):
        raise InputError("score of a lens in rings", got="write fields or bands", wanted="neither")
    if loaded is None and not in_parts:
        loaded = LoadedDesign(folder, device=device, element=element)
    if loaded is not None:
        record, device = loaded.record, loaded.device
    if judges is None and scan is None and camera is None and not in_parts:
        printers = models_at_hand([record.printer], record.layout, device=device)
    else:
        fit: Any = {"device": device, "extrapolate": extrapolate}
        printers = list(load_printers(judges or (), record.layout, **fit).values())
    if not printers and scan is None and camera is None:
        raise InputError("score", got="nothing to judge with", wanted="a judge, a scan or a photograph")
    with growing_folder(out, ScoreResult.FILE_NAME):
        if loaded is not None:
            judgement = judge_design(loaded, printers, scan, camera, stitch)
        elif band_px is None:
            judgement = judge_rings(folder, record, printers)
        else:
            judgement = judge_in_bands(folder, record, printers, band_px, stitch)
        result = ScoreResult.of(folder, record, judgement.scores)
        write_score_report(Path(out), result, judgement)
        result.write(out)
    return result
