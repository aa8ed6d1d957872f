"""The process model of a run folder, written as a frozen model on its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

from litho_data.foundation.errors import InputError
from litho_models.frozen import zoo
from litho_models.frozen.card import CARD_FILE, Attribution, ModelCard
from litho_models.frozen.files import load_simulator, save_frozen

# Where `train` and `close-loop` leave their model within the run folder.
MODEL_FOLDER = "model"
_CARRIED_FIELDS = {
    "training_level_share",
    "training_step_share",
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
    "declared_processes",
    "confusable_sets",
    "unexplained_fraction",
    "fabrication_batch",
    "optimiser_gap",
    "limitations",
}


def freeze(
    source: str | Path, out: str | Path, attribute: Attribution | Mapping[str, Attribution] | None = None
) -> ModelCard:
    """Write the process model of a run folder, or of a model folder, as a frozen model.

    Args:
        source: what ``train`` or ``close-loop`` wrote, or a frozen model (a folder, ``zoo:NAME``).
        out: folder of the frozen model.
        attribute: whose the effects of undetermined role are taken to be, of all of them or by name:
            those of the printer become part of the model, those of the microscope do not. The card says so.

    Raises:
        InputError: no model there, an effect that is not among the undetermined ones, or another side.
    """
    folder = zoo.model_folder(source)
    folder = folder if (folder / CARD_FILE).exists() else folder / MODEL_FOLDER
    if not (folder / CARD_FILE).exists():
        raise InputError(f"no model in {source}", wanted="a folder of `litho-models train` or a frozen model")
    card = ModelCard.read(folder / CARD_FILE)
    undetermined = dict(card.undetermined_effects)
    sides = {"printer": dict(card.process_effects), "microscope": dict(card.measurement_effects)}
    if isinstance(attribute, str):
        attribute = dict.fromkeys(undetermined, attribute) or {"": attribute}
    for name, side in (attribute or {}).items():
        if side not in sides:
            raise InputError("--attribute", got=side, wanted=" or ".join(get_args(Attribution)))
        if name not in undetermined:
            raise InputError(
                "effect to attribute",
                got=name or f"{card.name}, which has none",
                wanted=", ".join(undetermined) or "a model with an effect of undetermined role",
            )
        sides[side][name] = undetermined.pop(name)
    kept = card.model_dump(mode="json", by_alias=True, include=_CARRIED_FIELDS)
    kept["undetermined_effects"], kept["measurement_effects"] = undetermined, sides["microscope"]
    kept["attributed"] = {**card.attributed, **(attribute or {})}
    simulator = load_simulator(folder, card)
    save_frozen(simulator, out, name=card.name, process_effects=sides["printer"], **kept)
    return ModelCard.read(Path(out) / CARD_FILE)
