"""``close_loop.json``, schema 4: what was found, written once; report and tables read it."""

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
    """Error of one model on scans held out from it.

    Attributes:
        model: the base, with its causes, with all that was found (``all``, the corrected model).
        measurement: what is added to the print: nothing, the smooth background that training scans share (the
            published protocol), or the whole measurement model.
        policy: terms of each scan, ``k`` of them, fitted on pixels that are not scored.
        held_out: folds of scans, or whole prints; nested where everything was chosen anew without them.
        printer_numbers: fitted numbers of the model; ``measurement_numbers``: of the measurement, the largest
            of any fold.
        edge_by_scan_nm: mean distance of the edges, of films.
    """

    model: Stage
    measurement: MeasuredBy
    policy: Policy
    k: float
    held_out: Literal["scans", "prints", "nested folds", "nested prints", "locked"]
    printer_numbers: int
    measurement_numbers: int
    mae_nm: float
    mae_ci95_nm: tuple[float, float] | None
    rmse_nm: float
    by_scan_nm: dict[str, float]
    edge_by_scan_nm: dict[str, float] = Field(default_factory=dict)

    @property
    def leading_by_scan_nm(self) -> dict[str, float]:
        """The error that counts: of the edges of films, of all heights otherwise."""
        return self.edge_by_scan_nm or self.by_scan_nm

    @property
    def leading_nm(self) -> float:
        """Its mean over the scans."""
        return sum(self.leading_by_scan_nm.values()) / len(self.leading_by_scan_nm)

    @property
    def is_headline(self) -> bool:
        """Whether it is the one that is quoted: k = 1 (films 0), the shared measurement, folds of scans."""
        usual = usual_policy(bool(self.edge_by_scan_nm))
        return (self.policy, self.measurement, self.held_out) == (usual, "shared", "scans")


class Strength(Record):
    """A fitted number: its value for one label, and its interval over prints (over scans without prints)."""

    label: str
    value: float
    unit: str
    ci95: tuple[float, float] | None


class FoundEffect(Record):
    """Something added to the model.

    Attributes:
        by: the grouping in which its strength differs; ``all`` for one strength.
        strengths: parameter to its numbers.
        gain_nm2: what it takes from the squared error of held-out scans, the rest in place; scans and pixels
            as they are fitted, free of seven terms and an affine shift per scan.
        left_out_nm: by how much the mean absolute error grows when it is left out (k = 1).
        family_p: of its screening, over all candidates; ``group_p``: of its grouping, by exchanged labels.
        reshaped_share: what its change in other shapes would take beside it, of its own gain.
        survives_on: other bases beside which the search found it as well.
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
    """An effect that was not added, and why."""

    name: str
    verdict: CandidateVerdict
    reason: str
    p_screen: float | None = None
    gain_nm2: float | None = None


class ScanFinding(Record):
    """What single scans add, each its own, or what is seen in them directly; no model has it.

    Attributes:
        seen: whether it is there; ``evidence``: in a sentence; ``p``: of its test.
        spread: parameter to its standard deviation over scans.
        confusable_with: what these scans cannot tell from it.
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
        """With title and role of the catalogue, where it has the name and nothing else is said."""
        effect = CATALOGUE.get(name)
        role = effect.role if effect else "measurement"
        known = {"title": effect.title if effect else name, "role": role, **facts}
        return cls(name=name, evidence=evidence, seen=bool(seen), **known)


class Planted(Record):
    """An effect that was planted in copies of the scans: its amount, what it changes, what was found.

    ``rms_nm``: of the change, free of what single scans may add; ``named``: the set that it is in, empty if
    it was not found; ``found``: its amount there.
    """

    name: str
    amount: float
    unit: str
    rms_nm: float
    named: list[str]
    found: float | None


class Explained(Record):
    """What features of layout and place still explain out of fold, nm²; ``matters``: beyond chance."""

    stage: str
    squared_error_nm2: float
    explained_nm2: float
    matters: bool


class Comparison(Record):
    """Two answers on new prints: by how much the first is nearer, in nm² and in standard deviations.

    ``z`` is less what the form of the model may have made of it; ``difference_nm``: between the two, rms.
    """

    better: str
    worse: str
    gain_nm2: float
    z: float
    difference_nm: float


class Decision(Record):
    """A question that was open, and what new prints say: the answers declared before, and those left."""

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
    """What the loop found.

    ``errors``: see ``ErrorRow``; ``gain``: base minus all, k = 1, with the shared measurement, over scans and
    over prints. ``chosen``: in nested selections, how often each effect was chosen. ``confounded``: fitted
    numbers that these scans determine together only, with their correlation. ``decisions``: of further
    stores, about what was open on the first.
    """

    SCHEMA: ClassVar[str] = "litho-models/close-loop/4"
    FILE_NAME: ClassVar[str] = "close_loop.json"

    run: RunInfo
    dataset: DatasetId
    base_model: str
    base_values: dict[str, float]
    corrected_values: dict[str, float]
    settings: dict[str, Any]
    at_bounds: dict[str, float]
    split: Split
    groups: dict[str, list[str]]
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
    chosen: dict[str, int] = Field(default_factory=dict)
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
        """One row of the errors, with the usual terms unless stated; None if it was not measured."""
        policy = policy or usual_policy(any(row.edge_by_scan_nm for row in self.errors))
        wanted = model, policy, measurement, held_out
        rows = (r for r in self.errors if (r.model, r.policy, r.measurement, r.held_out) == wanted)
        return next(rows, None)
