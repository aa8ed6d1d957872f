"""``report.html`` of a noise analysis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from litho_data.foundation.report import Page
from litho_models.evaluation.tables import interval_text
from litho_models.noise import plots
from litho_models.noise.calibration import SpreadAnalysis
from litho_models.noise.dose import DoseMatrix
from litho_models.noise.staircase import StepPrint

if TYPE_CHECKING:
    import pandas as pd

    from litho_models.noise.references import Reference
    from litho_models.noise.result import NoiseAnalysis


def write_noise_report(result: NoiseAnalysis, references: Sequence[Reference], out: str | Path) -> Path:
    """Render the result into ``out``; returns the page."""
    floor = result.noise_floor
    title = f"Noise of {result.dataset.name}" if result.dataset else "Noise of single scans"
    known = "nothing bounds it" if floor.mae_nm is None else f"MAE {floor.mae_nm:.2f} nm ({floor.kind})"
    page = Page(title, f"Noise floor: {known}.")
    page.paragraph(f"Source of the floor: {floor.source}.")
    if floor.mae_nm is not None and floor.rmse_nm is not None:
        page.tiles([(f"{floor.mae_nm:.2f} nm", "floor, MAE"), (f"{floor.rmse_nm:.2f} nm", "floor, σ")])
    for note in result.notes:
        page.note(note)
    if references:
        _references(page, result, references)
    if result.dose is not None:
        _dose(page, result.dose)
    if result.bounds:
        page.heading("Bounds from ordinary prints")
        page.paragraph(
            "Each estimate says on which side it errs. The lower bound holds if the printer is no sharper "
            "than stated; an upper bound counts topography as well."
        )
        page.figure(plots.bounds(result.bounds, floor), "σ of each estimate.")
        page.table(_bounds(result), "What each contains, and what not.", "bounds.csv")
    if result.spread is not None:
        _spread(page, result.spread)
    page.code(result.run.command)
    return page.write(out)


def _references(page: Page, result: NoiseAnalysis, references: Sequence[Reference]) -> None:
    import pandas as pd

    found = result.references
    page.heading("Reference prints")
    page.figure(plots.surfaces(references), "Heights about their mean; substrate and flat share a scale.")
    rows = [
        {"use": use, **surface.model_dump()}
        for use, group in (("substrate", found.substrates), ("flat", found.flats))
        for surface in group
    ]
    if rows:
        page.table(
            pd.DataFrame(rows),
            "Roughness. MAE is measured about the median; 0.798 σ is what a Gaussian would have.",
            "surfaces.csv",
        )
    if found.print_noise:
        page.table(
            pd.DataFrame([one.model_dump() for one in found.print_noise]),
            "What the print adds to substrate and microscope, in quadrature.",
            "print_noise.csv",
        )
    for step in found.steps:
        _steps(page, step)


def _steps(page: Page, found: StepPrint) -> None:
    import pandas as pd

    page.heading(f"Steps of {found.id}")
    page.figure(plots.steps(found), "Step heights and the smallest step that can be told from none.")
    page.table(
        pd.DataFrame([{"step": n + 1, **step.model_dump()} for n, step in enumerate(found.steps)]),
        f"Steps along {found.axis}; tread σ {found.tread_sigma_nm:.2f} nm. Readability is height over σ; "
        "misread pixels are nearer to the other tread.",
        f"steps_{found.id}.csv",
        digits=3,
    )


def _dose(page: Page, found: DoseMatrix) -> None:
    import pandas as pd

    page.heading("Dose matrix")
    page.paragraph(f"Recommended dose: {found.recommended_dose:g}. Reason: {found.reason}.")
    page.figure(
        plots.dose(found),
        "Green: recommended. Shaded: steps are lost. Dashed: single pixels of two levels are told apart.",
    )
    rows = [{**row.model_dump(exclude={"levels", "scans"}), "scans": len(row.scans)} for row in found.rows]
    page.table(
        pd.DataFrame(rows),
        f"Measured farther than {found.guard_um:g} µm from every edge. Gain is printed over nominal height.",
        "doses.csv",
        digits=3,
    )
    levels = [{"dose": row.dose, **level.model_dump()} for row in found.rows for level in row.levels]
    page.table(pd.DataFrame(levels), "Height of every level.", "dose_levels.csv")


def _spread(page: Page, found: SpreadAnalysis) -> None:
    import pandas as pd

    page.heading(f"Uncertainty of {found.model}")
    origin = "out of fold" if found.held_out else "of scans that the model was trained on: too small"
    shared = "with" if found.nuisance.background == "training" else "without"
    background = f"{shared} the background that the training scans share"
    page.paragraph(
        f"Residuals {origin}, each scan freed by policy {found.nuisance.policy}, {background}: RMS "
        f"{found.residual_rms_nm:.2f} nm, MAE {found.residual_mae_nm:.2f} nm. They hold the noise and what "
        "the model lacks. σ(x) is fitted on other scans than it is judged on."
    )
    if found.epistemic_rms_nm is not None:
        page.paragraph(
            f"{found.members} members disagree by {found.epistemic_rms_nm:.2f} nm (RMS over pixels, each "
            "member freed of its mean). The fitted σ already holds the error that this disagreement is "
            "part of; the row with it added shows whether it helps."
        )
    page.figure(plots.spread(found), "Spread against level, slope, distance to the next edge, and radius.")
    page.figure(plots.calibration(found), "Calibration on scans left out.")
    rows = [
        {
            "σ": one.name,
            "nll": one.nll,
            "crps_nm": one.crps_nm,
            "ence": one.ence,
            "ause": one.ause,
            **{
                f"cover {100 * level:.0f} %": 100 * share
                for level, share in zip(one.levels, one.coverage, strict=True)
            },
            "worst scan at 90 %": 100 * one.worst_scan_coverage_90,
            "factor for 90 % of scans": one.conformal_factor
            if one.conformal_factor is not None
            else float("nan"),
        }
        for one in found.calibrations
    ]
    page.table(
        pd.DataFrame(rows),
        "Means over scans; NLL in nats of nm, ENCE and AUSE as shares (0 is best).",
        "calibration.csv",
        digits=3,
    )
    scans = [
        {
            "σ": one.name,
            **row.model_dump(exclude={"coverage"}),
            **{
                f"coverage_{100 * level:.0f}": share
                for level, share in zip(one.levels, row.coverage, strict=True)
            },
        }
        for one in found.calibrations
        for row in one.scans
    ]
    page.table(pd.DataFrame(scans), "By scan.", "calibration_scans.csv", digits=3)
    page.table(
        pd.DataFrame(
            {"covariate": found.variance.covariates, "coefficient of ln σ²": found.variance.coefficients}
        ),
        "The variance fitted on all scans.",
        "variance.csv",
        digits=4,
    )
    page.table(pd.DataFrame([row.model_dump() for row in found.bins]), "The bins.", "spread.csv")


def _bounds(result: NoiseAnalysis) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(
        [
            {
                "estimate from": bound.name,
                "of": bound.of,
                "what it is": bound.direction,
                "sigma_nm": bound.sigma_nm,
                "ci95_nm": interval_text(bound.ci95_nm),
                "mae_nm": bound.mae_nm,
                "contains": bound.contains,
                "lacks": bound.lacks,
            }
            for bound in result.bounds
        ]
    )
