"""Tables of the measured run: what the closed loop found, and the errors on the locked scans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.markdown_table import markdown_table, with_interval
from litho_models.evaluation.zoo_making import HELD_OUT
from litho_models.frozen.card import ModelCard

# Of results that do not record where the offsets of lines came from.
OLDER_PIXELS = (
    "Scored before line offsets came from the other side of the scan, the loop without a border of 8 px: "
    "to be made again on the benchmark's pixels."
)


def loop_table(loop: dict[str, Any], on_physics: dict[str, Any] | None = None) -> str:
    """The closed loop step by step, then what is left.

    ``on_physics``: the loop on the Physics model, for what a network is said to carry.
    """
    before, after = loop["before"], loop["after"]
    rows = []
    for effect in loop["effects"]:
        alike = f" or {', '.join(effect['confusable_with'])}" if effect["confusable_with"] else ""
        known = ", known before" if effect["prior_hypothesis"] else ""
        figure = "absolute" if effect["name"] == "datum-offset" else "datum-free"
        better, count = effect["scans_improved"]
        rows.append(
            (
                f"`{effect['name']}`{alike}",
                f"{effect['role']}, {effect['verdict']}{known}",
                f"{effect['before_nm']:.2f} nm ({figure})",
                f"{effect['after_nm']:.2f} nm",
                f"{better} of {count}",
            )
        )
    return markdown_table(
        ("step", "what it is", "held-out error before", "after", "scans better"),
        rows,
        "A row need not begin where the last one ended: both sides of a process effect leave each scan's "
        "shift, turn and stretch free, and both sides of one that acts as a gain go without the gain of "
        "single scans.",
        *_absorbed(loop, on_physics),
        f"Base model {loop['base_model']}: datum-free {before['mae_datum_free_nm']:.2f} nm before, "
        f"{after['mae_datum_free_nm']:.2f} nm after, {loop['split']['folds']} folds by scan. "
        f"What is left: {loop['residual']['state']}"
        + (f"; it {loop['residual']['signature']}." if loop["residual"]["signature"] else "."),
        *_older_pixels([loop]),
    )


def _older_pixels(loops: Sequence[dict[str, Any]]) -> list[str]:
    return [OLDER_PIXELS] if any(loop["nuisance"].get("line_gap_px") is None for loop in loops) else []


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


def locked_table(loops: Sequence[dict[str, Any]], cards: Sequence[ModelCard]) -> str:
    """The errors on the locked scans: the models of the zoo, and both loops before and after."""
    rows = []
    for card in cards:
        # The first of a name and policy is the one with the background.
        held_out = [metric for metric in reversed(card.metrics) if metric.split == HELD_OUT]
        errors = {(metric.name, metric.policy): metric.value for metric in held_out}
        figures = [("mae_datum_free", "offset"), ("mae_datum_free", "full+rows"), ("mae_abs", "none")]
        rows.append((card.name, *(f"{errors[key]:.2f} nm" for key in figures)))
    for loop in loops:
        before, after = (
            (with_interval(state["mae_datum_free_nm"], state["mae_datum_free_ci95_nm"]), state["mae_abs_nm"])
            for state in (loop["locked_before"], loop["locked_after"])
        )
        rows.append((f"loop on {loop['base_model']}, before", before[0], "–", f"{before[1]:.2f} nm"))
        rows.append((f"loop on {loop['base_model']}, after", "–", after[0], f"{after[1]:.2f} nm"))
    locked = loops[0]["split"]["lock_box"]
    others = loops[0]["run"]["n_scans"] - len(locked)
    return markdown_table(
        ("", "zero of each scan free", "tilt, bow, gain and lines free too", "absolute error"),
        rows,
        f"The {len(locked)} locked scans ({', '.join(locked)}), scored once, when model, recipe and loop "
        f"had been settled; all was fitted to the other {others}. Models: those of the package, with the "
        "background of their training scans. The loops on Physics and on PBL free what they accepted of "
        "single scans, on pixels that are not scored, the first the registration too.",
        *_older_pixels(loops),
    )
