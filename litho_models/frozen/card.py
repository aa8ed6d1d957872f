"""The card of a frozen model (``card.json``), which states how to use the model, how the model was made, and
how large its errors are.
"""

from pathlib import Path
from typing import Any, Literal, Self

from pydantic import ConfigDict, Field, JsonValue, field_validator

from litho_data.foundation.errors import InputError
from litho_data.foundation.names import PlainName
from litho_data.foundation.quantities import LevelHeightUm, Levels, PitchUm
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts
from litho_data.reports.page import filled
from litho_data.store.schema import DatasetId
from litho_models.scan_terms import BackgroundUse
from litho_models.scan_terms.background import Background

CARD_FILE = "card.json"
# Texts that say whether an error was scored on the training scans or on held-out scans.
TRAINED_ON, OUT_OF_FOLD = "development, trained on", "grouped, out of fold"

EffectValues = dict[str, dict[str, float]]
# Side (printer or microscope) to which an effect is attributed if the measurements do not determine its side.
Attribution = Literal["printer", "microscope"]

# The package reads only these lists from the card fields `training` and `split`. All other entries of the two
# fields are only for human readers.
_LISTS_OF_NAMES = ("scan_ids", "lock_box", "lock_box_files_sha256")


class CardMetric(Record):
    """One reported error or other value. ``split`` states the scans on which the value was computed,
    ``policy`` the nuisance terms that were fitted, and ``background`` the background that was added to the
    predictions.

    ``ci95`` is the 95 % confidence interval of the value, computed by resampling the scans.
    """

    name: str
    value: float
    ci95: tuple[float, float] | None = None
    unit: str = "nm"
    split: str
    policy: str
    background: BackgroundUse = "none"

    @property
    def text(self) -> str:
        """Return the value with its unit and its confidence interval, as text."""
        between = f" ({self.ci95[0]:.2f} … {self.ci95[1]:.2f})" if self.ci95 else ""
        return f"{self.value:.2f} {self.unit}{between}"


class ModelCard(RunFacts, Result):
    """The card of a frozen model. The card contains everything that is needed to load, use and assess the
    model.

    ``background`` is the mean contribution of the microscope to the training scans. This background is used
    only for comparisons with measured heights and is never part of the height that the model predicts.
    ``at_bounds`` contains the fitted values that lie on a bound of their range, as a dict from the name of
    the value to the bound. ``baseline`` contains the gain and the error (``ScanFigures``) of each scan on
    which the model was trained; ``litho-models check`` compares new prints with these values. For some
    effects, the measurements do not show whether the printer or the microscope causes them. The user can
    attribute such an effect to one of the two when the model is frozen; ``attributed`` maps the name of the
    effect to ``printer`` or ``microscope``.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    FORMER = frozenset({"declared_processes", "unexplained_fraction", "fabrication_batch", "optimiser_gap"})
    SCHEMA = "litho-models/frozen/1"
    FILE_NAME = CARD_FILE

    name: PlainName
    model: str
    variant: str
    hyper_parameters: dict[str, JsonValue]
    parameters: int
    weights_sha256: str
    pitch_um: PitchUm
    level_height_um: LevelHeightUm
    levels: Levels
    calibrated_range_um: tuple[float, float]
    training_level_share: list[float] = Field(default_factory=list)
    training_step_share: list[float] = Field(default_factory=list)
    receptive_radius_um: float | None
    at_bounds: dict[str, float] = Field(default_factory=dict)
    dataset: DatasetId | None = None
    training: dict[str, JsonValue] = Field(default_factory=dict)
    split: dict[str, JsonValue] = Field(default_factory=dict)
    nuisance: dict[str, JsonValue] = Field(default_factory=dict)
    background: Background | None = None
    metrics: list[CardMetric] = Field(default_factory=list)
    noise_floor: dict[str, JsonValue] | None = None
    baseline: list[dict[str, JsonValue]] = Field(default_factory=list)
    process_effects: EffectValues = Field(default_factory=dict)
    measurement_effects: EffectValues = Field(default_factory=dict)
    undetermined_effects: EffectValues = Field(default_factory=dict)
    attributed: dict[str, Attribution] = Field(default_factory=dict)
    confusable_sets: list[list[str]] = Field(default_factory=list)
    limitations: list[str] = Field(default_factory=list)

    @property
    def held_out(self) -> CardMetric | None:
        """Return the error on held-out scans. If the model was not benchmarked, the card states no such
        error, and the result is None.
        """
        return next((metric for metric in self.metrics if metric.split == OUT_OF_FOLD), None)

    @field_validator("training", "split")
    @classmethod
    def _names_are_names(cls, facts: dict[str, Any]) -> dict[str, Any]:
        for key in _LISTS_OF_NAMES:
            names = facts.get(key, [])
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                raise ValueError(f"{key} must be a list of names")
        return facts

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read the card from the folder of a frozen model.

        Raises:
            InputError: the folder or its card does not exist, or the card is damaged or has another schema.
        """
        if not Path(path).exists():
            raise InputError(
                "model", got=f"{path}, which does not exist", wanted="the folder of a frozen model"
            )
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        if not (folder / CARD_FILE).exists():
            inside = sorted(card.parent for card in folder.glob(f"*/{CARD_FILE}"))
            raise InputError(
                f"model in {folder}",
                got=f"no {CARD_FILE}",
                wanted="the folder of a frozen model",
                hint=f"use {inside[0]}" if inside else "`litho-models freeze RUN --out FOLDER` writes one",
            )
        return super().read(folder)

    @property
    def page(self) -> str:
        """Return the content of the card as a Markdown page, which begins with the metadata block that the
        Hugging Face Hub reads.
        """
        page = Path(__file__).with_name("readme.md.jinja")
        return filled(page, card=self, bounds=bounds_text(self.at_bounds))


def bounds_text(at_bounds: dict[str, float]) -> str:
    """Return a sentence that lists the fitted values that lie on a bound of their range."""
    named = ", ".join(f"{name} ({bound:g})" for name, bound in at_bounds.items())
    return (
        f"These fitted values lie on a bound of their range, so the best values may lie beyond it: {named}."
    )
