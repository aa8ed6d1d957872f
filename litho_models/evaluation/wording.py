"""Evaluations in plain words: the verdict of a report, and what the columns of its tables are."""

from __future__ import annotations

from litho_models.evaluation.results import Benchmark, Evaluation
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.pairs import Paired

# What counts as more than chance: an interval without zero, and sign flips of the independent units below.
_CHANCE = 0.05

_INTERVAL = "bootstrap over whole scans"
COLUMNS: dict[str, tuple[str, str]] = {
    "mae_datum_free_nm": (
        "error (nm)",
        "mean absolute error over scans, once its own terms (at least the zero height) are fitted to "
        "each scan, on other pixels than those scored",
    ),
    "mae_datum_free_ci95_nm": ("error, 95 % interval", f"of the error; {_INTERVAL}"),
    "above_floor_nm": ("above the noise (nm)", "error minus the noise floor of the same terms"),
    "rmse_datum_free_nm": ("RMS error (nm)", "root mean square instead of mean absolute error"),
    "mae_abs_nm": (
        "error, nothing fitted (nm)",
        "mean absolute error, zero height of the scan included",
    ),
    "mae_abs_ci95_nm": ("nothing fitted, 95 % interval", _INTERVAL),
    "bias_nm": ("bias (nm)", "mean of measured minus predicted height, nothing fitted"),
    "median_abs_datum_free_nm": ("median error (nm)", "half of the pixels have a smaller error"),
    "p95_abs_datum_free_nm": ("95th percentile (nm)", "1 in 20 pixels has a larger error"),
    "slope": ("gain", "of the line through measured against predicted height"),
    "slope_error": ("gain, standard error", "from blocks of pixels"),
    "intercept_nm": ("offset (nm)", "measured height where the prediction is zero"),
    "intercept_error_nm": ("offset, standard error (nm)", "from blocks of pixels"),
    "slope_intercept_correlation": ("correlation of gain and offset", "of their errors"),
    "phase_rms_waves": ("phase error (waves)", "RMS error that light passing the print would see"),
    "ssim": ("SSIM", "structural similarity of predicted and measured height; 1: the same"),
    "edge_mean_nm": ("edge shift, mean (nm)", "distance between predicted and measured edges"),
    "edge_p95_nm": ("edge shift, 95th percentile (nm)", "1 in 20 edge pixels is further off"),
    "edge_matched": ("edges found", "pieces of measured edges that have a partner in the prediction"),
    "edge_unmatched": ("edges not found", "pieces of measured edges that have none"),
    "edge_unmatched_expected": ("edges too many", "pieces of predicted edges without a partner"),
    "background": ("background", "what the training scans have in common beside their prints: added or not"),
    "none_mae_nm": ("nothing fitted (nm)", "mean absolute error, nothing fitted to the scan"),
    "offset_mae_nm": ("zero height (nm)", "mean absolute error with the zero height of each scan fitted"),
    "offset-gain_mae_nm": ("zero and gain (nm)", "and the gain"),
    "full_mae_nm": ("zero, gain, tilt, bow (nm)", "and tilt and bow: 7 terms"),
    "full+rows_mae_nm": ("and line offsets (nm)", "and an offset of each scan line"),
    "full+rows_k": ("terms with lines", "effective number of fitted terms with line offsets"),
    "first": ("model", ""),
    "second": ("against", ""),
    "mean_nm": (
        "difference (nm)",
        "error of the model minus that of the other, mean over scans",
    ),
    "ci95_nm": ("95 % interval over scans", _INTERVAL),
    "p": ("p over scans", "chance of as much if the signs of the differences were random"),
    "first_better": ("scans better", "in how many scans the model has the smaller error"),
    "ci95_over_prints_nm": (
        "95 % interval over prints",
        "scans of one print are not independent: prints are",
    ),
    "p_over_prints": ("p over prints", "the same with the signs of whole prints"),
    "smallest_p_over_prints": ("smallest p possible", "so few prints cannot show a smaller one"),
    "training_nm": ("error in training (nm)", "on the scans that were learned from"),
    "inner_validation_nm": ("on validation scans (nm)", "held back from training to choose when to stop"),
    "held_out_nm": ("on unseen scans (nm)", "the error that counts"),
    "training_s": ("training (s)", "on the machine at hand"),
    "tile_max_nm": (
        "other crop, largest (nm)",
        "largest change of the same pixels predicted in another crop",
    ),
    "tile_rms_nm": ("other crop, RMS (nm)", "RMS change of the same pixels predicted in another crop"),
    "prediction_s": ("prediction (s)", "per scan, on the machine at hand"),
    "prediction_mib": ("memory (MiB)", "at most, while one scan is predicted"),
    "half_power_x_per_um": (
        "half power along x (1/µm)",
        "up to here the prediction keeps 1/√2 of the detail",
    ),
    "half_power_y_per_um": ("half power along y (1/µm)", "the same along y"),
    "noise_band_x_per_um": (
        "noise band along x (1/µm)",
        "ideal low pass that lets as much white noise through",
    ),
    "noise_band_y_per_um": ("noise band along y (1/µm)", "the same along y"),
}


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
