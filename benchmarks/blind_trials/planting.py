"""What a trial prints: its base parameters and fields, and what is planted at which strength.

A cause is sized by what the best refitted base cannot take up. The noise-free scans with it are fitted by
the Physics model, which contains the plain fab; each scan may add datum, gain, tilt, bow and an affine error
of its registration. The rms of what is left is the size of the cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.blind_trials.other_forms import FORMS, FormCause
from benchmarks.blind_trials.records import Draw, KnobDraw, Planted
from litho_data.store import PrintedScan
from litho_data.virtual_fab import KNOBS, Job, KnobSetting, Printer, knob_rms_nm, strength_for_rms
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import OFF_CATALOGUE, KnobBoard
from litho_data.virtual_fab.settings import Microscope, Noise
from litho_data.virtual_fab.strength import NOISE_KNOB, search_strength
from litho_models.fitting.least_squares import Linearised, Rules, fit_least_squares, gram, orthonormal
from litho_models.fitting.small_models import ModelProblem
from litho_models.models import build_model
from litho_models.scan_terms import POLICIES
from litho_models.simulator import Simulator

# strength_for_rms refuses a knob that leaves less than this under the policy.
_TRACE_NM = 1e-3
_SCAN_TERMS = POLICIES["full"] | {"warp"}
_RULES = Rules("squares", relative_gain=5e-3)
# A strength is sought on four scans (both cut-offs, all of the order) and measured on all.
_SOUGHT_ON = 4
_PRECISION = 0.03


def printer_of(draw: Draw) -> Printer:
    """The printer of a trial: the default one but for what was drawn."""
    return replace(Printer(), **draw.printer)  # type: ignore[arg-type]


def trial_jobs(draw: Draw, n_scans: int, size_px: int) -> tuple[Job, ...]:
    """The fields that a trial prints; the same as of ``litho-data simulate`` at this seed."""
    return tuple(random_jobs(Plan(n_scans, (size_px, size_px)), printer_of(draw), draw.seed))


def plant(draw: Draw, jobs: Sequence[Job]) -> list[Planted]:
    """Strengths that give the drawn sizes on these fields, each cause by itself.

    Where the range of a strength ends before, the largest value is used and the size that it reached is
    recorded: nothing is drawn anew. Boards up to seed 20266 sized without a refit. So is an alias, most of
    which a refit takes up by definition; what is left of it is then measured.
    """
    if draw.kind in ("in-form", "other-form"):
        return [_sized_by_refit(knob, jobs, draw) for knob in draw.knobs]
    planted = [_sized_by_scan_terms(knob, jobs, draw) for knob in draw.knobs]
    if draw.kind == "alias":
        return [one.model_copy(update={"rms_nm": _refitted(one, jobs, draw)}) for one in planted]
    return planted


def knob_settings(planted: Sequence[Planted], seed: int) -> list[KnobSetting]:
    """Settings of the knobs among what was planted."""
    return [KnobSetting(one.name, one.strength, seed) for one in planted if one.name in KNOBS]


def cause_of(planted: Sequence[Planted], seed: int) -> FormCause | None:
    """The cause of another form, if one was planted."""
    forms = [FormCause(one.name, one.strength, seed) for one in planted if one.name in FORMS]
    return forms[0] if forms else None


def refitted_rms_nm(heights_um: Sequence[np.ndarray], jobs: Sequence[Job], printer: Printer) -> float:
    """Rms of what a refitted Physics model and the scans' own terms leave of noise-free prints, nm.

    Args:
        heights_um: (y, x) on the layout's grid, µm, one per job.
        printer: whose parameters the fit starts from.
    """
    scans = [_as_scan(job, height, printer) for job, height in zip(jobs, heights_um, strict=True)]
    model = plain_model(printer)
    start = np.concatenate([p.detach().numpy().ravel() for p in model.parameters()])
    fitted = fit_least_squares(_Refit(model, scans, _SCAN_TERMS), start, _RULES)
    left = [
        float(gram(part.residual[:, None], part.basis.T)[0, 0]) / len(part.residual) for part in fitted.linear
    ]
    return 1e3 * float(np.sqrt(np.mean(left)))


class _Refit(ModelProblem):
    """The model's own problem, the terms of each scan made orthonormal as sums of squares want them."""

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        return [replace(part, basis=orthonormal(part.basis.T).T) for part in super().linearise(vector)]


def plain_model(printer: Printer) -> Simulator:
    """The Physics model at the values at which it is the plain fab."""
    return build_model(
        "physics",
        pitch_um=printer.pitch_um,
        level_height_um=printer.level_height_um,
        levels=printer.levels,
        sigma_optical_um=printer.spot_sigma_um / 2**0.5,
        # A normalised logistic of steepness s is a normalised tanh of steepness s/2.
        alpha_init=printer.threshold_steepness / 2,
        eta_init=printer.threshold_dose,
        kappa_min_init=printer.loose_retention,
        sigma_diffusion_init_um=printer.network_reach_um,
        bias_init_um=printer.base_um,
    )


def _as_scan(job: Job, height_um: np.ndarray, printer: Printer) -> PrintedScan:
    return PrintedScan(
        id=job.id,
        print_id="",
        order=job.index,
        mask_level=job.level,
        height_um=height_um.astype(np.float32),
        valid=np.ones(height_um.shape, bool),
        pitch_um=printer.pitch_um,
        level_height_um=printer.level_height_um,
        levels=printer.levels,
        scan_to_layout=np.eye(3),
    )


def _noise_free(name: str, strength: float, jobs: Sequence[Job], draw: Draw) -> list[np.ndarray]:
    """Scans with one cause, without noise and on the layout's grid, µm."""
    knobs = [KnobSetting(name, strength, draw.seed)] if name in KNOBS else []
    cause = None if name in KNOBS else FormCause(name, strength, draw.seed)
    board = KnobBoard(knobs, draw.seed)
    fab = Fab(printer_of(draw), Microscope.aligned(), Noise.off(), board, draw.seed, cause)
    scans = [scan_job(fab, job).noiseless_um for job in jobs]
    # Scan and layout share their middle.
    margins = [(scan.shape[0] - job.level.shape[0]) // 2 for scan, job in zip(scans, jobs, strict=True)]
    return [scan[m : len(scan) - m, m : len(scan) - m] for scan, m in zip(scans, margins, strict=True)]


def _refitted(one: Planted, jobs: Sequence[Job], draw: Draw) -> float:
    return refitted_rms_nm(_noise_free(one.name, one.strength, jobs, draw), jobs, printer_of(draw))


def _sized_by_refit(drawn: KnobDraw, jobs: Sequence[Job], draw: Draw) -> Planted:
    wanted = drawn.wanted_rms_nm
    few = [jobs[i] for i in np.linspace(0, len(jobs) - 1, min(_SOUGHT_ON, len(jobs))).round().astype(int)]

    def on(fields: Sequence[Job]) -> Callable[[float], float]:
        return lambda strength: refitted_rms_nm(
            _noise_free(drawn.name, strength, fields, draw), fields, printer_of(draw)
        )

    limit = _limit(drawn.name)
    strength, at_limit = limit, on(few)(limit)
    if at_limit > wanted:
        strength, _ = search_strength(
            on(few), wanted, highest=limit, at_highest=at_limit, precision=_PRECISION
        )
    return _planted(drawn, strength, on(jobs)(strength))


def _sized_by_scan_terms(drawn: KnobDraw, jobs: Sequence[Job], draw: Draw) -> Planted:
    """The size of the noise-free scans with minus without the knob, freed of the scans' own terms only."""
    wanted, printer = drawn.wanted_rms_nm, printer_of(draw)
    highest = KnobSetting(drawn.name, _limit(drawn.name), draw.seed)
    if drawn.name != NOISE_KNOB:
        reached = knob_rms_nm(highest, jobs, printer=printer)
        if reached <= max(wanted, _TRACE_NM):
            return _planted(drawn, highest.strength, reached)
    found = strength_for_rms(drawn.name, wanted, jobs=jobs, seed=draw.seed, printer=printer)
    return _planted(drawn, found.setting.strength, found.rms_nm)


def _limit(name: str) -> float:
    return KNOBS[name].limit if name in KNOBS else FORMS[name].limit


def _planted(drawn: KnobDraw, strength: float, rms_nm: float) -> Planted:
    knob = KNOBS.get(drawn.name)
    return Planted(
        name=drawn.name,
        effect=knob.effect if knob else OFF_CATALOGUE,
        strength=strength,
        unit=knob.unit if knob else FORMS[drawn.name].unit,
        at_limit=strength == _limit(drawn.name),
        wanted_rms_nm=drawn.wanted_rms_nm,
        rms_nm=rms_nm,
        nuisance_span=bool(knob and knob.nuisance_span),
    )
