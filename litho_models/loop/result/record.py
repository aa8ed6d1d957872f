"""``close_loop.json``, schema ``litho-models/close-loop/1``."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import SerializerFunctionWrapHandler, model_serializer

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.splits.folds import Split

EffectVerdict = Literal["explained", "confusable", "traced-to-covariate"]
Verdict = Literal["traced", "nothing-missing", "unexplained"]
CandidateVerdict = Literal[
    "explained",
    "confusable",
    "contradicted",
    "absorbed",
    "not-testable",
    "below-noise",
    "traced-to-covariate",
]


class Errors(Record):
    mae_abs_nm: float
    mae_datum_free_nm: float
    mae_datum_free_ci95_nm: tuple[float, float]
    rmse_datum_free_nm: float


class ParameterEstimate(Record):
    value: float
    unit: str
    ci95: tuple[float, float] | None


class AddedEffect(Record):
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


class Candidate(Record):
    name: str
    verdict: CandidateVerdict
    reason: str
    p_screen: float | None
    gain_nm: float | None


class Shares(Record):
    nuisance: float
    effects: float
    traced: float
    masked_defects: float
    unexplained_structured: float
    noise_floor: float


class Residual(Record):
    state: Literal["at-floor", "unexplained", "undecided"]
    signature: str


class CloseLoop(Result):
    SCHEMA: ClassVar[str] = "litho-models/close-loop/1"
    FILE_NAME: ClassVar[str] = "close_loop.json"

    run: RunInfo
    dataset: DatasetId
    base_model: str
    split: Split
    nuisance: NuisanceProtocol
    prior_hypotheses: list[str]
    noise_floor: NoiseFloor
    before: Errors
    after: Errors
    locked_before: Errors | None = None
    locked_after: Errors | None = None
    effects: list[AddedEffect]
    candidates: list[Candidate]
    shares: Shares
    residual: Residual
    verdict: Verdict

    @model_serializer(mode="wrap")
    def _without_unopened_lock_box(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content = handler(self)
        return {
            k: v for k, v in content.items() if v is not None or k not in ("locked_before", "locked_after")
        }
