"""Score a finished design by models, a measured print or a photograph, and write the scores into a folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_design.images.measurements import MeasuredSource, PhotoSource
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.score import ScoreResult, judge_design
from litho_design.optics.thin_element import ElementKind
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
    band_px: int | None = None,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> ScoreResult:
    """Score the layout of a design with every judge, and write ``score.json`` and a report.

    For a lens that was designed ring by ring (``lens --large``), the print and the score are computed along
    one radius.

    Args:
        design: the folder of a design, or a design from ``load_design``.
        out: folder of the score.
        judges: loaded printers, or texts of the form NAME=MODEL, MODEL or ``none``; MODEL may be the folder
            ``truth`` of a virtual fab. Judges with the same weights as a model that the search used are
            marked as not independent. By default, the judges are the zoo's models that were trained on the
            same prints as the model of the design. Their prints also contribute to the uncertainty of a
            photograph.
        scan: a measured height map of the printed part.
        camera: a photograph of the printed hologram's image, or of an object through the printed lens. If
            ``scan`` is also given, the photograph of an object is deconvolved with the PSF of the measured
            print too.
        element: ``thin``, or ``thick`` to compute the light behind every print by the wave propagation
            method. By default, the kind stated in the design is used. The argument is ignored if ``design``
            is already loaded.
        band_px: if given, the print of a large hologram is predicted and scored in bands of at most this many
            rows.
        device: where prints and waves are computed; ignored if ``design`` is already loaded.
        extrapolate: accept heights beyond the range for which a judge was calibrated; the result records this
            choice.

    Raises:
        InputError: there is no judge, the design folder is incomplete or was altered, a measurement does not
            match the design, or ``out`` holds another kind of result.
    """
    in_memory = isinstance(design, LoadedDesign)
    record = design.record if isinstance(design, LoadedDesign) else Design.read(design)
    if band_px is not None or record.in_rings:
        if in_memory or any(one is not None for one in (scan, camera, element)):
            given = "a scan, a photograph, another element or a design in memory"
            raise InputError("score of a large element", got=given, wanted="only models as judges")
        if record.in_rings and band_px is not None:
            raise InputError(
                "score of a lens in rings",
                got="bands",
                wanted="no bands, because the lens is scored along its radius",
            )
        judges = judges or ()
    loaded = (
        design
        if isinstance(design, LoadedDesign)
        else LoadedDesign(design, device=device, element=element, band_px=band_px)
    )
    if judges is None:
        printers = models_at_hand([record.printer], record.layout, device=loaded.device)
    else:
        fit: Any = {"device": loaded.device, "extrapolate": extrapolate}
        printers = list(load_printers(judges, record.layout, **fit).values())
    if not printers and scan is None and camera is None:
        raise InputError("score", got="no judge", wanted="a judge, a scan or a photograph")
    with growing_folder(out, ScoreResult.FILE_NAME):
        judgement = judge_design(loaded, printers, scan, camera)
        result = ScoreResult.of(loaded.folder, loaded.record, judgement.scores)
        write_score_report(Path(out), result, judgement)
        result.write(out)
    return result
