"""A closed loop: its settings, and everything that report, result and models out are made from."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic import Field as Setting

from litho_data.foundation.errors import InputError
from litho_data.foundation.settings import refused
from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import Loss
from litho_models.fitting.pixel_weights import Weights
from litho_models.loop.choice import Choice
from litho_models.loop.equal_terms import BeforeAfter, TermSet
from litho_models.loop.explainable import Rest
from litho_models.loop.folded_base import FoldedBase
from litho_models.loop.gain_split import GainStep
from litho_models.loop.identifiability import Identifiability, Profile
from litho_models.loop.nested import HeldOut, Nested
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.layout import LAYOUT_FEATURES
from litho_models.loop.screening.power import Planted
from litho_models.loop.selection.weight import Weight
from litho_models.loop.single_scans.observed import Observed
from litho_models.loop.structure import CovariateTest, is_structured
from litho_models.loop.study import Score, State
from litho_models.scan_terms import BackgroundUse, Terms


class LoopConfig(BaseModel):
    """Settings of one run; the defaults are the reference."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folds: int = Setting(6, ge=2, description="outer folds by scan")
    seed: int = Setting(0, ge=0, description="folds, calibration blocks, bootstrap")
    loss: Loss = Setting("squares", description="what fits minimise; absolute, as in a benchmark")
    weights: Weights = Setting("uniform", description="what pixels count for in fits")
    background: BackgroundUse = Setting(
        "none", description="training: reported errors with the background that a benchmark learns"
    )
    nested: HeldOut | None = Setting(
        None, description="also choose everything anew without each fold, or each print, and judge it there"
    )
    open_lock_box: bool = False
    prior_hypotheses: tuple[str, ...] = ()
    inject: tuple[str, ...] = ()

    def __init__(self, **settings: Any):
        """Check the settings.

        Raises:
            InputError: an unknown one, or a value out of range.
        """
        try:
            super().__init__(**settings)
        except ValidationError as error:
            raise refused(error) from None


def loop_config(given: LoopConfig | None) -> LoopConfig:
    """The settings that were given, or the defaults; InputError for anything else."""
    if given is not None and not isinstance(given, LoopConfig):
        raise InputError("config", got=type(given).__name__, wanted="a LoopConfig")
    return given or LoopConfig()


@dataclass(frozen=True)
class LoopFindings(Choice):
    """Everything that report and ``close_loop.json`` are made from: the choice, and what was seen beside it.

    Attributes:
        locked: the scans that are not in ``study``.
        lock_box: ids of the locked scans, those that cannot be used among them.
        floor_nm: lower bound of the noise, nm (root mean square, mean absolute).
        structure: covariate tests on what is left beside all that follows a covariate.
        explainable: what layout and place still explain, by stage of the loop.
        weights: what each named effect gains beside its generic rivals.
        locked_scores: by name of the terms, errors of the locked scans before and after, if opened.
        observed: what is seen without a model, by name.
        identifiability, profiles: how well the scans pin down what was fitted to name the causes.
        gain_steps: what each thing that was added gains; ``planted``: power of the screening, if asked for.
        nested: the choice made without the scans that it is judged on, if asked for.
    """

    locked: list[PreparedScan]
    lock_box: list[str]
    floor_nm: tuple[float, float]
    structure: list[CovariateTest]
    explainable: dict[str, Rest]
    weights: dict[str, Weight]
    locked_scores: dict[TermSet, BeforeAfter] | None
    observed: dict[str, Observed]
    identifiability: Identifiability | None
    profiles: list[Profile]
    gain_steps: list[GainStep]
    planted: list[Planted]
    nested: Nested | None
    config: LoopConfig

    @property
    def development(self) -> Sequence[PreparedScan]:
        return self.study.scans

    @property
    def prints(self) -> list[str]:
        """The print of each development scan."""
        return [scan.stored.print_id for scan in self.development]

    @property
    def structured(self) -> list[CovariateTest]:
        return is_structured(self.structure)

    @property
    def rest(self) -> Rest:
        """What layout and place still explain beside all that follows a covariate."""
        return [rest for stage, rest in self.explainable.items() if stage != LAYOUT_FEATURES][-1]

    def errors(self, state: State, terms: Terms) -> Score:
        """Held-out errors of a state over the development scans."""
        return state.score(self.study, terms)


def corrected_chain(findings: LoopFindings) -> EffectChain:
    """The final model at the parameters fitted on all development scans, a copy."""
    chain = copy.deepcopy(findings.final.fits.chain)
    if isinstance(chain.base, FoldedBase):
        effects, common = chain.values(), chain.base.common
        return EffectChain(common, effects, full_height_um=chain.full_height_um, pitch_um=chain.pitch_um)
    return chain
