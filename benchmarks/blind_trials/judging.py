"""The judge: what the loop says against what was planted, and the error that the true models make.

The rules are written down in docs/blind_trials.md, before a board is run.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.blind_trials.planting import cause_of
from benchmarks.blind_trials.records import (
    COUNTS_FROM_RMS_NM,
    EMPTY,
    OTHER_FORM,
    Draw,
    ErrorPair,
    Judgement,
    Kind,
    Named,
    Outcome,
    Planted,
)
from litho_data.register.resample import resample_to_layout
from litho_data.store import Store
from litho_data.virtual_fab import Fab, Job, Noise, Truth, scan_job
from litho_data.virtual_fab.knobs import KnobBoard
from litho_models.effects import CATALOGUE
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.result.record import CloseLoop
from litho_models.loop.study import DATUM_FREE, names_to_terms, score

_CAUSES = ("explained", "confusable")
# Offsets of lines are what single scans add: to accept these is to notice a cause that is made of them.
_LINES = {"periodic-lines"}


def scan_terms(result: CloseLoop) -> list[str]:
    """Effects of single scans that the loop accepted: the nuisance span. Probes are no catalogue names."""
    return [e.name for e in result.effects if e.name in _span()]


def named_outside_span(result: CloseLoop, exported: Sequence[str] = ()) -> list[Named]:
    """What the loop reports beyond the nuisance span, which the default noise has in every scan anyway.

    Datum, gain, tilt and bow, offsets of lines, line-shaped roughness and warp of single scans are in it.

    Args:
        exported: names of the process effects in the model that the loop hands to design: whatever it says
            about them, they are used as causes.
    """
    span = _span()
    added = [effect for effect in result.effects if effect.name not in span]
    named = []
    for effect in added:
        used = effect.name in exported and effect.verdict not in _CAUSES
        verdict = "explained" if used else effect.verdict
        named.append(Named(names=[effect.name, *effect.confusable_with], verdict=verdict))
    known = span.union(*(one.names for one in named))
    # Some effects are seen without being added: rounding, scars.
    for one in result.candidates:
        if one.name not in known and one.verdict in ("explained", "partial"):
            named.append(Named(names=[one.name], verdict=one.verdict))
    return named


def strangers(named: Sequence[Named], planted: Sequence[Planted]) -> list[str]:
    """Causes that the loop named and that contain nothing of what was planted."""
    true = {one.effect for one in planted}
    return [" | ".join(n.names) for n in named if n.verdict in _CAUSES and not true & set(n.names)]


def judge(
    kind: Kind, planted: Sequence[Planted], result: CloseLoop, exported: Sequence[str] = ()
) -> list[Outcome]:
    """One outcome per planted cause; one for the trial where nothing was planted."""
    named = named_outside_span(result, exported)
    state = f"{result.verdict}; {result.residual.signature or result.residual.state}"
    if kind in EMPTY:
        judgement: Judgement = "false-positive" if named or _structured(result) else "clean"
        return [Outcome(effect="none", rms_nm=0.0, judgement=judgement, loop_says=state)]
    if kind in OTHER_FORM:
        (one,) = planted
        noticed = _judge_unnamed(one, named, result)
        return [Outcome(effect=one.name, rms_nm=one.rms_nm, judgement=noticed, loop_says=state)]
    return [
        Outcome(
            effect=one.effect,
            rms_nm=one.rms_nm,
            judgement=_judge_effect(one, named, planted, result),
            loop_says=_verdict_on(one.effect, result),
        )
        for one in planted
    ]


def _span() -> set[str]:
    return {name for name, effect in CATALOGUE.items() if effect.per_scan}


def _structured(result: CloseLoop) -> bool:
    return "unexplained" in (result.verdict, result.residual.state)


def _judge_unnamed(planted: Planted, named: Sequence[Named], result: CloseLoop) -> Judgement:
    verdicts = {one.verdict for one in named}
    if verdicts & {*_CAUSES}:
        return "named-a-cause"
    lines = planted.name in _LINES and "scan-line-stripes" in scan_terms(result)
    if lines or "traced-to-covariate" in verdicts:
        return "traced-to-covariate"
    if "partial" in verdicts:
        return "partial"
    return "unexplained" if _structured(result) else "missed"


def _judge_effect(
    one: Planted, named: Sequence[Named], planted: Sequence[Planted], result: CloseLoop
) -> Judgement:
    # All effects count here: a planted one may lie in the nuisance span, or be seen without a model.
    sets = [{e.name, *e.confusable_with} for e in result.effects if e.verdict in _CAUSES]
    sets += [{c.name} for c in result.candidates if c.verdict == "explained"]
    if {one.effect} in sets:
        return "right"
    if any(one.effect in members for members in sets):
        return "set-contains-it"
    if strangers(named, planted):
        return "wrong"
    if any(one.effect in n.names for n in named if n.verdict == "partial"):
        return "partial"
    absorbed = any(c.name == one.effect and c.verdict == "absorbed" for c in result.candidates)
    # Right for an alias only: what a refit of the base leaves of it is small.
    return "absorbed" if absorbed and one.rms_nm <= COUNTS_FROM_RMS_NM else "missed"


def _verdict_on(effect: str, result: CloseLoop) -> str:
    found = next((c for c in result.candidates if c.name == effect), None)
    return f"{found.verdict}: {found.reason}" if found else "not a candidate"


# What no model can predict: an offset drawn anew for every line is estimated from the other half of the
# pixels, as the loop does it; rounding cannot be undone, and scars lie where chance put them. The few
# values that other knobs draw per scan could be estimated almost exactly, so the true model knows them.
_UNFORESEEABLE = {"scan-line-stripes", "quantisation", "scars-and-spikes"}


def true_floor(
    truth: Truth, draw: Draw, planted: Sequence[Planted], jobs: Sequence[Job], store: Store, result: CloseLoop
) -> ErrorPair:
    """Held-out error of the noise-free scans with every effect in place, nm.

    They are brought onto the layout by the transform (and bend) that the store has for each scan, and
    scored as the loop scores its final model: development scans, same pixels, same terms per scan.
    """
    fab = _without_noise(truth, draw, planted)
    by_id = {job.id: job for job in jobs}
    locked = set(result.split.lock_box)
    scans = [scan for scan in store.scans() if scan.id not in locked]
    predictions = []
    for scan in scans:
        found = scan_job(fab, by_id[scan.id])
        height, valid = resample_to_layout(
            found.noiseless_um,
            scan.scan_to_layout,
            scan.shape,
            scan_pitch_um=(found.frame.pitch_um, found.frame.pitch_um),
            layout_pitch_um=scan.pitch_um,
            bend_um=scan.bend_um,
        )
        predictions.append(np.where(valid, height, np.float32(np.nanmean(height))))
    stripes = any(knob.name == "scan-line-stripes" for knob in truth.knobs)
    terms = DATUM_FREE | names_to_terms(scan_terms(result) + ["scan-line-stripes"] * stripes)
    errors = score(prepare_scans(scans), predictions, terms, result.nuisance.blocks)
    return ErrorPair(mae_nm=errors.mean_mae_nm, rmse_nm=errors.rmse_nm)


def _without_noise(truth: Truth, draw: Draw, planted: Sequence[Planted]) -> Fab:
    knobs = [knob.setting for knob in truth.knobs if knob.name not in _UNFORESEEABLE]
    return Fab(
        printer=truth.printer,
        microscope=truth.microscope,
        noise=Noise.off(),
        knobs=KnobBoard(knobs, truth.seed),
        seed=truth.seed,
        cause=cause_of(planted, draw.seed),
    )
