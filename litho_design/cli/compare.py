"""Command `compare`: parse options, call one function, say where the result is."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import typer

from litho_data.foundation.errors import InputError
from litho_design.cli.options import (
    TARGET_HELP,
    BlurSdUm,
    CellUm,
    DefocusSdUm,
    Device,
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
    PitchUm,
    Risk,
    RiskTail,
    RiskWeight,
    RobustSamples,
    SearchPrecision,
    SizePx,
    SpreadOf,
    Start,
    Variant,
    WavelengthSdUm,
    WavelengthUm,
    WindowPx,
    hoe_settings,
    lens_settings,
    load_printers,
)


def compare(
    models: Annotated[
        str, typer.Option(help="Arms, comma-separated: none, NAME=MODEL or MODEL (a folder, or zoo:NAME).")
    ],
    out: Out,
    judge: Annotated[
        list[str] | None,
        typer.Option(
            help="Further judges, NAME=MODEL or MODEL (or truth/ of a virtual fab); may be repeated."
        ),
    ] = None,
    task: Annotated[
        Literal["hoe", "lens-direct", "lens-computational"], typer.Option(help="What is designed.")
    ] = "hoe",
    target: Annotated[str, typer.Option(help=f"For hoe: {TARGET_HELP}")] = "text",
    variant: Variant = "default",
    size_px: SizePx = None,
    pitch_um: PitchUm = None,
    distance_um: Annotated[float | None, typer.Option(help="Image distance or focal length, µm.")] = None,
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
    seeds: Annotated[int, typer.Option(help="Number of seeds, 0, 1, 2 …")] = 3,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design with every arm, print with every judge: the design-to-manufacturing gap."""
    from litho_design.judging.compare import HEADLINE
    from litho_design.judging.compare import compare as run_comparison
    from litho_design.lens.lens import design_lens
    from litho_design.lens.objects import bring_objects
    from litho_design.tasks.hoe import design_hoe
    from litho_design.tasks.targets import make_target

    options: dict[str, Any] = {
        "size_px": size_px,
        "pitch_um": pitch_um,
        "distance_um": distance_um,
        "wavelength_um": wavelength_um,
        "index_step": index_step,
        "cell_um": cell_um,
        "levels": levels,
        "level_height_um": level_height_um,
        "iterations": iterations,
        "start": start,
        "learning_rate": learning_rate,
        "precision": precision,
        "samples": robust_samples,
        "risk": risk,
        "weight": risk_weight,
        "tail": risk_tail,
        "gain_sd": gain_sd,
        "blur_sd_um": blur_sd_um,
        "defocus_sd_um": defocus_sd_um,
        "wavelength_sd_um": wavelength_sd_um,
        "spread_of": spread_of,
    }

    def printers(layout):
        sources = (models.split(","), judge or [])
        return [load_printers(specs, layout, device, extrapolate) for specs in sources]

    brought = (objects or [], held_out_objects or [])
    # Printers first: what is wrong with them is told before a target is drawn.
    if task == "hoe":
        if any(brought):
            raise InputError(
                "objects", got="the hoe task, which has a target", wanted="a lens", hint="--target"
            )
        settings: Any = hoe_settings(variant, **options)
        arms, judges = printers(settings.layout)
        image, record = make_target(target, settings.layout.size_px)

        def designer(settings, printer, place):
            return design_hoe(settings, printer, image, record, place)
    else:
        kind = "direct" if task == "lens-direct" else "computational"
        settings = lens_settings(variant, kind, window_px=window_px, object_px=object_px, **options)
        arms, judges = printers(settings.layout)
        settings, pictures = bring_objects(settings, *brought)

        def designer(settings, printer, place):
            return design_lens(settings, printer, place, pictures=pictures)

    result = run_comparison(settings, designer, arms, judges, out, seeds=range(seeds))
    for item in result.summary:
        if item.figure == HEADLINE[result.task][0]:
            print(f"designed with {item.arm}, printed by {item.judge}: {item.figure} {item.judged_mean:.3f}")
    print(out / "report.html")
