"""Store checkpoints of a training: weights, optimiser moments, best weights, history."""

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
    """One round of training; the validation error is None without validation scans."""

    step: int
    training_mae_nm: float
    validation_mae_datum_free_nm: float | None
    seconds: float


@dataclass
class TrainingState:
    """The model, its optimiser, the rounds so far, and the best weights."""

    model: Simulator
    optimiser: torch.optim.Optimizer
    history: list[RoundRecord] = field(default_factory=list)
    best: dict[str, Tensor] = field(default_factory=dict)

    @property
    def step(self) -> int:
        """Return the number of optimiser steps done."""
        return self.history[-1].step if self.history else 0

    def record(self, record: RoundRecord) -> None:
        """Add a round; keep its weights if it is the best, or if no round has a validation error."""
        errors = [entry.validation_mae_datum_free_nm for entry in self.history]
        error = record.validation_mae_datum_free_nm
        if error is None or all(one is None or error < one for one in errors):
            self.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.history.append(record)

    def restore_best(self) -> None:
        """Load the weights of the best round."""
        self.model.load_state_dict(self.best)

    def save(self, file: Path) -> None:
        """Write weights, best weights and moments."""
        buffer = BytesIO()
        torch.save((self.model.state_dict(), self.best, self.optimiser.state_dict()), buffer)
        # torch does not write the file itself, because it raises no OSError on a full disk.
        file.write_bytes(buffer.getvalue())

    def load(self, file: Path, history: list[RoundRecord]) -> None:
        """The inverse of ``save``. The file can contain only tensors and numbers, and nothing in it is
        run.
        """
        weights, self.best, moments = torch.load(file, map_location="cpu", weights_only=True)
        self.model.load_state_dict(weights)
        self.optimiser.load_state_dict(moments)
        self.history = list(history)


@contextmanager
def reading_kept(folder: Path) -> Iterator[None]:
    """Read the files that an earlier call stored in ``folder``; they are always written as a whole.

    Raises:
        InputError: a missing or damaged file.
    """
    try:
        yield
    except InputError:
        raise
    except (OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, UnpicklingError) as error:
        said = str(error).partition("\n")[0]
        raise InputError(
            f"cannot read what an earlier call kept in {folder}",
            got=f"{type(error).__name__} ({said})",
            wanted="the files unchanged",
            hint=f"delete {folder} and run again",
        ) from error


class CheckpointFolder:
    """A folder that always contains the last complete checkpoint; ``key`` names the run to which it belongs.

    Raises:
        InputError: the folder holds a checkpoint of another model, configuration or data, or a damaged one.
    """

    def __init__(self, path: str | Path, key: str):
        self.path = Path(path)
        self._key = key
        self._kept = self._kept_history()

    def save(self, state: TrainingState) -> None:
        """Replace the checkpoint as a whole."""
        with atomic_folder(self.path) as folder:
            state.save(folder / "state.pt")
            record = {"key": self._key, "history": [entry.model_dump() for entry in state.history]}
            (folder / "state.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    def load(self, state: TrainingState) -> None:
        """Continue from the checkpoint, if there is one.

        Raises:
            InputError: its tensors are damaged.
        """
        if self._kept:
            with reading_kept(self.path):
                state.load(self.path / "state.pt", self._kept)

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
