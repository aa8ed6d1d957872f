"""What a killed run needs to go on: weights, optimiser moments, the best weights, the history."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_folder
from litho_models.frozen.files import write_tensors
from litho_models.simulator import Simulator


class RoundRecord(BaseModel):
    """One round of training; the validation error is None where no scans were set aside."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    step: int
    training_mae_nm: float
    validation_mae_datum_free_nm: float | None
    seconds: float


class TrainingState:
    """The model, its optimiser, and the best weights so far."""

    def __init__(self, model: Simulator, optimiser: torch.optim.Optimizer):
        self.model = model
        self.optimiser = optimiser
        self.history: list[RoundRecord] = []
        self.best: dict[str, Tensor] = {}
        self._best_error: float | None = None

    @property
    def step(self) -> int:
        """Optimiser steps done."""
        return self.history[-1].step if self.history else 0

    def record(self, record: RoundRecord) -> None:
        """Add a round; keep the weights where it is the best, or where there is nothing to judge by."""
        self.history.append(record)
        error = record.validation_mae_datum_free_nm
        if error is None or self._best_error is None or error < self._best_error:
            self._best_error = error
            self.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}

    def restore_best(self) -> None:
        """Load the weights of the best round."""
        self.model.load_state_dict(self.best)

    def tensors(self) -> dict[str, Tensor]:
        """Everything in one flat mapping."""
        named = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        named |= {f"best.{name}": value for name, value in self.best.items()}
        for index, moments in self.optimiser.state_dict()["state"].items():
            named |= {f"optimiser.{index}.{name}": torch.as_tensor(v) for name, v in moments.items()}
        return {name: value.detach().cpu().contiguous() for name, value in named.items()}

    def load(self, tensors: dict[str, Tensor], history: list[RoundRecord]) -> None:
        """The inverse of ``tensors``."""
        self.model.load_state_dict(_with_prefix(tensors, "model."))
        self.best = _with_prefix(tensors, "best.")
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in _with_prefix(tensors, "optimiser.").items():
            index, moment = name.split(".", 1)
            moments.setdefault(int(index), {})[moment] = value
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})
        self.history = list(history)
        errors = [
            r.validation_mae_datum_free_nm for r in history if r.validation_mae_datum_free_nm is not None
        ]
        self._best_error = min(errors, default=None)


@contextmanager
def reading_kept(folder: Path) -> Iterator[None]:
    """Read what an earlier call kept in ``folder``, whose files appear whole or not at all.

    Raises:
        InputError: a file is missing or was damaged since.
    """
    try:
        yield
    except InputError:
        raise
    except (OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, SafetensorError) as error:
        said = str(error).partition("\n")[0]
        raise InputError(
            f"cannot read what an earlier call kept in {folder}",
            got=f"{type(error).__name__} ({said})",
            wanted="its files as they were written",
            hint=f"delete {folder} and run again",
        ) from error


class CheckpointFolder:
    """One folder that always holds the last complete checkpoint; ``key`` names the run it belongs to.

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
            write_tensors(state.tensors(), folder / "state.safetensors")
            record = {"key": self._key, "history": [entry.model_dump() for entry in state.history]}
            (folder / "state.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    def load(self, state: TrainingState) -> None:
        """Continue from the checkpoint, if there was one.

        Raises:
            InputError: its tensors are damaged.
        """
        if self._kept:
            with reading_kept(self.path):
                state.load(load_file(self.path / "state.safetensors"), self._kept)

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
                got="one of another model, configuration or dataset",
                wanted="the run that is being continued",
                hint="choose another --out, or delete the folder",
            )
        return history


def _with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
