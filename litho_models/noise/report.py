"""Write ``report.html`` of a noise analysis."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from litho_data.reports.page import Page, filled
from litho_models.evaluation.tables import interval_text
from litho_models.noise import plots
from litho_models.noise.budget import NoiseBudget
from litho_models.noise.calibration import Calibration, ScanCalibration, SpreadAnalysis
from litho_models.noise.dose import DoseMatrix
from litho_models.noise.staircase import StepPrint
from litho_models.noise.texture import Texture
from litho_models.scoring.noise_floor import NoiseFloor

if TYPE_CHECKING:
    from litho_models.noise.references import Reference
    from litho_models.noise.result import NoiseAnalysis

# A description of the terms that each policy fits to a scan before the noise is measured.
_FREE = {
    "none": "nothing fitted",
    "offset": "the zero height of each scan fitted",
    "offset-gain": "the zero height and gain of each scan fitted",
    "full": "the zero height, gain, tilt and bow of each scan fitted",
    "full+rows": "the zero height, gain, tilt, bow and line offsets of each scan fitted",
}


def write_noise_report(result: NoiseAnalysis, references: Sequence[Reference], out: str | Path) -> Path:
    """Write the report of a noise analysis into ``out``; return its path."""
    title = f"Noise of {result.dataset.name}" if result.dataset else "Noise of single scans"
    hashes = {"dataset": result.dataset.sha256} if result.dataset else {}
    facts = hashes | {"seeds": ", ".join(map(str, result.run.seeds))}
    page = Page(title, run=result.run, facts=facts, words=Path(__file__).with_name("words.toml"))
    page.verdict(noise_verdict(result.noise_floor))
    page.note(*result.notes)
    if references:
        _references(page, result, references)
    if result.dose is not None:
        _dose(page, result.dose)
    if result.repeats is not None:
        page.paragraph(
            f"Noise from {result.repeats.scans} repeated prints: σ = {result.repeats.sigma_nm:.2f} nm (95 %: "
            f"{interval_text(result.repeats.ci95_nm)}). σ² is half the variance of a pair's difference."
        )
    if result.spread is not None:
        _spread(page, result.spread)
    if result.budget is not None:
        _budget(page, result.budget)
    return page.write(out)


def noise_verdict(floor: NoiseFloor) -> str:
    """State in one sentence how much of a model's error is noise."""
    return filled(Path(__file__).with_name("verdict.jinja"), floor=floor).strip()


def _references(page: Page, result: NoiseAnalysis, references: Sequence[Reference]) -> None:
    found = result.references
    page.heading("Reference prints")
    page.figure(
        plots.surfaces(references),
        "Heights relative to their mean. Substrate and flat print share one scale.",
    )
    page.heading("Reference prints in numbers", folded=True)
    rows = [
        {"use": use, **surface.model_dump()}
        for use, group in (("substrate", found.substrates), ("flat", found.flats))
        for surface in group
    ]
    if rows:
        page.table(
            rows,
            "Roughness. MAE is the mean absolute deviation from the median.",
            "surfaces.csv",
        )
    if found.print_noise:
        page.table(
            found.print_noise,
            "Roughness that the print adds in quadrature to the roughness of substrate and microscope.",
            "print_noise.csv",
        )
    for one in found.textures:
        _texture(page, one)
    for step in found.steps:
        _steps(page, step)


def _texture(page: Page, found: Texture) -> None:
    page.paragraph(f"Texture of {found.id}: {found.verdict}.")
    page.table(
        found.lines,
        f"The directional strength is {found.strength:.2f}: 0 if all directions are alike, 1 if all lines "
        "have one direction. An isotropic surface is at least as directional with probability "
        f"{found.isotropic_p:.1g}. Share: fraction of the variance in the means of the lines along each "
        "axis; fraction of the squares of these means in the strongest period. p: probability of such a "
        "peak in a smooth spectrum. Coherence: 1 if all surfaces have the same phase.",
        f"texture_{found.id.replace(' ', '_')}.csv",
        digits=3,
    )


def _steps(page: Page, found: StepPrint) -> None:
    page.heading(f"Steps of {found.id}", folded=True)
    page.table(
        [{"step": n + 1, **step.model_dump()} for n, step in enumerate(found.steps)],
        f"Steps along {found.axis}; tread σ {found.tread_sigma_nm:.2f} nm. Readability is height over σ; "
        "misread pixels are nearer to the other tread. Single pixels resolve steps of at least "
        f"{found.resolvable_step_nm:.1f} nm.",
        f"steps_{found.id}.csv",
        digits=3,
    )


def _dose(page: Page, found: DoseMatrix) -> None:
    page.heading("Dose matrix")
    page.paragraph(f"Recommended dose: {found.recommended_dose:g}. Reason: {found.reason}.")
    page.figure(
        plots.dose(found),
        "Green: recommended. Shaded: steps are lost. Above the dashed line, single pixels resolve levels.",
    )
    page.heading("The doses in numbers", folded=True)
    rows = [{**row.model_dump(exclude={"levels", "scans"}), "scans": len(row.scans)} for row in found.rows]
    page.table(
        rows,
        f"Values farther than {found.guard_um:g} µm from every edge. Gain is printed over nominal height.",
        "doses.csv",
        digits=3,
    )
    levels = [{"dose": row.dose, **level.model_dump()} for row in found.rows for level in row.levels]
    page.table(levels, "Height of every level.", "dose_levels.csv")


def _spread(page: Page, found: SpreadAnalysis) -> None:
    page.heading(f"Uncertainty of {found.model}")
    origin = "that no fit has used" if found.held_out else "used in training (so they are too small)"
    shared = "without" if found.nuisance.background == "none" else "with"
    background = f"{shared} the background shared by the training scans"
    page.paragraph(
        f"Errors on scans {origin}, with {_FREE[found.nuisance.policy]}, {background}: RMS "
        f"{found.residual_rms_nm:.2f} nm, MAE {found.residual_mae_nm:.2f} nm. They consist of noise and of "
        f"effects that the model lacks. σ(x), the uncertainty at a pixel, is judged on {found.left_out} "
        f"left out of its fit; the distribution is {_shape(found.variance.freedom)}."
    )
    page.figure(
        plots.calibration(found),
        "Scans left out of the fit. First: percentage of pixels inside their predicted 90 % intervals. "
        "Second: predicted probability of a lower height than the measured one; flat if σ is right.",
    )
    page.heading(f"Dependence of the uncertainty of {found.model} on its covariates", folded=True)
    page.figure(plots.spread(found), "Spread by level, slope, distance to the nearest edge, and radius.")
    page.table(
        [row for one in found.calibrations for row in _covered(one, [one], {"levels", "pit", "scans"})],
        "Means over scans. NLL is in nats for heights in nm; ENCE and AUSE are fractions (0 is best).",
        "calibration.csv",
        digits=3,
    )
    scans = [row for one in found.calibrations for row in _covered(one, one.scans)]
    page.table(scans, "By scan.", "calibration_scans.csv", digits=3)
    page.table(
        {"covariate": found.variance.covariates, "coefficient of ln s²": found.variance.coefficients},
        "The coefficients of ln s², fitted to all scans.",
        "variance.csv",
        digits=4,
    )
    page.table(
        found.bins,
        "By level, and by ranges of the other covariates with equal pixel counts; intervals over prints.",
        "spread.csv",
        digits=3,
    )


def _budget(page: Page, found: NoiseBudget) -> None:
    page.heading("Noise budget", folded=True)
    page.paragraph(
        f"These estimates come from residuals of {found.model} on scans that it had not seen. Both are upper "
        "limits: effects that the model lacks count as noise unless similar surroundings share them. The "
        "part that levelling removed from the scans, a few percent of the variance, is not included."
    )
    if found.floor.by_policy:
        page.table(
            found.floor.by_policy,
            "Noise for each set of fitted scan terms (k per scan), from similar layout surroundings in "
            "different scans, with 95 % confidence intervals over prints.",
            "budget.csv",
        )
    page.table(
        found.flat_levels,
        f"Noise where the layout is flat (slope at most {found.flat_slope:.3f}, a quarter of the pixels). "
        "Tilt, bow, gain and line offsets are fitted to each scan.",
        "flat_levels.csv",
    )
    if found.flat_texture is not None:
        _texture(page, found.flat_texture)


def _shape(freedom: float | None) -> str:
    return "Gaussian" if freedom is None else f"Student's t with {freedom:g} degrees of freedom"


def _covered(
    one: Calibration, rows: Sequence[Calibration | ScanCalibration], without: Collection[str] = ()
) -> Iterator[dict[str, object]]:
    """Yield the rows of a calibration, or of its scans, with a column for each level of coverage."""
    for row in rows:
        shares = zip(one.levels, row.coverage, strict=True)
        known = row.model_dump(exclude={"name", "coverage", *without})
        yield {"σ": one.name, **known} | {f"coverage_{100 * level:.0f}": share for level, share in shares}
