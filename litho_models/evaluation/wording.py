"""Describe results in sentences, which are filled into templates: the verdict, the protocol and the notes."""

from pathlib import Path

from litho_data.reports.page import filled
from litho_models.evaluation.results import Benchmark, Evaluation
from litho_models.scoring.records import ModelScores

# Chance does not explain a difference if its confidence interval excludes zero and the p value of its
# sign-flip test is at most this value.
_CHANCE = 0.05


def benchmark_verdict(result: Benchmark) -> str:
    """Return sentences that state which model predicts best, how much worse the second-best model is, whether
    chance may explain this difference, and how large the noise floor is.

    If the scans come from several prints, the test of the difference treats prints instead of scans as
    independent.
    """
    best, second = [*sorted(result.scores, key=lambda one: one.leading_nm), None][:2]
    assert best is not None
    names = {best.model, second and second.model}
    pair = next((one for one in result.paired if {one.first, one.second} == names), None)
    return _verdict(result, best, second=second, pair=pair, chance=_CHANCE)


def evaluation_verdict(result: Evaluation) -> str:
    """Return sentences that state the noise floor and two errors of the model: with and without terms fitted
    to each scan.
    """
    return _verdict(result, result.scores)


def _verdict(result: Benchmark | Evaluation, best: ModelScores, **more: object) -> str:
    least = result.noise_floor.mae_at(result.nuisance.policy)
    return " ".join(said("verdict", result=result, best=best, least=least, **more))


def said(name: str, **values: object) -> list[str]:
    """Fill a template (``verdict``, ``protocol``, ``notes`` or ``paper``) and return its lines."""
    return filled(Path(__file__).with_name(f"{name}.jinja"), **values).splitlines()
