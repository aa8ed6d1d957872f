"""Tables of the measured run: what the closed loop found, and the errors on the locked scans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.markdown_table import markdown_table, with_interval
from litho_models.effects import CATALOGUE
from litho_models.evaluation.zoo_making import HELD_OUT, OUT_OF_FOLD
from litho_models.frozen.card import ModelCard
from litho_models.loop.report.wording import chosen_text, terms_text
from litho_models.loop.result.record import EqualTerms, NestedResult, OverUnits


def equal_freedom_table(loops: Sequence[dict[str, Any]]) -> str:
    """Errors before and after with the same terms per scan, of loops on several base models."""
    rows = []
    for loop in loops:
        nested = loop.get("nested")
        rows += _equal_rows(loop["base_model"], loop["equal_terms"])
        if nested is not None:
            rows += _equal_rows(
                f"{loop['base_model']}, chosen anew ({nested['held_out']})", nested["equal_terms"]
            )
    first = EqualTerms.model_validate(loops[0]["equal_terms"][0])
    scans, prints = first.over_scans, first.over_prints
    best = (
        f" Scans of a print are not independent: what {prints.count} prints can show at best is "
        f"p = {prints.smallest_p:.3f}."
        if prints
        else ""
    )
    over = (f"over {scans.count} scans", f"over {prints.count} prints" if prints else "over prints")
    return markdown_table(
        ("loop on", "terms per scan", "before", "after", "gain", *over),
        rows,
        f"Mean absolute error on {scans.count} held-out scans, on the benchmark's pixels, "
        f"{_background(loops)}; terms are fitted on pixels that are not scored. Intervals of 95 % resample "
        "whole scans, or whole prints, and are those of the gain in the last columns, with how many of them "
        "are better. p of sign flips stands where it is not the smallest that so many can show "
        f"({scans.smallest_p:.2g} over scans). k of the accepted terms is an effective number: the "
        "same terms are free before and after, but line offsets are shrunk by what the residuals show."
        + best,
        *(_split_text(loop) for loop in loops if loop.get("gain_split")),
        *(_nested_text(loop) for loop in loops if loop.get("nested")),
        _names_text(loops),
    )


def _names_text(loops: Sequence[dict[str, Any]]) -> str:
    """What is found on each base, and what on every one."""
    found = {
        loop["base_model"]: [f"`{e['name']}` ({e['verdict']})" for e in loop["effects"] if not _of_scans(e)]
        for loop in loops
    }
    every = set.intersection(*(set(names) for names in found.values()))
    each = "; ".join(f"on {base} {', '.join(names) or 'nothing'}" for base, names in found.items())
    alike = ", ".join(sorted(every)) or "none"
    return f"Found beside terms of single scans: {each}. With the same verdict on every base: {alike}."


def _of_scans(effect: dict[str, Any]) -> bool:
    known = CATALOGUE.get(effect["name"])
    return known is not None and known.per_scan


def _equal_rows(name: str, equal_terms: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    return [
        (
            "" if place else name,
            terms_text(row),
            *(with_interval(side.mae_nm, side.mae_ci95_nm) for side in (row.before, row.after)),
            f"{row.gain_nm:.2f} nm",
            *map(_over_text, (row.over_scans, row.over_prints)),
        )
        for place, row in enumerate(map(EqualTerms.model_validate, equal_terms))
    ]


def _over_text(over: OverUnits | None) -> str:
    """Interval of a gain, how many scans or prints are better, and p where more could have been shown."""
    if over is None or over.ci95_nm is None:
        return "–"
    p = "" if over.p <= over.smallest_p else f", p = {over.p:.2g}"
    return "{:.2f} … {:.2f}".format(*over.ci95_nm) + f", better in {over.positive}{p}"


def _split_text(loop: dict[str, Any]) -> str:
    """The steps of the gain at k = 1, in the order added and left out of the final set."""
    steps = "; ".join(
        f"`{step['name']}` ({step['part']}) {step['in_order_k1_nm']:.2f} / {step['left_out_k1_nm']:.2f} nm"
        for step in loop["gain_split"]
        if step["part"] != "per-scan"
    )
    return (
        f"What each step gains on {loop['base_model']} at k = 1, in the order added / lost where it is left "
        f"out of the final set and the rest refitted: {steps or 'none but terms of single scans'}."
    )


def _nested_text(loop: dict[str, Any]) -> str:
    nested = NestedResult.model_validate(loop["nested"])
    return (
        f"Chosen anew on {loop['base_model']}: named effects, generic terms, terms of single scans, without "
        f"the {nested.held_out} that they are judged on: {chosen_text(nested)}."
    )


def _background(loops: Sequence[dict[str, Any]]) -> str:
    used = {loop["nuisance"].get("background", "none") for loop in loops}
    return {
        ("training",): "with the shared background of the benchmark",
        ("none",): "without the shared background of the benchmark",
    }.get(tuple(sorted(used)), "in part with the shared background")


# Slope terms were seen in the first look at all 24 scans, the locked ones among them.
SEEN_BEFORE = {"slope-thinning", "axis-slope-table"}


def loop_table(loop: dict[str, Any], on_physics: dict[str, Any] | None = None) -> str:
    """The closed loop step by step, then what is left.

    ``on_physics``: the loop on the Physics model, for what a network is said to carry.
    """
    before, after = loop["before"], loop["after"]
    rows = []
    for effect in loop["effects"]:
        alike = f" or {', '.join(effect['confusable_with'])}" if effect["confusable_with"] else ""
        known = ", known before" if effect["prior_hypothesis"] or effect["name"] in SEEN_BEFORE else ""
        figure = "absolute" if effect["name"] == "datum-offset" else "datum-free"
        better, count = effect["scans_improved"]
        rows.append(
            (
                f"`{effect['name']}`{alike}",
                f"{effect['role']}, {effect['verdict']}{known}",
                f"{effect['before_nm']:.2f} nm ({figure})",
                f"{effect['after_nm']:.2f} nm",
                " → ".join(f"{k:.0f}" for k in effect["terms_per_scan"]),
                f"{better} of {count}",
            )
        )
    signature = loop["residual"]["signature"]
    return markdown_table(
        ("step", "what it is", "held-out error before", "after", "terms per scan", "scans better"),
        rows,
        "Rows are the tests by which the steps were chosen, without the shared background. A row need not "
        "begin where the last one ended: before `tilt-bow` stands the mean tilt and bow of the training "
        "scans, both sides of a process effect leave each scan's shift, turn and stretch free, and both "
        "sides of one that acts as a gain go without the gain of single scans.",
        *_absorbed(loop, on_physics),
        f"Base model {loop['base_model']}, {loop['split']['folds']} folds by scan: "
        f"{before['mae_datum_free_nm']:.2f} nm before with the zero of each scan free, "
        f"{after['mae_datum_free_nm']:.2f} nm after with the same. {_background([loop]).capitalize()}. "
        f"What is left: {loop['residual']['state']}" + (f"; {signature}." if signature else "."),
        f"Made by `{loop['run']['command']}`.",
    )


def _absorbed(loop: dict[str, Any], on_physics: dict[str, Any] | None) -> list[str]:
    """What the Physics model lacks and the network does not.

    A network's loop screens on a Physics model in folds of its own, so it may take what the loop on Physics
    itself does not confirm: that is not called found.
    """
    absorbed = [c["name"] for c in loop["candidates"] if c["verdict"] == "absorbed"]
    if on_physics is None or not absorbed:
        return []
    confirmed = {
        name
        for effect in on_physics["effects"]
        if effect["verdict"] != "traced-to-covariate"
        for name in (effect["name"], *effect["confusable_with"])
    }
    found = [name for name in absorbed if name in confirmed]
    sentences = [f"Found on Physics and already carried by the network: {', '.join(found)}."] if found else []
    judged = {c["name"]: c for c in on_physics["candidates"]}
    sentences += [
        f"Taken on Physics in this run's own folds, without gain on the network: {name}. The loop on Physics "
        f"itself calls it {judged[name]['verdict']}: {judged[name]['reason']}."
        for name in absorbed
        if name not in confirmed
    ]
    return sentences


def locked_table(loop: dict[str, Any], cards: Sequence[ModelCard]) -> str:
    """The errors on the locked scans: the models of the zoo, and a loop before and after."""
    rows = []
    for card in cards:
        # The first of a name and policy is the one with the background.
        errors = {
            (metric.split, metric.name, metric.policy): metric.value for metric in reversed(card.metrics)
        }
        figures = [
            (HELD_OUT, "mae_datum_free", "offset"),
            (OUT_OF_FOLD, "mae_datum_free", "offset"),
            (HELD_OUT, "mae_datum_free", "full+rows"),
            (HELD_OUT, "mae_abs", "none"),
        ]
        rows.append(
            (
                f"`zoo:{card.name}`, {card.parameters:,} parameters",
                *(f"{errors[key]:.2f} nm" for key in figures),
            )
        )
    for when in ("before", "after"):
        rows.append((f"loop on {loop['base_model']}, {when}", *_locked_errors(loop, when)))
    locked = loop["split"]["lock_box"]
    others = loop["run"]["n_scans"] - len(locked)
    return markdown_table(
        (
            "",
            "zero of each scan free",
            "the same on the other scans, out of fold",
            "tilt, bow, gain and lines free too",
            "absolute error",
        ),
        rows,
        f"The {len(locked)} locked scans ({', '.join(locked)}), a check of optimism: models, recipes and "
        f"loops are chosen without them; all was fitted to the other {others}. Models: those of the package, "
        "with the background of their training scans. The loop: with one term per scan in the first column, "
        "and in the second with all that it accepted, the registration too, fitted on pixels that are not "
        f"scored; {_background([loop])}.",
    )


def _locked_errors(loop: dict[str, Any], when: str) -> tuple[str, str, str, str]:
    """With the zero of each scan free, there and out of fold; with the accepted terms; with none."""
    absolute = f"{loop[f'locked_{when}']['mae_abs_nm']:.2f} nm"
    locked, others = (
        {row["terms"]: row[when] for row in loop[rows]} for rows in ("locked_equal_terms", "equal_terms")
    )
    accepted = locked["accepted"]
    return (
        f"{locked['offset']['mae_nm']:.2f} nm",
        f"{others['offset']['mae_nm']:.2f} nm",
        f"{accepted['mae_nm']:.2f} nm, k = {accepted['k']:.0f}",
        absolute,
    )
