"""Define the settings of a training run, an immutable record that every run saves."""

from typing import Any, Literal, Self, get_args

from pydantic import ConfigDict, Field

from litho_data.foundation.errors import require_known
from litho_data.foundation.results import Record
from litho_models.scan_terms import Policy
from litho_models.simulator import Simulator, Variant, is_small

Recipe = Literal["fast", "paper"]
RECIPES: tuple[str, ...] = get_args(Recipe)
PAPER_EPOCHS, PAPER_CROPS, PAPER_BATCH = 4000, 72, 4
FAST_STEPS = {"pbl": 2000, "fno": 1000}
# In the default PBL, the steps train only the chain, which the feature networks then correct. A short
# training is therefore enough, and no validation scan is needed to choose between rounds.
FAST_CHAIN: dict[str, Any] = {"steps": 300, "rounds": 2, "validation_scans": 0}
# Settings on which a fit by least squares depends.
LEAST_SQUARES_FIELDS = {"recipe", "variant", "model", "seed", "nuisance"}
# Upper limit on all counts. No real case needs more, and sums over larger counts lose digits or overflow.
_MOST = 10**9
PAPER_LEARNING_RATE = {"pbl": 5e-4, "fno": 1e-4, "physics": 1e-2}


class TrainingConfig(Record):
    """Settings of one fit. Fits by least squares use only the seed and the nuisances.

    ``nuisance`` names the per-scan terms that are fitted jointly with the model and are never part of it. The
    gain is not among them, because part of it depends on the layout. The offset is pinned to a mean of zero
    over the training scans.
    """

    FORMER = frozenset({"free_gain"})
    model_config = ConfigDict(allow_inf_nan=False)

    recipe: Recipe = "fast"
    variant: Variant = "default"
    model: dict[str, Any] = Field(default_factory=dict, description="settings of the model that is trained")
    seed: int = Field(0, ge=0, lt=2**63)
    steps: int = Field(1000, ge=1, le=_MOST, description="optimiser steps")
    rounds: int = Field(
        4,
        ge=1,
        le=_MOST,
        description="number of rounds; after each, nuisances are estimated again and a checkpoint is written",
    )
    batch: int = Field(4, ge=1, le=_MOST, description="crops per step")
    crop_px: int = Field(
        128,
        ge=8,
        le=_MOST,
        description="side of the scored part of a crop, px; models on tiles use their tile size",
    )
    crops: Literal["random", "quadrants"] = "random"
    optimiser: Literal["adamw", "adam"] = "adamw"
    schedule: Literal["one-cycle", "constant"] = "one-cycle"
    learning_rate: float = Field(2e-3, gt=0, le=_MOST)
    weight_decay: float = Field(1e-3, ge=0, le=_MOST)
    nuisance: Policy = "full+rows"
    validation_scans: int = Field(
        2, ge=0, le=_MOST, description="training scans used only to choose the checkpoint"
    )
    precision: Literal["bf16-mixed", "32-true"] = "32-true"

    @classmethod
    def of_recipe(cls, recipe: Recipe, model_name: str, **settings: Any) -> Self:
        """Return the settings of a named recipe for a model; ``settings`` override individual fields.

        The recipe ``paper`` minimises the L1 loss with Adam, in batches of 4, over 4,000 epochs of 72
        quadrants. It uses the learning rates of the paper and no per-scan terms. The recipe ``fast`` uses
        AdamW with a one-cycle schedule, random crops and jointly fitted per-scan terms. Its number of steps
        is in ``FAST_STEPS``; ``FAST_CHAIN`` contains the settings of the default PBL.

        Raises:
            InputError: unknown recipe.
        """
        require_known("recipe", recipe, RECIPES)
        if recipe == "fast":
            usual = {"steps": FAST_STEPS[model_name]} if model_name in FAST_STEPS else {}
            if model_name == "pbl" and settings.get("variant", "default") == "default":
                usual = FAST_CHAIN
            return cls(**{"recipe": recipe, **usual, **settings})
        paper: dict[str, Any] = {
            "steps": PAPER_EPOCHS * PAPER_CROPS // PAPER_BATCH,
            "rounds": 100,
            "batch": PAPER_BATCH,
            "crop_px": 256,
            "crops": "quadrants",
            "optimiser": "adam",
            "schedule": "constant",
            "weight_decay": 0.0,
            "nuisance": "none",
        }
        if model_name in PAPER_LEARNING_RATE:
            paper["learning_rate"] = PAPER_LEARNING_RATE[model_name]
        return cls(**{"recipe": recipe, **paper, **settings})

    def takes_steps(self, model: Simulator) -> bool:
        """Return whether the model is trained by stochastic gradient descent rather than by least squares.

        Large models are trained by gradient descent unless they are linear in their parameters. Small models
        are trained by gradient descent only in the paper's recipe.
        """
        closed_form = is_small(model) or model.is_linear
        return not closed_form or (self.recipe == "paper" and model.name in PAPER_LEARNING_RATE)

    def used_by(self, model: Simulator) -> dict[str, Any]:
        """Return the settings on which a fit of ``model`` depends, for the record of the fit."""
        if self.takes_steps(model):
            return self.model_dump(mode="json")
        optimiser = "gauss-newton" if is_small(model) else "ridge"
        return {**self.model_dump(mode="json", include=LEAST_SQUARES_FIELDS), "optimiser": optimiser}
