"""A base model with one trained copy per fold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from torch import nn

from litho_data.commands.progress import progress
from litho_data.sharing.workers import HERE, Workers, run_jobs
from litho_data.store import PrintedScan

# A function that trains a model; it is sent to other processes.
Trainer = Callable[[Sequence[PrintedScan]], nn.Module]


class FoldedBase(nn.Module):
    """One trained model per fold; each scan is predicted by the model that was trained without it.

    Args:
        models: one per fold; ``fold_of``: fold of each scan id; ``common``: model for scans in no fold.
    """

    def __init__(self, models: Sequence[nn.Module], fold_of: Mapping[str, int], common: nn.Module):
        super().__init__()
        self.models = nn.ModuleList(models)
        self.common = common
        self.fold_of = dict(fold_of)
        # Weights stay as trained, because freezing would change their rounding.
        self.eval()

    def of_fold(self, fold: int) -> nn.Module:
        """Return the model trained without this fold."""
        return self.models[fold]

    def of_scan(self, scan_id: str) -> nn.Module:
        """Return the model trained without this scan."""
        fold = self.fold_of.get(scan_id)
        return self.common if fold is None else self.models[fold]


def train_folds(
    scans: Sequence[PrintedScan], fold_of: np.ndarray, trainer: Trainer, workers: Workers = HERE
) -> FoldedBase:
    """Train one model per fold on the scans outside the fold, and one model on all scans."""
    fold = {scan.id: int(own) for scan, own in zip(scans, fold_of, strict=True)}
    # The last model is trained on all scans.
    last = max(fold.values()) + 1
    jobs = [(out, trainer, [one for one in scans if fold[one.id] != out]) for out in range(last + 1)]
    done = run_jobs(_train, jobs, workers, name=lambda job: f"fold {job[0]}")
    trained = {out: model for (out, *_), model in progress(done, "training the base model", len(jobs))}
    return FoldedBase([trained[out] for out in range(last)], fold, trained[last])


def _train(job: tuple[int, Trainer, Sequence[PrintedScan]]) -> nn.Module:
    _, trainer, scans = job
    return trainer(scans)
