"""Repeated prints: what two prints of one layout at one dose differ by is noise of both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.noise.surface import without_background
from litho_models.scoring.statistics import interval

_FEWEST_PIXELS = 64


class RepeatedPrints(Record):
    """Noise of one print, nm: print and microscope, and at edges registration.

    Each pair is freed of a polynomial of second degree, so datum, tilt and bow are not in it, nor is what
    repeats from print to print. ``ci95_nm`` resamples pairs.
    """

    sigma_nm: float
    ci95_nm: tuple[float, float] | None
    mae_nm: float
    scans: int


def repeated_prints(scans: Sequence[PrintedScan]) -> RepeatedPrints | None:
    """Half the variance between prints of one layout at one dose; None where nothing was repeated.

    The mean absolute value is that of the difference over √2, as for a Gaussian; other noise is within a few
    percent of it (``estimated_floor``).
    """
    groups: dict[tuple[object, ...], list[PrintedScan]] = {}
    for scan in scans:
        groups.setdefault((scan.shape, scan.dose, scan.mask_level.tobytes()), []).append(scan)
    sigmas, absolute, members = [], [], set()
    for group in groups.values():
        for number, first in enumerate(group):
            for second in group[number + 1 :]:
                both = first.valid & second.valid
                difference = np.where(both, first.height_um - second.height_um, np.nan)
                if np.isfinite(difference).sum() < _FEWEST_PIXELS:
                    continue
                rest = NM_PER_UM * without_background(difference, "quadratic")
                rest = rest[np.isfinite(rest)] / np.sqrt(2)
                sigmas.append(float(np.sqrt(np.mean(rest**2))))
                absolute.append(float(np.abs(rest).mean()))
                members |= {first.id, second.id}
    if not sigmas:
        return None
    return RepeatedPrints(
        sigma_nm=float(np.sqrt(np.mean(np.square(sigmas)))),
        ci95_nm=interval(sigmas),
        mae_nm=float(np.mean(absolute)),
        scans=len(members),
    )
