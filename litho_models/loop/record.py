"""The record of a loop, i.e. of a search for effects that a base model lacks. It is written to the file
``close_loop.json`` (schema 4). The report and its tables are made from this record.
"""

from statistics import fmean
from typing import Any, ClassVar, Literal

from pydantic import Field

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.effects.effect import Knowledge, Role
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scan_terms.policies import Policy, usual_policy
from litho_models.scoring.statistics import Interval, OverUnits
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
    """The error of one model on held-out scans.

    Attributes:
        model: ``base`` for the base model, ``causes`` for the base model with the causes that were found, or
            ``all`` for the corrected model.
        measurement: what was added to the predicted print before it was compared with the scan. With ``print
            alone``, nothing was added. With ``published``, the smooth background of the training scans was
            added (the published protocol). With ``shared``, the whole measurement model was applied.
        policy: name of the policy, which is a set of terms. These terms were fitted to each scan, using only
            pixels that are not scored.
        k: effective number of these terms.
        held_out: what was held out: folds of scans, whole prints, or the locked scans. ``nested`` means that
            the held-out scans were used neither for the fits nor for choices, such as which effects to add.
            The only exception is the choice of the base model.
        printer_numbers: number of fitted parameters of the printer model.
        measurement_numbers: number of fitted parameters of the measurement model, in the fold where this
            number is largest.
        mae_nm, rmse_nm: mean absolute error and root mean square error.
        mae_ci95_nm: 95 % confidence interval of the mean absolute error, from resampling scans.
        by_scan_nm: mean absolute error of each scan, keyed by scan id.
        edge_by_scan_nm: for films, the mean distance between measured and predicted edges of each scan, keyed
            by scan id. It is empty for other prints.
    """

    model: Stage
    measurement: MeasuredBy = "shared"
    policy: Policy
    k: float
    held_out: Literal["scans", "prints", "nested folds", "nested prints", "locked"] = "scans"
    printer_numbers: int
    measurement_numbers: int
    mae_nm: float
    mae_ci95_nm: Interval
    rmse_nm: float
    by_scan_nm: dict[str, float]
    edge_by_scan_nm: dict[str, float]

    @property
    def leading_by_scan_nm(self) -> dict[str, float]:
        """Return the main error of each scan. It is the error of the edges for films, and the error of the
        heights for all other prints.
        """
        return self.edge_by_scan_nm or self.by_scan_nm

    @property
    def leading_nm(self) -> float:
        """Return the mean of the main error over scans."""
        return fmean(self.leading_by_scan_nm.values())

    @property
    def is_headline(self) -> bool:
        """Return whether this row is the headline error of its model, which is the error that the report
        shows first.

        The headline error is computed with k = 1 (for films with k = 0), with the shared measurement model,
        and on held-out folds of scans.
        """
        usual = usual_policy(bool(self.edge_by_scan_nm))
        return (self.policy, self.measurement, self.held_out) == (usual, "shared", "scans")


class Strength(Record):
    """The fitted value of a parameter for one group of scans, with its 95 % confidence interval. ``label`` is
    the label of the group; it is empty if the value holds for all scans.
    """

    label: str = ""
    value: float
    unit: str
    ci95: Interval = None


class FoundEffect(Record):
    """An effect, law or table that was added to the model.

    Attributes:
        by: ``all`` if the strength of the effect is the same in all scans, and otherwise the name of the
            grouping with one strength per group.
        strengths: fitted values of each parameter, keyed by the name of the parameter. There is one value per
            group if the parameter differs by group, and otherwise a single value.
        confusable_with: other effects that look the same in these scans.
        separating_experiment: experiments that would distinguish these effects.
        gain_nm2: decrease of the squared error of held-out scans when the effect is added to a model with all
            other effects. The error is computed on the pixels that are used for fits, after seven terms and
            an affine registration error have been subtracted from each scan.
        before_nm2: squared error of held-out scans without the effect, computed in the same way.
        scans_improved: number of held-out scans with a smaller error after the effect is added, and total
            number of scans.
        p_confirm: p value of the sign-flip test of the effect on held-out scans.
        family_p: p value of the effect in the screening of all candidates, corrected for the number of
            candidates.
        group_p: p value of the grouping, computed by permuting the labels of the scans; None if the strength
            does not differ by group.
        left_out_nm: increase of the headline error (see ``ErrorRow.is_headline``) if the effect is removed
            from the model.
        survives_on: names of the other base models that also need the effect beside all other effects.
    """

    name: str
    title: str
    knowledge: Knowledge
    role: Role
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
    left_out_nm: float
    survives_on: list[str]


class Candidate(Record):
    """An effect that was not added to the model, with the reason."""

    name: str
    verdict: CandidateVerdict
    reason: str
    p_screen: float | None
    gain_nm2: float | None


class ScanFinding(Record):
    """The evidence for a per-scan term or for a mark (such as a scar) in single scans. Such terms and marks
    are not part of any model.

    Attributes:
        seen: whether the scans show the term or mark.
        evidence: the evidence, in words.
        p: p value of the test.
        spread: standard deviation of each parameter over scans, keyed by the name of the parameter.
        confusable_with: other effects that look the same in these scans.
    """

    name: str
    title: str
    role: Role
    seen: bool
    evidence: str
    p: float | None = None
    spread: dict[str, Strength] = Field(default_factory=dict)
    confusable_with: list[str] = Field(default_factory=list)


class Planted(Record):
    """The record of an effect that was planted in copies of the scans, and of what the loop found in these
    copies.

    ``amount`` is the planted strength. ``rms_nm`` is the rms of the change that the planted effect makes,
    after the free terms of each scan have been fitted to this change and subtracted. If the planted effect is
    a cause that the loop found, or looks the same as such a cause, ``named`` lists this cause and all effects
    that look the same. Otherwise, ``named`` is empty. A cause counts only if all other base models also need
    it. ``found`` is the fitted strength of the planted effect, or None if this effect is not in the corrected
    model.
    """

    name: str
    amount: float
    unit: str
    rms_nm: float
    named: list[str]
    found: float | None


class Explained(Record):
    """The squared error on held-out scans after one stage of the loop, nm², and the part of this error that
    can still be explained by features of layout and position, nm². ``matters`` is True if this part is
    significant and exceeds 1 % of the error.
    """

    stage: str
    squared_error_nm2: float
    explained_nm2: float
    matters: bool


class Comparison(Record):
    """A comparison, on new prints, of two possible answers to a question.

    ``better`` is the answer that fits better, and ``worse`` is the other answer. ``gain_nm2`` is the
    difference of their squared errors. ``z`` is this difference minus an allowance for inexact formulas of
    the model, in standard deviations. ``difference_nm`` is the rms difference of the two predictions.
    """

    better: str
    worse: str
    gain_nm2: float
    z: float
    difference_nm: float


class Decision(Record):
    """What new prints have decided about an open question.

    ``declared`` lists the possible answers, which were stated before these prints were made, and ``left``
    lists the answers that are still possible. ``prints`` and ``scans`` are the numbers of new prints and of
    new scans.
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
        errors: the errors of all models on held-out scans, one row per model, policy and kind of held-out
            scans.
        gain_nm: decrease of the headline error (see ``ErrorRow.is_headline``) from the base model to the
            corrected model. ``over_scans`` and ``over_prints`` contain the confidence intervals of this
            decrease.
        decisions: decisions on the open questions of this loop, based on the prints of further stores.
    """

    SCHEMA: ClassVar[str] = "litho-models/close-loop/4"
    FILE_NAME: ClassVar[str] = "close_loop.json"

    run: RunInfo
    dataset: DatasetId
    base_model: str
    base_values: dict[str, float]
    corrected_values: dict[str, float]
    settings: dict[str, Any]
    split: Split
    errors: list[ErrorRow]
    gain_nm: float
    over_scans: OverUnits
    over_prints: OverUnits | None
    effects: list[FoundEffect]
    candidates: list[Candidate]
    single_scans: list[ScanFinding]
    planted: list[Planted]
    measurement: MeasurementModel
    explained: list[Explained]
    decisions: list[Decision]
    verdict: Verdict
    fewest_scans: int

    def error(
        self,
        model: Stage,
        policy: Policy | None = None,
        measurement: MeasuredBy = "shared",
        held_out: str = "scans",
    ) -> ErrorRow | None:
        """Return the error with the given properties, or None if this error was not computed.

        By default, ``policy`` is the usual policy: one offset is fitted to each scan. For films, nothing is
        fitted.
        """
        policy = policy or usual_policy(any(row.edge_by_scan_nm for row in self.errors))
        wanted = model, policy, measurement, held_out
        rows = (r for r in self.errors if (r.model, r.policy, r.measurement, r.held_out) == wanted)
        return next(rows, None)
