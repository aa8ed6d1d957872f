"""The records ``evaluation.json`` and ``benchmark.json``, and a function that compares two such records."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import read_text
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.evaluation.fit_cache import FitRecord
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.records import ModelScores, Paired, paired_scores
from litho_models.splits.folds import ScoredSplit

if TYPE_CHECKING:
    import pandas as pd


class ModelRecord(Record):
    """The frozen model that was scored."""

    name: str
    sha256: str
    extrapolated: bool
    parameters: int | None = None


class Evaluation(Result):
    """The content of ``evaluation.json``: the scores of one frozen model."""

    SCHEMA = "litho-models/evaluation/1"
    FILE_NAME = "evaluation.json"

    run: RunInfo
    dataset: DatasetId
    model: ModelRecord
    split: ScoredSplit
    nuisance: NuisanceProtocol
    noise_floor: NoiseFloor
    trained_on_scored_scans: list[str]
    scores: ModelScores


class Benchmark(Result):
    """The content of ``benchmark.json``: the scores of several cross-validated models."""

    SCHEMA = "litho-models/benchmark/1"
    FILE_NAME = "benchmark.json"

    run: RunInfo
    dataset: DatasetId
    split: ScoredSplit
    nuisance: NuisanceProtocol
    noise_floor: NoiseFloor
    training: dict[str, dict[str, Any]]
    scores: list[ModelScores]
    locked_scores: list[ModelScores] = Field(default_factory=list)
    paired: list[Paired]
    fits: list[FitRecord]


def compare(first: str | Path, second: str | Path) -> pd.DataFrame:
    """Compare the leading errors of two results, scan by scan. The leading error is the datum-free mean
    absolute error or, for films, the mean shift of the edges. Each result is a ``benchmark.json`` or an
    ``evaluation.json``.

    For every model in both results, its errors in the first and in the second result are compared. If each
    result contains only one model, these two models are compared, even if their names differ. A negative
    difference means that the model of the first result is better.

    Raises:
        InputError: a file cannot be read; the results differ in data, split, scored scans, nuisance terms or
            background; one result contains errors on training scans, but the other does not; or there are no
            models to compare.
    """
    import pandas as pd

    (protocol, left), (other, right) = _scored(first), _scored(second)
    for key, value in protocol.items():
        if other[key] != value:
            raise InputError(
                f"cannot compare {first} with {second}: {key} differs",
                got=f"{_short(value)} and {_short(other[key])}",
                wanted="two results with the same protocol",
            )
    pairs = [(left[name], right[name]) for name in left if name in right]
    if len(left) == len(right) == 1:
        pairs = [*zip(left.values(), right.values(), strict=True)]
    if not pairs:
        raise InputError(
            "models of the two results",
            got=f"{', '.join(left)} and {', '.join(right)}",
            wanted="at least one model that both results contain",
        )
    return pd.DataFrame([_row(*pair) for pair in pairs])


def _scored(path: str | Path) -> tuple[dict[str, object], dict[str, ModelScores]]:
    """Read a result. Return the facts that must agree between two compared results, and the scores, keyed by
    model name.
    """
    file = Path(path)
    if file.is_dir():
        names = [name for name in (Benchmark.FILE_NAME, Evaluation.FILE_NAME) if (file / name).exists()]
        file = file / (names[0] if names else Benchmark.FILE_NAME)
    result: Benchmark | Evaluation
    result = Evaluation.read(file) if _schema(file) == Evaluation.SCHEMA else Benchmark.read(file)
    split = result.split
    protocol: dict[str, object] = {
        "dataset": result.dataset.sha256,
        "split": split.model_dump(include={"kind", "folds", "seed"}),
        "scored scans": split.scored_ids_sha256,
        "held out": isinstance(result, Benchmark) or not result.trained_on_scored_scans,
        "nuisance": result.nuisance.model_dump(),
    }
    scores = result.scores if isinstance(result, Benchmark) else [result.scores]
    return protocol, {s.model: s for s in scores}


def _schema(file: Path) -> object:
    try:
        content = json.loads(read_text(file))
    except (OSError, ValueError):
        return None
    return content.get("schema") if isinstance(content, dict) else None


def _row(first: ModelScores, second: ModelScores) -> dict[str, object]:
    paired = paired_scores(first, second)
    low, high = paired.ci95_nm or (float("nan"), float("nan"))
    return {
        "first": first.model,
        "second": second.model,
        "first_nm": first.leading_nm,
        "second_nm": second.leading_nm,
        "difference_nm": paired.mean_nm,
        "low_nm": low,
        "high_nm": high,
        "p": paired.p,
        "first_better": f"{paired.first_better}/{paired.scans}",
    }


def _short(value: object) -> str:
    """Return a value as text. A hash is shortened to its first digits, which suffice to tell two hashes
    apart.
    """
    text = str(value)
    return f"{text[:12]}…" if len(text) == 64 and " " not in text else text
