"""What a designer should know of a layout before printing it, in words; commands and reports say it alike."""

from __future__ import annotations

from collections.abc import Mapping

from litho_design.tasks.design import Design

# Below this share of the training pixels a model has hardly seen the lowest and the highest level.
_SEEN_SHARE = 0.02


def distribution_warning(design: Design) -> str:
    """What to know about the layout's distance to the model's training layouts; empty if all is well."""
    gauge = design.out_of_distribution
    if gauge is None:
        if design.printer.source == "none":
            return ""
        return (
            f"the card of the model {design.printer.name} does not say what layouts it was trained on: how "
            "far this one is from them is not known"
        )
    if not gauge.flagged:
        return ""
    return (
        f"out of distribution: {100 * gauge.level_distance:.0f} % of the pixels would have to change level "
        "to match the layouts that the model was trained on; its prediction is an extrapolation"
    )


def stroke_advice(design: Design) -> str:
    """The advisor in words."""
    stroke, gauge = design.stroke, design.out_of_distribution
    text = (
        f"The full staircase prints {stroke.stroke_waves:.2f} waves high (gain {stroke.print_gain:.2f}); "
        f"as a blaze it would send {100 * stroke.blaze_order_1:.1f} % into the first order and "
        f"{100 * stroke.blaze_order_0:.1f} % straight on."
    )
    if gauge is not None and gauge.training_extreme_level_share < _SEEN_SHARE:
        text += (
            f" Its two ends made up {100 * gauge.training_extreme_level_share:.2g} % of the layouts that the "
            "model was trained on: there these heights are an extrapolation; compare models."
        )
    if stroke.levels_for_one_wave is None or stroke.level_height_for_one_wave_um is None:
        return text
    return text + (
        f" One wave needs {stroke.levels_for_one_wave:.0f} levels of {design.layout.level_height_um:g} µm, "
        f"or {design.layout.levels} levels of {stroke.level_height_for_one_wave_um:.3f} µm."
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
        told = {name: score.get(f"mae_{name}") for name in ("direct", "design", "calibrated")}
        return "MAE " + ", ".join(f"{name} {mae:.4f}" for name, mae in told.items() if mae is not None)
    text = f"{100 * score['focusing_efficiency']:.1f} % in the focus, Strehl {score['strehl']:.3f}"
    return text + (f", MAE {score['mae_calibrated']:.4f}" if "mae_calibrated" in score else "")
