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

# The terms that each policy fits to a scan before the noise is measured, in words.
_FREE = {
    "none": "nothing fitted",
    "offset": "the zero of each scan free",
    "offset-gain": "zero and gain of each scan free",
    "full": "zero, gain, tilt and bow of each scan free",
    "full+rows": "zero, gain, tilt, bow and line offsets of each scan free",
}


def write_noise_report(result: NoiseAnalysis, references: Sequence[Reference], out: str | Path) -> Path:
    """Render the result into ``out``; return the page."""
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
            f"Repeated prints ({result.repeats.scans}): σ {result.repeats.sigma_nm:.2f} nm "
            f"({interval_text(result.repeats.ci95_nm)}), half the variance of a pair's difference."
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
        plots.surfaces(references), "Heights relative to their mean; substrate and flat have the same scale."
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
        f"Strength of the direction {found.strength:.2f}: 0 where all directions are alike (chance of as "
        f"much: {found.isotropic_p:.1g}), 1 for lines of one direction. Share: part of the variance that is "
        "in the means of the lines along each axis; part of their squares in the strongest period. p: "
        "chance of such a peak in a smooth spectrum. Coherence: 1 if the surfaces have one phase.",
        f"texture_{found.id.replace(' ', '_')}.csv",
        digits=3,
    )


def _steps(page: Page, found: StepPrint) -> None:
    page.heading(f"Steps of {found.id}", folded=True)
    page.table(
        [{"step": n + 1, **step.model_dump()} for n, step in enumerate(found.steps)],
        f"Steps along {found.axis}; tread σ {found.tread_sigma_nm:.2f} nm. Readability is height over σ; "
        "misread pixels are nearer to the other tread. Single pixels tell steps of "
        f"{found.resolvable_step_nm:.1f} nm apart.",
        f"steps_{found.id}.csv",
        digits=3,
    )


def _dose(page: Page, found: DoseMatrix) -> None:
    page.heading("Dose matrix")
    page.paragraph(f"Recommended dose: {found.recommended_dose:g}. Reason: {found.reason}.")
    page.figure(
        plots.dose(found),
        "Green: recommended. Shaded: steps are lost. Above the dashed line, single pixels tell levels apart.",
    )
    page.heading("The doses in numbers", folded=True)
    rows = [{**row.model_dump(exclude={"levels", "scans"}), "scans": len(row.scans)} for row in found.rows]
    page.table(
        rows,
        f"Measured farther than {found.guard_um:g} µm from every edge. Gain is printed over nominal height.",
        "doses.csv",
        digits=3,
    )
    levels = [{"dose": row.dose, **level.model_dump()} for row in found.rows for level in row.levels]
    page.table(levels, "Height of every level.", "dose_levels.csv")


def _spread(page: Page, found: SpreadAnalysis) -> None:
    page.heading(f"Uncertainty of {found.model}")
    origin = "no fit has seen" if found.held_out else "the model was trained on, so they are too small"
    shared = "without" if found.nuisance.background == "none" else "with"
    background = f"{shared} the background that the training scans share"
    page.paragraph(
        f"Errors on scans that {origin}, with {_FREE[found.nuisance.policy]}, {background}: RMS "
        f"{found.residual_rms_nm:.2f} nm, MAE {found.residual_mae_nm:.2f} nm. They are the noise and what "
        f"the model lacks. σ(x), the uncertainty at a pixel, is fitted on other {found.left_out} than it is "
        f"judged on; its shape is {_shape(found.variance.freedom)}."
    )
    page.figure(
        plots.calibration(found),
        "Scans left out. First: how many pixels lie inside the 90 % interval that was predicted for them. "
        "Second: where among the predicted heights the measured ones fall; flat if σ is right.",
    )
    page.heading(f"Dependence of the uncertainty of {found.model} on its covariates", folded=True)
    page.figure(plots.spread(found), "Spread against level, slope, distance to the next edge, and radius.")
    page.table(
        [row for one in found.calibrations for row in _covered(one, [one], {"levels", "pit", "scans"})],
        "Means over scans; NLL in nats of nm, ENCE and AUSE as shares (0 is best).",
        "calibration.csv",
        digits=3,
    )
    scans = [row for one in found.calibrations for row in _covered(one, one.scans)]
    page.table(scans, "By scan.", "calibration_scans.csv", digits=3)
    page.table(
        {"covariate": found.variance.covariates, "coefficient of ln s²": found.variance.coefficients},
        "The scale fitted on all scans.",
        "variance.csv",
        digits=4,
    )
    page.table(
        found.bins,
        "By level, and by ranges of equal pixel count of the other covariates; intervals over prints.",
        "spread.csv",
        digits=3,
    )


def _budget(page: Page, found: NoiseBudget) -> None:
    page.heading("Noise budget", folded=True)
    page.paragraph(
        f"From residuals of {found.model} on scans that it had not seen. Both estimates are upper ones: what "
        "the model lacks counts as noise unless like surroundings share it. What levelling removed from the "
        "scans is missing, a few percent of the variance."
    )
    if found.floor.by_policy:
        page.table(
            found.floor.by_policy,
            "Noise by the scan terms that are set free (k per scan), from like layout surroundings in "
            "different scans; 95 % intervals over prints.",
            "budget.csv",
        )
    page.table(
        found.flat_levels,
        f"Where the layout is flat (slope at most {found.flat_slope:.3f}, a quarter of the pixels); tilt, "
        "bow, gain and line offsets of each scan are free.",
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
