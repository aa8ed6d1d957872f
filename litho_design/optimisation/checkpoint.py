"""The checkpoint that an interrupted search leaves in its folder, and from which the search resumes."""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file
from litho_design.optimisation.ranks import Ranks

# Exceptions that torch may raise for a damaged file. Which one it raises depends on the position of the
# damage.
_DAMAGED = (
    RuntimeError,
    pickle.UnpicklingError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
)


@dataclass
class SearchState:
    """The state of a search. To resume, a search needs this state, its settings, and the states of its parts,
    such as the optimiser.
    """

    iteration: int = 0
    best_loss: float = math.inf
    best_levels: Tensor | None = None
    history: list[dict[str, float]] = field(default_factory=list)
    # Time that the search took in earlier, interrupted runs.
    earlier_seconds: float = 0.0


def save_checkpoint(
    path: Path, fingerprint: str, state: SearchState, stateful: Mapping[str, Any], seconds: float
) -> None:
    """Write a checkpoint: the state of a search and the states of its parts, such as the optimiser.

    ``fingerprint`` identifies the task to which the checkpoint belongs. ``seconds`` is the time that the
    search has taken so far.
    """
    found = vars(state) | {"earlier_seconds": seconds}
    states = {name: part.state_dict() for name, part in stateful.items()}
    content = states | {"fingerprint": fingerprint, "found": found}
    with atomic_file(path) as temporary:
        torch.save(content, temporary)


def load_checkpoint(
    path: Path, fingerprint: str, stateful: Mapping[str, Any], device: torch.device
) -> SearchState:
    """Load a checkpoint and return the state of the search, with its tensors on ``device``. The states of the
    parts are loaded into the objects in ``stateful``, such as the optimiser, and change these objects in
    place.

    Raises:
        InputError: the checkpoint belongs to another task, or the file is damaged.
    """
    content = _load(path)
    if content["fingerprint"] != fingerprint:
        raise InputError(
            f"checkpoint {path}",
            got="a checkpoint of a run with another setting, target or model",
            wanted="the settings, target and model of this run",
            hint="choose another --out, or delete the checkpoint to start again",
        )
    for name, part in stateful.items():
        part.load_state_dict(content[name])
    state = SearchState(**content["found"])
    if state.best_levels is not None:
        state.best_levels = state.best_levels.to(device)
    return state


def checkpoint_path(folder: Path, part: str = "") -> Path:
    """Return the path of the file in which a search in ``folder`` stores its state.

    If several processes share the search, each has its own file, and ``part`` names the process.
    """
    return folder / f"checkpoint{part}.pt"


def finished_iterations(folder: Path, ranks: Ranks) -> int:
    """Return the number of iterations that all processes of an interrupted run in ``folder`` have finished.

    Return 0 if there is no such run.

    Raises:
        InputError: the processes have finished different numbers of iterations, or the number of processes
            has changed.
    """
    path = checkpoint_path(folder, ranks.part)
    done = int(_load(path)["found"]["iteration"]) if path.exists() else 0
    alike = float(ranks.total(torch.tensor([float(done)]))) == done * ranks.count
    if not alike or (not done and any(folder.glob("checkpoint*.pt"))):
        raise InputError(
            f"checkpoints in {folder}",
            got="checkpoints from another number of processes, or of different iterations",
            wanted=f"checkpoints of the same iteration, one from each of {ranks.count} processes",
            hint="start as many processes as the interrupted run had, or delete the checkpoints to restart",
        )
    return done


def remove_checkpoint(folder: Path, part: str = "") -> None:
    """Delete the checkpoint of a finished design."""
    checkpoint_path(folder, part).unlink(missing_ok=True)


def _load(path: Path) -> dict[str, Any]:
    """Load a checkpoint into CPU memory, so that a lack of GPU memory is not mistaken for a damaged file."""
    stored = path.read_bytes()
    try:
        content: dict[str, Any] = torch.load(io.BytesIO(stored), weights_only=True, map_location="cpu")
    except _DAMAGED:
        raise InputError(
            f"checkpoint {path}",
            got="a damaged file",
            wanted="the checkpoint of an interrupted run",
            hint="delete the file to start again",
        ) from None
    return content
