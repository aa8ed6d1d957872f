"""Report sections on what the scans can decide: how well they determine the fit, what they would reveal."""

from __future__ import annotations

from litho_data.foundation.report import Page, spelt_out
from litho_models.loop.findings import LoopFindings
from litho_models.loop.report.plots import profile_figure


def identifiability_section(page: Page, findings: LoopFindings) -> None:
    """Variance inflation of every fitted number, the least determined combination, and profiles."""
    found = findings.identifiability
    if found is None:
        return
    page.heading("How well these scans determine the fit", folded=True)
    weakest = ", ".join(f"{part:+.2f} {spelt_out(name)}" for name, part in found.weakest.items())
    idle = ", ".join(found.without_slope)
    bounds = f" At a bound, or without influence: {idle}." if idle else ""
    page.paragraph(
        f"Condition number of all fitted numbers together: {found.condition:.0f} (1: each has a signature of "
        f"its own). The combination that the scans say least about: {weakest}.{bounds}"
    )
    page.table(
        [{"number": n, "variance inflation": v} for n, v in found.inflation.items()],
        "By how much the variance of a number grows because the others are fitted too; above 10 it is known "
        "only together with them.",
        "identifiability.csv",
        digits=2,
    )
    if not findings.profiles:
        return
    page.figure(
        profile_figure(findings.profiles),
        "Profile of each number of each effect: root mean square residual, on the scans it was fitted to, "
        "with the number held there and all others fitted again. Steep sides: determined; flat: not.",
    )
    page.table(
        [
            {"effect": one.effect, "parameter": one.parameter, "unit": one.unit, "value": v, "RMSE (nm)": e}
            for one in findings.profiles
            for v, e in zip(one.held, one.rmse_nm, strict=True)
        ],
        "The same in numbers.",
        "profiles.csv",
        digits=5,
    )


def power_section(page: Page, findings: LoopFindings) -> None:
    """The smallest planted amounts that were found, and the power at every amount."""
    if not findings.planted:
        return
    page.heading("How small an effect would have been found", folded=True)
    for name in dict.fromkeys(p.name for p in findings.planted):
        found = [p for p in findings.planted if p.name == name and p.found]
        smallest = min(found, key=lambda p: p.rms_nm, default=None)
        page.paragraph(
            f"{name}: found from {smallest.amount:.3g} {smallest.unit} ({smallest.rms_nm:.1f} nm rms) "
            "upwards."
            if smallest
            else f"{name}: not found at any of the planted amounts."
        )
    page.table(
        [vars(p) for p in findings.planted],
        "The effect planted in copies of the development scans. Power: share of the training sets whose best "
        "candidate it is, or one with the same signature.",
        "power.csv",
        digits=3,
    )
