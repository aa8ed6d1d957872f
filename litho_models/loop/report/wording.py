"""The words of report and terminal: verdict, errors, one paragraph for a process engineer, warnings."""

from __future__ import annotations

from collections.abc import Mapping

from litho_data.foundation.report import capitalised, spelt_out
from litho_models.effects import get_effect
from litho_models.frozen.readme import bounds_text
from litho_models.loop.findings import LoopFindings
from litho_models.loop.probes.far import in_words
from litho_models.loop.probes.layout import LAYOUT_FEATURES
from litho_models.loop.result.record import AddedEffect, CloseLoop, EqualTerms, NestedResult, Part
from litho_models.loop.selection.confirming import FEWEST_SCANS
from litho_models.scoring.pairs import OverUnits

# What counts as more than chance.
_CHANCE = 0.05


def verdict_text(result: CloseLoop) -> str:
    """The verdict, and with too few scans how many would do."""
    if result.verdict != "too-few-scans" or result.headline is None:
        return f"verdict: {result.verdict}"
    return (
        f"verdict: too-few-scans: {result.headline.over_scans.count} to work on; {FEWEST_SCANS} are needed "
        f"to confirm anything, {result.fewest_scans} to find that nothing is missing"
    )


def error_lines(result: CloseLoop) -> list[str]:
    """The errors before and after with the same terms per scan, whose the gain is, and the nested errors."""
    lines = ["held-out error (MAE) before -> after, with the same terms per scan:"]
    lines += [_row_text(row) for row in result.equal_terms or []]
    lines += [f"  {text}" for text in [parts_text(result)] if text]
    if result.nested is not None:
        lines.append(f"the same where everything was chosen without {_UNSEEN[result.nested.held_out]}:")
        lines += [_row_text(row) for row in result.nested.equal_terms]
        lines.append(f"  {chosen_text(result.nested)}")
    return lines


_UNSEEN = {"folds": "the scans it is judged on", "prints": "the print it is judged on"}


def chosen_text(nested: NestedResult) -> str:
    """How often each effect was chosen."""
    times = ", ".join(f"{one.name} {one.times}" for one in nested.chosen)
    return f"chosen in so many of {nested.selections} selections: {times or 'nothing'}"


def _row_text(row: EqualTerms) -> str:
    over = [over_text(row.over_scans, "scans")]
    if row.over_prints is not None:
        over.append(over_text(row.over_prints, "prints"))
    return (
        f"  {terms_text(row)}: {row.before.mae_nm:.2f} -> {row.after.mae_nm:.2f} nm; "
        f"gain {row.gain_nm:.2f} nm, {', '.join(over)}"
    )


def parts_text(result: CloseLoop) -> str:
    """Whose the gain is, in the order added: with one term per scan, and on the way to all accepted terms."""
    if not result.gain_split:
        return ""
    model, way = (result.gain_by_part(figure) for figure in ("in_order_k1_nm", "in_order_nm"))
    model.pop("per-scan", None)
    return (
        f"gain with k = 1, in the order added: {_listed(model)}; "
        f"on the way from k = 1 to k = {result.gain_split[-1].k:.0f}: {_listed(way)}"
    )


def _listed(parts: Mapping[Part, float]) -> str:
    return ", ".join(f"{part} {gain:.2f} nm" for part, gain in parts.items()) or "none"


def terms_text(row: EqualTerms) -> str:
    """What is free in each scan, with the number of terms before and after."""
    before, after = row.before.k, row.after.k
    number = f"k = {before:.0f}" + (f" and {after:.0f}" if round(before) != round(after) else "")
    return f"accepted terms, {number}" if row.terms == "accepted" else number


def over_text(over: OverUnits, unit: str) -> str:
    """Interval and p of a gain over scans or prints, and what so many can show at best."""
    interval = "no interval" if over.ci95_nm is None else "{:.2f} … {:.2f}".format(*over.ci95_nm)
    best = f", the smallest that {over.count} {unit} can have" if over.p <= over.smallest_p else ""
    return f"{interval} over {over.count} {unit} (better in {over.positive}, p = {over.p:.2g}{best})"


def headline_words(result: CloseLoop) -> str:
    """What was found missing, what it is worth, and whether that is more than chance."""
    before, after = result.before.mae_datum_free_nm, result.after.mae_datum_free_nm
    if result.verdict == "too-few-scans":
        found = result.headline.over_scans.count if result.headline else "These"
        return (
            f"{found} scans are too few to say what is missing: {FEWEST_SCANS} are needed to confirm "
            f"anything, {result.fewest_scans} to find that nothing is missing. The held-out error is "
            f"{before:.2f} nm."
        )
    if not result.effects:
        left = result.verdict == "unexplained"
        missing = "although something with structure is left" if left else "or needed"
        return f"Nothing was found to add, {missing}: the held-out error stays at {before:.2f} nm."
    causes, own, generic = _by_kind(result)
    lacking = ", ".join(get_effect(e.name).title for e in causes)
    terms = f"{len(generic)} generic {'terms' if len(generic) > 1 else 'term'}"
    if lacking:
        beside = f"Beside it {terms} without a name. " if generic else ""
        text = f"Missing from {result.base_model}: {lacking}. {beside}"
    else:
        nameless = f"What {result.base_model} lacks has no name: {terms}. "
        text = nameless if generic else f"{capitalised(result.base_model)} lacks nothing that shows. "
    if own:
        titles = [get_effect(e.name).title.removesuffix(" of the single scan") for e in own]
        text += f"Each scan has its own {', '.join(titles)}. "
    text += f"With all of it the held-out error goes from {before:.2f} to {after:.2f} nm"
    if result.headline is None:
        return f"{text}."
    over = result.headline.over_prints or result.headline.over_scans
    unit = "scans" if result.headline.over_prints is None else "prints"
    if over.smallest_p > _CHANCE:
        alike = result.headline.over_scans
        better = f"{alike.positive} of {alike.count} scans are better (p = {alike.p:.2g}), but "
        known = better if result.headline.over_prints and alike.p <= _CHANCE else ""
        return f"{text}; {known}{over.count} {unit} are too few to tell that from chance."
    sure = "more than chance" if over.p <= _CHANCE and after < before else "which may be chance"
    return f"{text}, {sure} (p = {over.p:.2g} over {over.count} {unit})."


def _by_kind(result: CloseLoop) -> tuple[list[AddedEffect], list[AddedEffect], list[AddedEffect]]:
    """Named causes, what single scans add, and generic terms."""
    generic = [e for e in result.effects if e.verdict == "traced-to-covariate"]
    named = [e for e in result.effects if e.verdict != "traced-to-covariate"]
    own = [e for e in named if get_effect(e.name).per_scan]
    return [e for e in named if not get_effect(e.name).per_scan], own, generic


def plain_words(findings: LoopFindings, result: CloseLoop) -> list[str]:
    """What was found, point by point, for a process engineer."""
    causes, scan_terms, traced = _by_kind(result)
    total = len(findings.development)
    parts = [
        f"On {total} scans, each predicted by a fit that has not seen it, the model is wrong by "
        f"{result.before.mae_abs_nm:.0f} nm as it stands and by {result.before.mae_datum_free_nm:.1f} nm "
        "once the "
        f"zero of each scan is freed. With everything added, and still only the zero free, it is wrong by "
        f"{result.after.mae_datum_free_nm:.1f} nm."
    ]
    microscope = [get_effect(e.name).title for e in scan_terms if e.role == "measurement"]
    written = [get_effect(e.name).title for e in scan_terms if e.role != "measurement"]
    if microscope:
        parts.append(
            f"The microscope accounts for: {', '.join(microscope)}. This says nothing about the printer."
        )
    if written:
        parts.append(f"Different in every print, so no model can predict it: {', '.join(written)}.")
    for e in causes:
        title = get_effect(e.name).title
        alike = f" (or {', '.join(e.confusable_with)}: these data cannot tell)" if e.confusable_with else ""
        parts.append(
            f"{capitalised(title)} [{e.name}]{alike}: {_estimate_text(e)}; with it the "
            f"held-out error falls from {e.before_nm:.2f} to {e.after_nm:.2f} nm, in "
            f"{e.scans_improved[0]} of "
            f"{e.scans_improved[1]} scans."
        )
        if e.verdict == "partial":
            parts.append(
                f"It is a part of what is missing, {100 * (e.share or 0.0):.0f} % of what layout and place "
                "explain in its place, and not the explanation; design does not use it."
            )
        if e.separating_experiment and (e.confusable_with or e.role == "undetermined"):
            parts.append(f"To be sure: {e.separating_experiment}.")
    parts += [
        f"Seen without a model [{seen.name}]: {seen.evidence}."
        for seen in findings.observed.values()
        if seen.seen
    ]
    if not causes and result.verdict != "too-few-scans":
        parts.append("No named effect of the printer is confirmed as missing from the model.")
    for e in traced:
        far = e.name == "far-response"
        says = "it says where the rest lives, not why"
        if e.name == LAYOUT_FEATURES:
            says = "what is left follows the layout, in a way that no covariate shows"
        follows = f", {in_words({k: p.value for k, p in e.parameters.items()})}," if far else ""
        parts.append(
            f"A generic term [{e.name}]{follows} lowers the held-out error from {e.before_nm:.2f} to "
            f"{e.after_nm:.2f} nm in {e.scans_improved[0]} of {e.scans_improved[1]} scans: "
            f"{says}, and design does not use it."
        )
    if result.residual.state == "unexplained":
        parts.append(f"What is left is still structured: {result.residual.signature}.")
    elif result.verdict != "too-few-scans":
        parts.append("What is left shows no structure that is shared between scans.")
    return parts


def warnings_for(findings: LoopFindings, result: CloseLoop) -> list[str]:
    warnings = []
    if result.run.dropped:
        warnings.append(f"Scans left out: {'; '.join(result.run.dropped)}")
    if findings.development[0].stored.write is None:
        warnings.append(
            "The card says nothing about the write field: each scan is taken as a write field of its "
            "own, its "
            "lines written along x, one below the other."
        )
    if len({scan.context.order for scan in findings.development}) > 2:
        warnings.append(
            "Effects of the writing order rest on the order given in the card; where it gives none, the "
            "sorted "
            "names of the scans stand for it, which is an assumption."
        )
    flagged = [findings.development[i].id for i in findings.probed.defects.suspicious]
    if flagged:
        warnings.append(f"More than 2 % of the pixels lie in localised defects: {', '.join(flagged)}.")
    if result.at_bounds:
        warnings.append(bounds_text(result.at_bounds))
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


def _estimate_text(effect: AddedEffect) -> str:
    parts = []
    for name, p in effect.parameters.items():
        if p.ci95 is None:
            continue
        unit = "" if p.unit == "1" else f" {p.unit}"
        # The key ends with the unit, which stands behind the number.
        words = spelt_out(name).partition(" (")[0]
        parts.append(f"{words} {p.value:.3g}{unit} ({p.ci95[0]:.3g} … {p.ci95[1]:.3g})")
    return ", ".join(parts)
