"""Find the strengths of the causes of a trial, and simulate its prints and scans with these causes.

The size of a cause is the rms residual that remains if the base model is refitted to prints with this cause.
To measure it, each base model that the loop may choose is fitted to noise-free scans that contain the cause,
and the smallest residual counts. (Without causes, the Physics model represents the virtual fab exactly.)
Datum, gain, tilt, bow and an affine registration error are fitted to each scan at the same time.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.layouts.card_text import write_card, write_layout
from litho_data.readers.text_matrix import write_text_matrix
from litho_data.store import PrintedScan
from litho_data.virtual_fab import KNOBS, Fab, Job, KnobSetting, Microscope, Noise, Printer, scan_job
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.strength import knob_rms_nm, search_strength
from litho_models.boards.draws import names_of
from litho_models.boards.other_forms import FORMS, FormCause
from litho_models.boards.records import CauseDraw, Draw, Planted
from litho_models.fitting.base_models import base_models
from litho_models.fitting.least_squares import Linearised, Rules, fit_least_squares, gram, orthonormal
from litho_models.fitting.small_models import ModelProblem, fitted_numbers
from litho_models.scan_terms import POLICIES
from litho_models.simulator import Simulator

_SCAN_TERMS = POLICIES["full"] | {"warp"}
_RULES = Rules("squares", relative_gain=5e-3)
# The search for a strength uses four scans. They are spread over the printing order and over the two cut-off
# frequencies with which layouts are drawn. If the cause is weaker in some scans, both strong and weak scans
# are used. To save time, only the Physics model is fitted. The size of the cause is then measured on all
# scans, with all base models.
_SOUGHT_ON = 4
_PRECISION = 0.03
# The Physics model imitates a knob if a refit leaves less than this share of the change that the knob makes.
# A refit leaves 5 to 7 % of a moderate blur, and at least 23 % of any other knob.
_IMITATED = 0.12


def printer_of(draw: Draw) -> Printer:
    """Return the printer of a trial: the default printer with the drawn parameters."""
    return replace(Printer(), **draw.printer)  # type: ignore[arg-type]


def trial_jobs(draw: Draw, n_scans: int, size_px: int) -> tuple[Job, ...]:
    """Make the fields of a trial. They are the fields that ``litho-data simulate`` makes with the seed of the
    trial.
    """
    return tuple(random_jobs(Plan(n_scans, (size_px, size_px)), printer_of(draw), draw.seed))


def share_of(cause: CauseDraw, job: Job) -> float:
    """Return the strength of a cause in one scan, as a fraction of its full strength."""
    if cause.by == "all":
        return 1.0
    strong = job.id[-1] in cause.place if cause.by == "field" else job.order <= float(cause.place)
    return 1.0 if strong else cause.weak


def fab_of(
    draw: Draw,
    planted: Sequence[Planted],
    job: Job,
    *,
    noise: Noise | None = None,
    microscope: Microscope | None = None,
    without: Collection[str] = (),
) -> Fab:
    """Make the fab that prints and scans one field, with all planted causes at their strength in this field.

    Args:
        draw: the trial as drawn.
        planted: the planted causes with their strengths, as returned by `plant`.
        noise, microscope: if given, they replace the default noise and the default microscope of the virtual
            fab.
        without: names of causes to leave out.
    """
    strength = {one.draw.name: one.strength * share_of(one.draw, job) for one in planted}
    strength = {name: own for name, own in strength.items() if name not in without}
    return Fab(
        printer=printer_of(draw),
        microscope=microscope or Microscope(),
        noise=noise or Noise(),
        knobs=KnobBoard(
            [KnobSetting(n, own, draw.seed) for n, own in strength.items() if n in KNOBS], draw.seed
        ),
        seed=draw.seed,
        cause=FormCause({n: own for n, own in strength.items() if n in FORMS}, draw.seed),
    )


def plant(draw: Draw, jobs: Sequence[Job], base: str) -> list[Planted]:
    """Find the strength at which each drawn cause has its drawn size for the Physics model. Then measure its
    size for the base model that fits best. The sizes are measured in the given fields, in which only this
    cause is planted. ``base`` is the name of the loop's base model, or ``auto`` for several.

    If the draw has a form that changes the printer (``base``), this form comes first in the result.

    If a cause cannot reach its drawn size, it is planted at its largest allowed strength, and the size at
    this strength is recorded. It is not replaced by another cause. If the refit absorbs nearly all of a
    cause, and for a trial of kind ``alias``, the drawn size is the rms change of the scans before the refit.
    """
    drawn = [*([draw.base] if draw.base else []), *draw.causes]
    return [_sized(one, jobs, draw, base) for one in drawn]


def write_raw(draw: Draw, planted: Sequence[Planted], jobs: Sequence[Job], folder: Path) -> Path:
    """Simulate the prints and scans of all fields, and write the raw files. Return the path of the dataset
    card (the TOML file that describes the raw files).

    The card contains only the required entries.
    """
    (folder / "scans").mkdir(parents=True)
    for job in jobs:
        scan = scan_job(fab_of(draw, planted, job), job)
        write_layout(folder, job.id, job.level)
        write_text_matrix(folder / "scans" / f"{job.id}.txt", scan.height_um)
    printer = printer_of(draw)
    return write_card(
        folder,
        name="virtual-fab",
        title="Simulated two-photon prints with simulated AFM scans",
        pitch_um=printer.pitch_um,
        level_height_um=printer.level_height_um,
        levels=printer.levels,
        scan_size_um=scan.frame.size_um,
        levelled=True,
    )


def noise_free_um(draw: Draw, planted: Sequence[Planted], jobs: Sequence[Job]) -> list[np.ndarray]:
    """Return one noise-free scan per field: heights in µm on the grid of the layout, as arrays of shape (ny,
    nx).
    """
    found = []
    for job in jobs:
        fab = fab_of(draw, planted, job, noise=Noise.off(), microscope=Microscope.aligned())
        height = scan_job(fab, job).noiseless_um
        # Scan and layout have the same centre.
        top, left = ((a - b) // 2 for a, b in zip(height.shape, job.level.shape, strict=True))
        found.append(height[top : height.shape[0] - top, left : height.shape[1] - left])
    return found


def refitted_rms_nm(
    heights_um: Sequence[np.ndarray], jobs: Sequence[Job], printer: Printer, further: str = ""
) -> float:
    """Fit models and the per-scan terms to noise-free scans. Return the rms residual of the model that fits
    best, nm.

    Args:
        heights_um: one array of shape (ny, nx) per job: heights on the grid of the layout, µm.
        printer: printer whose parameters are used as starting values of the Physics model.
        further: name of a further model, or ``auto`` for several. If it is empty, only the Physics model is
            fitted.
    """
    scans = [_as_scan(job, height, printer) for job, height in zip(jobs, heights_um, strict=True)]
    models = base_models(further, _geometry(printer)).values() if further else ()
    return min(_rms_nm(model, scans) for model in (plain_model(printer), *models))


def _rms_nm(model: Simulator, scans: Sequence[PrintedScan]) -> float:
    start = fitted_numbers(model).astype(np.float64)
    fitted = fit_least_squares(_Refit(model, scans, _SCAN_TERMS), start, _RULES)
    left = [
        float(gram(part.residual[:, None], part.basis.T)[0, 0]) / len(part.residual) for part in fitted.linear
    ]
    return 1e3 * float(np.sqrt(np.mean(left)))


class _Refit(ModelProblem):
    """The least-squares problem of fitting a model together with per-scan terms. The per-scan terms are made
    orthonormal.
    """

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        return [replace(part, basis=orthonormal(part.basis.T).T) for part in super().linearise(vector)]


def plain_model(printer: Printer) -> Simulator:
    """Return the Physics model with the values that reproduce the virtual fab without causes. As in the loop,
    the width of its spot is one of the fitted parameters.
    """
    fields = {
        "sigma_optical_um": printer.spot_sigma_um / 2**0.5,
        # A normalised logistic of steepness s is a normalised tanh of steepness s/2.
        "alpha_init": printer.threshold_steepness / 2,
        "eta_init": printer.threshold_dose,
        "kappa_min_init": printer.loose_retention,
        "sigma_diffusion_init_um": printer.network_reach_um,
        "bias_init_um": printer.base_um,
    }
    return base_models("physics", _geometry(printer), fields)["physics"]


def _geometry(printer: Printer) -> dict[str, Any]:
    return {
        "pitch_um": printer.pitch_um,
        "level_height_um": printer.level_height_um,
        "levels": printer.levels,
    }


def _as_scan(job: Job, height_um: np.ndarray, printer: Printer) -> PrintedScan:
    return PrintedScan(
        id=job.id,
        print_id="",
        order=job.index,
        mask_level=job.level,
        height_um=height_um.astype(np.float32),
        valid=np.ones(height_um.shape, bool),
        **_geometry(printer),
        scan_to_layout=np.eye(3),
    )


def _sized(drawn: CauseDraw, jobs: Sequence[Job], draw: Draw, base: str) -> Planted:
    wanted, limit, printer = drawn.wanted_rms_nm, _limit(drawn.name), printer_of(draw)
    by_share = sorted(jobs, key=lambda job: share_of(drawn, job))
    few = [by_share[i] for i in np.linspace(0, len(jobs) - 1, min(_SOUGHT_ON, len(jobs))).round().astype(int)]

    def left_nm(strength: float, fields: Sequence[Job] = few, further: str = "") -> float:
        heights = noise_free_um(draw, [_planted(drawn, strength, 0.0)], fields)
        return refitted_rms_nm(heights, fields, printer, further)

    def change_nm(strength: float) -> float:
        return knob_rms_nm(KnobSetting(drawn.name, strength, draw.seed), jobs, printer=printer)

    imitated = draw.kind == "alias" or (
        drawn.name in KNOBS and left_nm(limit / 4) < _IMITATED * change_nm(limit / 4)
    )
    measured, precision = (change_nm, 0.01) if imitated else (left_nm, _PRECISION)
    strength, at_limit = limit, measured(limit)
    if at_limit > wanted:
        strength, _ = search_strength(
            measured, wanted, highest=limit, at_highest=at_limit, precision=precision
        )
    return _planted(drawn, strength, left_nm(strength, jobs, base))


def _limit(name: str) -> float:
    return KNOBS[name].limit if name in KNOBS else FORMS[name].limit


def _planted(drawn: CauseDraw, strength: float, rms_nm: float) -> Planted:
    return Planted(
        draw=drawn,
        names=[*names_of(drawn.name)],
        strength=strength,
        unit=(KNOBS if drawn.name in KNOBS else FORMS)[drawn.name].unit,
        at_limit=strength == _limit(drawn.name),
        rms_nm=rms_nm,
    )
