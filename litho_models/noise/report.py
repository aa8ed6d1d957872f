"""Write the ``report.html`` of a noise analysis."""

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

# Texts that say which terms are fitted to a scan under each policy before the noise is computed.
_FREE = {
    "none": "nothing fitted",
    "offset": "the zero height of each scan fitted",
    "offset-gain": "the zero height and gain of each scan fitted",
    "full": "the zero height, gain, tilt and bow of each scan fitted",
    "full+rows": "the zero height, gain, tilt, bow and line offsets of each scan fitted",
}


def write_noise_report(result: NoiseAnalysis, references: Sequence[Reference], out: str | Path) -> Path:
    """Write the report of a noise analysis into the folder ``out``, and return the path of the report."""
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
            f"Noise from {result.repeats.scans} repeated prints: σ = {result.repeats.sigma_nm:.2f} nm (95 % "
            "interval: "
            f"{interval_text(result.repeats.ci95_nm)}). σ² is half the variance of the difference between "
            "two prints."
        )
    if result.spread is not None:
        _spread(page, result.spread)
    if result.budget is not None:
        _budget(page, result.budget)
    return page.write(out)


def noise_verdict(floor: NoiseFloor) -> str:
    """Return one sentence that states how much of the error of a model is noise."""
    return filled(Path(__file__).with_name("verdict.jinja"), floor=floor).strip()


def _references(page: Page, result: NoiseAnalysis, references: Sequence[Reference]) -> None:
    found = result.references
    page.heading("Reference prints")
    page.figure(
        plots.surfaces(references),
        "Heights relative to the mean of each scan. The maps of substrates and flat prints have the same "
        "colour scale.",
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
            "Roughness of substrates and flat prints. MAE is the mean absolute deviation from the median.",
            "surfaces.csv",
        )
    if found.print_noise:
        page.table(
            found.print_noise,
            "Roughness of the print alone. It adds in quadrature to the roughness of the substrate and the "
            "noise of the microscope.",
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
        f"The directional strength is {found.strength:.2f}. It is 0 if all directions are alike, and 1 if "
        "all lines have one direction. If the surface were isotropic, the strength would be at least this "
        f"large with probability {found.isotropic_p:.1g}. The share of the lines is the fraction of the "
        "variance that is in the "
        "means of the lines along this axis. The share of the period is the fraction of the sum of squares "
        "of these means that has the strongest period. p is the probability of such a peak in a smooth "
        "spectrum. The coherence is 1 if the lines have the same phase on all surfaces.",
        f"texture_{found.id.replace(' ', '_')}.csv",
        digits=3,
    )


def _steps(page: Page, found: StepPrint) -> None:
    page.heading(f"Steps of {found.id}", folded=True)
    page.table(
        [{"step": n + 1, **step.model_dump()} for n, step in enumerate(found.steps)],
        f"Steps along {found.axis}. The standard deviation σ within the treads is {found.tread_sigma_nm:.2f} "
        "nm. The readability is "
        "the height of a step divided by σ. The height of a misread pixel is nearer to that of the other "
        f"tread. Single pixels resolve steps of at least {found.resolvable_step_nm:.1f} nm.",
        f"steps_{found.id}.csv",
        digits=3,
    )


def _dose(page: Page, found: DoseMatrix) -> None:
    page.heading("Dose matrix")
    page.paragraph(f"Recommended dose: {found.recommended_dose:g}. Reason: {found.reason}.")
    page.figure(
        plots.dose(found),
        "The green line marks the recommended dose. Steps are lost at the shaded doses. At doses whose "
        "point in the right plot is above the dashed line, single pixels of all neighbouring levels can be "
        "told "
        "apart.",
    )
    page.heading("The doses in numbers", folded=True)
    rows = [{**row.model_dump(exclude={"levels", "scans"}), "scans": len(row.scans)} for row in found.rows]
    page.table(
        rows,
        f"Only pixels farther than {found.guard_um:g} µm from every edge are used. The gain is the ratio of "
        "printed height to nominal height.",
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
        f"The RMS error is {found.residual_rms_nm:.2f} nm, and the MAE is {found.residual_mae_nm:.2f} nm. "
        f"These are errors on scans {origin}, with {_FREE[found.nuisance.policy]}, {background}. They "
        "consist of noise and of effects that the model lacks. σ(x) is the uncertainty at a pixel. It is "
        f"judged on {found.left_out} that its fit has not used. The distribution is "
        f"{_shape(found.variance.freedom)}."
    )
    page.figure(
        plots.calibration(found),
        "Calibration of σ on scans that were left out of its fit. The first plot shows the percentage of "
        "pixels inside their "
        "predicted 90 % intervals. The second plot is a histogram of the predicted probability of a height "
        "below the measured one; it is flat if σ is right.",
    )
    page.heading(f"Dependence of the uncertainty of {found.model} on its covariates", folded=True)
    page.figure(
        plots.spread(found),
        "Spread of the residuals by level, slope, distance to the nearest edge, and radius.",
    )
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
        "Coefficients of ln s², where s is the scale of the residuals in nm, fitted to all scans.",
        "variance.csv",
        digits=4,
    )
    page.table(
        found.bins,
        "The spread for each level, and for ranges of the other covariates that contain equal numbers of "
        "pixels. The intervals are confidence intervals over prints.",
        "spread.csv",
        digits=3,
    )


def _budget(page: Page, found: NoiseBudget) -> None:
    page.heading("Noise budget", folded=True)
    page.paragraph(
        f"The two estimates below come from residuals of {found.model} on scans that it had not seen. Both "
        "are upper "
        "limits, because an effect that the model lacks counts as noise unless it is the same in similar "
        "surroundings. Levelling removed a few percent of the variance from the scans. This part is not "
        "included."
    )
    if found.floor.by_policy:
        page.table(
            found.floor.by_policy,
            "Noise for each set of fitted scan terms (k terms per scan). It is estimated from pixels of "
            "different scans with similar surroundings in the layout. The 95 % confidence intervals are over "
            "prints.",
            "budget.csv",
        )
    page.table(
        found.flat_levels,
        "Noise at the quarter of the pixels where the layout is flattest (its slope is at most "
        f"{found.flat_slope:.3f}). Tilt, bow, gain and line offsets are fitted to each scan.",
        "flat_levels.csv",
    )
    if found.flat_texture is not None:
        _texture(page, found.flat_texture)


def _shape(freedom: float | None) -> str:
    return "Gaussian" if freedom is None else f"Student's t with {freedom:g} degrees of freedom"


def _covered(
    one: Calibration, rows: Sequence[Calibration | ScanCalibration], without: Collection[str] = ()
) -> Iterator[dict[str, object]]:
    """Yield a table row for each calibration or scan in ``rows``, with one column per level of coverage."""
    for row in rows:
        shares = zip(one.levels, row.coverage, strict=True)
        known = row.model_dump(exclude={"name", "coverage", *without})
        yield {"σ": one.name, **known} | {f"coverage_{100 * level:.0f}": share for level, share in shares}
