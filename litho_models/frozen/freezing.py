"""The process model of a run folder, written as a frozen model on its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from litho_data.foundation.errors import InputError
from litho_models.frozen import zoo
from litho_models.frozen.card import CARD_FILE, ModelCard
from litho_models.frozen.files import load_simulator, save_frozen

# Where `train` and `close-loop` leave their model within the run folder.
MODEL_FOLDER = "model"
_CARRIED_FIELDS = {
    "training_level_share",
    "dataset",
    "training",
    "command",
    "commit",
    "dirty",
    "split",
    "nuisance",
    "background",
    "metrics",
    "noise_floor",
    "measurement_effects",
    "confusable_sets",
    "unexplained_fraction",
    "fabrication_batch",
    "optimiser_gap",
    "limitations",
}


def freeze(source: str | Path, out: str | Path, declare_process: Sequence[str] = ()) -> ModelCard:
    """Write the process model of a run folder, or of a model folder, as a frozen model.

    Args:
        source: what ``train`` or ``close-loop`` wrote, or a frozen model (a folder, ``zoo:NAME``).
        out: folder of the frozen model.
        declare_process: effects of undetermined role that the user declares part of the printer; the
            card records the declaration.

    Raises:
        InputError: no model there, or an effect that is not among the undetermined ones.
    """
    folder = zoo.model_folder(source)
    folder = folder if (folder / CARD_FILE).exists() else folder / MODEL_FOLDER
    if not (folder / CARD_FILE).exists():
        raise InputError(f"no model in {source}", wanted="a folder of `litho-models train` or a frozen model")
    card = ModelCard.read(folder / CARD_FILE)
    undetermined = dict(card.undetermined_effects)
    process = dict(card.process_effects)
    for name in declare_process:
        if name not in undetermined:
            raise InputError(
                "--declare-process", got=name, wanted=", ".join(undetermined) or "nothing to declare"
            )
        process[name] = undetermined.pop(name)
    kept = card.model_dump(mode="json", by_alias=True, include=_CARRIED_FIELDS)
    kept["undetermined_effects"] = undetermined
    kept["declared_processes"] = [*card.declared_processes, *declare_process]
    simulator = load_simulator(folder, card)
    save_frozen(simulator, out, name=card.name, process_effects=process, **kept)
    return ModelCard.read(Path(out) / CARD_FILE)
