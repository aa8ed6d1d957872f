"""From a drawn size to a knob's strength, and the fields of a trial."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.blind_trials.records import Draw, KnobDraw, Planted
from litho_data.virtual_fab import KNOBS, Job, KnobSetting, Printer, knob_rms_nm, strength_for_rms
from litho_data.virtual_fab.jobs import Plan, random_jobs

# Noise by nature: no noise-free scan shows it, its strength is its rms.
_NOISE_KNOB = "line-roughness"
# strength_for_rms refuses a knob that leaves less than this under the policy.
_TRACE_NM = 1e-3


def trial_jobs(draw: Draw, n_scans: int, size_px: int) -> tuple[Job, ...]:
    """The fields that a trial prints; the same as of ``litho-data simulate`` at this seed."""
    return tuple(random_jobs(Plan(n_scans, (size_px, size_px)), Printer(), draw.seed))


def plant(draw: Draw, jobs: Sequence[Job]) -> list[Planted]:
    """Strengths that give the drawn sizes on these fields, each knob by itself.

    Where a knob's range ends before, it is set to its largest value and the size that it reached is
    recorded: nothing is drawn anew.
    """
    return [_set(knob, jobs, draw.seed) for knob in draw.knobs]


def _set(drawn: KnobDraw, jobs: Sequence[Job], seed: int) -> Planted:
    knob, wanted = KNOBS[drawn.name], drawn.wanted_rms_nm
    highest = KnobSetting(knob.name, knob.limit, seed)
    if knob.name == _NOISE_KNOB:
        strength = rms_nm = min(wanted, knob.limit)
    elif (reached := knob_rms_nm(highest, jobs)) <= max(wanted, _TRACE_NM):
        strength, rms_nm = knob.limit, reached
    else:
        found = strength_for_rms(knob.name, wanted, jobs=jobs, seed=seed)
        strength, rms_nm = found.setting.strength, found.rms_nm
    return Planted(
        name=knob.name,
        effect=knob.effect,
        strength=strength,
        unit=knob.unit,
        at_limit=strength == knob.limit,
        wanted_rms_nm=wanted,
        rms_nm=rms_nm,
        nuisance_span=knob.nuisance_span,
    )


def settings(planted: Sequence[Planted], seed: int) -> list[KnobSetting]:
    """Knob settings of what was planted."""
    return [KnobSetting(one.name, one.strength, seed) for one in planted]
