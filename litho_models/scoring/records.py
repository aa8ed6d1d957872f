"""The records of scoring: a prediction, the scores of a scan, the scores of a model, and the comparison of
two models.
"""

from __future__ import annotations

from typing import NamedTuple, get_args

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_data.store.schema import Instrument
from litho_models.scan_terms import Policy
from litho_models.scan_terms.background import Background
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scoring.statistics import Interval, OverUnits, over_prints, over_units
from litho_models.scoring.transfer import LevelError, TransferCurves

LEADING: dict[Instrument, str] = dict.fromkeys(get_args(Instrument), "mae_datum_free_nm")
LEADING["sem"] = "edge_mean_nm"
"""For each instrument, the name of the leading error, by which models are ranked and compared."""


class Prediction(NamedTuple):
    """The prediction of a model for a scan. It contains the height of the print and, if known, the height
    that the microscope adds to it (``background_um``). Both are maps in µm, of shape (ny, nx).
    """

    height_um: Array
    background_um: Array | None = None

    @classmethod
    def beside(cls, background: Background | None, scan: PrintedScan, height_um: Array) -> Prediction:
        """Make a prediction from the height of a print and a learned background. The background is left out
        if it is None or was learned on fields of another size.
        """
        if background is None or not background.fits(scan):
            return cls(height_um)
        return cls(height_um, background.of_scan(scan))

    @classmethod
    def seen(cls, measurement: MeasurementModel, scan: PrintedScan, height_um: Array) -> Prediction:
        """Make a prediction from the height of a print and a learned measurement model."""
        return cls(height_um, measurement.expected_um(scan, height_um) - height_um)

    @property
    def map_um(self) -> Array:
        """Return the height map that the microscope is expected to show, µm."""
        return self.height_um if self.background_um is None else self.height_um + self.background_um


class PolicyError(Record):
    """The mean absolute error for one nuisance policy (set of per-scan terms), nm, with its 95 % confidence
    interval from resampling scans. ``k`` is the number of terms that are fitted to each scan.
    """

    policy: Policy
    k: float
    mae_nm: float
    ci95_nm: Interval


class MetricValues(Record):
    """The metrics that are computed in addition to the errors, from maps without the per-scan terms (see
    ``metric_registry``).

    ``ssim`` is explained at ``structural_similarity``, and the metrics of edges at ``EdgePlacement``. All
    other metrics are in ``metrics``; their keys contain name and unit. A metric is None if the scan contained
    nothing to compare.
    """

    ssim: float | None = None
    edge_mean_nm: float | None = None
    edge_p95_nm: float | None = None
    edge_matched: int | None = None
    edge_unmatched: int | None = None
    edge_unmatched_expected: int | None = None
    metrics: dict[str, float | None] = Field(default_factory=dict)

    def metric(self, key: str) -> float | None:
        """Return the metric with this key, or None if it was not computed."""
        return self.metrics.get(key) if key not in MetricValues.model_fields else getattr(self, key)


class ScanErrors(Record):
    """The errors of one model on one scan, over the scored pixels.

    ``mae_abs_nm`` and ``bias_nm`` (measured minus predicted) are computed with nothing fitted to the scan.
    The errors with ``datum_free`` in their name are computed after per-scan terms are removed. These terms
    are not fitted to the scored pixels. ``slope`` and ``intercept_nm`` are the gain and the offset of the
    measured height relative to the predicted height (see ``print_gain``).
    """

    pixels: int
    mae_abs_nm: float
    bias_nm: float
    mae_datum_free_nm: float
    rmse_datum_free_nm: float
    median_abs_datum_free_nm: float
    p95_abs_datum_free_nm: float
    slope: float | None
    intercept_nm: float
    slope_error: float | None = None


class ScanRow(MetricValues, ScanErrors):
    """The scores of one scan."""

    scan: str
    print: str


class ModelScores(MetricValues):
    """All scores of one model. Errors are means over scans, counts are sums over scans, and confidence
    intervals come from resampling scans.

    ``by_policy`` contains the mean absolute error for each policy, with the background that the protocol
    states. ``without_background`` contains the same errors without this background. ``without_background`` is
    empty if the protocol has no background. If the background is smooth (``training``),
    ``without_background`` lists only policies without tilt and bow, because these terms would absorb the
    background. ``phase_rms_waves`` is the RMS phase error, in waves, of light that passes through the print.
    """

    model: str
    scans: list[ScanRow]
    seen_by: Instrument = "afm"
    edge_mean_ci95_nm: Interval = None
    mae_abs_nm: float
    mae_abs_ci95_nm: Interval
    bias_nm: float
    mae_datum_free_nm: float
    mae_datum_free_ci95_nm: Interval
    rmse_datum_free_nm: float
    rmse_datum_free_ci95_nm: Interval
    by_policy: list[PolicyError]
    without_background: list[PolicyError] = Field(default_factory=list)
    phase_rms_waves: float | None = None
    by_level: list[LevelError]
    transfer: TransferCurves
    dropped_pixels: int
    constant_predictions: int

    @property
    def leading_nm(self) -> float:
        """Return the leading error in nm, by which models are ranked. For films, it is the mean shift of the
        edges. For other scans it is the datum-free error of the height.
        """
        return float(getattr(self, LEADING[self.seen_by]))

    @property
    def leading_ci95_nm(self) -> Interval:
        """Return the 95 % confidence interval of the leading error."""
        return self.edge_mean_ci95_nm if self.seen_by == "sem" else self.mae_datum_free_ci95_nm

    @property
    def leading_of_scans_nm(self) -> dict[str, float]:
        """Return the leading error of each scan, nm, keyed by scan id."""
        return {row.scan: float(getattr(row, LEADING[self.seen_by])) for row in self.scans}


class Paired(Record):
    """The comparison of two models. ``mean_nm`` is the leading error (see ``ModelScores.leading_nm``) of the
    first model minus the leading error of the second model, averaged over scans. If it is negative, the first
    model is better. ``first_better`` counts the scans in which the first model is better.

    ``over_prints`` is the same comparison with prints instead of scans as independent units. ``over_prints``
    is None if there is only one print.
    """

    first: str
    second: str
    mean_nm: float
    ci95_nm: Interval
    p: float
    first_better: int
    scans: int
    over_prints: OverUnits | None = None


def paired_scores(first: ModelScores, second: ModelScores, seed: int = 0) -> Paired:
    """Compare the leading errors of two models on the same scans. The scans are paired by id, because the two
    models may list them in different orders.

    Raises:
        InputError: the two models were scored on different scans.
    """
    errors = [score.leading_of_scans_nm for score in (first, second)]
    if errors[0].keys() != errors[1].keys():
        counts = " and ".join(str(len(found)) for found in errors)
        raise InputError(
            "scores to compare", got=f"{counts} scans", wanted="the same scans in both lists of scores"
        )
    differences = [one - errors[1][scan] for scan, one in errors[0].items()]
    found = over_units(differences, seed=seed)
    return Paired(
        first=first.model,
        second=second.model,
        mean_nm=float(np.mean(differences)),
        ci95_nm=found.ci95_nm,
        p=found.p,
        first_better=sum(one < 0 for one in differences),
        scans=found.count,
        over_prints=over_prints(differences, [row.print for row in first.scans], seed),
    )
