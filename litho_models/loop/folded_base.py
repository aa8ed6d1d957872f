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
    fold = {scan.id: int(own) for scan, own in zip(scans, fold_of, strict=True)}
    # No scan has the number of the last one.
    last = max(fold.values()) + 1
    jobs = [(out, trainer, [one for one in scans if fold[one.id] != out]) for out in range(last + 1)]
    done = run_jobs(_train, jobs, workers, name=lambda job: f"fold {job[0]}")
    trained = {out: model for (out, *_), model in progress(done, "training the base model", len(jobs))}
    return FoldedBase([trained[out] for out in range(last)], fold, trained[last])


def _train(job: tuple[int, Trainer, Sequence[PrintedScan]]) -> nn.Module:
    _, trainer, scans = job
    return trainer(scans)
