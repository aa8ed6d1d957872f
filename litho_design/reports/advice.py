"""Write the sentences with which commands and reports advise the user on a layout before it is printed."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import Any

from litho_data.reports.page import Words, spelt_out
from litho_design.tasks.design import LEVELS_FILE, Design

# Readable names of those scores whose keys are unclear. The field descriptions of the score classes explain
# all scores.
WORDS: Words = {
    key: (name, "")
    for key, name in {
        "eff_signal": "power on the signal",
        "eff_paper": "power where T > 0",
        "eff_window": "power in the window",
        "rmse_paper": "RMSE, the paper's scale",
        "strehl": "Strehl ratio",
        "cbr": "centre-to-background ratio",
        "cbr_ceiling": "centre-to-background ratio, perfect lens",
        "mae_direct": "MAE, sensor image",
        "mae_design": "MAE, designed PSF",
        "mae_calibrated": "MAE, print's own PSF",
    }.items()
}
# Scores that a summary states if they exist. Each entry consists of the key, the text, the number of decimals
# and, where needed, a factor.
_HEADLINE: tuple[tuple[Any, ...], ...] = (
    ("focusing_efficiency", "{} % in the focus", 1, 100),
    ("strehl", "Strehl {}", 3),
    ("eff_signal", "{} % on the signal", 1, 100),
    ("si_psnr_db", "{} dB", 2),
    ("ssim", "SSIM {}", 3),
    ("si_psnr_window_db", "{} dB inside the signal window", 2),
    ("rms_nm", "{} nm rms error", 1),
    ("mae_direct", "MAE {} on the sensor", 4),
    ("mae_design", "MAE {} with the designed PSF", 4),
    ("mae_calibrated", "MAE {} with the print's own PSF", 4),
)
_EFFICIENCIES = ("eff_signal", "focusing_efficiency")
# A warning is given if the efficiency as a thick element is lower by more than this share. Reflection alone
# lowers it by 4.6 %.
_THICK_SHARE = 0.1
# If the lowest and the highest level together make up less than this share of the training pixels, the model
# has hardly been trained on them.
_SEEN_SHARE = 0.02


def named(figure: str) -> str:
    """Return the readable name of a score, given its key."""
    return WORDS.get(figure, (spelt_out(figure), ""))[0]


def called(printer: str) -> str:
    """Return the name of a printer as it appears in a sentence."""
    return "nominal heights" if printer == "none" else printer


def distribution_warning(design: Design) -> str:
    """Return a warning if the layout of a design is far from the model's training layouts, or if its distance
    from them is unknown.

    Otherwise, return an empty text.
    """
    gauge = design.out_of_distribution
    if gauge is None:
        if design.printer.source == "none" or LEVELS_FILE not in design.files:
            return ""
        return (
            f"the card of the model {design.printer.name} does not describe its training layouts, so the "
            "distance of this layout from them is unknown"
        )
    if not gauge.flagged:
        return ""
    text = (
        f"the layout is far from the model's training layouts: to match them, "
        f"{100 * gauge.level_distance:.0f} % of the pixels would need another level, so the "
        "prediction is an extrapolation"
    )
    text += f": {'; '.join(gauge.unusual)}" if gauge.unusual else ""
    return f"{text}. Use --inside-weight to keep a search closer to the training layouts"


def width_sentence(design: Design) -> str:
    """Return sentences about the differences between the predictions of all available models of the printer.

    The text is empty if the model of the design is the only available model.
    """
    width = design.width
    if width is None or len(width.level_heights_um) == 1:
        return ""
    by_model = dict(zip(width.level_heights_um, width.values().tolist(), strict=True))
    text = spread_sentence(width.figure, by_model, width.less, width.gain)
    text += f" The search used {width.searched_with} of these models."
    (low, high), (_, unit) = width.between, _parted(width.figure)
    if high > max(by_model.values()):
        text += f" With the models' own errors, the expected range is {low:.3g} to {high:.3g}{unit}."
    if width.gain is not None and width.disagreement > width.gain:
        level, low_um, high_um = width.open_level
        text += (
            f" The models differ most in the height of level {level} ({low_um:.3f} to {high_um:.3f} µm). To "
            "decide between the models, print wide fields of this level (see litho-models next-print)."
        )
    return text


def spread_sentence(figure: str, by_model: Mapping[str, float], less: bool, gain: float | None) -> str:
    """Return a sentence about one score: its value according to the first model, its median over all models,
    and its worst value.

    If the models disagree by more than ``gain``, a second sentence states this disagreement and the gain.

    Args:
        less: True if lower values are better.
        gain: gain of the design over the best uncorrected layout, or None if it is unknown.
    """
    name, unit = _parted(figure)
    stated, *_ = by_model
    worst = (max if less else min)(by_model, key=by_model.__getitem__)
    text = (
        f"{len(by_model)} models of this printer predict the print ({', '.join(by_model)}): {name} "
        f"{by_model[stated]:.3g}{unit} according to {stated}, {median(by_model.values()):.3g} as the median, "
        f"and {by_model[worst]:.3g} at worst (by {worst})."
    )
    apart = max(by_model.values()) - min(by_model.values())
    if gain is not None and apart > gain:
        text += f" The models disagree by {apart:.3g}{unit}, more than the design gains ({gain:.3g}{unit})."
    return text


def _parted(figure: str) -> tuple[str, str]:
    """Return the readable name of a score, and its unit with a leading space. The unit is empty if the score
    has none.
    """
    name, _, unit = named(figure).partition(" (")
    return name, f" {unit.rstrip(')')}" if unit else ""


def thickness_warning(design: Design) -> str:
    """Return a warning if the print, computed as a thick element, has a clearly lower efficiency than as a
    thin one. Otherwise, return an empty text.
    """
    name = next((one for one in _EFFICIENCIES if one in design.predicted), None)
    if design.thick is None or name is None:
        return ""
    thin, thick = design.predicted[name], design.thick[name]
    if thick >= (1 - _THICK_SHARE) * thin:
        return ""
    return (
        f"computed as a thick element (wave propagation method, including one reflection), the same print "
        f"has an efficiency of {100 * thick:.1f} % instead of the {100 * thin:.1f} % in these scores; the "
        "detail is too fine for this height, so these scores are too optimistic"
    )


def stroke_advice(design: Design) -> str:
    """Return sentences about the stroke (height range) of the printed levels. They also state the number of
    levels or the level height with which the stroke would be one wave.
    """
    stroke, gauge = design.stroke, design.out_of_distribution
    text = (
        f"The print of the highest level lies {stroke.stroke_waves:.2f} waves above that of the lowest "
        f"({stroke.print_gain:.2f} times the nominal height). A blazed grating with these levels would send "
        f"{100 * stroke.blaze_order_1:.1f} % of the light into the first order and "
        f"{100 * stroke.blaze_order_0:.1f} % straight through."
    )
    if gauge is not None and gauge.training_extreme_level_share < _SEEN_SHARE:
        text += (
            " The lowest and the highest level make up only "
            f"{100 * gauge.training_extreme_level_share:.2g} % of the training layouts, so "
            "their heights are an extrapolation; compare several models."
        )
    if stroke.levels_for_one_wave is None or stroke.level_height_for_one_wave_um is None:
        return text
    return text + (
        f" A full wave needs {stroke.levels_for_one_wave:.0f} levels of "
        f"{design.layout.level_height_um:g} µm, or {design.layout.levels} levels of "
        f"{stroke.level_height_for_one_wave_um:.3f} µm."
    )


def headline(score: Mapping[str, float], uncertainty: Mapping[str, float] | None = None) -> str:
    """Return the summary of the scores, which a command prints when it ends. The summary of a measurement
    includes the uncertainties.
    """
    sd = uncertainty or {}

    def told(name: str, digits: int, scale: int = 1) -> str:
        more = f" ± {scale * sd[name]:.{digits}f}" if name in sd else ""
        return f"{scale * score[name]:.{digits}f}{more}"

    known = [form.format(told(key, *shown)) for key, form, *shown in _HEADLINE if key in score]
    return ", ".join(known or [f"{named(name)} {told(name, 4)}" for name in score])


def baseline_line(baselines: Mapping[str, Mapping[str, float]]) -> str:
    """Return one line with the main scores of the baselines."""
    return f"for comparison: {'; '.join(f'{name} {headline(one)}' for name, one in baselines.items())}"
