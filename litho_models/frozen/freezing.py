"""Freeze a process model: load the model that a training or a closed loop wrote, and save it as a frozen
model.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

from litho_data.foundation.errors import InputError
from litho_models.frozen import zoo
from litho_models.frozen.card import CARD_FILE, Attribution, ModelCard
from litho_models.frozen.files import load_simulator, save_frozen

# Name of the folder that holds the model in the output folders of `train` and `close-loop`.
MODEL_FOLDER = "model"
# Name of the part of a model that `Simulator.printer` leaves out. This part is listed among the effects of
# undetermined role, i.e. effects that may arise in the printer or in the microscope.
SCAN_AXIS = "scan-axis"
_WITHOUT_IT = (
    f"The stated errors are those of a model that also has {SCAN_AXIS}, a part for predicting measured maps. "
    "This model was frozen without it, and so without background and values of reference prints, which "
    "depend on it."
)


def freeze(
    source: str | Path, out: str | Path, attribute: Attribution | Mapping[str, Attribution] | None = None
) -> ModelCard:
    """Write a process model as a frozen model. The process model comes from a run folder or from another
    frozen model.

    Args:
        source: a folder that ``train`` or ``close-loop`` wrote, or a frozen model (a folder or ``zoo:NAME``).
        out: output folder for the frozen model.
        attribute: ``printer`` or ``microscope``, to which effects of undetermined role are attributed. (The
            measurements do not show which of the two causes these effects.) The value is either one of the
            two for all of these effects, or a mapping from the name of an effect to one of the two. Effects
            attributed to the printer become part of the frozen model; those attributed to the microscope do
            not. The card records the attribution. The name ``scan-axis`` stands for the part of a base model
            that acts along the lines of the scan. If this part of the base model is left out, the card of the
            frozen model states no background and no baseline.

    Raises:
        InputError: ``source`` contains no model; an effect to attribute is not of undetermined role; a value
            is neither ``printer`` nor ``microscope``; or ``scan-axis`` is attributed to the printer, but the
            model was frozen without it.
    """
    folder = zoo.model_folder(source)
    folder = folder if (folder / CARD_FILE).exists() else folder / MODEL_FOLDER
    if not (folder / CARD_FILE).exists():
        raise InputError(f"no model in {source}", wanted="a folder that `train` wrote, or a frozen model")
    card = ModelCard.read(folder / CARD_FILE)
    simulator = load_simulator(folder, card)
    decided = card.attributed.get(SCAN_AXIS) == "printer"
    printer = simulator if decided else simulator.printer()
    undetermined = dict(card.undetermined_effects)
    undetermined |= {} if printer is simulator else {SCAN_AXIS: {}}
    sides = {"printer": dict(card.process_effects), "microscope": dict(card.measurement_effects)}
    if isinstance(attribute, str):
        attribute = dict.fromkeys(undetermined, attribute) or {"": attribute}
    for name, side in (attribute or {}).items():
        if side not in sides:
            raise InputError("--attribute", got=side, wanted=" or ".join(get_args(Attribution)))
        if name not in undetermined:
            raise InputError(
                "undetermined effect to attribute",
                got=name or f"{card.name}, which has none",
                wanted=", ".join(undetermined) or "a model with an effect of undetermined role",
            )
        sides[side][name] = undetermined.pop(name)
    taken = sides["printer"].pop(SCAN_AXIS, None) is not None
    if taken and printer is simulator:
        raise InputError(
            f"attributing {SCAN_AXIS} to the printer",
            got=f"{card.name}, which was frozen without this effect",
            wanted="a folder that `train` or `close-loop` wrote",
        )
    kept = card.model_dump(mode="json", by_alias=True, exclude={"name", "process_effects", "versions"})
    kept["undetermined_effects"], kept["measurement_effects"] = undetermined, sides["microscope"]
    kept["attributed"] = {**card.attributed, **(attribute or {})}
    if not taken and printer is not simulator:
        simulator = printer
        kept["limitations"] = [*card.limitations, _WITHOUT_IT]
        # The background and the baseline were computed from the predictions of the whole model for the
        # training scans.
        del kept["background"], kept["baseline"]
    save_frozen(simulator, out, name=card.name, process_effects=sides["printer"], **kept)
    return ModelCard.read(Path(out) / CARD_FILE)
