"""The report of one holographic design."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.report import Page, new_figure
from litho_design.judging.metrics import HologramScore
from litho_design.optimisation.robust import ProcessWindow
from litho_design.reports.window import add_yield
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Design

if TYPE_CHECKING:
    import pandas as pd

# Below this share of the training pixels a model has hardly seen the lowest and the highest level.
_SEEN_SHARE = 0.02

SCORE_LABELS = {
    "eff_signal": "power on the signal (T > 0.5), share of incident",
    "eff_paper": "power where T > 0, share of incident",
    "eff_window": "power in the window, share of incident",
    "zero_order_share": "zero order, share of incident",
    "si_psnr_db": "scale-invariant PSNR, dB",
    "rmse_paper": "RMSE at the paper's scale",
    "ssim": "SSIM",
    "clipped_share": "pixels clipped for SSIM, share",
    "ssim_camera": "SSIM as the camera sees it",
    "speckle_contrast": "speckle contrast on the signal",
    "uniformity": "uniformity on the signal",
    "background_ratio": "mean signal over mean background",
}


def write_hologram_report(
    folder: Path, design: Design, history: list[dict[str, float]], window: list[dict[str, float]]
) -> Path:
    """Write ``report.html`` and its CSV tables from the arrays in ``folder``."""
    levels, height_um, image, target = (
        np.load(folder / name) for name in (LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE, TARGET_FILE)
    )
    score = HologramScore.model_validate(design.predicted)
    page = Page(
        "Holographic element",
        f"Designed through the printer model “{design.printer.name}”; "
        "every figure is of the printable layout.",
    )
    page.tiles(
        [
            (f"{100 * score.eff_signal:.1f} %", "of the incident light on the signal"),
            (f"{score.si_psnr_db:.1f} dB", "scale-invariant PSNR"),
            (f"{score.ssim:.3f}", "SSIM"),
            (f"{score.speckle_contrast:.2f}", "speckle contrast"),
            (f"{design.stroke.stroke_waves:.2f} waves", "stroke that the print reaches"),
        ]
    )
    add_notes(page, design)
    page.heading("Layout, print and image")
    page.figure(
        _pictures(design, levels, height_um, image, target), "Rows are y (down), columns x; lengths in µm."
    )
    page.table(score_table(score), "Scores of the argmax layout", "scores.csv", digits=4)
    if design.reference_efficiency:
        page.paragraph(
            f"A Gerchberg-Saxton element with the same cells and any phase puts "
            f"{100 * design.reference_efficiency:.1f} % on the signal: the print reaches "
            f"{score.eff_signal / design.reference_efficiency:.2f} of that."
        )
    page.heading("Search")
    page.figure(
        progress_figure(history, design), "Loss of the sampled layout and of the printable (argmax) layout."
    )
    page.paragraph(
        f"Argmax loss {design.start_loss:.4f} at the start, {design.argmax_loss:.4f} after "
        f"{design.iterations} iterations, {design.polished_loss:.4f} after the polish; the last sample had "
        f"{design.sample_loss:.4f} (soft-to-hard gap {design.argmax_loss - design.sample_loss:+.4f})."
    )
    shown = {name: (getattr(score, name), SCORE_LABELS[name]) for name in ("si_psnr_db", "eff_signal")}
    add_yield(page, window, ProcessWindow.model_validate(design.settings["window"]), shown)
    page.heading("What the print makes of the levels")
    page.table(
        stroke_frame(design), "Printed height of a uniform field of each level", "levels.csv", digits=3
    )
    page.paragraph(stroke_advice(design))
    add_gauge(page, design)
    page.heading("Settings")
    page.code(design.model_dump_json(indent=1, include={"settings", "printer", "target", "run", "notes"}))
    return page.write(folder)


def score_table(score: HologramScore) -> pd.DataFrame:
    """One row per figure, with its meaning."""
    import pandas as pd

    rows = [(name, getattr(score, name), label) for name, label in SCORE_LABELS.items()]
    return pd.DataFrame(rows, columns=["name", "value", "meaning"])


def _pictures(
    design: Design, levels: np.ndarray, height_um: np.ndarray, image: np.ndarray, target: np.ndarray
):
    figure = new_figure(11, 8.6)
    axes = figure.subplots(2, 2)
    side = design.layout.size_um
    extent = (0, side, side, 0)
    scaled = (image * target).sum() / (image**2).sum() * image
    for axis, array, title, colours, limits, unit in (
        (axes[0, 0], levels, "layout", "viridis", (0, design.layout.levels - 1), "level"),
        (
            axes[0, 1],
            height_um,
            f"print predicted by {design.printer.name}",
            "viridis",
            (None, None),
            "height, µm",
        ),
        (axes[1, 0], target, "wanted image", "inferno", (0, 1), "intensity"),
        (
            axes[1, 1],
            scaled,
            "image behind the predicted print",
            "inferno",
            (0, 1.5),
            "intensity, matched scale",
        ),
    ):
        shown = axis.imshow(
            array, cmap=colours, vmin=limits[0], vmax=limits[1], extent=extent, interpolation="nearest"
        )
        axis.set_title(title)
        axis.set_xlabel("x, µm")
        axis.set_ylabel("y, µm")
        figure.colorbar(shown, ax=axis, label=unit, shrink=0.85)
    return figure


def progress_figure(history: list[dict[str, float]], design: Design):
    """Loss against iteration."""
    figure = new_figure(8, 3.4)
    axis = figure.subplots()
    steps = [entry["iteration"] for entry in history]
    axis.plot(steps, [entry["sample_loss"] for entry in history], color="0.6", label="sampled layout")
    axis.plot(steps, [entry["argmax_loss"] for entry in history], color="tab:blue", label="argmax layout")
    axis.axhline(design.polished_loss, color="tab:green", linewidth=1, label="after polish")
    axis.set_xlabel("iteration")
    axis.set_ylabel("loss")
    axis.legend()
    return figure


def add_notes(page: Page, design: Design) -> None:
    """What a reader of any design must know first: whose figures these are, and what was adapted."""
    page.note(
        "These figures are the design model's own opinion of its design. Judge the layout with another "
        "model (litho-design score, litho-design compare) before printing it."
    )
    for note in design.notes:
        page.note(note[0].upper() + note[1:] + ".")


def add_gauge(page: Page, design: Design) -> None:
    """What the layout asks of the printer, and how far it is from the model's training layouts."""
    import pandas as pd

    page.heading("What the layout asks of the printer")
    warning = distribution_warning(design)
    if warning:
        page.note(warning[0].upper() + warning[1:] + ".")
    gauge = design.out_of_distribution
    tiling, ensemble = design.tiling, design.ensemble
    if tiling is not None:
        page.paragraph(
            f"Whole field against {tiling.tiles} tiles of {tiling.tile_px} px with their halo: the "
            f"predicted height differs by {tiling.rms_nm:.2g} nm rms, {tiling.max_nm:.2g} nm at most."
        )
    if ensemble is not None:
        names = ", ".join(member.name for member in ensemble.members)
        page.paragraph(
            f"Designed together with {names}: here the models are {ensemble.disagreement_nm:.1f} nm "
            f"({ensemble.disagreement_waves:.3f} waves) apart, rms over the pixels."
        )
    figures = design.printability.model_dump() | (gauge.model_dump() if gauge else {})
    given = {name: float(value) for name, value in figures.items() if value is not None}
    frame = pd.DataFrame({"name": list(given), "value": list(given.values())})
    page.table(frame, "Lengths in µm; shares of pixel pairs or runs", "printability.csv", digits=3)


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


def stroke_frame(design: Design) -> pd.DataFrame:
    """Level, nominal and printed height."""
    from litho_design.optics import stroke_table

    table, _ = stroke_table(
        design.stroke.printed_height_um,
        design.optics.wave_height_um,
        level_height_um=design.layout.level_height_um,
    )
    return table


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
