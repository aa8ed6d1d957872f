"""The page of a front: efficiency against likeness."""

from __future__ import annotations

from pathlib import Path

from litho_data.foundation.report import Page
from litho_data.foundation.report_pictures import new_figure
from litho_design.judging.front import FrontResult


def write_front_report(folder: Path, result: FrontResult, printer: str) -> Path:
    """Write ``report.html`` and ``front.csv``."""
    page = Page(
        "Efficiency against likeness",
        f"One hologram designed through “{printer}” with several weights of the light that misses the "
        "target; figures of the prints that this model expects. A design is on the front if no other is "
        "better in both.",
    )
    figure = new_figure(7, 4.4)
    axis = figure.subplots()
    for on_front, colour in ((True, "tab:blue"), (False, "0.6")):
        chosen = [point for point in result.points if point.on_front == on_front]
        shares, likeness = ([getattr(p, name) for p in chosen] for name in ("eff_signal", "si_psnr_db"))
        axis.plot(shares, likeness, "o-" if on_front else "o", color=colour)
    for point in result.points:
        axis.annotate(f" {point.efficiency_weight:g}", (point.eff_signal, point.si_psnr_db))
    axis.set(xlabel="power on the signal, share of incident", ylabel=f"{result.figure.replace('_', ' ')}")
    page.figure(figure, "Each point is a design, with the weight of the light that misses.")
    page.table([p.model_dump() for p in result.points], "The designs", "front.csv", digits=3)
    page.links([(f"{p.folder}/report.html", f"weight {p.efficiency_weight:g}") for p in result.points])
    return page.write(folder)
