"""The judge: what the loop says against what was planted, and the error that the true models make.

The rules are written down in docs/blind_trials.md, before a board is run.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.blind_trials.planting import fab_of, plain_model, printer_of, share_of
from benchmarks.blind_trials.records import Draw, Found, Outcome, Planted, Verdict
from litho_data.register.resample import resample_to_layout
from litho_data.store import PrintedScan
from litho_data.virtual_fab import Job, Noise, scan_job
from litho_models.effects import CATALOGUE
from litho_models.loop.errors import error_rows
from litho_models.loop.record import CloseLoop
from litho_models.models.physics import Physics
from litho_models.scan_terms.grouped import label_of

# A form that is right under the name of a family only with this exponent.
_EXPONENT = {"cubic-slope-loss": 3.0}
_DISPLACED = "s-shaped-axis"
# Made of offsets of lines: to see those is to notice it.
_OF_LINES, _LINES = "periodic-lines", "scan-line-stripes"


def found_by(result: CloseLoop) -> list[Found]:
    """What the loop reports: causes, laws and descriptions, and what it sees in single scans."""
    added = [
        Found(names=[one.name, *one.confusable_with], knowledge=one.knowledge, by=one.by)
        for one in result.effects
    ]
    seen = [one for one in result.single_scans if one.seen]
    return added + [
        Found(names=[one.name, *one.confusable_with], knowledge="cause", by="scan") for one in seen
    ]


def _beyond_noise(found: Sequence[Found]) -> list[Found]:
    """Without what the fab's default noise has in every scan: datum, bow, offsets of lines, their like."""
    return [one for one in found if not (one.by == "scan" and one.names[0] in CATALOGUE)]


def judge(
    draw: Draw,
    planted: Sequence[Planted],
    result: CloseLoop,
    jobs: Sequence[Job],
    scans: Sequence[PrintedScan],
) -> list[Outcome]:
    """One outcome per planted cause, in order; one for the trial where nothing was planted.

    What the loop reports counts for one cause at most, for the larger one first.
    """
    found = found_by(result)
    rest = result.verdict == "unexplained" or any(one.matters for one in result.explained[-1:])
    left = rest or bool(_beyond_noise(found))
    if not draw.causes:
        return [Outcome(name="none", verdict="false-positive" if left else "clean")]
    verdicts: dict[str, Verdict] = {}
    causes = sorted(_own(draw, planted), key=lambda one: -one.rms_nm)
    pool = [one for one in found if one.knowledge == "cause"]
    for one in causes:
        name = one.draw.name
        hit = next((named for named in pool if _is_right(one, named, result)), None)
        if hit:
            pool.remove(hit)
            verdicts[name] = "right" if {*hit.names} <= {*one.names} else "set-contains-it"
        elif name == _DISPLACED and _displacement_is_shared(one, result, jobs, scans):
            verdicts[name] = "right"
    laws = sum(one.knowledge == "law" for one in found)
    for one in causes:
        if one.draw.name not in verdicts:
            absorbed = draw.kind == "alias" and not one.counts and _is_absorbed(one, result)
            lines = one.draw.name == _OF_LINES and any(_LINES in other.names for other in found)
            silent: Verdict = "absorbed" if absorbed else "noticed" if left or lines else "missed"
            verdicts[one.draw.name] = "lawful" if laws > 0 else silent
            laws -= 1
    return [Outcome(name=one.name, verdict=verdicts[one.name]) for one in draw.causes]


def false_names(planted: Sequence[Planted], result: CloseLoop) -> list[str]:
    """Sets of causes that the loop named and that have nothing of what was planted, base included."""
    return [
        " | ".join(named.names)
        for named in _beyond_noise(found_by(result))
        if named.knowledge == "cause" and not any(_is_right(one, named, result) for one in planted)
    ]


def _own(draw: Draw, planted: Sequence[Planted]) -> list[Planted]:
    """What was planted, the base's form aside."""
    return [one for one in planted if one.draw in draw.causes]


def _is_right(one: Planted, named: Found, result: CloseLoop) -> bool:
    if not {*one.names} & {*named.names}:
        return False
    wanted = _EXPONENT.get(one.draw.name)
    return wanted is None or any(
        own.ci95 is not None and own.ci95[0] <= wanted <= own.ci95[1]
        for effect in result.effects
        if effect.name == named.names[0]
        for own in effect.strengths.get("exponent", [])
    )


def _displacement_is_shared(
    one: Planted, result: CloseLoop, jobs: Sequence[Job], scans: Sequence[PrintedScan]
) -> bool:
    """Whether the measurement has a displacement along x by a grouping that parts the scans as planted."""
    strong = {job.id: share_of(one.draw, job) == 1 for job in jobs}
    for part in result.measurement.parts:
        if part.what == "shift-x":
            labels: dict[str, set[bool]] = {}
            for scan in scans:
                labels.setdefault(label_of(scan, part.by), set()).add(strong[scan.id])
            if all(len(kinds) == 1 for kinds in labels.values()):
                return True
    return False


def _is_absorbed(one: Planted, result: CloseLoop) -> bool:
    return any(own.name in one.names and own.verdict == "absorbed" for own in result.candidates)


# What no model of all scans can predict: values drawn anew in every scan (or line), rounding, and scars where
# chance put them. A bend stays in: the store's own transform of the scan has it.
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
    draw: Draw, planted: Sequence[Planted], jobs: Sequence[Job], scans: Sequence[PrintedScan], seed: int
) -> float:
    """Mean absolute error of the noise-free scans with every cause in place, k = 1, nm.

    They are brought onto the layout by the transform (and bend) that the store has for each scan, and
    scored as the loop scores its models: same scans, same pixels, same terms per scan.
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


def bias_of(draw: Draw, result: CloseLoop) -> tuple[float, float] | None:
    """Median of the relative errors of the base's values, as fitted alone and with all that was found.

    None if printer or base is no Physics model.
    """
    if draw.base or draw.kind == "measured" or result.base_model != "physics":
        return None
    model = plain_model(printer_of(draw))
    assert isinstance(model, Physics)
    true = {name: float(value.detach()) for name, value in model.values.items()}

    # The sd of the squared spot, where the base has it free.
    true["spot_um"] = printer_of(draw).spot_sigma_um / 2**0.5

    def error(values: dict[str, float]) -> float:
        return float(np.median([abs(values[name] / own - 1) for name, own in true.items() if name in values]))

    return error(result.base_values), error(result.corrected_values)
