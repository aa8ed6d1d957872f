"""What to know about a layout before printing it, in words; used by commands and reports."""

from __future__ import annotations

from collections.abc import Mapping

from litho_design.tasks.design import Design

# Below this share of the training pixels, a model has hardly seen the lowest and the highest level.
_SEEN_SHARE = 0.02


def distribution_warning(design: Design) -> str:
    """A warning where a layout is far from the training layouts, or where that is unknown; else empty."""
    gauge = design.out_of_distribution
    if gauge is None:
        if design.printer.source == "none":
            return ""
        return (
            f"the card of the model {design.printer.name} does not describe its training layouts, so the "
            "distance of this layout from them is unknown"
        )
    if not gauge.flagged:
        return ""
    return (
        f"out of distribution: {100 * gauge.level_distance:.0f} % of the pixels would have to change level "
        "to match the training layouts of the model; its prediction is an extrapolation"
    )


def stroke_advice(design: Design) -> str:
    """What the printed levels reach, and what a full wave needs."""
    stroke, gauge = design.stroke, design.out_of_distribution
    text = (
        f"The highest level prints {stroke.stroke_waves:.2f} waves above the lowest (gain "
        f"{stroke.print_gain:.2f}). A blazed grating of these levels would send "
        f"{100 * stroke.blaze_order_1:.1f} % into the first order and {100 * stroke.blaze_order_0:.1f} % "
        "straight through."
    )
    if gauge is not None and gauge.training_extreme_level_share < _SEEN_SHARE:
        text += (
            " The lowest and the highest level make up only "
            f"{100 * gauge.training_extreme_level_share:.2g} % of the training layouts: their "
            "heights are an extrapolation, so compare several models."
        )
    if stroke.levels_for_one_wave is None or stroke.level_height_for_one_wave_um is None:
        return text
    return text + (
        f" A full wave needs {stroke.levels_for_one_wave:.0f} levels of "
        f"{design.layout.level_height_um:g} µm, or {design.layout.levels} levels of "
        f"{stroke.level_height_for_one_wave_um:.3f} µm."
    )


def headline(score: Mapping[str, float]) -> str:
    """The two or three numbers of a score that a command ends with."""
    if "eff_signal" in score:
        return (
            f"{100 * score['eff_signal']:.1f} % on the signal, {score['si_psnr_db']:.2f} dB, "
            f"SSIM {score['ssim']:.3f}"
        )
    if "speckle_contrast" in score:
        return f"{score['si_psnr_db']:.2f} dB, SSIM {score['ssim']:.3f}"
    if "focusing_efficiency" not in score:
        errors = {name: score.get(f"mae_{name}") for name in ("direct", "design", "calibrated")}
        return "MAE " + ", ".join(f"{name} {mae:.4f}" for name, mae in errors.items() if mae is not None)
    text = f"{100 * score['focusing_efficiency']:.1f} % in the focus, Strehl {score['strehl']:.3f}"
    return text + (f", MAE {score['mae_calibrated']:.4f}" if "mae_calibrated" in score else "")
