"""`litho-design`: thin commands over the public functions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from litho_data.commands.app import new_app, run_app, with_further_options
from litho_data.commands.settings import changed
from litho_data.foundation.errors import InputError
from litho_design.cli.design import compare, correct, first, hoe, lens, settings
from litho_design.cli.options import (
    BandPx,
    Device,
    Extrapolate,
    Out,
    Scan,
    ScanAligned,
    ScanLevelling,
    ScanSizeUm,
    ScanUnit,
    measured_source,
    numbers,
)
from litho_design.cli.sheet import sheet
from litho_design.exports.formats import Format

if TYPE_CHECKING:
    from litho_design.judging.score import ScoreResult

app = new_app("Design diffractive optics through a frozen model of the printer, score and export them.")
app.command()(first)
app.command()(hoe)
app.command()(lens)
app.command()(correct)
app.command()(compare)
app.command()(settings)
app.add_typer(sheet, name="sheet")


@app.command()
@with_further_options
def score(
    design: Annotated[Path, typer.Argument(help="folder of a design")],
    out: Out,
    judge: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=MODEL, MODEL or `none`; MODEL may be truth/ of a virtual fab; repeatable. Without it, "
            "scan and photograph: the models of the zoo for the same printer"
        ),
    ] = None,
    scan: Scan = None,
    scan_unit: ScanUnit = None,
    scan_size_um: ScanSizeUm = None,
    scan_levelling: ScanLevelling = "bow",
    scan_aligned: ScanAligned = False,
    scan_scale_sd: Annotated[
        float,
        typer.Option(help="relative standard uncertainty of the microscope's height scale", hidden=True),
    ] = 0.02,
    scan_tip_um: Annotated[
        float | None,
        typer.Option(
            help="radius of the tip, µm; 0 for none. By default estimated from the scan", hidden=True
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(help="photograph of the printed hologram's image, or through the printed lens"),
    ] = None,
    camera_pitch_um: Annotated[
        float | None, typer.Option(help="pixel of the photograph in the image plane, µm")
    ] = None,
    camera_pitch_sd: Annotated[
        float,
        typer.Option(
            help="relative uncertainty of that pixel, if the magnification is uncertain", hidden=True
        ),
    ] = 0.0,
    camera_flat: Annotated[
        Path | None,
        typer.Option(help="photograph of uniform light by the same camera, to correct vignetting"),
    ] = None,
    camera_dark_level: Annotated[
        float | None, typer.Option(help="dark level of the photograph, counts")
    ] = None,
    camera_object: Annotated[
        str | None,
        typer.Option(help="object in front of the lens: one of the design's objects by name, or a picture"),
    ] = None,
    camera_orientation: Annotated[
        str,
        typer.Option(
            help="operation that makes the photograph upright: identity, rotate-90, rotate-180, rotate-270, "
            "flip-x, flip-y, transpose or anti-transpose; refused if another one fits better"
        ),
    ] = "identity",
    camera_power: Annotated[
        float | None,
        typer.Option(
            help="summed counts of all light that falls on the element, at the same exposure: gives "
            "efficiencies"
        ),
    ] = None,
    element: Annotated[
        Literal["thin", "thick"] | None,
        typer.Option(
            help="optics of the judges: thin, or thick (wave propagation method). By default as designed"
        ),
    ] = None,
    stitch_field_um: Annotated[
        float,
        typer.Option(help="side of the write fields in the judges' prints, µm", hidden=True),
    ] = 100.0,
    stitch_sigma_um: Annotated[
        float,
        typer.Option(help="sd of the displacement of each write field along each axis, µm", hidden=True),
    ] = 0.0,
    stream: Annotated[
        bool,
        typer.Option("--stream", help="large hologram: printed and scored band by band"),
    ] = False,
    band_px: BandPx = 512,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Score a design as models print it, as an AFM measured it, or as a camera saw it.

    Example: litho-design score hologram --judge zoo:physics --out score
    """
    from litho_design.images.photograph import PhotoSource
    from litho_design.optimisation.stitching import Stitching
    from litho_design.workflows.score import score as score_design

    stitch = changed(Stitching(), {"field_um": stitch_field_um, "sigma_um": stitch_sigma_um})
    if camera is not None and camera_pitch_um is None:
        raise InputError(
            "--camera", got="no --camera-pitch-um", wanted="the camera's pixel in the image plane, µm"
        )
    if camera is None and camera_object is not None:
        raise InputError("--camera-object", got="no --camera", wanted="a photograph of the object")
    photo = None
    if camera is not None:
        photo = PhotoSource(
            camera,
            camera_pitch_um or 0.0,
            dark_level=camera_dark_level,
            imaged=camera_object,
            orientation=camera_orientation,
            power_counts=camera_power,
            pitch_sd=camera_pitch_sd,
            flat=camera_flat,
        )
    further = {"scale_sd": scan_scale_sd, "aligned": scan_aligned, "tip_um": scan_tip_um}
    measured = measured_source(scan, scan_unit, scan_size_um, scan_levelling, **further)
    result = score_design(
        design,
        out,
        judges=judge,
        scan=measured,
        camera=photo,
        element=element,
        stitch=stitch if stitch_sigma_um else None,
        band_px=band_px if stream else None,
        device=device,
        extrapolate=extrapolate,
    )
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
def export(
    design: Annotated[Path, typer.Argument(help="folder of a design, or NAME.npy: levels, or heights in µm")],
    out: Out,
    format: Annotated[Format, typer.Option(help="file for the printer")] = "png16",
    pitch_um: Annotated[float, typer.Option(help="pixel of NAME.npy, µm")] = 0.1,
    level_height_um: Annotated[float, typer.Option(help="level of NAME.npy, µm")] = 0.1,
    pedestal_um: Annotated[float, typer.Option(help="base under level 0, µm")] = 1.0,
    slicing_um: Annotated[float, typer.Option(help="slicing distance for the job, µm")] = 0.1,
    hatching_um: Annotated[float, typer.Option(help="hatching distance for the job, µm")] = 0.1,
    gds_layers: Annotated[
        Literal["cumulative", "exclusive"], typer.Option(help="layer k is level >= k, or level == k")
    ] = "cumulative",
    gwl_mode: Annotated[Literal["galvo", "piezo"], typer.Option(help="what moves the focus")] = "galvo",
    gwl_field_um: Annotated[float, typer.Option(help="write field of the galvo, µm")] = 100.0,
    gwl_speed: Annotated[float, typer.Option(help="scan speed, µm/s")] = 40000.0,
    gwl_power: Annotated[
        str, typer.Option(help="laser power, %: one number, or one for the pedestal and one per level")
    ] = "50",
    dose_curve: Annotated[
        Path | None,
        typer.Option(help="CSV of grey,height_um as printed; without it, grey is linear in height"),
    ] = None,
    marks: Annotated[
        bool, typer.Option("--marks", help="also print an F (orientation) and a flat witness beside it")
    ] = False,
) -> None:
    """Write the layout for the printer, with the sidecar that gives it heights and size.

    Example: litho-design export hologram --format stl --out files
    """
    from litho_design.exports.files import export as export_design
    from litho_design.exports.gwl import Gwl
    from litho_design.exports.sidecar import sidecar_path

    powers = tuple(numbers("--gwl-power", gwl_power, float))
    file = export_design(
        design,
        format,
        out,
        pitch_um=pitch_um,
        level_height_um=level_height_um,
        pedestal_um=pedestal_um,
        slicing_um=slicing_um,
        hatching_um=hatching_um,
        gds_layers=gds_layers,
        gwl=changed(
            Gwl(),
            {"mode": gwl_mode, "field_um": gwl_field_um, "speed_um_s": gwl_speed, "power_percent": powers},
        ),
        dose_curve=dose_curve,
        marks=marks,
    )
    print(file)
    print(sidecar_path(file))


def main() -> None:
    """Entry point of `litho-design`."""
    run_app(app, "litho-design")
