"""``close_loop.json``, schema ``litho-models/close-loop/3``."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.pairs import OverUnits
from litho_models.scoring.statistics import ByPrint
from litho_models.splits.folds import Split

ChosenKind = Literal["named", "generic", "per-scan"]
Part = Literal["process", "undetermined", "measurement", "per-scan"]
EffectVerdict = Literal["explained", "confusable", "partial", "traced-to-covariate"]
Verdict = Literal["traced", "nothing-missing", "unexplained", "too-few-scans"]
Decided = Literal["decided", "still open", "none of them", "not shown by these prints"]
CandidateVerdict = Literal[
    "explained",
    "confusable",
    "partial",
    "contradicted",
    "absorbed",
    "not-testable",
    "below-noise",
    "traced-to-covariate",
]


class Errors(Record):
    """Nothing fitted (``mae_abs_nm``), and the zero of each scan free: k = 1, before and after alike.

    In results of schema 1 the zero alone before, and all accepted terms after.
    """

    mae_abs_nm: float
    mae_datum_free_nm: float
    mae_datum_free_ci95_nm: tuple[float, float]
    rmse_datum_free_nm: float


class TermsError(Record):
    """Held-out error with ``k`` terms per scan, their effective number in the mean over scans, nm."""

    k: float
    mae_nm: float
    mae_ci95_nm: tuple[float, float] | None
    rmse_nm: float


class EqualTerms(Record):
    """Errors before and after with the same terms per scan: a policy of the benchmark, or the accepted terms.

    Offsets of lines count with their weight, so that ``k`` of the same terms may differ a little. The gain is
    before minus after of the mean absolute error, with its interval and sign flips over scans and over prints
    (None for a single print).
    """

    terms: Literal["offset", "offset-gain", "full", "accepted"]
    before: TermsError
    after: TermsError
    gain_nm: float
    over_scans: OverUnits
    over_prints: OverUnits | None


class GainPart(Record):
    """What one of the added things gains, MAE in nm: see ``gain_split.GainStep`` for the figures.

    ``part``: ``process``, what the exported model has; ``measurement``, of the microscope and the same in all
    scans; ``per-scan``, terms of single scans; ``undetermined``, everything else.
    """

    name: str
    part: Part
    k: float
    in_order_nm: float
    in_order_k1_nm: float
    left_out_nm: float
    left_out_k1_nm: float


class Chosen(Record):
    """An effect, generic term or effect of single scans, and in how many of the selections it was chosen."""

    name: str
    kind: ChosenKind
    times: int


class NestedResult(Record):
    """Everything chosen anew without each fold of scans, or each print, and judged there.

    ``equal_terms``: as for the loop itself; ``accepted`` are the terms that each selection accepted.
    ``chosen``: by kind, the most frequent first.
    """

    held_out: Literal["folds", "prints"]
    selections: int
    equal_terms: list[EqualTerms]
    chosen: list[Chosen]


class ParameterEstimate(Record):
    value: float
    unit: str
    ci95: tuple[float, float] | None


class AddedEffect(Record):
    """``terms_per_scan``: effective number before and after; ``over_prints``: as in ``EqualTerms``.

    ``share``: of what the best generic rival explains in its place, for named effects of the printer. All
    three are None in results of schema 1.
    """

    name: str
    stage: Literal["exposure", "resist", "development", "measurement"]
    role: Literal["process", "measurement", "nuisance", "undetermined"]
    verdict: EffectVerdict
    prior_hypothesis: bool
    parameters: dict[str, ParameterEstimate]
    metric: Literal["mae_abs", "mae_datum_free"]
    before_nm: float
    after_nm: float
    gain_ci95_nm: tuple[float, float]
    p_screen: float
    p_confirm: float
    scans_improved: tuple[int, int]
    confusable_with: list[str]
    separating_experiment: str
    terms_per_scan: tuple[float, float] | None = None
    over_prints: OverUnits | None = None
    share: float | None = None
    by_print: ByPrint | None = None


class Candidate(Record):
    name: str
    verdict: CandidateVerdict
    reason: str
    p_screen: float | None = None
    gain_nm: float | None = None


class Shares(Record):
    nuisance: float
    effects: float
    traced: float
    masked_defects: float
    unexplained_structured: float
    noise_floor: float


class Explainable(Record):
    """What a ridge over features of layout and place explains out of fold, at one stage of the loop.

    Of the squared error per pixel with ``k`` terms per scan free; the interval over scans is None with fewer
    than six.
    """

    stage: str
    squared_error_nm2: float
    k: int
    explained_nm2: float
    explained_ci95_nm2: tuple[float, float] | None


class Residual(Record):
    state: Literal["at-floor", "unexplained", "undecided"]
    signature: str


class Comparison(Record):
    """Of two rivals on new scans: how much smaller the squared error of the first is, mean over pixels.

    ``z``: what of it neither noise nor the form of the model explains, in standard deviations of the noise.
    ``difference_nm``: rms difference of the two predictions; ``form_nm``: error of the model's own form at
    most. Both None before schema 3, where ``z`` counted noise alone.
    """

    better: str
    worse: str
    gain_nm2: float
    z: float
    difference_nm: float | None = None
    form_nm: float | None = None


class Decision(Record):
    """A question declared by the first round, and what the new prints say."""

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

    ``fewest_scans``: with fewer to work on the verdict is ``too-few-scans`` unless something is found.
    ``settings``: what was asked for, None in older results.
    ``decisions``: what further stores decided about names and sets declared on the first, if there were any.
    ``gain_split``: what each step gains, in the order added; ``nested``: if asked for. ``equal_terms``,
    ``gain_split``, ``explainable``, ``fewest_scans`` and, where the lock box was opened,
    ``locked_equal_terms`` are None in results of schema 1.
    """

    SCHEMA: ClassVar[str] = "litho-models/close-loop/3"
    OLDER: ClassVar[tuple[str, ...]] = ("litho-models/close-loop/2", "litho-models/close-loop/1")
    FILE_NAME: ClassVar[str] = "close_loop.json"

    run: RunInfo
    dataset: DatasetId
    base_model: str
    settings: dict[str, Any] | None = None
    at_bounds: dict[str, float] = Field(default_factory=dict)
    split: Split
    nuisance: NuisanceProtocol
    prior_hypotheses: list[str]
    noise_floor: NoiseFloor
    before: Errors
    after: Errors
    locked_before: Errors | None = None
    locked_after: Errors | None = None
    equal_terms: list[EqualTerms] | None = None
    locked_equal_terms: list[EqualTerms] | None = None
    gain_split: list[GainPart] | None = None
    nested: NestedResult | None = None
    effects: list[AddedEffect]
    candidates: list[Candidate]
    shares: Shares
    explainable: list[Explainable] | None = None
    residual: Residual
    verdict: Verdict
    decisions: list[Decision] | None = None
    fewest_scans: int | None = None

    @property
    def headline(self) -> EqualTerms | None:
        """The zero of each scan free, before and after; None in results of schema 1."""
        return self.equal_terms[0] if self.equal_terms else None

    def gain_by_part(self, figure: Literal["in_order_nm", "in_order_k1_nm"]) -> dict[Part, float]:
        """Sums of a figure of ``gain_split`` over the parts that have any, in nm."""
        sums: dict[Part, float] = {}
        for step in self.gain_split or []:
            sums[step.part] = sums.get(step.part, 0.0) + getattr(step, figure)
        return sums

    @model_serializer(mode="wrap")
    def _without_unopened_lock_box(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {
            k: v
            for k, v in handler(self).items()
            if v is not None or not k.startswith(("locked_", "decisions"))
        }
