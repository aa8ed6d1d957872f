"""The human report: what was missing, the error before and after, and why each candidate was taken or not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from litho_data.foundation.report import Page
from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.findings import LoopFindings
from litho_models.loop.report.plots import curve_figure, map_figure, probe_figure, staircase_figure
from litho_models.loop.report.power import identifiability_section, power_section
from litho_models.loop.report.wording import plain_words, warnings_for
from litho_models.loop.result.record import CloseLoop
from litho_models.loop.single_scans.nested_tests import scan_parameters
from litho_models.loop.structure import PLACE
from litho_models.loop.study import DATUM_FREE, Score, names_to_terms
from litho_models.scan_terms import Terms, parameter_names


def write_report(findings: LoopFindings, result: CloseLoop, folder: Path) -> Path:
    """Write ``report.html`` and the CSV tables into ``folder``; returns the page's path."""
    before = findings.errors(findings.base, DATUM_FREE)
    after = findings.errors(findings.final, findings.terms)
    page = Page(
        f"Closing the loop: {result.dataset.name}, base model {result.base_model}",
        "From the residual of the model on scans it was not fitted on, to causes, to a corrected model.",
    )
    page.tiles(
        [
            (result.verdict, "verdict"),
            (f"{result.before.mae_datum_free_nm:.2f} nm", "datum-free error before (MAE, held out)"),
            (f"{result.after.mae_datum_free_nm:.2f} nm", "after"),
            (
                f"{result.after.mae_abs_nm:.1f} nm",
                f"absolute error after (before {result.before.mae_abs_nm:.1f})",
            ),
            (
                f"{result.noise_floor.rmse_nm:.1f} nm" if result.noise_floor.rmse_nm else "–",
                "lower bound of the noise (rms)",
            ),
        ]
    )
    page.paragraph(plain_words(findings, result))
    for warning in warnings_for(findings, result):
        page.note(warning)
    _error_section(page, findings, result)
    _effect_section(page, result)
    _candidate_section(page, result)
    page.heading("Residual maps")
    page.figure(
        map_figure(findings, before, after),
        "Measured minus predicted on held-out scans: the worst, the median and the best scan before; one "
        "colour "
        "scale for all. Per-scan terms were fitted on other pixels.",
    )
    _probe_section(page, findings)
    _rest_section(page, findings, result)
    identifiability_section(page, findings)
    power_section(page, findings)
    _scan_section(page, findings, before, after)
    page.heading("How it was run")
    page.code(result.run.command or "litho_models.loop.close_loop")
    return page.write(folder)


def _error_section(page: Page, findings: LoopFindings, result: CloseLoop) -> None:
    page.heading("Error, step by step")
    rows = _staircase(findings)
    frame = pd.DataFrame(
        [
            {
                "model": label,
                "terms per scan": s.degrees_of_freedom,
                "MAE (nm)": s.mean_mae_nm,
                "low": s.interval_nm(findings.config.seed)[0],
                "high": s.interval_nm(findings.config.seed)[1],
                "RMSE (nm)": s.rmse_nm,
            }
            for label, s in rows
        ]
    )
    page.figure(
        staircase_figure(frame, result),
        "Held-out mean absolute error; bars are 95 % bootstrap intervals over scans. Grey: per-scan terms of "
        "the microscope on the base model. Blue: with the effects added. Dotted: lower bound of the noise.",
    )
    page.table(
        frame,
        "The same per-scan terms with and without the process effects, fitted on pixels not scored.",
        "errors.csv",
    )
    shares = result.shares.model_dump()
    page.table(
        pd.DataFrame({"share of the squared error": list(shares), "%": [100 * v for v in shares.values()]}),
        "Where the squared error of the base model goes. The noise floor is a lower bound without correlated "
        "roughness; what lies above it is counted as unexplained, structured or not.",
        "shares.csv",
        digits=1,
    )


def _staircase(findings: LoopFindings) -> list[tuple[str, Score]]:
    steps: list[tuple[str, Terms]] = [("no fit", frozenset()), ("datum", DATUM_FREE)]
    names: list[str] = []
    for name in findings.accepted:
        names.append(name)
        terms = DATUM_FREE | names_to_terms(names)
        if terms != steps[-1][1]:
            steps.append((f"+ {name}", terms))
    rows = [(f"base: {label}", findings.errors(findings.base, terms)) for label, terms in steps]
    if findings.search.added or findings.probed.added:
        rows += [(f"corrected: {label}", findings.errors(findings.final, terms)) for label, terms in steps]
    return rows


def _effect_section(page: Page, result: CloseLoop) -> None:
    page.heading("Effects added")
    if not result.effects:
        page.paragraph("None.")
        return
    page.table(
        pd.DataFrame(
            [
                {
                    "effect": e.name + (" (known before)" if e.prior_hypothesis else ""),
                    "role": e.role,
                    "verdict": e.verdict,
                    "or": ", ".join(e.confusable_with),
                    "before (nm)": e.before_nm,
                    "after (nm)": e.after_nm,
                    "gain, 95 %": f"{e.gain_ci95_nm[0]:.2f} ... {e.gain_ci95_nm[1]:.2f}",
                    "scans better": f"{e.scans_improved[0]} of {e.scans_improved[1]}",
                    "p confirm": f"{e.p_confirm:.1e}",
                    "to separate": e.separating_experiment,
                }
                for e in result.effects
            ]
        ),
        "In the order added. Before and after: held-out MAE with the per-scan terms accepted so far.",
        "effects.csv",
    )
    page.table(
        pd.DataFrame(
            [
                {
                    "effect": e.name,
                    "parameter": name,
                    "value": f"{p.value:.4g}",
                    "95 %": f"{p.ci95[0]:.4g} ... {p.ci95[1]:.4g}" if p.ci95 else "chosen, not fitted",
                    "unit": p.unit,
                }
                for e in result.effects
                for name, p in e.parameters.items()
            ]
        ),
        "Parameters; intervals from the spread over scans. Per-scan terms: standard deviation between scans.",
        "parameters.csv",
    )


def _candidate_section(page: Page, result: CloseLoop) -> None:
    page.heading("Every candidate, and why")
    order = [
        "explained",
        "confusable",
        "traced-to-covariate",
        "contradicted",
        "below-noise",
        "absorbed",
        "not-testable",
    ]
    page.table(
        pd.DataFrame(
            [
                {
                    "effect": c.name,
                    "verdict": c.verdict,
                    "p screen": np.nan if c.p_screen is None else c.p_screen,
                    "gain (nm)": np.nan if c.gain_nm is None else c.gain_nm,
                    "reason": c.reason,
                }
                for c in sorted(result.candidates, key=lambda c: order.index(c.verdict))
            ]
        ),
        "p screen: family-wise over all candidates, by flipping the signs of whole scans, before "
        "anything was "
        "added. Gain: on held-out scans for what was added (MAE), else predicted by the score test (RMSE).",
        "candidates.csv",
        digits=4,
    )


def _probe_section(page: Page, findings: LoopFindings) -> None:
    probed = findings.probed
    page.heading("What has no name")
    for entry in probed.added:
        page.figure(
            probe_figure(entry),
            f"{entry.probe.name}: held-out error {entry.before.mean_mae_nm:.2f} to "
            f"{entry.after.mean_mae_nm:.2f} nm. It says where the residual lives, not why.",
        )
    if probed.trends:
        page.table(
            pd.DataFrame(
                [vars(t) | {"left_out": " / ".join(f"{e:.3g}" for e in t.left_out)} for t in probed.trends]
            ),
            "Offset and gain of the scans against the order of printing: a line, or one step. p under "
            "permuted orders; left out: error on prints not used, for mean / line / step.",
            "order_trend.csv",
            digits=4,
        )
    defects = probed.defects
    share = 100 * float(np.mean(defects.share_of_pixels))
    page.paragraph(
        f"Localised defects: {len(defects.blobs)} blobs of 9 pixels or more, beyond 5 robust standard "
        f"deviations; {share:.2f} % of the pixels, {100 * defects.share_of_squares:.1f} % of the squared "
        "residual. They are kept out of the generic terms, and count in every error."
    )
    if defects.blobs:
        page.table(pd.DataFrame([vars(b) for b in defects.blobs]), "Every blob.", "defects.csv", digits=2)


def _rest_section(page: Page, findings: LoopFindings, result: CloseLoop) -> None:
    page.heading("What is left")
    state = result.residual.state
    page.paragraph(
        f"State: {state}. {result.residual.signature or 'No covariate carries a shared structure.'} The "
        "tests "
        "ask whether the residual follows the layout or the place in the same way in many scans; correlated "
        "roughness alone does not count as structure."
    )
    page.table(
        pd.DataFrame(
            [
                {"covariate": t.name, "p": t.p, "share of squared error (%)": 100 * t.share}
                for t in findings.structure
            ]
        ),
        "Sign-flip p over scans (largest of the bins); part of the squared error that the mean curve "
        "carries.",
        "structure.csv",
        digits=4,
    )
    curves = [t for t in findings.structure if len(t.curve_nm) and t.name != PLACE]
    if curves:
        page.figure(
            curve_figure(curves),
            "Mean residual along each covariate; bars are two standard errors over development scans.",
        )


def _scan_section(page: Page, findings: LoopFindings, before: Score, after: Score) -> None:
    page.heading("Scan by scan")
    frame = pd.DataFrame(
        {
            "scan": [f.id for f in findings.development],
            "print": [f.stored.print_id for f in findings.development],
            "fold": findings.study.fold_of,
            "MAE before (nm)": before.mae_nm,
            "MAE after (nm)": after.mae_nm,
        }
    )
    terms = findings.terms
    coefficients = scan_parameters(findings.development, findings.final.predictions, terms)
    for name, values in zip(parameter_names(terms), coefficients.T, strict=True):
        frame[name] = values * NM_PER_UM if name.endswith("(nm)") else values
    page.table(
        frame,
        "Datum-free error of each held-out scan, and its own terms: the measurement model, never in the "
        "design.",
        "scans.csv",
    )
