"""Define the settings of a training run. The settings are an immutable record, which every run saves together
with its results.
"""

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
# In the default PBL, the optimiser steps train only the chain of blurs and small networks. Feature networks,
# which are fitted afterwards, correct the errors that remain after the chain. A short training is therefore
# enough, and no validation scans are needed to choose the best round.
FAST_CHAIN: dict[str, Any] = {"steps": 300, "rounds": 2, "validation_scans": 0}
# Names of the settings on which a fit by least squares depends.
LEAST_SQUARES_FIELDS = {"recipe", "variant", "model", "seed", "nuisance"}
# Upper limit of all settings that are counts. No real case needs larger counts, and sums over larger counts
# would lose digits or overflow.
_MOST = 10**9
PAPER_LEARNING_RATE = {"pbl": 5e-4, "fno": 1e-4, "physics": 1e-2}


class TrainingConfig(Record):
    """Settings of one fit. A fit by least squares uses only the settings in ``LEAST_SQUARES_FIELDS``. The
    other settings apply only to stochastic gradient descent.

    ``nuisance`` is the policy, i.e. the name of the set of terms that are fitted to each scan together with
    the model. These terms never become part of the model. The gain of a scan is not fitted in training,
    because a fitted gain would absorb part of the influence of the layout. The offsets of the training scans
    are constrained to a mean of zero.
    """

    FORMER = frozenset({"free_gain"})
    model_config = ConfigDict(allow_inf_nan=False)

    recipe: Recipe = "fast"
    variant: Variant = "default"
    model: dict[str, Any] = Field(default_factory=dict, description="settings of the model to be trained")
    seed: int = Field(0, ge=0, lt=2**63)
    steps: int = Field(1000, ge=1, le=_MOST, description="optimiser steps")
    rounds: int = Field(
        4,
        ge=1,
        le=_MOST,
        description="number of rounds; per-scan terms are estimated anew in each, and a checkpoint ends it",
    )
    batch: int = Field(4, ge=1, le=_MOST, description="number of crops in each step")
    crop_px: int = Field(
        128,
        ge=8,
        le=_MOST,
        description="side of the scored part of a crop, px; a model that runs on tiles uses its tile size",
    )
    crops: Literal["random", "quadrants"] = "random"
    optimiser: Literal["adamw", "adam"] = "adamw"
    schedule: Literal["one-cycle", "constant"] = "one-cycle"
    learning_rate: float = Field(2e-3, gt=0, le=_MOST)
    weight_decay: float = Field(1e-3, ge=0, le=_MOST)
    nuisance: Policy = "full+rows"
    validation_scans: int = Field(
        2, ge=0, le=_MOST, description="number of training scans used only to choose the best round"
    )
    precision: Literal["bf16-mixed", "32-true"] = "32-true"

    @classmethod
    def of_recipe(cls, recipe: Recipe, model_name: str, *, film: bool = False, **settings: Any) -> Self:
        """Return the settings of a recipe for a model. Values in ``settings`` replace individual values of
        the recipe. ``film`` states whether the scans are micrographs of films. To such scans, no terms are
        fitted unless ``settings`` names a policy.

        The recipe ``paper`` minimises the mean absolute error with Adam, in batches of 4, over 4,000 epochs
        of 72 quadrants. This recipe uses the learning rates of the paper and fits no per-scan terms. The
        recipe ``fast`` uses AdamW with a one-cycle schedule and random crops, and fits per-scan terms
        together with the model. ``FAST_STEPS`` contains the number of steps of ``fast`` for some models, and
        ``FAST_CHAIN`` contains the settings of ``fast`` for the default PBL model.

        Raises:
            InputError: the recipe is unknown.
        """
        require_known("recipe", recipe, RECIPES)
        settings = {**({"nuisance": "none"} if film else {}), **settings}
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
        """Return True if the model is trained by stochastic gradient descent, and False if it is fitted by
        least squares.

        A large model is trained by gradient descent unless it is linear in its parameters. A small or linear
        model is trained by gradient descent only if the recipe is ``paper`` and the paper states a learning
        rate for this model.
        """
        closed_form = is_small(model) or model.is_linear
        return not closed_form or (self.recipe == "paper" and model.name in PAPER_LEARNING_RATE)

    def used_by(self, model: Simulator) -> dict[str, Any]:
        """Return the settings on which a fit of ``model`` depends. The record of the fit contains them."""
        if self.takes_steps(model):
            return self.model_dump(mode="json")
        optimiser = "gauss-newton" if is_small(model) else "ridge"
        return {**self.model_dump(mode="json", include=LEAST_SQUARES_FIELDS), "optimiser": optimiser}
