"""Measure how much a knob (an effect that the virtual fab adds) changes the scans, and find the strength at
which the knob causes a given change.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import KNOBS, KnobBoard, KnobSetting, checked
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer

# This knob adds roughness, so its effect is not measured in noise-free scans. Its strength is the rms of this
# roughness in nm.
NOISE_KNOB = "line-roughness"
_RELATIVE_PRECISION = 0.01
_MAX_STEPS = 40


@dataclass(frozen=True)
class KnobStrength:
    """A setting of a knob, and the rms change, in nm, that it causes in the scans.

    If the requested change exceeds the change at the knob's largest strength, the setting has the largest
    strength, and ``rms_nm`` is smaller than requested.
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
    """Find the strength at which a knob changes noise-free scans by ``rms_nm``.

    ``knob_rms_nm`` computes the change. The change grows with the strength, so the strength is found by an
    interval search within the range of the knob.

    Args:
        name: name of the knob.
        rms_nm: wanted rms change of the scans in nm.
        jobs: the fields on which the change is measured. By default, they are four fields of 256 × 256 px
            with random layouts. Two of the layouts have coarse features (low cut-off frequency), and two have
            fine features (high cut-off frequency).
        seed: seed of the knob.

    Raises:
        InputError: the knob is unknown, ``rms_nm`` is not positive, or a fit of offset, gain, plane and bow
            to each scan absorbs the effect completely.
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
    # A change that is not larger than float32 rounding errors does not count as an effect.
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
    """Find the strength at which a measured quantity has the value ``wanted``. Return the strength and the
    measured value.

    Args:
        measured: function that takes a strength and returns the quantity, which must grow with the strength.
        wanted: wanted value of the quantity.
        highest: upper limit of the strength.
        at_highest: value of the quantity at ``highest``. It must exceed ``wanted``.
        precision: largest accepted relative deviation from ``wanted``.
    """
    low, high = 0.0, highest
    # Most effects grow about linearly with the strength, so the first guess assumes linear growth.
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
    """Return the rms change, in nm, that a knob causes in noise-free scans. The part of the change that the
    per-scan terms absorb is not counted.

    The per-scan terms are offset, gain, plane and bow: {1, P, x, y, x², xy, y²}, where P is the scan without
    the knob. They are fitted to the change of each scan by least squares and subtracted. The pixels of the
    scans coincide with those of the layout. If a knob displaces the scan, the displacement is not corrected.
    The heights are compared at the same pixel.
    """
    mean_squares = []
    for job in jobs:
        without = _noise_free(job, (), printer)
        change = _noise_free(job, (setting,), printer) - without
        mean_squares.append(np.mean(_free_of_nuisances(change, without) ** 2))
    return float(1e3 * np.sqrt(np.mean(mean_squares)))


def _free_of_nuisances(change: Array, prediction: Array) -> Array:
    """Fit ``change`` by a multiple of ``prediction`` plus a quadratic surface, and return the residual."""
    y, x = (
        axis.ravel() for axis in np.meshgrid(*(np.linspace(-1, 1, n) for n in change.shape), indexing="ij")
    )
    own = prediction.ravel() - prediction.mean()
    basis = np.stack([np.ones(change.size), own, y, x, y * y, x * y, x * x], axis=1)
    weights, *_ = np.linalg.lstsq(basis, change.ravel(), rcond=None)
    return change - (basis @ weights).reshape(change.shape)


def default_fields(printer: Printer, seed: int) -> tuple[Job, ...]:
    """Return four fields of 256 × 256 px with random layouts, evenly spaced in the order of printing. Two of
    the layouts have coarse features (low cut-off frequency), and two have fine features (high cut-off
    frequency).
    """
    return tuple(random_jobs(Plan(count=4, size_px=(256, 256), fields_per_print=2), printer, seed))


def _noise_free(job: Job, knobs: Sequence[KnobSetting], printer: Printer | None) -> Array:
    fab = Fab(printer or Printer(), Microscope.aligned(), Noise.off(), KnobBoard(knobs, 0), 0)
    return scan_job(fab, job).noiseless_um
