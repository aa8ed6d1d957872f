"""The page of a front: efficiency against likeness."""

from __future__ import annotations

from pathlib import Path

from litho_data.reports.page import Page
from litho_data.reports.pictures import new_figure
from litho_design.judging.front import FrontResult
from litho_design.reports.advice import WORDS, named


def write_front_report(folder: Path, result: FrontResult, printer: str) -> Path:
    """Write ``report.html`` and ``front.csv``."""
    page = Page(
        "Efficiency against likeness",
        f"One hologram designed through “{printer}” with several weights of the light that misses the "
        "target; figures of the prints that this model expects. A design is on the front if no other is "
        "better in both.",
        run=result,
        words={**WORDS, "on_front": ("on the front", "")},
    )
    likest, brightest = (
        max(result.points, key=lambda point: getattr(point, name)) for name in ("si_psnr_db", "eff_signal")
    )
    page.verdict(
        f"From {likest.si_psnr_db:.1f} dB with {100 * likest.eff_signal:.0f} % of the light on the signal "
        f"(weight {likest.efficiency_weight:g}) to {brightest.si_psnr_db:.1f} dB with "
        f"{100 * brightest.eff_signal:.0f} % (weight {brightest.efficiency_weight:g}); "
        f"{sum(point.on_front for point in result.points)} of {len(result.points)} designs are on the front."
    )
    figure = new_figure(7, 4.4)
    axis = figure.subplots()
    for on_front, colour in ((True, "tab:blue"), (False, "0.6")):
        chosen = [point for point in result.points if point.on_front == on_front]
        shares, likeness = ([getattr(p, name) for p in chosen] for name in ("eff_signal", "si_psnr_db"))
        axis.plot(shares, likeness, "o-" if on_front else "o", color=colour)
    for point in result.points:
        axis.annotate(f" {point.efficiency_weight:g}", (point.eff_signal, point.si_psnr_db))
    axis.set(xlabel="power on the signal, share of incident", ylabel=named(result.figure))
    page.figure(figure, "Each point is a design, with the weight of the light that misses.")
    page.table([p.model_dump() for p in result.points], "The designs", "front.csv", digits=3)
    page.links([(f"{p.folder}/report.html", f"weight {p.efficiency_weight:g}") for p in result.points])
    return page.write(folder)
