"""Write and load frozen models. A frozen model is a folder with weights and a card. Loading a frozen model
runs no code from its folder.

``model.safetensors`` contains the weights, ``card.json`` contains the card, and ``README.md`` shows the card
as a page for people. Only numbers, texts and names of known classes are read; nothing is unpickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from litho_data.foundation.begun import whole_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import first_error
from litho_data.foundation.run_facts import run_facts
from litho_models.frozen import hub, zoo
from litho_models.frozen.card import CARD_FILE, EffectValues, ModelCard
from litho_models.frozen.simulator import FrozenSimulator
from litho_models.models import model_class
from litho_models.simulator import Simulator

if TYPE_CHECKING:
    from litho_models.effects.chain import EffectChain

WEIGHTS_FILE, README_FILE = "model.safetensors", "README.md"
MODEL_FILES = (WEIGHTS_FILE, CARD_FILE, README_FILE)


def save_frozen(
    simulator: Simulator,
    folder: str | Path,
    *,
    name: str | None = None,
    process_effects: EffectValues | None = None,
    **card_fields: Any,
) -> Path:
    """Write a process model as a frozen model, which can then be used for design. Return the folder of the
    frozen model.

    Args:
        simulator: the fitted model.
        folder: output folder. If the folder contains an older frozen model, the older model is replaced
            completely.
        name: name of the frozen model in reports; by default, the name of the simulator.
        process_effects: effects of the printer that become part of the frozen model. The mapping contains the
            parameter values of each effect by name.
        card_fields: further fields of ``ModelCard`` (dataset, training, split, metrics, …). Fields that
            follow from the model itself are computed from the model, even if values for them are given here.

    Raises:
        InputError: weights are not finite or not float32; a card field is unknown or has a wrong value; or an
            effect is not an effect of the printer.
    """
    state = {key: value.detach().cpu().contiguous() for key, value in simulator.state_dict().items()}
    _check_numbers(state, f"weights of {simulator.name}")
    config = simulator.config
    with whole_folder(folder, *MODEL_FILES) as temporary:
        # The file has no metadata. Safetensors writes metadata in no fixed order, so with metadata the hash
        # of the file would change from call to call.
        (temporary / WEIGHTS_FILE).write_bytes(save(state))
        try:
            own = {
                "name": name or simulator.name,
                "model": simulator.name,
                "hyper_parameters": config.model_dump(mode="json"),
                "parameters": simulator.parameter_count,
                "weights_sha256": file_sha256(temporary / WEIGHTS_FILE),
                "calibrated_range_um": (0.0, config.full_height_um),
                "receptive_radius_um": None if process_effects else simulator.reach_um,
                "at_bounds": simulator.at_bounds,
                "process_effects": process_effects or {},
            }
            geometry = config.model_dump(include={"variant", "pitch_um", "level_height_um", "levels"})
            card = ModelCard(**{**run_facts(), **card_fields, **geometry, **own})
        except ValidationError as error:
            raise InputError("model card", got=first_error(error), wanted=ModelCard.SCHEMA) from error
        _check_effects(card)
        card.write(temporary)
        (temporary / README_FILE).write_text(card.page, encoding="utf-8")
    return Path(folder)


def load_frozen(
    source: str | Path, device: str | torch.device = "cpu", extrapolate: bool = False
) -> FrozenSimulator:
    """Load a frozen model together with the printer effects that it contains. The model is in eval mode, and
    no gradients are computed for its weights.

    Args:
        source: a folder that ``save_frozen`` wrote, ``zoo:NAME`` for a model of the package, or
            ``hf://owner/name`` for a model that ``push`` shared.
        device: device on which the model is placed.
        extrapolate: accept layouts with heights beyond the model's calibrated range.

    Raises:
        InputError: there is no such folder, model of the zoo or repository; the card or the weights are
            damaged or have another format; or the weights do not belong to the card.
    """
    path = zoo.model_folder(source)
    card = ModelCard.read(path)
    _check_effects(card)
    simulator = load_simulator(path, card)
    model: Simulator | EffectChain = simulator
    if card.process_effects:
        from litho_models.effects.chain import EffectChain

        model = EffectChain(simulator, card.process_effects)
    frozen = FrozenSimulator(model, card, file_sha256(path / CARD_FILE), extrapolate)
    return frozen.to(device)


def push(source: str | Path, repository: str, *, private: bool = False) -> str:
    """Upload a frozen model to the Hugging Face Hub. Return the address of the uploaded model, which
    ``load_frozen`` accepts.

    Args:
        source: the model to share, as for ``load_frozen``.
        repository: ``owner/name`` of the repository. A repository that does not exist is created, and is
            private if ``private`` is set.

    Raises:
        InputError: ``load_frozen`` cannot load the model, the repository rejects the upload, or
            huggingface_hub is not installed.
    """
    load_frozen(source)
    return hub.upload(zoo.model_folder(source), repository, private=private)


def load_simulator(folder: str | Path, card: ModelCard) -> Simulator:
    """Load the base model of a frozen model from its folder, without the printer effects that the frozen
    model may contain. Check the weights against the card.

    Raises:
        InputError: the weights are missing or damaged, or do not belong to the model in the card.
    """
    weights = Path(folder) / WEIGHTS_FILE
    if not weights.is_file():
        raise InputError(f"no {WEIGHTS_FILE} in {folder}", wanted="a folder written by `litho-models freeze`")
    found = file_sha256(weights)
    if found != card.weights_sha256:
        raise InputError(
            f"SHA-256 of {weights}",
            got=f"{found[:12]}…",
            wanted=f"{card.weights_sha256[:12]}…, as stated in its card",
            hint="the file is damaged or belongs to another model",
        )
    try:
        state = load_file(weights)
    except SafetensorError as error:
        raise InputError(
            f"weights in {weights}", got=str(error), wanted=f"the weights of {card.model}"
        ) from error
    _check_numbers(state, f"weights in {weights}")
    simulator = _empty_simulator(card, weights)
    wanted = simulator.state_dict()
    for key in sorted(wanted.keys() | state.keys()):
        found, fits = (str(tuple(part[key].shape)) if key in part else "absent" for part in (state, wanted))
        if found != fits:
            raise InputError(
                f"weights in {weights}", got=f"{key} {found}", wanted=f"{fits}, as in {card.model}"
            )
    simulator.load_state_dict(state)
    return simulator


def _empty_simulator(card: ModelCard, weights: Path) -> Simulator:
    known = model_class(card.model)
    try:
        config = known.Config.model_validate(card.hyper_parameters)
    except ValidationError as error:
        raise InputError(f"hyper_parameters beside {weights}", got=first_error(error)) from error
    stated = (card.pitch_um, card.level_height_um, card.levels)
    if stated != (config.pitch_um, config.level_height_um, config.levels):
        raise InputError(
            "pitch, level height and levels in the card", got=stated, wanted="those of its hyper_parameters"
        )
    lowest, highest = card.calibrated_range_um
    if not 0 <= lowest < highest <= config.full_height_um:
        raise InputError(
            f"calibrated_range_um beside {weights}",
            got=f"{lowest:g} to {highest:g} µm",
            wanted=f"a range within that of its levels, 0 to {config.full_height_um:g} µm",
        )
    try:
        return known(config)
    except (ArithmeticError, ValueError) as error:
        # Each value of the card is inside its own range, but the values may contradict each other. For
        # example, a starting value may exceed the upper bound.
        raise InputError(f"hyper_parameters beside {weights}", got=str(error)) from error


def _check_numbers(state: Mapping[str, Tensor], what: str) -> None:
    for key, value in state.items():
        if value.dtype != torch.float32 or not torch.isfinite(value).all():
            got = f"{value.dtype}" if value.dtype != torch.float32 else "non-finite values"
            raise InputError(what, got=f"{got} in {key}", wanted="finite float32 numbers")


def _check_effects(card: ModelCard) -> None:
    """Raise an InputError if the card names a process effect that is not an effect of the printer, or gives
    it values out of range.
    """
    from litho_models.effects import get_effect

    for name, values in card.process_effects.items():
        effect = get_effect(name)
        if effect.role != "process" and card.attributed.get(name) != "printer":
            raise InputError(
                "process effect",
                got=f"{name}, whose role is {effect.role}",
                wanted="an effect of the printer",
                hint="`litho-models freeze --attribute printer` attributes undetermined effects to the "
                "printer",
            )
        effect.require_in_range(values)
