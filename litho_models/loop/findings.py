"""A closed loop: its settings, and everything that report, result and models out are made from."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict
from pydantic import Field as Setting

from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import Loss
from litho_models.loop.folded_base import FoldedBase
from litho_models.loop.identifiability import Identifiability, Profile
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes import Probed
from litho_models.loop.screening.power import Planted
from litho_models.loop.selection.search import Search
from litho_models.loop.single_scans.nested_tests import MeasurementTest
from litho_models.loop.single_scans.observed import Observed
from litho_models.loop.structure import CovariateTest, is_structured
from litho_models.loop.study import DATUM_FREE, Score, State, Study, names_to_terms
from litho_models.scan_terms import BackgroundUse, Terms


class LoopConfig(BaseModel):
    """Settings of one run; the defaults are the reference."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folds: int = Setting(6, ge=2, description="outer folds by scan")
    seed: int = Setting(0, ge=0, description="folds, calibration blocks, bootstrap")
    loss: Loss = Setting("squares", description="what fits minimise; absolute, as in a benchmark")
    background: BackgroundUse = Setting(
        "none", description="training: reported errors with the background that a benchmark learns"
    )
    open_lock_box: bool = False
    prior_hypotheses: tuple[str, ...] = ()
    inject: tuple[str, ...] = ()


@dataclass(frozen=True)
class LoopFindings:
    """Everything that the report and ``close_loop.json`` are made from.

    Attributes:
        study: development scans, their folds and how they are judged; ``locked``: the other scans.
        lock_box: ids of the locked scans, those that cannot be used among them.
        base, final: fitted states before and after; ``search``: how it got there.
        probed: generic terms where no named effect won; ``final`` predicts with them.
        first_tests, last_tests: measurement tests before and after the process effects.
        accepted: measurement effects in force at the end.
        floor_nm: lower bound of the noise, nm (root mean square, mean absolute).
        left_by_named, structure: covariate tests on what the named effects leave, and at last.
        locked_scores: (before, after) as pairs (no fit, datum free), if opened.
        observed: what is seen without a model, by name.
        identifiability, profiles: how well the scans pin down what was fitted to name the causes.
        untestable: effect to reason; ``planted``: power of the screening, if asked for.
    """

    study: Study
    locked: list[PreparedScan]
    lock_box: list[str]
    base: State
    final: State
    search: Search
    probed: Probed
    first_tests: list[MeasurementTest]
    last_tests: list[MeasurementTest]
    accepted: list[str]
    floor_nm: tuple[float, float]
    left_by_named: list[CovariateTest]
    structure: list[CovariateTest]
    locked_scores: tuple[tuple[Score, Score], tuple[Score, Score]] | None
    observed: dict[str, Observed]
    identifiability: Identifiability | None
    profiles: list[Profile]
    untestable: dict[str, str]
    planted: list[Planted]
    config: LoopConfig

    @property
    def development(self) -> Sequence[PreparedScan]:
        return self.study.scans

    @property
    def structured(self) -> list[CovariateTest]:
        return is_structured(self.structure)

    @property
    def terms(self) -> Terms:
        """Per-scan terms of the final error: the datum and the accepted measurement effects."""
        return DATUM_FREE | names_to_terms(self.accepted)

    def errors(self, state: State, terms: Terms) -> Score:
        """Held-out errors of a state over the development scans."""
        return state.score(self.study, terms)


def corrected_chain(findings: LoopFindings) -> EffectChain:
    """The final model at the parameters fitted on all development scans, a copy."""
    chain = copy.deepcopy(findings.final.fits.chain)
    if isinstance(chain.base, FoldedBase):
        effects, common = chain.values(), chain.base.common
        geometry = {"full_height_um": chain.full_height_um, "pitch_um": chain.pitch_um}
        return EffectChain(common, effects, **geometry)
    return chain
