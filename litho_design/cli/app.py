"""The commands of `litho-design`; each of them calls one public function."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from litho_data.commands.app import new_app, run_app, with_further_options
from litho_design.cli.design import compare, correct, first, hoe, lens, settings
from litho_design.cli.options import BandPx, Device, Extrapolate, Given, Out, takes_parts, takes_settings
from litho_design.cli.sheet import sheet
from litho_design.exports.job import Format, PrintJob
from litho_design.images.measurements import MeasuredSource, PhotoSource

if TYPE_CHECKING:
    from litho_design.judging.score import ScoreResult

app = new_app(
    "Design diffractive optics through a frozen model of the printer, score and export the designs."
)
app.command()(first)
app.command()(hoe)
app.command()(lens)
app.command()(correct)
app.command()(compare)
app.command()(settings)
app.add_typer(sheet, name="sheet")


@app.command()
@with_further_options
@takes_parts(scan=MeasuredSource, camera=PhotoSource)
def score(
    design: Annotated[Path, typer.Argument(help="folder of a design")],
    out: Out,
    scan: MeasuredSource | None,
    camera: PhotoSource | None,
    judge: Annotated[
        list[str] | None,
        typer.Option(
            help="model that judges the design: NAME=MODEL, MODEL or `none`; MODEL may be the truth/ folder "
            "of a virtual fab; repeatable; by default the zoo's models of the same printer"
        ),
    ] = None,
    element: Annotated[
        Literal["thin", "thick"] | None,
        typer.Option(
            help="how the judges treat the element: thin, or thick (wave propagation method); by default, as "
            "the design states"
        ),
    ] = None,
    stream: Annotated[
        bool,
        typer.Option("--stream", help="print and score a large hologram band by band"),
    ] = False,
    band_px: BandPx = 512,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Score a design by the prints that models predict, by an AFM scan of its print, or by a photograph of
    the image behind the print.

    Example: litho-design score hologram --judge zoo:physics --out score
    """
    from litho_design.workflows.score import score as score_design

    result = score_design(
        design, out, judges=judge, scan=scan, camera=camera, element=element,
        band_px=band_px if stream else None, device=device, extrapolate=extrapolate,
    )  # fmt: skip
    _print_scores(result, out)


def _print_scores(result: ScoreResult, out: Path) -> None:
    from litho_design.reports.advice import baseline_line, headline

    for item in result.scores:
        print(f"{item.kind} {item.judge.name}: {headline(item.figures, item.uncertainty)}")
        for remark in item.remarks():
            print(f"  {remark}")
    if result.baselines:
        print(baseline_line(result.baselines))
    print(out / "report.html")


@app.command()
@takes_settings(PrintJob())
def export(
    design: Annotated[
        Path, typer.Argument(help="folder of a design, or file NAME.npy of levels or heights in µm")
    ],
    out: Out,
    given: Given,
    format: Annotated[Format, typer.Option(help="format of the file for the printer")] = "png16",
    pitch_um: Annotated[float, typer.Option(help="side length of a pixel in NAME.npy, µm")] = 0.1,
    level_height_um: Annotated[float, typer.Option(help="height of a level in NAME.npy, µm")] = 0.1,
    dose_curve: Annotated[
        Path | None,
        typer.Option(
            help="CSV with the columns grey and height_um (printed height of each grey value); by default, "
            "the height is linear in the grey value"
        ),
    ] = None,
    marks: Annotated[
        bool,
        typer.Option(
            "--marks",
            help="also print an F, which shows the orientation, and a flat witness area beside the element",
        ),
    ] = False,
) -> None:
    """Write a layout as a file for the printer, and a sidecar file that states the heights and the size.

    Example: litho-design export hologram --format stl --out files
    """
    from litho_design.exports.files import export as export_design
    from litho_design.exports.sidecar import sidecar_path

    file = export_design(
        design, format, out, pitch_um=pitch_um, level_height_um=level_height_um, dose_curve=dose_curve,
        marks=marks, **given.over(PrintJob(), "export"),
    )  # fmt: skip
    print(file)
    print(sidecar_path(file))


def main() -> None:
    """Entry point of `litho-design`."""
    run_app(app, "litho-design")
