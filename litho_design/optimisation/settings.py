"""Settings of the search for a layout."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, TypeVar, get_args

from litho_data.commands.settings import changed, setting
from litho_data.foundation.errors import require_known
from litho_data.foundation.results import Record
from litho_design.optics import Optics
from litho_design.optimisation.process_window import ProcessWindow
from litho_design.printers.layout import LayoutSettings

# Smallest decrease of a loss that counts as progress.
PROGRESS = 1e-4

S = TypeVar("S", bound="DesignSettings")
Variant = Literal["default", "paper", "authors"]
StartName = Literal["random", "gs", "wgs", "fresnel", "inverse"]


class SearchSettings(Record):
    """Settings of the search, including every choice that the paper leaves open."""

    FORMER: ClassVar[frozenset[str]] = frozenset({"start_iterations", "start_jitter_levels", "hard_from"})

    parametrisation: Literal["gumbel", "direct"] = setting(
        "direct",
        "Free parameters: one height per cell (direct), or a distribution over levels per cell (gumbel)",
        option="--parametrisation",
    )
    start: StartName = setting(
        "random",
        "Start of the search: random, gs or wgs (holograms), fresnel (lenses), inverse (reliefs)",
        option="--start",
    )
    iterations: int = setting(300, "Iterations of the search", option="--iterations", ge=1)
    optimiser: Literal["adam", "adamw"] = setting("adam", "Optimiser")
    learning_rate: float = setting(
        1.0,
        "Learning rate of the optimiser: in twelfths of the range of levels (direct), or in logits (gumbel)",
        option="--learning-rate",
        gt=0,
    )
    rate_schedule: Literal["constant", "step", "plateau"] = setting(
        "constant",
        "Schedule of the learning rate: constant; step, which multiplies the rate by rate_factor every "
        "rate_iterations; or plateau, which does so after more than rate_iterations in which the loss fell "
        f"by less than {PROGRESS:g}",
    )
    rate_factor: float = setting(0.5, "Factor of the learning rate at each reduction", gt=0, lt=1)
    rate_iterations: int = setting(
        25, "Iterations between two reductions (step), or without progress before one (plateau)", ge=1
    )
    temperature_start: float = setting(2.0, "Gumbel temperature at the start", gt=0)
    temperature_end: float = setting(0.1, "Gumbel temperature at the end", gt=0)
    evaluate_every: int = setting(10, "Iterations between two evaluations of the printable layout", ge=1)
    keep: Literal["best", "last"] = setting("best", "Which evaluated layout is kept")
    polish_rounds: int = setting(10, "Rounds of single-level changes after the search", ge=0)
    checkpoint_every: int = setting(50, "Iterations between two checkpoints", ge=1)
    precision: Literal["float32", "bfloat16"] = setting(
        "float32",
        "Precision of the model's networks in the search: float32 or bfloat16; scores are always in float32",
        option="--precision",
    )
    seed: int = setting(0, "Seed of start and sampling", option="--seed")

    def temperature(self, iteration: int) -> float:
        """Return the Gumbel temperature at an iteration. It changes from its start value to its end value
        along half a period of a cosine.
        """
        share = iteration / max(self.iterations - 1, 1)
        weight = (1 + math.cos(math.pi * share)) / 2
        return self.temperature_end + (self.temperature_start - self.temperature_end) * weight


# Settings of the search in the paper, for holograms and lenses. The learning rate is missing, because it
# differs between holograms and lenses.
PAPER_SEARCH = SearchSettings(
    parametrisation="gumbel",
    start="random",
    iterations=1000,
    temperature_start=0.5,
    temperature_end=0.5,
    keep="last",
    polish_rounds=0,
)


class EnsemblePenalty(Record):
    """The penalty on the disagreement of several models.

    A search minimises the combined loss of the models (by default the largest, see ``Task.over_models``),
    plus ``weight`` times the disagreement of the models. The disagreement is given in waves.
    """

    FORMER: ClassVar[frozenset[str]] = frozenset({"risk"})

    weight: float = setting(
        1.0,
        "Weight of the models' disagreement, per wave of height difference",
        option="--ensemble-weight",
        ge=0,
    )


class Fabrication(Record):
    """A penalty on layouts that are unlike the model's training layouts. The function
    ``litho_design.printers.training.outside`` computes this penalty, and the search adds ``inside_weight``
    times the penalty to the loss.
    """

    FORMER: ClassVar[frozenset[str]] = frozenset({"weight", "max_step_levels", "min_feature_um"})

    inside_weight: float = setting(
        0.0, "Weight of the penalty on levels and steps that are rare in the model's training layouts",
        option="--inside-weight", ge=0,
    )  # fmt: skip


class DesignSettings(Record):
    """The settings that are common to the designs of all tasks."""

    FORMER: ClassVar[frozenset[str]] = frozenset({"camera"})

    variant: Variant = setting(
        "default",
        "Preset: ours (default), the paper's, or that of its authors' code",
        option="--variant",
    )
    layout: LayoutSettings = setting(LayoutSettings(), "Layout")
    optics: Optics = setting(Optics(), "Optics")
    search: SearchSettings = setting(SearchSettings(), "Search")
    window: ProcessWindow = setting(ProcessWindow(), "Process window")
    ensemble: EnsemblePenalty = setting(EnsemblePenalty(), "Several models")
    fabrication: Fabrication = setting(Fabrication(), "Limits of the printer")


def design_settings(changes: Mapping[str, Any] | None = None) -> DesignSettings:
    """Return the settings for a user-defined task, changed by ``changes``, such as ``{"layout.size_px":
    256}``.

    Raises:
        InputError: a change names an unknown setting, or gives a setting a value that it does not accept.
    """
    return changed(DesignSettings(), dict(changes or {}))


def preset(presets: Callable[[Variant], S], variant: Variant, changes: Mapping[str, Any] | None = None) -> S:
    """Return the settings of a preset, changed by ``changes``. A ``variant`` among the changes overrides the
    argument ``variant``.

    Raises:
        InputError: there is no preset of this name, or a change names an unknown setting or a value that the
            setting does not accept.
    """
    given = dict(changes or {})
    variant = given.pop("variant", variant)
    require_known("variant", variant, get_args(Variant))
    return changed(presets(variant), given)
