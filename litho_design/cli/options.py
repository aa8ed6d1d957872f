"""Options that several commands of `litho-design` share, and what they are turned into."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from litho_data.foundation.errors import InputError

if TYPE_CHECKING:
    from litho_design.optimisation.parametrise import LayoutSettings
    from litho_design.printers.printer import Printer
    from litho_design.tasks.settings import HoeSettings, LensSettings

TARGET_HELP = "an image file, or a drawing: text, ring, chart, spots, letters"

Out = Annotated[Path, typer.Option(help="Folder of the result.")]
Device = Annotated[str, typer.Option(help="cpu, cuda, cuda:0 …")]
Extrapolate = Annotated[
    bool,
    typer.Option(
        "--extrapolate", help="Accept heights beyond the model's calibration; stamped into the result."
    ),
]
Variant = Annotated[
    Literal["default", "paper", "authors"],
    typer.Option(help="Preset: ours, as printed in the paper, or as in the authors' code."),
]
SizePx = Annotated[int | None, typer.Option(help="Side of the element, pixels.")]
PitchUm = Annotated[
    float | None, typer.Option(help="Side of a pixel, µm: that of the model; 0.1 by default.")
]
Levels = Annotated[int | None, typer.Option(help="Number of printable levels.")]
LevelHeight = Annotated[float | None, typer.Option(help="Height of one level, µm.")]
CellUm = Annotated[
    float | None, typer.Option(help="Side of one free cell (hologram) or width of one ring (lens), µm.")
]
WavelengthUm = Annotated[float | None, typer.Option(help="Wavelength, µm.")]
IndexStep = Annotated[float | None, typer.Option(help="Refractive index of the resist minus that around it.")]
Iterations = Annotated[int | None, typer.Option(help="Iterations of the search.")]
Start = Annotated[
    Literal["random", "gs", "wgs", "fresnel"] | None,
    typer.Option(help="Start of the search: random, gs or wgs for holograms, fresnel for lenses."),
]
Parametrisation = Annotated[Literal["gumbel", "direct"] | None, typer.Option(help="Free parameters.")]
LearningRate = Annotated[float | None, typer.Option(help="Step of the optimiser, levels or logits.")]
SearchPrecision = Annotated[
    Literal["float32", "mixed", "bfloat16"],
    typer.Option(
        help="Networks of the model in the search: float32; mixed, with their gradient in bfloat16; or "
        "bfloat16. Scores are always in float32."
    ),
]
Seed = Annotated[int, typer.Option(help="Seed of start and sampling.")]
WindowPx = Annotated[int | None, typer.Option(help="Lens: side of the PSF window, pixels.")]
ObjectPx = Annotated[int | None, typer.Option(help="Computational lens: side of the objects, sensor pixels.")]
Objects = Annotated[
    list[Path] | None,
    typer.Option(
        help="Computational lens: picture, or folder of pictures, to image instead of the drawings; may be "
        "repeated. Without --held-out-objects the last quarter by name, two at least, is held out."
    ),
]
HeldOutObjects = Annotated[
    list[Path] | None,
    typer.Option(
        help="Computational lens: picture or folder of pictures that is only scored; may be repeated."
    ),
]
RobustSamples = Annotated[
    int | None,
    typer.Option(help="Draws of the process window in the loss; 0 designs for the print as modelled."),
]
Risk = Annotated[
    Literal["cvar", "mean-sd"] | None,
    typer.Option(help="Loss over the draws: mean of the worst share, or mean + weight * sd."),
]
RiskWeight = Annotated[float | None, typer.Option(help="Weight of the standard deviation for mean-sd.")]
RiskTail = Annotated[float | None, typer.Option(help="Worst share of the draws for cvar, 0 to 1.")]
GainSd = Annotated[float | None, typer.Option(help="Spread of the print's gain, relative.")]
BlurSdUm = Annotated[float | None, typer.Option(help="Scale of the extra blur, µm.")]
DefocusSdUm = Annotated[float | None, typer.Option(help="Spread of the distance, µm.")]
WavelengthSdUm = Annotated[float | None, typer.Option(help="Spread of the wavelength, µm.")]
SpreadOf = Annotated[
    Path | None,
    typer.Option(
        help="Dataset store: take the spread of gain and offset from its measured prints, the locked "
        "scans left out."
    ),
]
Ensemble = Annotated[
    list[str] | None,
    typer.Option(help="NAME=MODEL of a further model in the loss; may be repeated."),
]
EnsembleWeight = Annotated[
    float | None, typer.Option(help="Weight of the models' disagreement, per wave of height.")
]


def hoe_settings(variant: Any, **options: Any) -> HoeSettings:
    """A preset of the hologram with the options that were given (those that are not None)."""
    from litho_design.tasks.settings import HoeSettings, hoe_preset

    return _changed(HoeSettings, hoe_preset(variant), options)


def lens_settings(variant: Any, task: Any, **options: Any) -> LensSettings:
    """A preset of the lens with the options that were given (those that are not None)."""
    from litho_design.tasks.settings import LensSettings, lens_preset

    return _changed(LensSettings, lens_preset(variant, task), options)


# Which part of the settings an option belongs to; options of the search are the rest.
_PART = {
    **dict.fromkeys(("size_px", "pitch_um", "cell_um", "levels", "level_height_um"), "layout"),
    **dict.fromkeys(("distance_um", "wavelength_um", "index_step"), "optics"),
    "window_px": "view",
    "object_px": "imaging",
    "ensemble_weight": "ensemble",
    **dict.fromkeys(
        ("samples", "risk", "weight", "tail", "gain_sd", "blur_sd_um", "defocus_sd_um", "wavelength_sd_um"),
        "window",
    ),
}


def _changed(kind: Any, preset: Any, options: dict[str, Any]) -> Any:
    """``preset`` with ``options``, validated as a whole."""
    from pydantic import ValidationError

    from litho_data.foundation.results import first_error

    settings = preset.model_dump()
    spread_of = options.pop("spread_of", None)
    for name, value in options.items():
        if value is not None:
            settings[_PART.get(name, "search")][name.removeprefix("ensemble_")] = value
    try:
        changed = kind.model_validate(settings)
    except ValidationError as error:
        raise InputError("settings", got=first_error(error)) from None
    if spread_of is None:
        return changed
    from litho_data.store import open_store
    from litho_design.optimisation.robust import measured_window

    return changed.model_copy(update={"window": measured_window(open_store(spread_of), changed.window)})


def load_printers(
    specs: Iterable[str], layout: LayoutSettings, device: str, extrapolate: bool
) -> dict[str, Printer]:
    """Printers by name from NAME=MODEL, MODEL or `none`."""
    from litho_design.printers.source import load_printer

    printers: dict[str, Printer] = {}
    for spec in specs:
        name, _, source = spec.strip().partition("=")
        if not name:
            raise InputError("models", got=f"{spec!r}", wanted="none, MODEL or NAME=MODEL")
        printer = load_printer(
            source or name, layout, name=name if source else "", device=device, extrapolate=extrapolate
        )
        if printer.name in printers:
            raise InputError(
                "models", got=f"{printer.name!r} twice", wanted="one name each", hint="use NAME=MODEL"
            )
        printers[printer.name] = printer
    return printers


def headline(figures: dict[str, float]) -> str:
    """The two or three figures that a command ends with."""
    if "eff_signal" in figures:
        return (
            f"{100 * figures['eff_signal']:.1f} % on the signal, {figures['si_psnr_db']:.2f} dB, "
            f"SSIM {figures['ssim']:.3f}"
        )
    if "speckle_contrast" in figures:
        return f"{figures['si_psnr_db']:.2f} dB, SSIM {figures['ssim']:.3f}"
    if "focusing_efficiency" not in figures:
        told = {name: figures.get(f"mae_{name}") for name in ("direct", "design", "calibrated")}
        return "MAE " + ", ".join(f"{name} {mae:.4f}" for name, mae in told.items() if mae is not None)
    text = f"{100 * figures['focusing_efficiency']:.1f} % in the focus, Strehl {figures['strehl']:.3f}"
    return text + (f", MAE {figures['mae_calibrated']:.4f}" if "mae_calibrated" in figures else "")
