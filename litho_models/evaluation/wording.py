"""Evaluations in plain words: the verdict of a report, and what the columns of its tables are."""

from __future__ import annotations

from litho_models.evaluation.results import Benchmark, Evaluation
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.pairs import Paired

# What counts as more than chance: an interval without zero, and sign flips of the independent units below.
_CHANCE = 0.05


def benchmark_verdict(result: Benchmark) -> str:
    """Which model predicts best, by how much, whether that is more than chance, and what noise leaves."""
    ranking = sorted(result.scores, key=lambda one: one.mae_datum_free_nm)
    best, *others = ranking
    unit = "quadrants" if result.split.kind == "paper" else "scans"
    text = (
        f"{best.model} is best at predicting {unit} it was not trained on: {best.mae_datum_free_nm:.2f} nm "
        f"mean error over {len(best.scans)} {unit}. "
    )
    if others:
        second = others[0]
        text += f"{second.model} is next with {second.mae_datum_free_nm:.2f} nm; "
        names = {best.model, second.model}
        pair = next((one for one in result.paired if {one.first, one.second} == names), None)
        text += "they were not compared scan by scan. " if pair is None else f"{chance_text(pair)}. "
    return text + _share_of_noise(result.noise_floor, best.mae_datum_free_nm, result.nuisance.policy)


def evaluation_verdict(result: Evaluation) -> str:
    """How far the model is off on scans, what of it the zero height is, and what noise leaves."""
    scores = result.scores
    trained = len(result.trained_on_scored_scans)
    seen = f" ({trained} of which it was trained on)" if trained else ""
    return (
        f"{result.model.name} is off by {scores.mae_abs_nm:.1f} nm over {len(scores.scans)} scans{seen} as "
        f"it stands, and by {scores.mae_datum_free_nm:.2f} nm once the scan's own terms are fitted. "
        + _share_of_noise(result.noise_floor, scores.mae_datum_free_nm, result.nuisance.policy)
    )


def chance_text(pair: Paired) -> str:
    """Whether the difference of a pair is more than chance, judged over prints where there are several."""
    size = f"the difference is {abs(pair.mean_nm):.2f} nm"
    over = pair.over_prints
    if over is not None and over.smallest_p > _CHANCE:
        return f"{size}, and {over.count} prints are too few to tell it from chance"
    p, count, unit = (pair.p, pair.scans, "scans") if over is None else (over.p, over.count, "prints")
    excluded = pair.ci95_nm is not None and (pair.ci95_nm[0] > 0 or pair.ci95_nm[1] < 0)
    if p <= _CHANCE and excluded:
        return f"{size}, more than chance (p = {p:.2g} over {count} {unit})"
    return f"{size}, which may be chance (p = {p:.2g} over {count} {unit})"


def _share_of_noise(floor: NoiseFloor, error_nm: float, policy: str) -> str:
    """What of an error is noise that no model can predict."""
    least = floor.mae_at(policy)
    if least is None:
        return "How much of it is noise that no model can predict is not known."
    if floor.kind == "upper-estimate":
        return f"Noise that no model can predict makes up {least:.2f} nm at most."
    return (
        f"Noise that no model can predict makes up {least:.2f} nm, so {error_nm - least:.2f} nm can be won."
    )
