"""Measure how much a knob changes the scans, and find the strength for a given change."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import KNOBS, KnobBoard, KnobSetting, checked
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer

# The knob that is noise: no noise-free scan shows it, and its strength is its rms.
NOISE_KNOB = "line-roughness"
_RELATIVE_PRECISION = 0.01
_MAX_STEPS = 40


@dataclass(frozen=True)
class KnobStrength:
    """The strength of a knob, and the rms change ``rms_nm`` that it causes.

    The rms is smaller than requested if the knob's range is too small.
    """

    setting: KnobSetting
    rms_nm: float


def strength_for_rms(
    name: str,
    rms_nm: float,
    *,
    jobs: Sequence[Job] | None = None,
    seed: int = 0,
) -> KnobStrength:
    """Find the strength at which a knob changes the noise-free scans by ``rms_nm``.

    The rms is computed by `knob_rms_nm`. The rms grows with the strength, so an interval search within the
    range of the knob finds the strength.

    Args:
        name: name of the knob.
        rms_nm: desired rms, nm.
        jobs: fields on which the rms is measured; by default four of 256 × 256 px, two of each cut-off.
        seed: seed of the knob.

    Raises:
        InputError: the knob is unknown, the rms is not positive, or offset, gain, plane and bow of each scan
            absorb the effect completely.
    """
    if not rms_nm > 0:
        raise InputError("rms_nm", got=rms_nm, wanted="a positive number")
    fields = tuple(jobs) if jobs is not None else default_fields(Printer(), seed)

    def measured(strength: float) -> float:
        return knob_rms_nm(KnobSetting(name, strength, seed), fields)

    checked(KnobSetting(name, 0.0))
    highest = KNOBS[name].limit
    if name == NOISE_KNOB:
        strength = min(rms_nm, highest)
        return KnobStrength(KnobSetting(name, strength, seed), strength)
    at_limit = measured(highest)
    # Residuals of the size of float32 rounding do not count as an effect.
    if at_limit < 1e-3:
        raise InputError(
            f"effect of knob {name} on the scans",
            got="no change beyond offset, gain, plane and bow",
            wanted="another knob",
        )
    if at_limit <= rms_nm:
        return KnobStrength(KnobSetting(name, highest, seed), at_limit)
    strength, found = search_strength(measured, rms_nm, highest=highest, at_highest=at_limit)
    return KnobStrength(KnobSetting(name, strength, seed), found)


def search_strength(
    measured: Callable[[float], float],
    wanted: float,
    *,
    highest: float,
    at_highest: float,
    precision: float = _RELATIVE_PRECISION,
) -> tuple[float, float]:
    """Find the strength below ``highest`` at which a measure reaches ``wanted``; return strength and measure.

    Args:
        measured: function that returns the measure at a strength; the measure grows with the strength.
        wanted: desired value of the measure.
        highest: upper limit of the strength.
        at_highest: the measure at ``highest``, which must exceed ``wanted``.
        precision: largest accepted relative distance from ``wanted``.
    """
    low, high = 0.0, highest
    # Most effects grow about linearly and only some quadratically, so the first guess assumes linear growth.
    strength = highest * wanted / at_highest
    for _ in range(_MAX_STEPS):
        found = measured(strength)
        if abs(found - wanted) <= precision * wanted:
            break
        low, high = (strength, high) if found < wanted else (low, strength)
        guess = strength * wanted / found if found > 0 else 0.0
        strength = guess if low < guess < high else (low + high) / 2
    return strength, found


def knob_rms_nm(setting: KnobSetting, jobs: Sequence[Job], printer: Printer | None = None) -> float:
    """Return the rms change, in nm, that a knob causes in noise-free scans after the per-scan terms are
    removed.

    Scan pixels coincide with layout pixels, so a warp is measured by the changes in height that it causes.
    The per-scan terms are the least-squares fit of {1, P, x, y, x², xy, y²} to each scan's change, where P is
    the scan without the knob.
    """
    mean_squares = []
    for job in jobs:
        without = _noise_free(job, (), printer)
        change = _noise_free(job, (setting,), printer) - without
        mean_squares.append(np.mean(_free_of_nuisances(change, without) ** 2))
    return float(1e3 * np.sqrt(np.mean(mean_squares)))


def _free_of_nuisances(change: Array, prediction: Array) -> Array:
    """Fit the prediction and a quadratic surface to ``change`` by least squares, and return the residual."""
    y, x = (
        axis.ravel() for axis in np.meshgrid(*(np.linspace(-1, 1, n) for n in change.shape), indexing="ij")
    )
    own = prediction.ravel() - prediction.mean()
    basis = np.stack([np.ones(change.size), own, y, x, y * y, x * y, x * x], axis=1)
    weights, *_ = np.linalg.lstsq(basis, change.ravel(), rcond=None)
    return change - (basis @ weights).reshape(change.shape)


def default_fields(printer: Printer, seed: int) -> tuple[Job, ...]:
    """Return four fields of 256 × 256 px, two of each cut-off, evenly spaced in the print order."""
    return tuple(random_jobs(Plan(count=4, size_px=(256, 256), fields_per_print=2), printer, seed))


def _noise_free(job: Job, knobs: Sequence[KnobSetting], printer: Printer | None) -> Array:
    fab = Fab(printer or Printer(), Microscope.aligned(), Noise.off(), KnobBoard(knobs, 0), 0)
    return scan_job(fab, job).noiseless_um
