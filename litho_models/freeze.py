"""Frozen models: a folder of weights and a plain card, written once, loaded without running anything.

``model.safetensors`` holds the weights, ``card.json`` what they are for, ``README.md`` the same for
people. Only numbers and names of known classes are read: nothing is unpickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from litho_data.errors import InputError
from litho_data.files import atomic_folder, file_sha256
from litho_data.outputs import require_replaceable_folder
from litho_data.results import Record, Result, first_error, software_versions
from litho_models.background import Background, BackgroundUse
from litho_models.model_readme import model_readme
from litho_models.models import model_class
from litho_models.simulator import Simulator
from litho_models.tiles import predict_field, predict_interior

WEIGHTS_FILE, CARD_FILE, README_FILE = "model.safetensors", "card.json", "README.md"
# A level's height in float32 may exceed the range by rounding; a level off it differs by 100 nm.
_ROUNDING_UM = 1e-5

EffectValues = dict[str, dict[str, float]]


class DatasetName(Record):
    """A dataset by name and content hash."""

    name: str
    sha256: str


class Metric(Record):
    """One reported figure: what, how much, on which scans, with which nuisances and background."""

    name: str
    value: float
    unit: str = "nm"
    split: str
    policy: str
    background: BackgroundUse = "none"


class ModelCard(Result):
    """All that is needed to load, use and judge a frozen model.

    ``background`` is what the microscope added to the training scans on average; only a comparison with
    measured maps uses it, the model's height never contains it.
    """

    SCHEMA: ClassVar[str] = "litho-models/frozen/1"
    FILE_NAME: ClassVar[str] = CARD_FILE

    schema_: Literal["litho-models/frozen/1"] = Field("litho-models/frozen/1", alias="schema")
    name: str
    model: str
    variant: str
    hyper_parameters: dict[str, Any]
    parameters: int
    weights_sha256: str
    pitch_um: float
    level_height_um: float
    levels: int
    calibrated_range_um: tuple[float, float]
    training_level_share: list[float] = Field(default_factory=list)
    receptive_radius_um: float | None
    dataset: DatasetName | None = None
    training: dict[str, Any] = Field(default_factory=dict)
    command: str = ""
    split: dict[str, Any] = Field(default_factory=dict)
    nuisance: dict[str, Any] = Field(default_factory=dict)
    background: Background | None = None
    metrics: list[Metric] = Field(default_factory=list)
    noise_floor: dict[str, Any] | None = None
    process_effects: EffectValues = Field(default_factory=dict)
    measurement_effects: EffectValues = Field(default_factory=dict)
    undetermined_effects: EffectValues = Field(default_factory=dict)
    declared_processes: list[str] = Field(default_factory=list)
    confusable_sets: list[list[str]] = Field(default_factory=list)
    unexplained_fraction: float | None = None
    fabrication_batch: str = ""
    optimiser_gap: float | None = None
    limitations: list[str] = Field(default_factory=list)
    versions: dict[str, str] = Field(default_factory=dict)


class FrozenSimulator(nn.Module):
    """A process model for design: fixed weights, gradients to its input only.

    ``model(layout_um, pitch_um=0.1)`` maps a layout (b, 1, y, x) in µm to its printed height.
    """

    def __init__(self, simulator: nn.Module, card: ModelCard, sha256: str, extrapolate: bool):
        super().__init__()
        self.simulator = simulator
        self.card: Mapping[str, Any] = card.model_dump(mode="json", by_alias=True)
        self.sha256 = sha256
        self.extrapolate = extrapolate
        self._lowest_um, self._highest_um = card.calibrated_range_um
        self.eval().requires_grad_(False)

    @property
    def name(self) -> str:
        """Name in the card."""
        return self.card["name"]

    @property
    def pitch_um(self) -> float:
        """Lateral sampling that the model is made for, µm."""
        return self.card["pitch_um"]

    @property
    def reach_um(self) -> float | None:
        """Receptive radius, µm; None where a pixel depends on the whole image."""
        return self.card["receptive_radius_um"]

    def train(self, mode: bool = True) -> FrozenSimulator:
        """Frozen models stay in eval mode."""
        return super().train(False)

    def forward(
        self, layout_um: Tensor, pitch_um: float | None = None, level_height_um: float | None = None
    ) -> Tensor:
        """Printed height (b, 1, y, x), µm.

        Args:
            layout_um: nominal height (b, 1, y, x), µm, float.
            pitch_um: sampling of the layout, if the caller wants it checked; so is ``level_height_um``.

        Raises:
            InputError: another pitch or level height, another shape, or heights beyond the calibrated
                range without ``extrapolate``.
        """
        self._check_layout(layout_um, pitch_um, level_height_um)
        if isinstance(self.simulator, Simulator):
            return predict_field(self.simulator, layout_um)
        return self.simulator(layout_um)

    @property
    def has_interior(self) -> bool:
        """Whether ``interior`` can be asked for: a finite receptive radius, no effects behind the model."""
        return isinstance(self.simulator, Simulator) and self.simulator.reach_px is not None

    def interior(self, layout_um: Tensor, pitch_um: float | None = None) -> Tensor:
        """As ``forward``, of the pixels farther than the receptive radius r from the edge only.

        Nothing beyond the edge is assumed, and nothing is computed there: (b, 1, y - 2r, x - 2r), µm.

        Raises:
            InputError: as ``forward``, or a model without ``has_interior``.
        """
        self._check_layout(layout_um, pitch_um, None)
        if not isinstance(self.simulator, Simulator):
            raise InputError(f"interior of a print by {self.name}", wanted="a model without added effects")
        return predict_interior(self.simulator, layout_um)

    def _check_layout(self, layout_um: Tensor, pitch_um: float | None, level_height_um: float | None) -> None:
        self.check_geometry(pitch_um, level_height_um)
        if layout_um.ndim != 4 or layout_um.shape[1] != 1:
            raise InputError("layout", got=f"shape {tuple(layout_um.shape)}", wanted="(batch, 1, y, x)")
        if not self.extrapolate:
            self._check_range(layout_um)

    def check_geometry(self, pitch_um: float | None, level_height_um: float | None = None) -> None:
        """Refuse another pitch or level height than the model's; None is not checked.

        Raises:
            InputError: they differ.
        """
        for name, given in (("pitch_um", pitch_um), ("level_height_um", level_height_um)):
            wanted = self.card[name]
            if given is not None and abs(given - wanted) > 1e-9:
                raise InputError(
                    f"{name} for model {self.name}", got=f"{given:g} µm", wanted=f"{wanted:g} µm"
                )

    def _check_range(self, layout_um: Tensor) -> None:
        lowest, highest = (float(v) for v in torch.aminmax(layout_um.detach()))
        inside = lowest >= self._lowest_um - _ROUNDING_UM and highest <= self._highest_um + _ROUNDING_UM
        if not inside:
            raise InputError(
                f"layout for model {self.name}",
                got=f"heights from {lowest:g} to {highest:g} µm",
                wanted=f"{self._lowest_um:g} to {self._highest_um:g} µm, the calibrated range",
                hint="load it with extrapolate=True to accept a guess",
            )


def save_frozen(
    simulator: Simulator,
    folder: str | Path,
    *,
    name: str | None = None,
    process_effects: EffectValues | None = None,
    **card_fields: Any,
) -> Path:
    """Write a process model for design; returns the folder.

    Args:
        simulator: the fitted model.
        folder: where; an older model there is replaced as a whole.
        name: name in reports; the model's own by default.
        process_effects: effects of the printer that are part of the model, name to parameter values.
        card_fields: further fields of ``ModelCard`` (dataset, training, split, metrics, …).

    Raises:
        InputError: weights that are not finite, or card fields that do not belong.
    """
    state = {key: value.detach().cpu().contiguous() for key, value in simulator.state_dict().items()}
    broken = [key for key, value in state.items() if not torch.isfinite(value).all()]
    if broken:
        raise InputError(
            f"weights of {simulator.name}", got=f"non-finite values in {broken[0]}", wanted="numbers"
        )
    require_replaceable_folder(folder, WEIGHTS_FILE, CARD_FILE, README_FILE)
    config = simulator.config
    with atomic_folder(folder) as temporary:
        # No metadata in the file: safetensors writes its entries in no fixed order, which moved the hash.
        save_file(state, temporary / WEIGHTS_FILE)
        try:
            card = ModelCard(
                name=name or simulator.name,
                model=simulator.name,
                variant=config.variant,
                hyper_parameters=config.model_dump(mode="json"),
                parameters=simulator.parameter_count,
                weights_sha256=file_sha256(temporary / WEIGHTS_FILE),
                pitch_um=config.pitch_um,
                level_height_um=config.level_height_um,
                levels=config.levels,
                calibrated_range_um=(0.0, config.full_height_um),
                receptive_radius_um=None if process_effects else simulator.reach_um,
                process_effects=process_effects or {},
                versions=software_versions(),
                **card_fields,
            )
        except ValidationError as error:
            raise InputError("model card", got=first_error(error), wanted=ModelCard.SCHEMA) from error
        card.write(temporary)
        (temporary / README_FILE).write_text(model_readme(card), encoding="utf-8")
    return Path(folder)


def load_frozen(
    folder: str | Path, device: str | torch.device = "cpu", extrapolate: bool = False
) -> FrozenSimulator:
    """Load a frozen model: eval mode, weights without gradients, effects of the printer included.

    Args:
        folder: what ``save_frozen`` wrote.
        device: where to put it.
        extrapolate: accept heights beyond the calibrated range.

    Raises:
        InputError: no such folder, or a card or weights that are damaged, foreign or do not fit.
    """
    path = Path(folder)
    card = ModelCard.read(path / CARD_FILE)
    simulator = load_simulator(path, card)
    model: nn.Module = simulator
    if card.process_effects:
        from litho_models.effects.chain import EffectChain

        full = simulator.config.full_height_um
        model = EffectChain(simulator, card.process_effects, full_height_um=full, pitch_um=card.pitch_um)
    frozen = FrozenSimulator(model, card, file_sha256(path / CARD_FILE), extrapolate)
    return frozen.to(device)


def load_simulator(folder: str | Path, card: ModelCard) -> Simulator:
    """The base model of a frozen folder without its effects, weights checked against the card.

    Raises:
        InputError: weights missing, damaged, or of another model than the card says.
    """
    weights = Path(folder) / WEIGHTS_FILE
    if not weights.is_file():
        raise InputError(f"no {WEIGHTS_FILE} in {folder}", wanted="a folder written by `litho-models freeze`")
    found = file_sha256(weights)
    if found != card.weights_sha256:
        raise InputError(
            f"SHA-256 of {weights}",
            got=f"{found[:12]}…",
            wanted=f"{card.weights_sha256[:12]}…, as its card says",
            hint="the file is damaged or belongs to another model",
        )
    simulator = _empty_simulator(card, weights)
    try:
        simulator.load_state_dict(load_file(weights))
    except (SafetensorError, RuntimeError) as error:
        raise InputError(f"weights in {weights}", got=str(error), wanted=f"those of {card.model}") from error
    return simulator


def _empty_simulator(card: ModelCard, weights: Path) -> Simulator:
    known = model_class(card.model)
    try:
        config = known.Config.model_validate(card.hyper_parameters)
    except ValidationError as error:
        raise InputError(f"hyper_parameters beside {weights}", got=first_error(error)) from error
    stated = (card.pitch_um, card.level_height_um, card.levels)
    if stated != (config.pitch_um, config.level_height_um, config.levels):
        raise InputError("card", got=f"geometry {stated}", wanted="the same in hyper_parameters")
    return known(config)
