"""Evaluate the scans of a sheet: build a dataset, fit a printer model, correct the model, freeze it together
with its card, and compare the two printed holograms.
"""

from __future__ import annotations

from pathlib import Path

from litho_data import build_dataset
from litho_data.cards.card import load_card
from litho_data.commands.progress import say
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.run_facts import run_facts
from litho_data.layouts.card_text import CARD_NAME
from litho_data.reports.page import Page
from litho_design.images.measurements import MeasuredSource
from litho_design.judging.gap import design_folder
from litho_design.printers.source import Device
from litho_design.sheets.record import ARMS, HOLOGRAM, SCANS_OF_HOLOGRAMS, Arm, ReadSheet, Sheet
from litho_design.workflows.score import score
from litho_models import close_loop, evaluate, freeze

# The base model that the correction loop fits to the scans and extends. A sheet has too few scans for a model
# with more parameters.
_BASE = "physics"


def read_sheet(sheet: str | Path, out: str | Path, *, device: Device = "cpu") -> ReadSheet:
    """Fit a printer model to the scans of a sheet, find the effects that the model lacks, and compare the two
    printed holograms.

    Args:
        sheet: folder written by ``new_sheet``, to which the lab has added its scans.
        out: folder of the result: ``prints.zarr``, ``printer`` (the model and its card), ``loop``,
            ``evaluation``, a score of each hologram, and ``report.html``. An interrupted run resumes.
        device: where prints and waves are computed.

    Raises:
        InputError: ``sheet`` is not the folder of a sheet, the scan of a hologram is missing, or one of the
            steps rejects its input.
    """
    source = Path(sheet)
    given = Sheet.read(source)
    scans = {arm: _scan_of(source, arm) for arm in ARMS}
    sha256 = file_sha256(source / Sheet.FILE_NAME)
    with growing_folder(out, ReadSheet.FILE_NAME, {"sheet_sha256": sha256}) as begun:
        folder = begun.folder
        store = folder / "prints.zarr"
        build_dataset(source / CARD_NAME, store)
        model = given.settings["model"]
        evaluated = evaluate(model, store, folder / "evaluation")
        loop = close_loop(store, folder / "loop", base=_BASE, report=say)
        freeze(folder / "loop", folder / "printer")
        base, corrected = loop.error("base"), loop.error("all")
        assert base is not None
        assert corrected is not None
        measured = {}
        for arm, scan in scans.items():
            scored = score(
                design_folder(source / HOLOGRAM, arm, 0), folder / f"score-{arm}", judges=(), scan=scan,
                device=device,
            )  # fmt: skip
            measured[arm] = scored.scores[-1].figures["si_psnr_db"]
        result = ReadSheet(
            **run_facts(),
            sheet_sha256=sha256,
            dataset=loop.dataset,
            model=model,
            model_nm=evaluated.scores.mae_datum_free_nm,
            own_nm=base.mae_nm,
            corrected_nm=corrected.mae_nm,
            found=[one.name for one in loop.effects],
            verdict=loop.verdict,
            measured_db=measured,
            expected_db=given.expected_db,
        )
        _write_report(folder, result)
        result.write(folder)
    return result


def sheet_text(result: ReadSheet) -> str:
    """Return the main results as a few sentences."""
    gain = {kind: db["with"] - db["without"] for kind, db in _by_kind(result).items()}
    better = "better" if gain["measured"] >= 0 else "worse"
    return (
        f"The print of the hologram designed through {result.model} is {abs(gain['measured']):.1f} dB "
        f"{better} than that of the other hologram ({result.measured_db['with']:.1f} instead of "
        f"{result.measured_db['without']:.1f} dB; the expected gain was {gain['expected']:+.1f} dB). "
        f"The mean absolute error of {result.model} on these prints is {result.model_nm:.1f} nm. A model "
        f"fitted to these prints has an error of {result.corrected_nm:.1f} nm on held-out scans."
    )


def _scan_of(sheet: Path, arm: Arm) -> MeasuredSource:
    found = sorted((sheet / SCANS_OF_HOLOGRAMS).glob(f"{arm}.*"))
    if len(found) != 1:
        got = ", ".join(path.name for path in found) or "none"
        raise InputError(
            f"scan of the hologram designed {arm} the model",
            got=got,
            wanted=f"{SCANS_OF_HOLOGRAMS}/{arm}.txt",
        )
    scan = load_card(sheet / CARD_NAME).scan
    stated = found[0].suffix != ".txt"
    return MeasuredSource(found[0], None if stated else scan.unit, None if stated else scan.size_um)


def _by_kind(result: ReadSheet) -> dict[str, dict[Arm, float]]:
    return {"expected": result.expected_db, "measured": result.measured_db}


def _write_report(folder: Path, result: ReadSheet) -> None:
    page = Page(
        "What the sheet shows",
        "A printer model fitted to one sheet of prints, and one hologram printed twice.",
        run=result,
        facts={"dataset": result.dataset.sha256},
    )
    page.verdict(sheet_text(result))
    page.heading("The hologram")
    rows = [
        {"image": kind, **{f"{arm} the model, dB": db[arm] for arm in ARMS}}
        for kind, db in _by_kind(result).items()
    ]
    page.table(rows, "SI-PSNR: higher is better", "holograms.csv")
    page.heading("The printer")
    errors = [
        {"model": result.model, "mae_nm": result.model_nm},
        {"model": f"{_BASE}, fitted to these prints", "mae_nm": result.own_nm},
        {"model": "the same model with the effects that the loop found", "mae_nm": result.corrected_nm},
    ]
    page.table(
        errors,
        "Mean absolute error on scans held out of the fits, with one free offset per scan",
        "errors.csv",
    )
    found = ", ".join(result.found) or "nothing"
    page.paragraph(f"The loop adds {found}. Its verdict: {result.verdict.replace('-', ' ')}.")
    page.links(
        [
            ("prints-report/report.html", "Report of the dataset"),
            ("loop/report.html", "What the model lacks"),
            ("evaluation/report.html", f"{result.model} on these prints"),
            *((f"score-{arm}/report.html", f"The hologram designed {arm} the model") for arm in ARMS),
        ]
    )
    page.write(folder)
