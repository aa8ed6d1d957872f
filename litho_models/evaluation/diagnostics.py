"""What a benchmark records of each fit besides its predictions, while the fitted model is at hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.prediction.cost import PredictionCost, measured_predictions
from litho_models.prediction.tiles import predict_scan, tile_difference
from litho_models.scan_terms.background import Background, learn_background
from litho_models.scan_terms.measurement import MeasurementModel, learn_measurement
from litho_models.scoring.metrics import mean_error_nm
from litho_models.simulator import Simulator


class TileConsistency(Record):
    """The same pixels predicted in the whole field and in a crop of it, nm."""

    max_nm: float
    rms_nm: float
    pixels: int


class FitDiagnostics(Record):
    """One fitted model on its own scans and on those held out.

    The three errors are comparable, which shows over-fitting: the mean over scans of the datum-free error of
    policy ``offset``, without a background. ``inner_validation_nm`` is None for fits without it.
    ``measurement``: learned with the model, for fits that were freed of it.
    """

    background: Background
    measurement: MeasurementModel | None = None
    training_nm: float
    inner_validation_nm: float | None
    held_out_nm: float
    tiles: TileConsistency | None
    cost: PredictionCost


def diagnose(
    model: Simulator,
    scans: Sequence[PrintedScan],
    validation_ids: Sequence[str],
    held_out: Sequence[PrintedScan],
    held_out_um: Sequence[np.ndarray],
    measured: bool = False,
) -> FitDiagnostics:
    """Examine a fitted model.

    Args:
        model: the model; ``scans``: all that it was fitted to, of which ``validation_ids`` chose the weights.
        held_out: scans that it has not seen; ``held_out_um``: its heights (ny, nx) for them, µm.
        measured: also learn the measurement model beside it.
    """
    heights, cost = measured_predictions(lambda scan: predict_scan(model, scan), scans, device_of(model))

    def error_nm(chose: bool) -> float:
        own = [one for one in zip(scans, heights, strict=True) if (one[0].id in validation_ids) == chose]
        return mean_error_nm([scan for scan, _ in own], [height for _, height in own])

    return FitDiagnostics(
        background=learn_background(scans, heights),
        measurement=learn_measurement(scans, heights) if measured else None,
        training_nm=error_nm(False),
        inner_validation_nm=error_nm(True) if validation_ids else None,
        held_out_nm=mean_error_nm(held_out, held_out_um),
        tiles=tile_consistency(model, held_out[0]),
        cost=cost,
    )


def tile_consistency(model: torch.nn.Module, scan: PrintedScan) -> TileConsistency | None:
    """Difference between a scan's field and a crop of it that lacks a third of the rows and columns.

    Pixels within the receptive radius of the crop's edge are not compared, nor those within one tile
    of a model on tiles. None for fields too small to leave any, and for models with effects behind them.
    """
    if not isinstance(model, Simulator):
        return None
    border = model.tile.size_px if model.tile is not None else model.reach_px or 0
    offset = scan.shape[0] // 3, scan.shape[1] // 3
    if any(length - cut <= 2 * border for length, cut in zip(scan.shape, offset, strict=True)):
        return None
    layout = torch.from_numpy(scan.layout_um)[None, None].to(device_of(model))
    return TileConsistency(**tile_difference(model, layout, offset, border)._asdict())


def device_of(model: torch.nn.Module) -> str:
    """Where a model's weights are, as torch names it."""
    return str(next((parameter.device for parameter in model.parameters()), torch.device("cpu")))
