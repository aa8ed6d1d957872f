"""The human report: what was missing, the error before and after, and why each candidate was taken or not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from litho_data.foundation.report import Page, capitalised
from litho_data.foundation.units import NM_PER_UM
from litho_models.evaluation.tables import interval_text
from litho_models.loop import equal_terms
from litho_models.loop.equal_terms import TermSet
from litho_models.loop.findings import LoopFindings
from litho_models.loop.probes.layout import LAYOUT_FEATURES
from litho_models.loop.report.plots import (
    OF_SHAPES,
    curve_figure,
    map_figure,
    probe_figure,
    staircase_figure,
)
from litho_models.loop.report.power import identifiability_section, power_section
from litho_models.loop.report.wording import (
    headline_words,
    parts_text,
    plain_words,
    terms_text,
    warnings_for,
)
from litho_models.loop.result.record import CloseLoop, EqualTerms
from litho_models.loop.single_scans.nested_tests import scan_parameters
from litho_models.loop.structure import PLACE
from litho_models.loop.study import DATUM_FREE, Score, names_to_terms
from litho_models.scan_terms import Terms, parameter_names
from litho_models.scoring.noise_floor import NoiseFloor

_BACKGROUND = {
    "none": "Without the shared background of the benchmark.",
    "training": "With the shared background of the training scans, as in the benchmark.",
}


def write_report(findings: LoopFindings, result: CloseLoop, folder: Path) -> Path:
    """Write ``report.html`` and the CSV tables into ``folder``; returns the page's path."""
    page = Page(
        f"What {result.base_model} lacks on {result.dataset.name}",
        "From the residual of the model on scans it was not fitted on, to causes, to a corrected model.",
        run=result.run,
        facts={"dataset": result.dataset.sha256, "seeds": ", ".join(map(str, result.run.seeds))},
    )
    page.verdict(headline_words(result))
    noise = f"{result.noise_floor.mae_nm:.2f} nm" if result.noise_floor.mae_nm else "–"
    page.tiles(
        [
            (f"{result.before.mae_datum_free_nm:.2f} nm", "error before, on scans held out"),
            (f"{result.after.mae_datum_free_nm:.2f} nm", "after, with the same one term per scan"),
            (
                f"{result.after.mae_abs_nm:.1f} nm",
                f"error after with nothing fitted (before {result.before.mae_abs_nm:.1f})",
            ),
            (noise, f"noise that no model predicts: {result.noise_floor.kind.replace('-', ' ')}"),
        ]
    )
    page.figure(
        staircase_figure(_steps_frame(findings)),
        "Held-out mean absolute error, step by step, with 95 % bootstrap intervals over scans. Grey: the "
        "base model with more and more terms of each scan fitted. Blue: the same with the effects added.",
    )
    _decision_section(page, result)
    page.note(*warnings_for(findings, result))
    page.heading("In words", folded=True)
    page.points(plain_words(findings, result))
    page.heading("Residual maps", folded=True)
    page.figure(
        map_figure(findings, *equal_terms.scores(findings)["accepted"]),
        "Measured minus predicted on held-out scans: the worst, the median and the best scan before; one "
        "colour scale for all. Above and below with the accepted terms per scan, fitted on other pixels.",
    )
    _effect_section(page, result)
    _error_section(page, findings, result)
    _candidate_section(page, result)
    _probe_section(page, findings)
    _rest_section(page, findings, result)
    identifiability_section(page, findings)
    power_section(page, findings)
    _scan_section(page, findings)
    return page.write(folder)


def _decision_section(page: Page, result: CloseLoop) -> None:
    if not result.decisions:
        return
    page.heading("What the new prints decided")
    page.paragraph(
        "Names and sets were found on the first store and declared before the new prints were looked at. "
        "Each rival was fitted to all prints and judged on the new ones alone."
    )
    rows = [
        {
            "question": one.question,
            "declared": ", ".join(one.declared),
            "left": ", ".join(one.left),
            "verdict": one.verdict,
            "evidence": one.evidence,
            "prints": one.prints,
            "scans": one.scans,
        }
        for one in result.decisions
    ]
    page.table(rows, "Declared questions on the new prints.", "decisions.csv")


def _error_section(page: Page, findings: LoopFindings, result: CloseLoop) -> None:
    page.heading("Error before and after, with the same terms per scan", folded=True)
    page.table(
        [_equal_row(row, result.noise_floor) for row in result.equal_terms or []],
        "Held-out mean absolute error on the benchmark's pixels; terms are fitted on pixels that are not "
        f"scored. {_BACKGROUND[result.nuisance.background]} Intervals (95 %) resample whole scans, or whole "
        "prints; p by flipping their signs, and what so many can show at best.",
        "equal_terms.csv",
    )
    if result.nested is not None:
        page.heading("The same where the choice itself has not seen the scans", folded=True)
        page.table(
            [_equal_row(row, result.noise_floor) for row in result.nested.equal_terms],
            f"Named effects, generic terms and terms of single scans were chosen anew without each of the "
            f"{result.nested.selections} {result.nested.held_out}, and judged there.",
            "nested.csv",
        )
        page.table(
            result.nested.chosen,
            f"In how many of the {result.nested.selections} selections each was chosen.",
            "nested_chosen.csv",
        )
    if result.gain_split:
        page.heading("Whose the gain is", folded=True)
        page.paragraph(f"{capitalised(parts_text(result))}.")
        page.table(
            [
                {
                    "step": step.name,
                    "part": step.part,
                    "terms per scan": step.k,
                    "gain in order (nm)": step.in_order_nm,
                    "in order, k = 1 (nm)": step.in_order_k1_nm,
                    "lost if left out (nm)": step.left_out_nm,
                    "lost if left out, k = 1 (nm)": step.left_out_k1_nm,
                }
                for step in result.gain_split
            ],
            "Held-out MAE. In the order added, with the terms of single scans accepted so far, and with one "
            "term per scan throughout. Left out: the final set without it, the rest fitted again, with all "
            "accepted terms and with one. Only what is called process goes into the exported model.",
            "gain_split.csv",
        )
    page.heading("Error, step by step", folded=True)
    page.table(
        _steps_frame(findings),
        "The same per-scan terms with and without the process effects, fitted on pixels not scored.",
        "errors.csv",
    )
    shares = result.shares.model_dump()
    page.table(
        {"share of the squared error": list(shares), "%": [100 * v for v in shares.values()]},
        "Where the squared error of the base model goes. The noise floor is a lower bound without correlated "
        "roughness; what lies above it is counted as unexplained, structured or not.",
        "shares.csv",
        digits=1,
    )


def _steps_frame(findings: LoopFindings) -> pd.DataFrame:
    rows = []
    for label, s in _staircase(findings):
        low, high = s.interval_nm(findings.config.seed)
        errors = {"MAE (nm)": s.mean_mae_nm, "low": low, "high": high, "RMSE (nm)": s.rmse_nm}
        rows.append({"model": label, "terms per scan": s.degrees_of_freedom, **errors})
    return pd.DataFrame(rows)


def _equal_row(row: EqualTerms, floor: NoiseFloor) -> dict[str, object]:
    cells: dict[str, object] = {
        "terms per scan": terms_text(row),
        "before (nm)": row.before.mae_nm,
        "after (nm)": row.after.mae_nm,
        "gain (nm)": row.gain_nm,
        "noise floor (nm)": floor.mae_at(row.terms),
    }
    for unit, over in (("scans", row.over_scans), ("prints", row.over_prints)):
        if over is not None:
            cells[f"gain over {over.count} {unit} (nm)"] = interval_text(over.ci95_nm)
            cells[f"better {unit}; p"] = f"{over.positive}; {over.p:.2g} (at best {over.smallest_p:.2g})"
    return cells


def _staircase(findings: LoopFindings) -> list[tuple[str, Score]]:
    steps: list[tuple[str, Terms]] = [("nothing fitted", frozenset()), ("zero height fitted", DATUM_FREE)]
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
    page.heading("Effects added", folded=True)
    if not result.effects:
        page.paragraph("None.")
        return
    alike = any(e.confusable_with for e in result.effects)
    page.table(
        [
            {
                "effect": e.name + (" (known before)" if e.prior_hypothesis else ""),
                "role": e.role,
                "verdict": e.verdict,
                "share of the best rival (%)": np.nan if e.share is None else 100 * e.share,
                **({"or": ", ".join(e.confusable_with)} if alike else {}),
                "terms per scan": " / ".join(f"{k:.0f}" for k in e.terms_per_scan or ()),
                "before (nm)": e.before_nm,
                "after (nm)": e.after_nm,
                "gain, 95 % over scans": interval_text(e.gain_ci95_nm),
                "over prints": interval_text(e.over_prints.ci95_nm) if e.over_prints else "–",
                "scans better": f"{e.scans_improved[0]} of {e.scans_improved[1]}",
                "p confirm": f"{e.p_confirm:.1e}",
                "to separate": e.separating_experiment,
            }
            for e in result.effects
        ],
        "In the order added. Before and after: held-out MAE with the terms per scan that are given; they are "
        "the same on both sides but for what single scans add themselves.",
        "effects.csv",
    )
    page.table(
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
        ],
        "Parameters; intervals from the spread over scans. Per-scan terms: standard deviation between scans.",
        "parameters.csv",
    )


def _candidate_section(page: Page, result: CloseLoop) -> None:
    page.heading("Every candidate, and why", folded=True)
    order = [
        "explained",
        "confusable",
        "partial",
        "traced-to-covariate",
        "contradicted",
        "below-noise",
        "absorbed",
        "not-testable",
    ]
    page.table(
        [
            {
                "effect": c.name,
                "verdict": c.verdict,
                "p screen": np.nan if c.p_screen is None else c.p_screen,
                "gain (nm)": np.nan if c.gain_nm is None else c.gain_nm,
                "reason": c.reason,
            }
            for c in sorted(result.candidates, key=lambda c: order.index(c.verdict))
        ],
        "p screen: family-wise over all candidates, by flipping the signs of whole scans, before "
        "anything was "
        "added. Gain: on held-out scans for what was added (MAE), else predicted by the score test (RMSE).",
        "candidates.csv",
        digits=4,
    )


def _probe_section(page: Page, findings: LoopFindings) -> None:
    probed = findings.probed
    page.heading("What has no name", folded=True)
    for entry in probed.added:
        if entry.probe.name == LAYOUT_FEATURES:
            # Hundreds of features that stand for each other: no picture.
            continue
        letters = " h: share of the full height, y and x: slopes." if entry.probe.name in OF_SHAPES else ""
        page.figure(
            probe_figure(entry),
            f"{entry.probe.name}: held-out error {entry.before.mean_mae_nm:.2f} to "
            f"{entry.after.mean_mae_nm:.2f} nm. It says where the residual lives, not why.{letters}",
        )
    if probed.trends:
        page.table(
            [vars(t) | {"left_out": " / ".join(f"{e:.3g}" for e in t.left_out)} for t in probed.trends],
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
        page.table([vars(b) for b in defects.blobs], "Every blob.", "defects.csv", digits=2)


def _rest_section(page: Page, findings: LoopFindings, result: CloseLoop) -> None:
    page.heading("What is left", folded=True)
    state = result.residual.state
    page.paragraph(
        f"State: {state}: {result.residual.signature or 'no covariate carries a shared structure'}. The "
        "tests ask whether the residual follows the layout or the place in the same way in many scans; "
        "correlated roughness alone does not count as structure."
    )
    page.table(
        [
            {
                "stage": one.stage,
                "squared error (nm²)": one.squared_error_nm2,
                "explained (nm²)": one.explained_nm2,
                "95 % over scans": interval_text(one.explained_ci95_nm2),
            }
            for one in result.explainable or []
        ],
        "What a ridge regression over features of layout, place, order and dose still explains, each scan by "
        "one that has not seen it; offset, gain, tilt, bow and affine registration of each scan are free "
        f"(k = {findings.rest.k}). It says that something could be learned, not what.",
        "explainable.csv",
        digits=1,
    )
    page.table(
        [
            {"covariate": t.name, "p": t.p, "share of squared error (%)": 100 * t.share}
            for t in findings.structure
        ],
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


def _scan_section(page: Page, findings: LoopFindings) -> None:
    page.heading("Scan by scan", folded=True)
    found = equal_terms.scores(findings)
    shown: dict[TermSet, str] = {"offset": "k = 1", "accepted": "accepted terms"}
    errors = {
        f"MAE {when}, {name} (nm)": found[terms][at].mae_nm
        for terms, name in shown.items()
        for at, when in enumerate(("before", "after"))
    }
    terms = findings.terms
    coefficients = scan_parameters(findings.development, findings.final.predictions, terms)
    own = {
        name: values * NM_PER_UM if name.endswith("(nm)") else values
        for name, values in zip(parameter_names(terms), coefficients.T, strict=True)
    }
    page.table(
        {"scan": [f.id for f in findings.development], "print": findings.prints}
        | {"fold": findings.study.fold_of, **errors, **own},
        "Error of each held-out scan, before and after with the same terms, and its own terms: the "
        "measurement model, never in the design.",
        "scans.csv",
    )
