"""A base model that is trained elsewhere, one per fold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from torch import nn

from litho_data.commands.progress import progress
from litho_data.sharing.workers import HERE, Workers, run_jobs
from litho_data.store import PrintedScan

# Where other processes train, it is sent to them.
Trainer = Callable[[Sequence[PrintedScan]], nn.Module]


class FoldedBase(nn.Module):
    """One trained model per fold; each scan is predicted by the one that has not seen it.

    Args:
        models: by fold; ``fold_of``: scan id to fold; ``common``: for every other scan.
    """

    def __init__(self, models: Sequence[nn.Module], fold_of: Mapping[str, int], common: nn.Module):
        super().__init__()
        self.models = nn.ModuleList(models)
        self.common = common
        self.fold_of = dict(fold_of)
        # Weights stay as the trainer left them: frozen ones would be predicted with other roundings.
        self.eval()

    def of_fold(self, fold: int) -> nn.Module:
        """The model trained without this fold."""
        return self.models[fold]

    def of_scan(self, scan_id: str) -> nn.Module:
        """The model that has not seen this scan."""
        fold = self.fold_of.get(scan_id)
        return self.common if fold is None else self.models[fold]


def train_folds(
    scans: Sequence[PrintedScan], fold_of: np.ndarray, trainer: Trainer, workers: Workers = HERE
) -> FoldedBase:
    """Train once without each fold and once on all development scans."""
    folds = range(int(fold_of.max()) + 1)
    # No scan has the number of the last one.
    jobs = [
        (fold, trainer, [scan for scan, own in zip(scans, fold_of, strict=True) if own != fold])
        for fold in (*folds, len(folds))
    ]
    done = run_jobs(_train, jobs, workers, name=lambda job: f"fold {job[0]}")
    trained = {fold: model for (fold, *_), model in progress(done, "training the base model", len(jobs))}
    assigned = {scan.id: int(fold) for scan, fold in zip(scans, fold_of, strict=True)}
    return FoldedBase([trained[fold] for fold in folds], assigned, trained[len(folds)])


def _train(job: tuple[int, Trainer, Sequence[PrintedScan]]) -> nn.Module:
    _, trainer, scans = job
    return trainer(scans)
