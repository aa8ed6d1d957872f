"""The metrics that are computed in addition to the errors, and a function that registers further ones. Every
report shows all metrics with their unit and an explanation.

A metric is computed by a function that receives one scan, the prediction of the model, and the residual
without the per-scan terms. In result files, each metric that is a field of ``MetricValues`` has its own
entry. All other metrics are listed under the entry ``metrics``.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from litho_data.foundation.errors import InputError, require_known, said
from litho_data.foundation.kinds import Array
from litho_data.store import PrintedScan
from litho_models.scoring.films import FILMS_TEXT, films_of_scan
from litho_models.scoring.records import ModelScores, ScanRow
from litho_models.scoring.shapes import EDGES_TEXT, SIMILARITY_TEXT, edges_of_scan, similarity_of_scan

Summary = Literal["mean", "sum"]
MetricFunction = Callable[[PrintedScan, Array, Array], float | None]


class Metric(NamedTuple):
    """The name and the unit of a metric, and the rule by which its values for single scans are combined."""

    name: str
    unit: str
    over_scans: Summary = "mean"

    @property
    def key(self) -> str:
        """Return the name of the metric in results and tables. It ends with the unit, unless the unit is
        ``1``.
        """
        return self.name if self.unit == "1" else f"{self.name}_{self.unit}"


class Measurement(NamedTuple):
    """A function that computes one or more metrics of a scan. ``metrics`` lists them in the order in which
    the function returns them, and ``explanation`` explains them in a report.

    ``of_films`` is True if these metrics exist only for films, False if they exist only for scans of heights,
    and None if they exist for all scans.
    """

    metrics: tuple[Metric, ...]
    function: Callable[[PrintedScan, Array, Array], Sequence[float | None]]
    explanation: str
    of_films: bool | None = None


_MEASUREMENTS = [
    Measurement((Metric("ssim", "1"),), lambda *scan: (similarity_of_scan(*scan),), SIMILARITY_TEXT, False),
    Measurement(
        (
            Metric("edge_mean", "nm"),
            Metric("edge_p95", "nm"),
            Metric("edge_matched", "1", "sum"),
            Metric("edge_unmatched", "1", "sum"),
            Metric("edge_unmatched_expected", "1", "sum"),
        ),
        edges_of_scan,
        EDGES_TEXT,
    ),
    Measurement(
        (
            Metric("area_error", "percent"),
            *(Metric(f"features_{name}", "1", "sum") for name in ("missing", "extra", "merged")),
        ),
        films_of_scan,
        FILMS_TEXT,
        True,
    ),
]


def register_metric(
    name: str, unit: str, function: MetricFunction, explanation: str, *, over_scans: Summary = "mean"
) -> Metric:
    """Register a metric. From then on, every evaluation and every benchmark in this Python process computes
    it.

    ``function(scan, prediction_um, residual_um)`` receives the ``PrintedScan`` and two maps in µm, of shape
    (ny, nx). The first map is the predicted height. The second map is the measured minus the predicted
    height, after the per-scan terms are removed; it is NaN at pixels that are not scored. The function
    returns a number, or None or NaN if there is nothing to measure. Example::

        register_metric(
            "worst_pixel", "nm", lambda scan, prediction, residual: 1000 * np.nanmax(np.abs(residual)),
            "worst_pixel is the largest error of a scan.",
        )

    Results then contain ``metrics: {"worst_pixel_nm": …}`` for each scan and for the model.

    Args:
        name: name of the metric, which must be a Python identifier (letters, digits and underscores).
        unit: unit of the metric, which must also be a Python identifier; ``1`` for a metric without a unit.
        function: function that computes the metric of one scan, as described above.
        explanation: sentence that explains the metric in the report.
        over_scans: ``mean`` or ``sum``. The metric of a model is the mean or the sum of the values of all
            scans. Scans with the value None are left out.

    Raises:
        InputError: the name or the unit is not an identifier, the name is already taken, or ``over_scans`` is
            neither ``mean`` nor ``sum``.
    """
    metric = Metric(name, unit, over_scans)
    if not (name.isidentifier() and (unit == "1" or unit.isidentifier())):
        raise InputError("metric", got=f"{name!r} in {unit!r}", wanted="letters, digits and underscores")
    require_known(f"over_scans of {name}", over_scans, get_args(Summary))
    taken = {known.key for known in registered_metrics()} | ScanRow.model_fields.keys()
    if metric.key in taken | ModelScores.model_fields.keys():
        raise InputError("metric", got=metric.key, wanted="a name that is not taken")

    def measured(scan: PrintedScan, prediction_um: Array, residual_um: Array) -> tuple[float | None]:
        try:
            return (function(scan, prediction_um, residual_um),)
        except Exception as error:
            got = f"{type(error).__name__}: {said(error)}"
            raise InputError(f"metric {name} of {scan.id}", got=got, wanted="a number or None") from error

    _MEASUREMENTS.append(Measurement((metric,), measured, explanation))
    return metric


def registered_metrics() -> list[Metric]:
    """Return all metrics, in the order in which tables show them."""
    return [metric for measurement in _MEASUREMENTS for metric in measurement.metrics]


def metrics_text(keys: Collection[str]) -> str:
    """Return sentences that explain the metrics with these keys."""
    return " ".join(
        one.explanation for one in _MEASUREMENTS if any(metric.key in keys for metric in one.metrics)
    )


def metrics_of(scan: PrintedScan, prediction_um: Array, residual_um: Array) -> dict[str, Any]:
    """Compute all metrics of one scan from the predicted height and the residual, µm, of shape (ny, nx).
    Return them as the fields of ``MetricValues``.

    Raises:
        InputError: the function of a metric raises an error, or returns neither a number nor None.
    """
    values: dict[str, float | None] = {}
    for measurement in _MEASUREMENTS:
        if measurement.of_films not in (None, scan.seen_by == "sem"):
            continue
        found = measurement.function(scan, prediction_um, residual_um)
        values |= {m.key: _number(m, value) for m, value in zip(measurement.metrics, found, strict=True)}
    return _as_fields(values)


def metrics_over_scans(rows: Sequence[ScanRow]) -> dict[str, Any]:
    """Combine the metrics of scans into the metrics of a model. Each metric is the mean or the sum over the
    scans for which it is known. Return them as the fields of ``MetricValues``.
    """
    values = {}
    for metric in registered_metrics():
        if not any(metric.key in ScanRow.model_fields or metric.key in row.metrics for row in rows):
            continue
        known = [value for value in (row.metric(metric.key) for row in rows) if value is not None]
        mean = float(np.mean(known)) if known else None
        values[metric.key] = sum(known) if metric.over_scans == "sum" else mean
    return _as_fields(values)


def _as_fields(values: Mapping[str, float | None]) -> dict[str, Any]:
    """Arrange metrics as the fields of ``MetricValues``. A metric without a field of its own is put under
    ``metrics``.
    """
    own = {key: value for key, value in values.items() if key in ScanRow.model_fields}
    return {**own, "metrics": {key: value for key, value in values.items() if key not in own}}


def _number(metric: Metric, value: Any) -> float | None:
    if value is None or isinstance(value, int):
        return value
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        got = type(value).__name__
        raise InputError(f"metric {metric.name}", got=f"a {got}", wanted="a number or None") from error
    return number if math.isfinite(number) else None
