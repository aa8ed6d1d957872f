"""Commands `hoe` and `lens`: parse options, call one function, say where the result is."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from litho_design.cli.options import (
    TARGET_HELP,
    BlurSdUm,
    CellUm,
    DefocusSdUm,
    Device,
    Ensemble,
    EnsembleWeight,
    Extrapolate,
    GainSd,
    HeldOutObjects,
    IndexStep,
    Iterations,
    LearningRate,
    LevelHeight,
    Levels,
    ObjectPx,
    Objects,
    Out,
    Parametrisation,
    PitchUm,
    Risk,
    RiskTail,
    RiskWeight,
    RobustSamples,
    SearchPrecision,
    Seed,
    SizePx,
    SpreadOf,
    Start,
    Variant,
    WavelengthSdUm,
    WavelengthUm,
    WindowPx,
    headline,
    hoe_settings,
    lens_settings,
    load_printers,
)

if TYPE_CHECKING:
    from litho_design.tasks.design import Design

Model = Annotated[
    str, typer.Option(help="Folder of a frozen model, zoo:NAME, or `none` for nominal heights.")
]


def hoe(
    model: Model,
    out: Out,
    target: Annotated[str, typer.Option(help=TARGET_HELP)] = "text",
    variant: Variant = "default",
    size_px: SizePx = None,
    pitch_um: PitchUm = None,
    distance_um: Annotated[float | None, typer.Option(help="Distance to the image plane, µm.")] = None,
    wavelength_um: WavelengthUm = None,
    index_step: IndexStep = None,
    cell_um: CellUm = None,
    levels: Levels = None,
    level_height_um: LevelHeight = None,
    iterations: Iterations = None,
    start: Start = None,
    parametrisation: Parametrisation = None,
    learning_rate: LearningRate = None,
    precision: SearchPrecision = "float32",
    robust_samples: RobustSamples = None,
    risk: Risk = None,
    risk_weight: RiskWeight = None,
    risk_tail: RiskTail = None,
    gain_sd: GainSd = None,
    blur_sd_um: BlurSdUm = None,
    defocus_sd_um: DefocusSdUm = None,
    wavelength_sd_um: WavelengthSdUm = None,
    spread_of: SpreadOf = None,
    ensemble: Ensemble = None,
    ensemble_weight: EnsembleWeight = None,
    seed: Seed = 0,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design a holographic element; an interrupted run in OUT is continued."""
    from litho_design.printers.source import load_printer
    from litho_design.tasks.hoe import design_hoe
    from litho_design.tasks.targets import make_target

    settings = hoe_settings(
        variant, size_px=size_px, pitch_um=pitch_um, distance_um=distance_um, wavelength_um=wavelength_um,
        index_step=index_step, cell_um=cell_um, levels=levels, level_height_um=level_height_um,
        iterations=iterations, start=start, parametrisation=parametrisation, learning_rate=learning_rate,
        precision=precision, samples=robust_samples, risk=risk, weight=risk_weight, tail=risk_tail,
        gain_sd=gain_sd, blur_sd_um=blur_sd_um, defocus_sd_um=defocus_sd_um,
        wavelength_sd_um=wavelength_sd_um, spread_of=spread_of, ensemble_weight=ensemble_weight, seed=seed,
    )  # fmt: skip
    printer = load_printer(model, settings.layout, device=device, extrapolate=extrapolate)
    others = load_printers(ensemble or [], settings.layout, device, extrapolate)
    image, record = make_target(target, settings.layout.size_px)
    design = design_hoe(settings, printer, image, record, out, ensemble=list(others.values()))
    _tell(design, out)


def lens(
    model: Model,
    out: Out,
    task: Annotated[
        Literal["direct", "computational"],
        typer.Option(help="Focus light, or image after Richardson-Lucy."),
    ] = "direct",
    variant: Variant = "default",
    size_px: SizePx = None,
    pitch_um: PitchUm = None,
    focal_length_um: Annotated[float | None, typer.Option(help="Focal length, µm.")] = None,
    wavelength_um: WavelengthUm = None,
    index_step: IndexStep = None,
    cell_um: CellUm = None,
    levels: Levels = None,
    level_height_um: LevelHeight = None,
    window_px: WindowPx = None,
    object_px: ObjectPx = None,
    objects: Objects = None,
    held_out_objects: HeldOutObjects = None,
    iterations: Iterations = None,
    start: Start = None,
    parametrisation: Parametrisation = None,
    learning_rate: LearningRate = None,
    precision: SearchPrecision = "float32",
    robust_samples: RobustSamples = None,
    risk: Risk = None,
    risk_weight: RiskWeight = None,
    risk_tail: RiskTail = None,
    gain_sd: GainSd = None,
    blur_sd_um: BlurSdUm = None,
    defocus_sd_um: DefocusSdUm = None,
    wavelength_sd_um: WavelengthSdUm = None,
    spread_of: SpreadOf = None,
    ensemble: Ensemble = None,
    ensemble_weight: EnsembleWeight = None,
    seed: Seed = 0,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design a multi-level diffractive lens; an interrupted run in OUT is continued."""
    from litho_design.lens.lens import design_lens
    from litho_design.lens.objects import bring_objects
    from litho_design.printers.source import load_printer

    settings = lens_settings(
        variant, task, size_px=size_px, pitch_um=pitch_um, distance_um=focal_length_um,
        wavelength_um=wavelength_um, index_step=index_step, cell_um=cell_um, levels=levels,
        level_height_um=level_height_um, window_px=window_px, object_px=object_px, iterations=iterations,
        start=start, parametrisation=parametrisation, learning_rate=learning_rate, precision=precision,
        samples=robust_samples, risk=risk, weight=risk_weight, tail=risk_tail, gain_sd=gain_sd,
        blur_sd_um=blur_sd_um, defocus_sd_um=defocus_sd_um, wavelength_sd_um=wavelength_sd_um,
        spread_of=spread_of, ensemble_weight=ensemble_weight, seed=seed,
    )  # fmt: skip
    printer = load_printer(model, settings.layout, device=device, extrapolate=extrapolate)
    others = load_printers(ensemble or [], settings.layout, device, extrapolate)
    settings, pictures = bring_objects(settings, objects or [], held_out_objects or [])
    design = design_lens(settings, printer, out, ensemble=list(others.values()), pictures=pictures)
    _tell(design, out)


def _tell(design: Design, out: Path) -> None:
    from litho_design.reports.design import distribution_warning, stroke_advice

    warning = distribution_warning(design)
    if warning:
        print(warning, file=sys.stderr)
    print(stroke_advice(design))
    print(f"{out / 'report.html'}: {headline(design.predicted)} (judged by its own model)")
