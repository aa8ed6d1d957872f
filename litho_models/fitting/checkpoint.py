"""Write and read the checkpoints of a training run. A checkpoint contains the present weights, the best
weights so far, the state of the optimiser, and the records of the rounds so far.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.results import Record
from litho_models.simulator import Simulator


class RoundRecord(Record):
    """The record of one round of training. If there are no validation scans, the validation error is None."""

    step: int
    training_mae_nm: float
    validation_mae_datum_free_nm: float | None
    seconds: float


@dataclass
class TrainingState:
    """The state of a training run: the model, its optimiser, the records of the rounds so far, and the best
    weights.
    """

    model: Simulator
    optimiser: torch.optim.Optimizer
    history: list[RoundRecord] = field(default_factory=list)
    best: dict[str, Tensor] = field(default_factory=dict)

    @property
    def step(self) -> int:
        """Return the number of optimiser steps taken so far."""
        return self.history[-1].step if self.history else 0

    def record(self, record: RoundRecord) -> None:
        """Add the record of a round. The present weights become the best weights if this round has the
        smallest validation error so far, or if there are no validation scans.
        """
        errors = [entry.validation_mae_datum_free_nm for entry in self.history]
        error = record.validation_mae_datum_free_nm
        if error is None or all(one is None or error < one for one in errors):
            self.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.history.append(record)


@contextmanager
def reading_kept(folder: Path) -> Iterator[None]:
    """Context manager for a block that reads the files of an earlier run from ``folder``. Any error in the
    block becomes an InputError that reports a missing or damaged file. A file that cannot be read must be
    damaged, because a run writes each file completely or not at all.

    Raises:
        InputError: a file is missing or damaged.
    """
    try:
        yield
    except InputError:
        raise
    except (OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, UnpicklingError) as error:
        said = str(error).partition("\n")[0]
        raise InputError(
            f"cannot read the files of an earlier run in {folder}",
            got=f"{type(error).__name__} ({said})",
            wanted="unchanged files",
            hint=f"delete {folder} and run again",
        ) from error


class CheckpointFolder:
    """A folder that contains at any time the last complete checkpoint of one run. ``key`` is a hash that
    identifies the run.

    Raises:
        InputError: the checkpoint in the folder is damaged, or belongs to another model, configuration or
            dataset.
    """

    def __init__(self, path: str | Path, key: str):
        self.path = Path(path)
        self._key = key
        self._kept = self._kept_history()

    def save(self, state: TrainingState) -> None:
        """Replace the checkpoint atomically."""
        buffer = BytesIO()
        torch.save((state.model.state_dict(), state.best, state.optimiser.state_dict()), buffer)
        with atomic_folder(self.path) as folder:
            # The file is written by Python instead of torch, because torch does not raise an OSError if the
            # disk is full.
            (folder / "state.pt").write_bytes(buffer.getvalue())
            record = {"key": self._key, "history": [entry.model_dump() for entry in state.history]}
            (folder / "state.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    def load(self, state: TrainingState) -> None:
        """Load the checkpoint into ``state``, if there is one.

        Raises:
            InputError: the tensors of the checkpoint are damaged.
        """
        if self._kept:
            with reading_kept(self.path):
                # Only tensors and numbers are loaded, so no code in the file is run.
                kept = torch.load(self.path / "state.pt", map_location="cpu", weights_only=True)
                weights, state.best, moments = kept
                state.model.load_state_dict(weights)
                state.optimiser.load_state_dict(moments)
                state.history = self._kept

    def _kept_history(self) -> list[RoundRecord]:
        file = self.path / "state.json"
        if not file.exists():
            return []
        with reading_kept(self.path):
            record = json.loads(file.read_text(encoding="utf-8"))
            key, history = record["key"], [RoundRecord(**entry) for entry in record["history"]]
        if key != self._key:
            raise InputError(
                f"checkpoint in {self.path}",
                got="a checkpoint of another model, configuration or dataset",
                wanted="a checkpoint of this run",
                hint="choose another --out, or delete the folder",
            )
        return history
