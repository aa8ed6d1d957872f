"""Write the page of the demo. It tells which effects were planted in the virtual fab, which of them were
found, and how much better a hologram becomes.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data import open_store
from litho_data.reports.page import Page
from litho_data.reports.pictures import model_colour, new_figure
from litho_data.virtual_fab import Truth
from litho_design import load_printer
from litho_design.judging.gap import GapResult, design_folder
from litho_design.judging.loaded import LoadedDesign
from litho_design.reports.pictures import BRIGHTEST
from litho_models.effects import get_effect
from litho_models.evaluation.results import Benchmark
from litho_models.evaluation.wording import benchmark_verdict
from litho_models.loop.record import CloseLoop, FoundEffect

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The name of the virtual fab, as judge, in the comparison of designs.
FAB = "fab"
# The name of the corrected model, which is the base model with the effects that the loop added.
CORRECTED = "corrected"
# These effects are found in every run and not listed. Like an AFM, the fab gives each scan a different zero,
# and its printed lines are always rough.
ALWAYS = ("datum-offset", "line-roughness")
PLANTED, OTHER = "#2a7ab8", "#b0b0b0"
# All images have the same brightness scale, so that dim images look dim.
IMAGE = {"cmap": "inferno", "vmin": 0.0, "vmax": BRIGHTEST}


def tell(page: Page, out: Path) -> str:
    """Add the verdict and the sections to the page of a demo with results in ``out``. Return the verdict."""
    truth = Truth.read(out / "fab" / "truth")
    loop = CloseLoop.read(out / "close-loop")
    gap = GapResult.read(out / "compare")
    units = {knob.name: "" if knob.unit == "1" else f" {knob.unit}" for knob in truth.knobs}
    planted = {knob.effect: f"{knob.name}, {knob.strength:g}{units[knob.name]}" for knob in truth.knobs}
    found = [effect.name for effect in _causes(loop)]
    found += [one.name for one in loop.single_scans if one.seen and one.name not in ALWAYS]
    hit = [name for name in planted if name in found]
    psnr = {
        entry.arm: entry.judged["si_psnr_db"]
        for entry in gap.entries
        if entry.judge == FAB and entry.seed == gap.seeds[0]
    }
    before, after = loop.error("base"), loop.error("all")
    assert before is not None
    assert after is not None
    less = 100 * (1 - after.mae_nm / before.mae_nm)
    answer = (
        f"{len(planted)} effects were hidden in the prints, and the loop found {len(hit)} of them"
        f"{': ' if hit else ''}{' and '.join(hit)}"
        f"{_also([name for name in found if name not in planted])}. On held-out scans, the error "
        f"changed from {before.mae_nm:.1f} to {after.mae_nm:.1f} nm ({abs(less):.0f} % "
        f"{'less' if less >= 0 else 'more'}). If the virtual fab prints it, a hologram designed with "
        f"the corrected model reaches {psnr[CORRECTED]:.1f} dB (SI-PSNR of its image), and one designed "
        f"without a model {psnr['none']:.1f} dB. A single run cannot show how much of this difference is "
        "chance."
    )
    page.verdict(answer)
    page.heading("1. What was planted")
    told = [f"{get_effect(name).title} ({knob})" for name, knob in planted.items()]
    page.paragraph(
        f"The virtual fab prints with these effects: {'; '.join(told)}. No file that the programs read "
        "mentions them."
    )
    page.figure(
        _first_scan(out / "store.zarr"), "The first field: its layout, its scan, and their difference."
    )
    page.links([("store-report/report.html", "The dataset, scan by scan")])
    page.heading("2. What was found")
    page.paragraph(f"Found and planted: {', '.join(hit) or 'none'}. Planted and not found: "
                   f"{', '.join(name for name in planted if name not in found) or 'none'}."
                   f"{_width(loop)}")  # fmt: skip
    page.figure(
        _gains(loop, set(planted)),
        "Increase of the error if one of the found causes is left out. Planted causes are blue.",
    )
    page.links([("close-loop/report.html", "The closed loop, with its evidence")])
    page.heading("3. The error before and after the loop")
    over = loop.over_scans
    interval = (
        "" if over.ci95_nm is None else " (95 % interval over scans: {:.2f} to {:.2f})".format(*over.ci95_nm)
    )
    page.paragraph(
        f"After the loop, the mean absolute error on {over.count} held-out scans is {loop.gain_nm:.2f} nm "
        f"smaller{interval}. It is smaller in {over.positive} of the {over.count} scans. The number of terms "
        f"fitted to each scan is {before.k:g} before and {after.k:g} after the loop."
    )
    pairs = {"before": before, "after": after}
    page.figure(
        _bars({name: one.mae_nm for name, one in pairs.items()}, "error, nm", [OTHER, PLANTED]),
        "Before: the base model as it was trained. After: the base model with the effects that the loop "
        "found.",
    )
    page.heading("4. Which model predicts best")
    benchmark = Benchmark.read(out / "benchmark")
    scores = {one.model: one.mae_datum_free_nm for one in benchmark.scores}
    page.paragraph(benchmark_verdict(benchmark))
    colours = [model_colour(name) for name in scores]
    page.figure(
        _bars(scores, "error, nm", colours),
        "Errors of the models on held-out scans. The zero height of each scan is fitted before its error is "
        "computed.",
    )
    page.links(
        [
            ("benchmark/report.html", "The benchmark"),
            ("compare/report.html", "Designs made with one model and judged with another"),
        ]
    )
    designs = {"none": "without a model", CORRECTED: "with the corrected model"}
    for number, (arm, how) in enumerate(designs.items(), 5):
        folder = design_folder(Path("compare"), arm, gap.seeds[0])
        page.heading(f"{number}. A hologram designed {how}")
        page.paragraph(f"If the fab prints this hologram, the SI-PSNR of its image is {psnr[arm]:.1f} dB.")
        page.figure(
            _hologram(out / folder, out / "fab" / "truth"),
            "The target, the print, and the image of the print.",
        )
        page.links([((folder / "report.html").as_posix(), f"The hologram designed {how}")])
    return answer


def _causes(loop: CloseLoop) -> list[FoundEffect]:
    """Return the effects in the corrected model, except those that describe the residual without naming a
    cause.
    """
    return [effect for effect in loop.effects if effect.knowledge != "description"]


def _width(loop: CloseLoop) -> str:
    """Return a sentence that states the extra blur in µm that the loop finds along one axis of the spot. It
    is empty if the loop did not find such a blur.
    """
    spot = next((effect for effect in loop.effects if effect.name == "elliptical-psf"), None)
    if spot is None:
        return ""
    # A blur of standard deviation s along an axis at the angle a adds s² cos 2a to the difference Cxx - Cyy
    # of the spot's second moments, and s² sin 2a to 2 Cxy.
    stretch, shear = (spot.strengths[name][0].value for name in ("stretch_um2", "shear_um2"))
    wider_um = math.hypot(stretch, shear) ** 0.5
    return f" The loop finds an extra blur of {wider_um:.2f} µm along one axis of the spot."


def _also(names: list[str]) -> str:
    return f", and also {', '.join(names)}" if names else ""


def _first_scan(store: Path) -> Figure:
    scan = open_store(store).scans()[0]
    measured = np.where(scan.valid, scan.height_um, np.nan)
    off_nm = 1000 * (measured - scan.layout_um)
    most_nm = float(np.nanmax(np.abs(off_nm)))
    maps = {"layout, µm": scan.layout_um, "scan, µm": measured, "scan - layout, nm": off_nm}
    return _row(maps, {"scan - layout, nm": {"cmap": "RdBu_r", "vmin": -most_nm, "vmax": most_nm}})


def _gains(loop: CloseLoop, planted: set[str]) -> Figure:
    effects = _causes(loop)
    figure = new_figure(8.0, 0.6 + 0.45 * max(1, len(effects)))
    axis = figure.subplots()
    names = [effect.name for effect in effects]
    gains = [effect.left_out_nm or 0.0 for effect in effects]
    axis.barh(names, gains, color=[PLANTED if name in planted else OTHER for name in names])
    axis.invert_yaxis()
    axis.set_xlabel("increase of the error without the cause, nm")
    return figure


def _bars(values: dict[str, float], label: str, colours: list[str]) -> Figure:
    figure = new_figure(8.0, 0.6 + 0.45 * len(values))
    axis = figure.subplots()
    drawn = axis.barh(list(values), list(values.values()), color=colours)
    axis.bar_label(drawn, fmt="%.2f", padding=3)
    # The margin leaves room for the numbers beside the bars. On a phone's screen, they need a fifth of the
    # width.
    axis.margins(x=0.22)
    axis.invert_yaxis()
    axis.set_xlabel(label)
    return figure


def _hologram(folder: Path, fab: Path) -> Figure:
    design = LoadedDesign(folder)
    printed = design.printed_um(load_printer(fab, design.record.layout))
    assert design.target is not None
    shown = {"target": design.target, "printed, µm": printed, "image": design.display(design.image(printed))}
    maps = {title: np.asarray(picture) for title, picture in shown.items()}
    return _row(maps, {"target": IMAGE, "image": IMAGE})


def _row(maps: dict[str, np.ndarray], scales: dict[str, dict[str, Any]]) -> Figure:
    """Draw maps side by side. The colours of a map span the range in ``scales``, or the range of the map's
    own values if it has no entry there.
    """
    figure = new_figure(10.5, 3.6)
    for axis, (title, picture) in zip(figure.subplots(1, len(maps)), maps.items(), strict=True):
        figure.colorbar(axis.imshow(picture, **scales.get(title, {})), ax=axis, shrink=0.75)
        axis.set_title(title)
        axis.set_axis_off()
    return figure
