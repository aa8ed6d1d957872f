"""Fit printer and measurement together, and subtract the measurement errors that groups of scans share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from litho_data.store import PrintedScan
from litho_models.fitting.least_squares import fit_least_squares
from litho_models.loop.fits import RULES, State, TwinProblem
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepared_among
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scan_terms.measurement_fit import learn_measurement


class Fit(NamedTuple):
    """A printer and a measurement model fitted to the same scans."""

    twin: Twin
    measurement: MeasurementModel

    @property
    def numbers(self) -> tuple[int, int]:
        """Return the numbers of fitted parameters of the printer and of the measurement."""
        return len(self.twin.vector), self.measurement.numbers

    def expected_um(self, scan: PreparedScan) -> np.ndarray:
        """Return the map (y, x) that a scan is expected to show."""
        return self.measurement.expected_um(scan.stored, self.twin.height(scan))


def freed_scans(state: State) -> list[PrintedScan]:
    """Subtract from each scan the measurement errors that the scans of its group share.

    An error that all scans share is not subtracted, because a cause may explain it. The subtracted part is
    learned from scans outside the scan's fold.
    """
    study = state.study
    maps = state.maps_um(study.scans)
    scans = [scan.stored for scan in study.scans]
    freed = list(scans)
    for own, held_out in study.folds:
        if len(own) < 2:
            continue
        learned = learn_measurement([scans[i] for i in own], [maps[i] for i in own], seed=study.seed)
        differences = learned.between_groups()
        for i in held_out:
            freed[i] = differences.freed(scans[i], maps[i])
    return freed


def fit_with_measurement(twin: Twin, scans: Sequence[PreparedScan], seed: int = 0, refit: bool = True) -> Fit:
    """Fit the measurement model, then the printer, and then the strengths of the measurement model again, all
    to the same scans.

    Args:
        twin: starting model for the fit of the printer.
        scans: original scans.
        refit: whether to fit the printer again once the measurement model is known.
    """
    stored = [scan.stored for scan in scans]
    maps = [twin.height(scan) for scan in scans]
    measurement = learn_measurement(stored, maps, seed=seed)
    if refit and len(twin.vector):
        freed = [measurement.freed(scan, own) for scan, own in zip(stored, maps, strict=True)]
        windows = [scan.window for scan in prepared_among(freed, scans)]
        twin = twin.at(fit_least_squares(TwinProblem(twin, windows), twin.vector, RULES).vector)
        maps = [twin.height(scan) for scan in scans]
        measurement = learn_measurement(stored, maps, seed=seed, like=measurement)
    return Fit(twin, measurement)
