"""The judge: what the loop says against what was planted."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.blind_trials.records import Judgement, Kind, Named, Outcome, Planted
from litho_models.effects import CATALOGUE
from litho_models.loop.result.record import CloseLoop

_CAUSES = ("explained", "confusable")


def scan_terms(result: CloseLoop) -> list[str]:
    """Effects of single scans that the loop accepted: the nuisance span. Probes are no catalogue names."""
    return [e.name for e in result.effects if e.name in CATALOGUE and CATALOGUE[e.name].per_scan]


def named_outside_span(result: CloseLoop) -> list[Named]:
    """Effects that the loop added, without what the default noise has in every scan anyway.

    Datum, gain, tilt and bow, line offsets and warp of single scans are in the nuisance span.
    """
    span = scan_terms(result)
    return [
        Named(names=[effect.name, *effect.confusable_with], verdict=effect.verdict)
        for effect in result.effects
        if effect.name not in span
    ]


def strangers(named: Sequence[Named], planted: Sequence[Planted]) -> list[str]:
    """Causes that the loop named and that contain nothing of what was planted."""
    true = {one.effect for one in planted}
    return [" | ".join(n.names) for n in named if n.verdict in _CAUSES and not true & set(n.names)]


def judge(kind: Kind, planted: Sequence[Planted], result: CloseLoop) -> list[Outcome]:
    """One outcome per planted effect; one for the trial where there is no nameable effect."""
    named = named_outside_span(result)
    state = f"{result.verdict}; {result.residual.signature or result.residual.state}"
    if kind == "none":
        judgement: Judgement = "false-positive" if named else "clean"
        return [Outcome(effect="none", rms_nm=0.0, judgement=judgement, loop_says=state)]
    if kind == "off-catalogue":
        (one,) = planted
        honesty = _judge_unnamed(named, result)
        return [Outcome(effect=one.name, rms_nm=one.rms_nm, judgement=honesty, loop_says=state)]
    return [
        Outcome(
            effect=one.effect,
            rms_nm=one.rms_nm,
            judgement=_judge_effect(one.effect, named, planted, result),
            loop_says=_verdict_on(one.effect, result),
        )
        for one in planted
    ]


def _judge_unnamed(named: Sequence[Named], result: CloseLoop) -> Judgement:
    if any(one.verdict in _CAUSES for one in named):
        return "named-a-cause"
    if named:
        return "traced-to-covariate"
    return "unexplained" if result.verdict == "unexplained" else "missed"


def _judge_effect(
    effect: str, named: Sequence[Named], planted: Sequence[Planted], result: CloseLoop
) -> Judgement:
    # All effects count here: a planted one may lie in the nuisance span, or be seen without a model.
    sets = [{e.name, *e.confusable_with} for e in result.effects if e.verdict in _CAUSES]
    sets += [{c.name} for c in result.candidates if c.verdict == "explained"]
    if {effect} in sets:
        return "right"
    if any(effect in members for members in sets):
        return "set-contains-it"
    return "wrong" if strangers(named, planted) else "missed"


def _verdict_on(effect: str, result: CloseLoop) -> str:
    found = next((c for c in result.candidates if c.name == effect), None)
    return f"{found.verdict}: {found.reason}" if found else "not a candidate"
