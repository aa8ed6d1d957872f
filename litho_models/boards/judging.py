"""Compare the causes that a loop names with the planted causes. Also compare the error of its corrected model
with the error of the true models.

The rules for both comparisons were stated in docs/blind_trials.md before any board was run.
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from litho_data.register.resample import resample_to_layout
from litho_data.store import PrintedScan, Store
from litho_data.virtual_fab import Job, Noise, scan_job
from litho_models.boards.planting import fab_of, plain_model, printer_of, share_of
from litho_models.boards.records import Answer, Draw, Found, Outcome, Planted, Trial, TrialErrors, Verdict
from litho_models.effects import CATALOGUE
from litho_models.loop.errors import error_rows
from litho_models.models.physics import Physics
from litho_models.scan_terms.grouped import label_of

# A right name for one of these forms counts only if the loop also states the exponent of a power law. Its
# confidence interval must contain this value.
_EXPONENT = {"cubic-slope-loss": 3.0}
_DISPLACED = "s-shaped-axis"
# The form ``periodic-lines`` consists of line offsets, so a loop that reports line offsets counts as having
# noticed it.
_OF_LINES, _LINES = "periodic-lines", "scan-line-stripes"


def _beyond_noise(found: Sequence[Found]) -> list[Found]:
    """Return all findings except those about per-scan terms of the loop's catalogue, such as datum, bow or
    line offsets. The default noise of the virtual fab adds such terms to every scan.
    """
    return [one for one in found if not (one.by == "scan" and one.names[0] in CATALOGUE)]


def judged(
    draw: Draw, planted: Sequence[Planted], answer: Answer, jobs: Sequence[Job], store: Store, used_s: float
) -> Trial:
    """Judge one trial.

    Args:
        draw: the trial as drawn.
        planted: the planted causes with their strengths, as returned by `plant`.
        answer: answer of the loop.
        jobs: the printed fields.
        store: dataset store that the loop received.
        used_s: CPU time that the loop used, s.
    """
    locked = set(store.locked_ids)
    scans = [scan for scan in store.scans() if scan.id not in locked]
    errors = None
    if answer.before_nm is not None and answer.after_nm is not None:
        floor_nm = None if draw.kind == "measured" else true_floor(draw, planted, jobs, scans)
        errors = TrialErrors(before_nm=answer.before_nm, after_nm=answer.after_nm, floor_nm=floor_nm)
    return Trial(
        draw=draw,
        planted=list(planted),
        outcomes=judge(draw, planted, answer, jobs, scans),
        false_names=false_names(planted, answer),
        found=answer.found,
        errors=errors,
        bias=bias_of(draw, answer),
        dataset_cpu_s=used_s,
    )


def judge(
    draw: Draw,
    planted: Sequence[Planted],
    answer: Answer,
    jobs: Sequence[Job],
    scans: Sequence[PrintedScan],
) -> list[Outcome]:
    """Return one outcome per planted cause, in the order of the causes.

    If nothing was planted, the list contains a single outcome for the whole trial.

    Each finding is matched with at most one cause. The causes are matched in order of size, the largest
    first.
    """
    found = answer.found
    left = answer.left or bool(_beyond_noise(found))
    if not draw.causes:
        return [Outcome(name="none", verdict="false-positive" if left else "clean")]
    verdicts: dict[str, Verdict] = {}
    causes = sorted(_own(draw, planted), key=lambda one: -one.rms_nm)
    pool = [one for one in found if one.knowledge == "cause"]
    for one in causes:
        name = one.draw.name
        hit = next((named for named in pool if _is_right(one, named)), None)
        if hit:
            pool.remove(hit)
            verdicts[name] = "right" if {*hit.names} <= {*one.names} else "set-contains-it"
        elif name == _DISPLACED and _displacement_is_shared(one, answer, jobs, scans):
            verdicts[name] = "right"
    laws = sum(one.knowledge == "law" for one in found)
    for one in causes:
        if one.draw.name not in verdicts:
            absorbed = (
                draw.kind == "alias" and not one.counts and any(own in one.names for own in answer.absorbed)
            )
            lines = one.draw.name == _OF_LINES and any(_LINES in other.names for other in found)
            silent: Verdict = "absorbed" if absorbed else "noticed" if left or lines else "missed"
            verdicts[one.draw.name] = "lawful" if laws > 0 else silent
            laws -= 1
    return [Outcome(name=one.name, verdict=verdicts[one.name]) for one in draw.causes]


def false_names(planted: Sequence[Planted], answer: Answer) -> list[str]:
    """Return the wrong findings. Only findings that name a cause are considered. Such a finding is wrong
    unless it is the right answer for one of the planted causes. The form that changes the printer
    (``base`` of the draw) counts as one of the planted causes.
    """
    return [
        " | ".join(named.names)
        for named in _beyond_noise(answer.found)
        if named.knowledge == "cause" and not any(_is_right(one, named) for one in planted)
    ]


def _own(draw: Draw, planted: Sequence[Planted]) -> list[Planted]:
    """Return the planted causes without the form that changes the printer."""
    return [one for one in planted if one.draw in draw.causes]


def _is_right(one: Planted, named: Found) -> bool:
    if not {*one.names} & {*named.names}:
        return False
    wanted = _EXPONENT.get(one.draw.name)
    return wanted is None or any(low <= wanted <= high for low, high in named.exponents)


def _displacement_is_shared(
    one: Planted, answer: Answer, jobs: Sequence[Job], scans: Sequence[PrintedScan]
) -> bool:
    """Return whether the loop found a displacement along x that the scans of each group share. The finding
    counts only if no group contains both strongly and weakly displaced scans.
    """
    strong = {job.id: share_of(one.draw, job) == 1 for job in jobs}
    for grouping in answer.displaced_by:
        labels: dict[str, set[bool]] = {}
        for scan in scans:
            labels.setdefault(label_of(scan, grouping), set()).add(strong[scan.id])
        if all(len(kinds) == 1 for kinds in labels.values()):
            return True
    return False


# A single model of all scans cannot predict rounding, scars at random positions, or values that are drawn
# anew for every scan or line. Bends of the scans are not listed here, because the registration transforms in
# the store already contain them.
_UNFORESEEABLE = {
    "datum-offset",
    "min-to-zero-datum",
    "periodic-lines",
    "quantisation",
    "scan-line-stripes",
    "scars-and-spikes",
    "slow-drift",
    "tilt-bow",
    "z-gain",
}


def true_floor(
    draw: Draw, planted: Sequence[Planted], jobs: Sequence[Job], scans: Sequence[PrintedScan], seed: int = 0
) -> float:
    """Return the mean absolute error, nm, of a model that contains the true causes exactly. One term (the
    datum) is fitted to each scan.

    The predictions are noise-free scans that contain all planted causes. Each predicted scan is mapped onto
    the layout with the transform and the bend that the store contains for this scan. The error is computed
    over the same scans and pixels as the scores of the loop, with the same per-scan terms.
    """
    by_id = {job.id: job for job in jobs}
    predictions = []
    for scan in scans:
        job = by_id[scan.id]
        fab = fab_of(draw, planted, job, noise=Noise.off(), without=_UNFORESEEABLE)
        found = scan_job(fab, job)
        height, valid = resample_to_layout(
            found.noiseless_um,
            scan.scan_to_layout,
            scan.shape,
            scan_pitch_um=(found.frame.pitch_um, found.frame.pitch_um),
            layout_pitch_um=scan.pitch_um,
            bend_um=scan.bend_um,
        )
        predictions.append(np.where(valid, height, np.float32(np.nanmean(height))))
    rows = error_rows(
        scans, predictions, model="all", measurement="shared", held_out="scans", numbers=(0, 0), seed=seed
    )
    return next(row.mae_nm for row in rows if row.policy == "offset")


def bias_of(draw: Draw, answer: Answer) -> tuple[float, float] | None:
    """Return the median relative error of the base model's physical values for two fits: without the loop's
    findings, and with them.

    Return None if the printer or the base model is not a Physics model.
    """
    if draw.base or draw.kind == "measured" or not answer.base_values:
        return None
    model = plain_model(printer_of(draw))
    assert isinstance(model, Physics)
    true = {name: float(value.detach()) for name, value in model.values.items()}

    def error(values: dict[str, float]) -> float:
        return float(np.median([abs(values[name] / own - 1) for name, own in true.items() if name in values]))

    return error(answer.base_values), error(answer.corrected_values)


def broken(draw: Draw, error: Exception, planted: list[Planted], places: Mapping[Path, str]) -> Trial:
    """Make the record of a trial that ended with an exception, and print the exception.

    The text of the exception is published. Local paths in this text are therefore replaced by names;
    ``places`` contains the name for each path.
    """
    traceback.print_exception(error)
    reason = f"{type(error).__name__}: {error}"
    for place, name in places.items():
        reason = reason.replace(str(place), name)
    return failed(draw, reason, planted)


def failed(draw: Draw, reason: str, planted: list[Planted] | None = None) -> Trial:
    """Make the record of a trial that did not finish."""
    names = [one.name for one in draw.causes] or ["none"]
    return Trial(
        draw=draw,
        planted=planted or [],
        outcomes=[Outcome(name=name, verdict="failed") for name in names],
        failure=" ".join(reason.split()),
    )
