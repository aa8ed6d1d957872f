"""`litho-design`: thin commands over the public functions."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from litho_data.commands import new_app, run_app
from litho_data.errors import InputError

app = new_app("Design diffractive optics through a frozen model of the printer, score them, export them.")

_TARGET_HELP = "an image file, or a drawing: text, ring, chart, spots, letters"

Out = Annotated[Path, typer.Option(help="Folder of the result.")]
Device = Annotated[str, typer.Option(help="cpu, cuda, cuda:0 …")]
Extrapolate = Annotated[
    bool,
    typer.Option(
        "--extrapolate", help="Accept heights beyond the model's calibration; stamped into the result."
    ),
]
SizePx = Annotated[int | None, typer.Option(help="Side of the element in pixels of 0.1 µm.")]
Iterations = Annotated[int | None, typer.Option(help="Iterations of the search.")]
Precision = Annotated[
    Literal["float32", "mixed", "bfloat16"],
    typer.Option(
        help="Networks of the model in the search: float32, float32 with the gradient in bfloat16 (mixed), or bfloat16. Scores are always float32."
    ),
]
LensTaskOption = Annotated[
    Literal["direct", "computational"], typer.Option(help="Focus light, or image after Richardson-Lucy.")
]
VariantOption = Annotated[
    Literal["default", "paper", "authors"],
    typer.Option(help="Preset: ours, as printed in the paper, or as in the authors' code."),
]


@app.command()
def hoe(
    model: Annotated[str, typer.Option(help="Folder of a frozen model, or `none` for nominal heights.")],
    out: Out,
    target: Annotated[str, typer.Option(help=_TARGET_HELP)] = "text",
    variant: VariantOption = "default",
    size_px: SizePx = None,
    distance_um: Annotated[float | None, typer.Option(help="Distance to the image plane, µm.")] = None,
    levels: Annotated[int | None, typer.Option(help="Number of printable levels.")] = None,
    level_height_um: Annotated[float | None, typer.Option(help="Height of one level, µm.")] = None,
    iterations: Iterations = None,
    start: Annotated[Literal["random", "gs", "wgs"] | None, typer.Option(help="Start of the search.")] = None,
    parametrisation: Annotated[
        Literal["gumbel", "direct"] | None, typer.Option(help="Free parameters.")
    ] = None,
    learning_rate: Annotated[
        float | None, typer.Option(help="Step of the optimiser, levels or logits.")
    ] = None,
    robust_samples: Annotated[
        int, typer.Option(help="Draws of the process window in the loss; 0 designs for the nominal print.")
    ] = 0,
    precision: Precision = "float32",
    seed: Annotated[int, typer.Option(help="Seed of start and sampling.")] = 0,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design a holographic element; an interrupted run in OUT is continued."""
    from litho_design.hoe import design_hoe
    from litho_design.printer import load_printer
    from litho_design.targets import make_target

    layout = {"size_px": size_px, "levels": levels, "level_height_um": level_height_um}
    search = {
        "iterations": iterations,
        "start": start,
        "parametrisation": parametrisation,
        "learning_rate": learning_rate,
        "precision": precision,
        "seed": seed,
    }
    settings = _hoe_settings(variant, layout, distance_um, search, {"samples": robust_samples})
    image, record = make_target(target, settings.layout.size_px)
    if record.adaptation:
        print(f"target: {record.adaptation}", file=sys.stderr)
    printer = load_printer(model, settings.layout, device=device, extrapolate=extrapolate)
    design = design_hoe(settings, printer, image, record, out, command=_command())
    print(f"{out / 'report.html'}: {_headline(design.predicted)} (judged by its own model)")


@app.command()
def score(
    design: Annotated[Path, typer.Argument(help="Folder of a design.")],
    out: Out,
    judge: Annotated[
        list[str] | None, typer.Option(help="NAME=MODEL, MODEL or `none`; may be repeated.")
    ] = None,
    scan: Annotated[Path | None, typer.Option(help="AFM height map of the printed part.")] = None,
    scan_unit: Annotated[str | None, typer.Option(help="Unit of its heights, if the file has none.")] = None,
    scan_size_um: Annotated[float | None, typer.Option(help="Its side, µm, if the file has none.")] = None,
    camera: Annotated[Path | None, typer.Option(help="Photograph of the printed hologram's image.")] = None,
    camera_pitch_um: Annotated[float | None, typer.Option(help="Its pixel in object space, µm.")] = None,
    camera_dark_level: Annotated[float | None, typer.Option(help="Its dark level, counts.")] = None,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Score a design as printed by models, as measured by AFM, or as photographed."""
    from litho_design.design import Design
    from litho_design.score import MeasuredSource, PhotoSource, score_design

    if not judge and scan is None and camera is None:
        raise InputError("score", got="nothing to judge with", wanted="--judge, --scan or --camera")
    if camera is not None and camera_pitch_um is None:
        raise InputError(
            "--camera", got="no --camera-pitch-um", wanted="the camera's pixel in object space, µm"
        )
    layout = Design.read(design).layout
    judges = list(_printers(judge or [], layout, device, extrapolate).values())
    size = None if scan_size_um is None else (scan_size_um, scan_size_um)
    result = score_design(
        design,
        judges,
        out,
        scan=None if scan is None else MeasuredSource(scan, scan_unit, size),
        camera=None if camera is None else PhotoSource(camera, camera_pitch_um or 0.0, camera_dark_level),
        command=_command(),
        device=device,
    )
    for item in result.scores:
        print(f"{item.kind} {item.judge.name}: {_headline(item.figures)}")
    print(out / "report.html")


@app.command()
def lens(
    model: Annotated[str, typer.Option(help="Folder of a frozen model, or `none` for nominal heights.")],
    out: Out,
    task: LensTaskOption = "direct",
    variant: VariantOption = "default",
    size_px: SizePx = None,
    focal_length_um: Annotated[float | None, typer.Option(help="Focal length, µm.")] = None,
    iterations: Iterations = None,
    precision: Precision = "float32",
    seed: Annotated[int, typer.Option(help="Seed of start and sampling.")] = 0,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design a multi-level diffractive lens; an interrupted run in OUT is continued."""
    from litho_design.lens import design_lens
    from litho_design.printer import load_printer

    search = {"iterations": iterations, "precision": precision, "seed": seed}
    settings = _lens_settings(variant, task, size_px, focal_length_um, search)
    printer = load_printer(model, settings.layout, device=device, extrapolate=extrapolate)
    design = design_lens(settings, printer, out, command=_command())
    print(f"{out / 'report.html'}: {_headline(design.predicted)} (judged by its own model)")


@app.command()
def compare(
    models: Annotated[str, typer.Option(help="Arms, comma-separated: none, NAME=MODEL or MODEL.")],
    out: Out,
    judge: Annotated[
        list[str] | None, typer.Option(help="Further judges, NAME=MODEL or MODEL; may be repeated.")
    ] = None,
    task: Annotated[
        Literal["hoe", "lens-direct", "lens-computational"], typer.Option(help="What is designed.")
    ] = "hoe",
    target: Annotated[str, typer.Option(help=f"For hoe: {_TARGET_HELP}")] = "text",
    variant: VariantOption = "default",
    size_px: SizePx = None,
    distance_um: Annotated[float | None, typer.Option(help="Image distance or focal length, µm.")] = None,
    iterations: Iterations = None,
    precision: Precision = "float32",
    seeds: Annotated[int, typer.Option(help="Number of seeds, 0, 1, 2 …")] = 3,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design with every arm, print with every judge: the design-to-manufacturing gap."""
    from litho_design.compare import HEADLINE
    from litho_design.compare import compare as run_comparison
    from litho_design.hoe import design_hoe
    from litho_design.lens import design_lens
    from litho_design.targets import make_target

    search = {"iterations": iterations, "precision": precision}
    if task == "hoe":
        settings = _hoe_settings(variant, {"size_px": size_px}, distance_um, search)
        image, record = make_target(target, settings.layout.size_px)

        def designer(settings, printer, place):
            return design_hoe(settings, printer, image, record, place, command=_command())
    else:
        kind = "direct" if task == "lens-direct" else "computational"
        settings = _lens_settings(variant, kind, size_px, distance_um, search)

        def designer(settings, printer, place):
            return design_lens(settings, printer, place, command=_command())

    arms = _printers(models.split(","), settings.layout, device, extrapolate)
    judges = _printers(judge or [], settings.layout, device, extrapolate)
    result = run_comparison(settings, designer, arms, judges, out, seeds=range(seeds), command=_command())
    for item in result.summary:
        if item.figure == HEADLINE[result.task][0]:
            print(f"designed with {item.arm}, printed by {item.judge}: {item.figure} {item.judged_mean:.3f}")
    print(out / "report.html")


@app.command()
def export(
    design: Annotated[Path, typer.Argument(help="Folder of a design.")],
    out: Out,
    format: Annotated[
        Literal["png16", "bmp", "tiff", "stl", "gds"], typer.Option(help="File for the printer.")
    ] = "png16",
    pedestal_um: Annotated[float, typer.Option(help="Base under level 0, µm.")] = 1.0,
    slicing_um: Annotated[float, typer.Option(help="Slicing distance for the job, µm.")] = 0.1,
    hatching_um: Annotated[float, typer.Option(help="Hatching distance for the job, µm.")] = 0.1,
    gds_layers: Annotated[
        Literal["cumulative", "exclusive"], typer.Option(help="Layer k is level >= k, or level == k.")
    ] = "cumulative",
) -> None:
    """Write the layout for the printer, with the sidecar that gives it heights and size."""
    from litho_design.export import export_design, sidecar_path

    file = export_design(
        design,
        format,
        out,
        pedestal_um=pedestal_um,
        slicing_um=slicing_um,
        hatching_um=hatching_um,
        gds_layers=gds_layers,
    )
    print(file)
    print(sidecar_path(file))


def main() -> None:
    """Entry point of `litho-design`."""
    run_app(app, "litho-design")


def _hoe_settings(
    variant: Any, layout: dict, distance_um: float | None, search: dict, window: dict | None = None
) -> Any:
    from litho_design.settings import HoeSettings, hoe_preset

    return _changed(HoeSettings, hoe_preset(variant), layout, distance_um, search, window or {})


def _lens_settings(
    variant: Any, task: Any, size_px: int | None, focal_length_um: float | None, search: dict
) -> Any:
    from litho_design.settings import LensSettings, lens_preset

    return _changed(LensSettings, lens_preset(variant, task), {"size_px": size_px}, focal_length_um, search)


def _changed(
    kind: Any, preset: Any, layout: dict, distance_um: float | None, search: dict, window: dict | None = None
) -> Any:
    """A preset with the options that were given, validated as a whole."""
    from pydantic import ValidationError

    from litho_data.results import first_error

    settings = preset.model_dump()
    parts = {"layout": layout, "search": search, "optics": {"distance_um": distance_um}}
    for part, options in (parts | ({"window": window} if window else {})).items():
        settings[part] |= {key: value for key, value in options.items() if value is not None}
    try:
        return kind.model_validate(settings)
    except ValidationError as error:
        raise InputError("settings", got=first_error(error)) from None


def _printers(specs, layout, device: str, extrapolate: bool):
    from litho_design.printer import load_printer

    printers = {}
    for spec in specs:
        name, _, source = spec.strip().partition("=")
        printer = load_printer(
            source or name, layout, name=name if source else "", device=device, extrapolate=extrapolate
        )
        if printer.name in printers:
            raise InputError(
                "models", got=f"{printer.name!r} twice", wanted="one name each", hint="use NAME=MODEL"
            )
        printers[printer.name] = printer
    return printers


def _headline(figures: dict[str, float]) -> str:
    if "eff_signal" in figures:
        return (
            f"{100 * figures['eff_signal']:.1f} % on the signal, {figures['si_psnr_db']:.2f} dB, "
            f"SSIM {figures['ssim']:.3f}"
        )
    if "speckle_contrast" in figures:
        return f"{figures['si_psnr_db']:.2f} dB, SSIM {figures['ssim']:.3f}"
    text = f"{100 * figures['focusing_efficiency']:.1f} % in the focus, Strehl {figures['strehl']:.3f}"
    return text + (f", MAE {figures['mae_calibrated']:.4f}" if "mae_calibrated" in figures else "")


def _command() -> str:
    return " ".join(["litho-design", *sys.argv[1:]])
