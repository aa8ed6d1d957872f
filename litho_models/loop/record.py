"""The record of a loop, ``close_loop.json`` (schema 4), from which the report and its tables are made."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.effects import CATALOGUE
from litho_models.effects.effect import Knowledge, Role
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scan_terms.policies import Policy, usual_policy
from litho_models.scoring.statistics import OverUnits
from litho_models.splits.folds import Split

Verdict = Literal["traced", "described", "nothing-missing", "unexplained", "too-few-scans"]
EffectVerdict = Literal["explained", "confusable", "lawful", "described"]
CandidateVerdict = Literal[
    "explained",
    "confusable",
    "resembles",
    "contradicted",
    "absorbed",
    "not-testable",
    "below-noise",
    "too-few-scans",
]
Stage = Literal["base", "causes", "all"]
Decided = Literal["decided", "still open", "none of them", "not shown by these prints"]
MeasuredBy = Literal["print alone", "published", "shared"]


class ErrorRow(Record):
    """Error of one model on held-out scans.

    Attributes:
        model: ``base`` for the base model, ``causes`` for the base model with the causes that were found, or
            ``all`` for the corrected model.
        measurement: what was added to the predicted print. ``print alone`` adds nothing, ``published`` adds
            the smooth background of the training scans (the published protocol), and ``shared`` adds the
            whole measurement model.
        policy: the ``k`` terms fitted to each scan, on pixels that are not scored.
        held_out: what was held out: folds of scans, whole prints, or the locked scans. ``nested`` means that
            all choices were also made without the held-out scans.
        printer_numbers: number of fitted parameters of the model.
        measurement_numbers: number of fitted parameters of the measurement model, in the fold where this
            number is largest.
        edge_by_scan_nm: mean distance of the edges, for films.
    """

    model: Stage
    measurement: MeasuredBy = "shared"
    policy: Policy
    k: float
    held_out: Literal["scans", "prints", "nested folds", "nested prints", "locked"] = "scans"
    printer_numbers: int
    measurement_numbers: int
    mae_nm: float
    mae_ci95_nm: tuple[float, float] | None
    rmse_nm: float
    by_scan_nm: dict[str, float]
    edge_by_scan_nm: dict[str, float] = Field(default_factory=dict)

    @property
    def leading_by_scan_nm(self) -> dict[str, float]:
        """Return the leading error by scan, which is the error of the edges for films and the error of the
        heights for all other prints.
        """
        return self.edge_by_scan_nm or self.by_scan_nm

    @property
    def leading_nm(self) -> float:
        """Return the mean of the leading error over scans."""
        return sum(self.leading_by_scan_nm.values()) / len(self.leading_by_scan_nm)

    @property
    def is_headline(self) -> bool:
        """Return whether this is the headline error.

        The headline error is computed with k = 1 (for films with k = 0), with the shared measurement model
        and on held-out folds of scans.
        """
        usual = usual_policy(bool(self.edge_by_scan_nm))
        return (self.policy, self.measurement, self.held_out) == (usual, "shared", "scans")


class Strength(Record):
    """A fitted parameter for one label, with its confidence interval over prints, or over scans if no prints
    are known.
    """

    label: str
    value: float
    unit: str
    ci95: tuple[float, float] | None


class FoundEffect(Record):
    """An effect, law or table that was added to the model.

    Attributes:
        by: the grouping by which the strength differs, or ``all`` if all scans have the same strength.
        strengths: fitted values of each parameter.
        gain_nm2: decrease of the squared error of held-out scans when the effect is added to everything else
            in the model. The error is computed on the fitted pixels, after seven terms and an affine
            registration error have been removed from each scan.
        left_out_nm: increase of the mean absolute error if the effect is left out (k = 1).
        family_p: p value of the effect in the screening of all candidates.
        group_p: p value of the grouping, from permuted labels.
        reshaped_share: further gain if variants of the effect's change were added to the model, divided by
            the gain of the effect itself.
        survives_on: other bases with which the search also found the effect.
    """

    name: str
    title: str
    knowledge: Knowledge
    role: Role
    stage: str
    verdict: EffectVerdict
    by: str
    strengths: dict[str, list[Strength]]
    confusable_with: list[str]
    separating_experiment: str
    gain_nm2: float
    before_nm2: float
    scans_improved: tuple[int, int]
    p_confirm: float
    family_p: float
    group_p: float | None
    reshaped_share: float | None
    left_out_nm: float | None = None
    survives_on: list[str] = Field(default_factory=list)


class Candidate(Record):
    """An effect that was not added, with the reason."""

    name: str
    verdict: CandidateVerdict
    reason: str
    p_screen: float | None = None
    gain_nm2: float | None = None


class ScanFinding(Record):
    """A per-scan term, or a mark found in single scans, that is not part of any model.

    Attributes:
        seen: whether the term or mark was found.
        evidence: the evidence, in words.
        p: p value of the test.
        spread: standard deviation of each parameter over scans.
        confusable_with: effects that look the same in these scans.
    """

    name: str
    title: str
    role: Role
    seen: bool
    evidence: str
    p: float | None = None
    spread: dict[str, Strength] = Field(default_factory=dict)
    confusable_with: list[str] = Field(default_factory=list)

    @classmethod
    def of(cls, name: str, evidence: str, *, seen: object, **facts: Any) -> ScanFinding:
        """Make a finding, by default with the title and role that the catalogue states."""
        effect = CATALOGUE.get(name)
        role = effect.role if effect else "measurement"
        known = {"title": effect.title if effect else name, "role": role, **facts}
        return cls(name=name, evidence=evidence, seen=bool(seen), **known)


class Planted(Record):
    """An effect planted in copies of the scans, and what the loop found in these copies.

    ``rms_nm`` is the rms of the change that the planted effect makes, after the free terms of each scan are
    removed. ``named`` is the reported set of effects that contains the planted effect; it is empty if no set
    contains it. ``found`` is the fitted amount.
    """

    name: str
    amount: float
    unit: str
    rms_nm: float
    named: list[str]
    found: float | None


class Explained(Record):
    """How much of the squared error on held-out scans (nm²) can still be explained by features of the layout
    and of the position. ``matters`` says whether this part is larger than expected by chance.
    """

    stage: str
    squared_error_nm2: float
    explained_nm2: float
    matters: bool


class Comparison(Record):
    """A comparison of two answers on new prints.

    ``gain_nm2`` and ``z`` say how much better the first answer fits, in nm² and in standard deviations.

    ``z`` allows for an error in the form of the model. ``difference_nm`` is the rms difference of
    the two predictions.
    """

    better: str
    worse: str
    gain_nm2: float
    z: float
    difference_nm: float


class Decision(Record):
    """The state of an open question after new prints.

    ``declared`` lists the answers that were declared before the prints, and ``left`` lists the answers that
    remain.
    """

    question: str
    kind: str
    declared: list[str]
    left: list[str]
    verdict: Decided
    evidence: str
    prints: int
    scans: int
    comparisons: list[Comparison] = Field(default_factory=list)


class CloseLoop(Result):
    """The record of a loop.

    Attributes:
        errors: see ``ErrorRow``.
        gain_nm: the error of the base model minus the error of the corrected model, at k = 1 and with the
            shared measurement model. ``over_scans`` and ``over_prints`` contain its confidence intervals.
        confounded: pairs of parameters that these scans cannot determine separately, with the correlation of
            each pair.
        decisions: open questions of this store to which the prints of further stores were applied.
    """

    SCHEMA: ClassVar[str] = "litho-models/close-loop/4"
    FILE_NAME: ClassVar[str] = "close_loop.json"
    FORMER: ClassVar[frozenset[str]] = frozenset({"groups", "chosen"})

    run: RunInfo
    dataset: DatasetId
    base_model: str
    base_values: dict[str, float]
    corrected_values: dict[str, float]
    settings: dict[str, Any]
    at_bounds: dict[str, float]
    split: Split
    errors: list[ErrorRow]
    gain_nm: float
    over_scans: OverUnits
    over_prints: OverUnits | None
    effects: list[FoundEffect]
    candidates: list[Candidate]
    single_scans: list[ScanFinding] = Field(default_factory=list)
    planted: list[Planted] = Field(default_factory=list)
    confounded: list[tuple[str, str, float]] = Field(default_factory=list)
    measurement: MeasurementModel
    explained: list[Explained]
    decisions: list[Decision] = Field(default_factory=list)
    verdict: Verdict
    fewest_scans: int

    def error(
        self,
        model: Stage,
        policy: Policy | None = None,
        measurement: MeasuredBy = "shared",
        held_out: str = "scans",
    ) -> ErrorRow | None:
        """Return the row of the errors with these properties, or None if this error was not computed.

        The default policy is the usual one.
        """
        policy = policy or usual_policy(any(row.edge_by_scan_nm for row in self.errors))
        wanted = model, policy, measurement, held_out
        rows = (r for r in self.errors if (r.model, r.policy, r.measurement, r.held_out) == wanted)
        return next(rows, None)
