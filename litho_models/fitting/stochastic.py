"""Train models with many parameters by stochastic gradient descent on random crops, in rounds.

Before each round, the per-scan terms (such as the zero height and the tilt of a scan) are estimated from
predictions of whole scans. The measured heights minus these terms are the targets of the round. After each
round, the validation scans are scored and a checkpoint is written. Random choices depend only on the seed and
the step, so an interrupted and continued run gives the same result as an uninterrupted one. If there are
several processes, they divide the crops of each step among themselves and add up their gradients. The
computations between two rounds are not divided: every process repeats them.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from litho_data.commands.progress import progress
from litho_data.foundation.errors import InputError
from litho_data.foundation.quantities import HEIGHT_UM
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.fitting.checkpoint import CheckpointFolder, RoundRecord, TrainingState
from litho_models.fitting.config import TrainingConfig
from litho_models.fitting.crops import Window, in_passes, plan_batch, stack
from litho_models.fitting.processes import add_over_processes, joined
from litho_models.layers.precision import Precision, network_precision, warn_where_slower
from litho_models.prediction.tiles import blending_window, predict_scan
from litho_models.scan_terms.policies import estimate_scan_terms, training_terms
from litho_models.scoring.metrics import mean_error_nm
from litho_models.simulator import Simulator

WARM_UP_FRACTION = 0.1
FIRST_RATE, LAST_RATE = 0.1, 1e-3


def train_network(
    model: Simulator,
    training: Sequence[PrintedScan],
    validation: Sequence[PrintedScan],
    config: TrainingConfig,
    first_predictions_um: Callable[[], Sequence[np.ndarray]],
    checkpoints: CheckpointFolder | None = None,
) -> list[RoundRecord]:
    """Train ``model`` in place, on a GPU if there is one. When the function returns, the model has the
    weights of the best round.

    The best round is the one with the smallest error on the ``validation`` scans, or the last round if there
    are none. ``first_predictions_um`` returns the heights, µm, that a small model predicts for the training
    scans. The per-scan terms of the first round are estimated from these heights. If an interrupted run
    continues after its first round, ``first_predictions_um`` is not called.
    """
    if model.tile is not None and config.crops == "random":
        config = config.model_copy(update={"crop_px": model.tile.size_px})
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    warn_where_slower(_precision(config), device.type)
    model.to(device)
    state = TrainingState(model, _optimiser(model, config))
    if checkpoints is not None:
        checkpoints.load(state)
    bounds = np.linspace(0, config.steps, config.rounds + 1).astype(int)
    bounds = bounds[np.diff(bounds, prepend=-1) > 0]
    begun = state.step
    for first, last in pairwise(bounds.tolist()):
        if last <= state.step:
            continue
        started = time.monotonic()
        predictions = [predict_scan(model, scan) for scan in training] if first else first_predictions_um()
        terms = training_terms(config.nuisance)
        added = estimate_scan_terms(training, predictions, terms)
        targets = _Targets(training, added, _overhang_px(model, training, config))
        sums = []
        left = config.steps - first if first == begun else 0
        what = f"training {model.name} to step {config.steps}"
        with _diverging(model, last):
            for step in progress(range(first, last), what, estimate_of=left):
                sums.append(_step(state, targets, config, step, device))
        absolute, counted = torch.stack(sums).cpu().double().numpy().T
        # A step whose crops contain no measured pixel does not count in the mean error of the round.
        seen = counted > 0
        if not seen.any():
            raise InputError(
                f"crops of {model.name} up to step {last}", got="no measured pixel", wanted="at least one"
            )
        record = RoundRecord(
            step=last,
            training_mae_nm=NM_PER_UM * float(np.mean(absolute[seen] / counted[seen])),
            validation_mae_datum_free_nm=validation_error(model, validation),
            seconds=time.monotonic() - started,
        )
        errors_nm = record.training_mae_nm, record.validation_mae_datum_free_nm or 0.0
        if not HEIGHT_UM.holds([one / NM_PER_UM for one in errors_nm]):
            raise _diverged(model, last)
        state.record(record)
        if checkpoints is not None and joined()[0] == 0:
            checkpoints.save(state)
    model.load_state_dict(state.best)
    return state.history


@contextmanager
def _diverging(model: Simulator, last: int) -> Iterator[None]:
    """Context manager for a block that takes the optimiser steps up to number ``last``. Raise an InputError
    if weights of the model become infinite or NaN in this block.
    """
    try:
        yield
        error = None
    except (ArithmeticError, LookupError, RuntimeError, ValueError) as raised:
        error = raised
    if not all(bool(value.isfinite().all()) for value in model.state_dict().values()):
        raise _diverged(model, last) from error
    if error is not None:
        raise error


def _diverged(model: Simulator, step: int) -> InputError:
    return InputError(
        f"training of {model.name}",
        got=f"weights or errors that became infinite or NaN at step {step}",
        wanted="finite weights and errors",
        hint="try a smaller learning_rate",
    )


class _Targets:
    """The training data of one round: the exposures of the training scans, their measured heights without
    the per-scan terms, and the weight of each pixel. Unmeasured pixels have weight zero.

    Each exposure is extended by ``overhang_px`` pixels on each side, which repeat its outermost pixels. The
    added pixels also have weight zero.
    """

    def __init__(self, scans: Sequence[PrintedScan], added_um: Sequence[np.ndarray], overhang_px: int):
        self.exposures_um = [np.pad(scan.exposed_um, overhang_px, mode="edge") for scan in scans]
        self.shapes = [layout.shape for layout in self.exposures_um]
        self.weights = [np.pad(scan.usable.astype(np.float32), overhang_px) for scan in scans]
        heights = [
            np.where(scan.usable, scan.height_um - added, 0).astype(np.float32)
            for scan, added in zip(scans, added_um, strict=True)
        ]
        self.heights_um = [np.pad(height, overhang_px) for height in heights]


def _step(
    state: TrainingState, targets: _Targets, config: TrainingConfig, step: int, device: torch.device
) -> Tensor:
    """Take one optimiser step. Return a tensor of shape (2,), which contains the weighted absolute error, µm,
    and the mean weight. A GPU may still be computing this tensor when the function returns.
    """
    for group in state.optimiser.param_groups:
        group["lr"] = learning_rate(config, step)
    batch = plan_batch(targets.shapes, config, step)
    rank, count = joined()
    own = batch[rank::count]
    state.optimiser.zero_grad(set_to_none=True)
    sums = torch.zeros(2, device=device)
    # If there are fewer crops than processes in this step, a process without a crop computes the gradients of
    # some other crop with weight 0.
    for some in in_passes(own or batch[:1], device):
        loss, means = _losses(state.model, config, targets, some, device)
        share = len(some) / len(batch) if own else 0.0
        (share * loss).backward()
        sums += share * means
    add_over_processes([sums, *(value.grad for value in state.model.parameters() if value.grad is not None)])
    state.optimiser.step()
    return sums


def _losses(
    model: Simulator, config: TrainingConfig, targets: _Targets, windows: list[Window], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return the loss of some windows, µm, and a tensor of shape (2,) for the training record. This tensor
    contains the same loss, without a gradient, and the mean weight of the pixels.

    A random crop is predicted together with its surroundings or, if the model runs on tiles, as one tile. A
    quadrant is treated as a separate layout without surroundings.
    """
    tile = model.tile if config.crops == "random" else None
    # The receptive radius changes during training if the width of a blur is learned.
    reach = model.reach_px if config.crops == "random" else None
    predict = model if tile is None and reach is None else model.interior
    layout, height, weight = (
        _crops(fields, windows, margin, device)
        for fields, margin in (
            (targets.exposures_um, reach or 0),
            (targets.heights_um, 0),
            (targets.weights, 0),
        )
    )
    # Layouts and heights are float32, even if the network computes in a lower precision.
    with network_precision(_precision(config), device.type):
        prediction = predict(layout).float()
    if tile is not None:
        # Each pixel has the same weight in the loss as in the blending of predicted tiles.
        window = blending_window(tile, weight)
        weight = weight * (window / window.mean())
    # The mean is taken over all pixels, measured or not. Every crop therefore has the same weight, whatever
    # the number of crops in its group.
    loss = (weight * (prediction - height).abs()).mean()
    return loss, torch.stack([loss.detach(), weight.mean()])


def _crops(
    fields: Sequence[np.ndarray], windows: Sequence[Window], margin_px: int, device: torch.device
) -> Tensor:
    crops = stack(fields, windows, margin_px)
    # A copy from pinned memory starts at once, without waiting for the GPU to finish its current work.
    return crops.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else crops.to(device)


def _precision(config: TrainingConfig) -> Precision:
    return "bfloat16" if config.precision == "bf16-mixed" else "float32"


def _overhang_px(model: Simulator, scans: Sequence[PrintedScan], config: TrainingConfig) -> int:
    """Return the number of pixels by which tiles may extend beyond a scan in training. As in prediction, this
    number is at least the overlap of the tiles. It is larger if the extended scan would otherwise be smaller
    than a tile.
    """
    if model.tile is None or config.crops != "random":
        return 0
    shortest = min(length for scan in scans for length in scan.shape)
    return max(model.tile.overlap_px, -(-(model.tile.size_px - shortest) // 2))


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Return the learning rate of one step. With the schedule ``constant``, the rate is always the same. With
    ``one-cycle``, the rate rises along a cosine during the first tenth of the steps and then falls along a
    cosine.
    """
    if config.schedule == "constant":
        return config.learning_rate
    done = (step + 0.5) / config.steps
    if done < WARM_UP_FRACTION:
        start, stop, along = FIRST_RATE, 1.0, done / WARM_UP_FRACTION
    else:
        start, stop, along = 1.0, LAST_RATE, (done - WARM_UP_FRACTION) / (1 - WARM_UP_FRACTION)
    return config.learning_rate * (stop + (start - stop) * (1 + math.cos(math.pi * along)) / 2)


def validation_error(model: Simulator, scans: Sequence[PrintedScan]) -> float | None:
    """Return the datum-free error of the model, nm, averaged over the scans. This is the error after the zero
    height of each scan is fitted and subtracted. Return None if there are no scans.
    """
    return mean_error_nm(scans, (predict_scan(model, scan) for scan in scans)) if scans else None


def _optimiser(model: Simulator, config: TrainingConfig) -> torch.optim.Optimizer:
    if config.optimiser == "adam":
        return torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    return torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
