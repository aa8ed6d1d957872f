"""The human report: what was missing, the error before and after, and why each candidate was taken or not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from litho_data.report import Page, new_figure
from litho_models.effects import get_effect
from litho_models.loop.closing import Closed
from litho_models.loop.confirming import FEWEST_SCANS
from litho_models.loop.measurement import scan_parameters
from litho_models.loop.result import AddedEffect, CloseLoop
from litho_models.loop.scoring import DATUM_FREE, Score, Terms, names_to_terms, scan_parameter_names
from litho_models.metrics import NM_PER_UM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAPS = 3
_BEFORE, _AFTER = "#9aa5b1", "#0b6aa2"


def write_report(closed: Closed, result: CloseLoop, folder: Path) -> Path:
    """Write ``report.html`` and the CSV tables into ``folder``; returns the page's path."""
    before = closed.errors(closed.base, DATUM_FREE)
    after = closed.errors(closed.final, closed.terms)
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
    page.paragraph(plain_words(closed, result))
    for warning in _warnings(closed, result):
        page.note(warning)
    _error_section(page, closed, result)
    _effect_section(page, result)
    _candidate_section(page, result)
    page.heading("Residual maps")
    page.figure(
        _map_figure(closed, before, after),
        "Measured minus predicted on held-out scans: the worst, the median and the best scan before; one "
        "colour "
        "scale for all. Per-scan terms were fitted on other pixels.",
    )
    _rest_section(page, closed, result)
    _power_section(page, closed)
    _scan_section(page, closed, before, after)
    page.heading("How it was run")
    page.code(result.run.command or "litho_models.loop.close_loop")
    return page.write(folder)


def plain_words(closed: Closed, result: CloseLoop) -> str:
    """One paragraph for a process engineer."""
    scan_terms = [e for e in result.effects if get_effect(e.name).per_scan]
    causes = [e for e in result.effects if not get_effect(e.name).per_scan]
    total = len(closed.development)
    parts = [
        f"On {total} scans, each predicted by a fit that has not seen it, the model is wrong by "
        f"{result.before.mae_abs_nm:.0f} nm as it stands and by {result.before.mae_datum_free_nm:.1f} nm "
        "once the "
        "zero of each scan is freed."
    ]
    if scan_terms:
        names = ", ".join(get_effect(e.name).title for e in scan_terms)
        parts.append(f"The microscope accounts for: {names}. This says nothing about the printer.")
    for e in causes:
        alike = f" (or {', '.join(e.confusable_with)}: these data cannot tell)" if e.confusable_with else ""
        parts.append(
            f"{_sentence_case(get_effect(e.name).title)} [{e.name}]{alike}: {_estimate_text(e)}; with it the "
            f"held-out error falls from {e.before_nm:.2f} to {e.after_nm:.2f} nm, in "
            f"{e.scans_improved[0]} of "
            f"{e.scans_improved[1]} scans."
        )
        if e.separating_experiment and (e.confusable_with or e.role == "undetermined"):
            parts.append(f"To be sure: {e.separating_experiment}.")
    if not causes:
        parts.append("No effect of the printer is confirmed as missing from the model.")
    if result.residual.state == "unexplained":
        parts.append(f"What is left is still structured: {result.residual.signature}.")
    else:
        parts.append("What is left shows no structure that is shared between scans.")
    return " ".join(parts)


def _warnings(closed: Closed, result: CloseLoop) -> list[str]:
    warnings = []
    if len(closed.development) < FEWEST_SCANS:
        warnings.append(
            f"Only {len(closed.development)} scans to work on, and nothing can be confirmed below "
            f"{FEWEST_SCANS}: errors are given, verdicts are withheld."
        )
    if result.run.dropped:
        warnings.append(f"Scans left out: {'; '.join(result.run.dropped)}")
    if closed.development[0].scan.write is None:
        warnings.append(
            "The card says nothing about the write field: each scan is taken as a write field of its "
            "own, its "
            "lines written along x, one below the other."
        )
    if len({field.context.order for field in closed.development}) > 2:
        warnings.append(
            "Effects of the writing order rest on the order given in the card; where it gives none, the "
            "sorted "
            "names of the scans stand for it, which is an assumption."
        )
    if result.prior_hypotheses:
        warnings.append(
            f"Known from earlier looks at these data, so only a new print confirms them cleanly: "
            f"{', '.join(result.prior_hypotheses)}."
        )
    if any(e.role == "undetermined" or e.confusable_with for e in result.effects):
        warnings.append(
            "Effects of undetermined role, and sets with a member that belongs to the microscope, are "
            "left out "
            "of the exported process model."
        )
    return warnings


def _error_section(page: Page, closed: Closed, result: CloseLoop) -> None:
    page.heading("Error, step by step")
    rows = _staircase(closed)
    frame = pd.DataFrame(
        [
            {
                "model": label,
                "terms per scan": s.degrees_of_freedom,
                "MAE (nm)": s.mean_mae_nm,
                "low": s.interval_nm(closed.config.seed)[0],
                "high": s.interval_nm(closed.config.seed)[1],
                "RMSE (nm)": s.rmse_nm,
            }
            for label, s in rows
        ]
    )
    page.figure(
        _staircase_figure(frame, result),
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


def _staircase(closed: Closed) -> list[tuple[str, Score]]:
    steps: list[tuple[str, Terms]] = [("no fit", frozenset()), ("datum", DATUM_FREE)]
    names: list[str] = []
    for name in closed.accepted:
        names.append(name)
        terms = DATUM_FREE | names_to_terms(names)
        if terms != steps[-1][1]:
            steps.append((f"+ {name}", terms))
    rows = [(f"base: {label}", closed.errors(closed.base, terms)) for label, terms in steps]
    if closed.search.added:
        rows += [(f"corrected: {label}", closed.errors(closed.final, terms)) for label, terms in steps]
    return rows


def _staircase_figure(frame: pd.DataFrame, result: CloseLoop) -> Figure:
    figure = new_figure(9, 0.42 * len(frame) + 1.2)
    axes = figure.subplots()
    y = np.arange(len(frame))[::-1]
    colours = [_BEFORE if label.startswith("base") else _AFTER for label in frame["model"]]
    mae = frame["MAE (nm)"].to_numpy()
    errors = np.abs(np.stack([mae - frame["low"], frame["high"] - mae]))
    axes.barh(y, mae, xerr=errors, color=colours, height=0.66, error_kw={"elinewidth": 1.2})
    for position, value, high in zip(y, mae, frame["high"], strict=True):
        axes.annotate(
            f"{value:.1f}", (high, position), (5, 0), textcoords="offset points", va="center", fontsize=9
        )
    if result.noise_floor.mae_nm:
        axes.axvline(result.noise_floor.mae_nm, color="k", ls=":", lw=1)
    axes.set_yticks(y, frame["model"])
    axes.set_xlim(0, 1.12 * float(frame["high"].max()))
    axes.set_xlabel("mean absolute error on held-out scans (nm)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


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
    order = ["explained", "confusable", "contradicted", "below-noise", "absorbed", "not-testable"]
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


def _map_figure(closed: Closed, before: Score, after: Score) -> Figure:
    ranking = np.argsort(-before.mse_nm2)
    picked = ranking[np.unique(np.linspace(0, len(ranking) - 1, _MAPS).astype(int))]
    limit = 2.5 * before.rmse_nm
    figure = new_figure(4.1 * len(picked) + 0.8, 8.2)
    axes = figure.subplots(2, len(picked), squeeze=False)
    for column, scan in enumerate(picked):
        field = closed.development[scan]
        extent_um = [
            0,
            field.usable.shape[1] * field.scan.pitch_um,
            field.usable.shape[0] * field.scan.pitch_um,
            0,
        ]
        for row, (label, s) in enumerate((("before", before), ("after", after))):
            panel = axes[row, column]
            panel.imshow(
                s.residual_um[scan] * NM_PER_UM, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=extent_um,
                interpolation="nearest",
            )  # fmt: skip
            panel.set_title(f"{field.id} {label}: {s.mae_nm[scan]:.1f} nm", fontsize=10)
            panel.set_xlabel("x (µm)" if row else "")
            panel.set_ylabel("" if column else "y (µm)")
    figure.colorbar(axes[0, 0].images[0], ax=axes, label="measured - predicted (nm)", shrink=0.6)
    return figure


def _rest_section(page: Page, closed: Closed, result: CloseLoop) -> None:
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
                for t in closed.structure
            ]
        ),
        "Sign-flip p over scans (largest of the bins); part of the squared error that the mean curve "
        "carries.",
        "structure.csv",
        digits=4,
    )
    curves = [t for t in closed.structure if len(t.curve_nm)]
    if curves:
        page.figure(
            _curve_figure(curves),
            "Mean residual along each covariate; bars are two standard errors over development scans.",
        )


def _curve_figure(curves: list) -> Figure:
    columns = 3
    rows = -(-len(curves) // columns)
    figure = new_figure(10, 2.3 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for panel, test in zip(axes, curves, strict=False):
        panel.axhline(0, color="k", lw=0.6)
        panel.errorbar(
            test.centres, test.curve_nm, 2 * test.error_nm, fmt="o-", color=_AFTER, ms=3.5, capsize=2
        )
        panel.set_xlabel(test.name, fontsize=8)
        panel.tick_params(labelsize=8)
    for panel in axes[len(curves) :]:
        panel.set_visible(False)
    for panel in axes[::columns]:
        panel.set_ylabel("residual (nm)", fontsize=8)
    return figure


def _power_section(page: Page, closed: Closed) -> None:
    if not closed.planted:
        return
    page.heading("How small an effect would have been found")
    for name in dict.fromkeys(p.name for p in closed.planted):
        found = [p for p in closed.planted if p.name == name and p.found]
        smallest = min(found, key=lambda p: p.rms_nm, default=None)
        page.paragraph(
            f"{name}: found from {smallest.amount:.3g} {smallest.unit} ({smallest.rms_nm:.1f} nm rms) "
            "upwards."
            if smallest
            else f"{name}: not found at any of the planted amounts."
        )
    page.table(
        pd.DataFrame([vars(p) for p in closed.planted]),
        "The effect planted in copies of the development scans. Power: share of the training sets whose best "
        "candidate it is, or one with the same signature.",
        "power.csv",
        digits=3,
    )


def _scan_section(page: Page, closed: Closed, before: Score, after: Score) -> None:
    page.heading("Scan by scan")
    frame = pd.DataFrame(
        {
            "scan": [f.id for f in closed.development],
            "print": [f.scan.print_id for f in closed.development],
            "fold": closed.fold_of,
            "MAE before (nm)": before.mae_nm,
            "MAE after (nm)": after.mae_nm,
        }
    )
    terms = closed.terms
    coefficients = scan_parameters(closed.development, closed.final.predictions, terms)
    for name, values in zip(scan_parameter_names(terms), coefficients.T, strict=True):
        frame[name] = values * NM_PER_UM if name.endswith("(nm)") else values
    page.table(
        frame,
        "Datum-free error of each held-out scan, and its own terms: the measurement model, never in the "
        "design.",
        "scans.csv",
    )


def _sentence_case(text: str) -> str:
    return text[:1].upper() + text[1:]


def _estimate_text(effect: AddedEffect) -> str:
    parts = []
    for name, p in effect.parameters.items():
        if p.ci95 is None:
            continue
        unit = "" if p.unit == "1" else f" {p.unit}"
        parts.append(f"{name} {p.value:.3g}{unit} [{p.ci95[0]:.3g}, {p.ci95[1]:.3g}]")
    return ", ".join(parts)
