"""Fit the feature networks of a PBL model pixel by pixel. The features have no parameters, so they are
computed only once for each scan.
"""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from litho_data.commands.progress import progress
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.fitting.checkpoint import RoundRecord
from litho_models.fitting.config import TrainingConfig
from litho_models.fitting.crops import grid_pixels
from litho_models.fitting.stochastic import learning_rate, validation_error
from litho_models.layers.gaussian import pad_field
from litho_models.models.pbl import Pbl
from litho_models.scan_terms import FloatMap, TermPixels, Terms, least_squares, term_maps
from litho_models.scan_terms.policies import PINNED, smooth_training_terms

# Number of fitted pixels in all scans together. The fitted pixels of each scan lie on a square grid. The
# features of all fitted pixels take 100 MB.
FITTED_PX = 2**18
EPOCHS, BATCH_PX, LEARNING_RATE = 8, 1024, 3e-3
# Number of passes over all fitted pixels between two estimates of the per-scan terms.
EPOCHS_PER_ROUND = 2


class _Pixels(NamedTuple):
    """The n fitted pixels of one scan. ``features`` contains the k features of all networks together, with
    shape (n, k). ``rest_um`` is the measured height minus the height that the chain predicts, µm, with shape
    (n,). ``terms`` contains the values of the m per-scan terms at these pixels, with shape (m, n).
    """

    features: Tensor
    rest_um: FloatMap
    terms: FloatMap


def fit_feature_networks(
    model: Pbl, scans: Sequence[PrintedScan], validation: Sequence[PrintedScan], config: TrainingConfig
) -> RoundRecord:
    """Fit the feature networks of ``model`` in place. The feature networks learn the residual of the model's
    chain (blurs and small networks) by minimising the mean absolute error.

    Line offsets are not fitted as per-scan terms here, because they average out over a scan.

    Returns:
        The record of this fit, which counts as one round of training. The errors in the record are computed
        after the per-scan terms are removed. The ``validation`` scans are only scored and do not influence
        the fit.
    """
    started = time.monotonic()
    terms = smooth_training_terms(config.nuisance)
    count = FITTED_PX // len(scans)
    parts = [_pixels(model, scan, terms, count) for scan in progress(scans, "features of pixels")]
    sizes = [network.feature_count for network in model.feature_networks]
    seen = zip(*(part.features.T.split(sizes) for part in parts), strict=True)
    for network, own in zip(model.feature_networks, seen, strict=True):
        network.standardise(own)

    def heights(features: Tensor) -> Tensor:
        both = zip(model.feature_networks, features.T.split(sizes), strict=True)
        return torch.stack([network.at_pixels(own) for network, own in both]).sum(dim=0)

    features = torch.cat([part.features for part in parts])
    steps = EPOCHS * -(-len(features) // BATCH_PX)
    schedule = config.model_copy(
        update={"steps": steps, "learning_rate": LEARNING_RATE, "schedule": "one-cycle"}
    )
    learned = [weight for network in model.feature_networks for weight in network.parameters()]
    optimiser = torch.optim.AdamW(learned, lr=LEARNING_RATE, weight_decay=config.weight_decay)
    random = torch.Generator().manual_seed(config.seed)
    target, step = torch.zeros(0), 0
    losses: list[float] = []
    for epoch in progress(range(EPOCHS), f"fitting pixels of {model.name}"):
        if epoch % EPOCHS_PER_ROUND == 0:
            target = _targets(parts, heights, pinned=len(PINNED & terms))
        losses = []
        for batch in torch.randperm(len(features), generator=random).split(BATCH_PX):
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(schedule, step)
            loss = (heights(features[batch]) - target[batch]).abs().mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
            step += 1
    return RoundRecord(
        step=config.steps + step,
        training_mae_nm=NM_PER_UM * float(np.mean(losses)),
        validation_mae_datum_free_nm=validation_error(model, validation),
        seconds=time.monotonic() - started,
    )


def _targets(parts: Sequence[_Pixels], heights: Callable[[Tensor], Tensor], pinned: int) -> Tensor:
    """Return the heights, µm, that the networks should learn at the fitted pixels, with the per-scan terms
    removed. The result is a single vector with the fitted pixels of all scans.
    """
    with torch.no_grad():
        rests = [part.rest_um - heights(part.features).double().numpy() for part in parts]
    own = np.array([least_squares(part.terms, rest) for part, rest in zip(parts, rests, strict=True)])
    own[:, :pinned] -= own[:, :pinned].mean(axis=0)
    freed = [part.rest_um - found @ part.terms for part, found in zip(parts, own, strict=True)]
    return torch.from_numpy(np.concatenate(freed).astype(np.float32))


def _pixels(model: Pbl, scan: PrintedScan, terms: Terms, count: int) -> _Pixels:
    at = grid_pixels(scan, count)
    chosen = torch.from_numpy(at)
    with torch.no_grad():
        layout = pad_field(torch.from_numpy(scan.exposed_um)[None, None], model.reach_px, model.reach_px)
        printed, fields = model.feature_fields(layout)
        seen = [
            feature.flatten()[chosen]
            for network, field in zip(model.feature_networks, fields, strict=True)
            for feature in network.features(field)
        ]
    rest = scan.height_um.reshape(-1)[at].astype(np.float64) - printed.flatten()[chosen].double().numpy()
    maps = term_maps(TermPixels(scan.exposed_um, at=at), terms)
    return _Pixels(torch.stack(seen, dim=1), rest, maps)
