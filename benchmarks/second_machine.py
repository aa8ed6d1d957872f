"""Measure how well the models predict a second machine, which patterns silicon with an electron beam. The
patterns are imaged in a scanning electron microscope.

    litho-data build datasets/prefab-soi.toml --out prefab-soi.zarr
    python -m benchmarks.second_machine prefab-soi.zarr [--learned features,fno] [--loop FOLDER] [--publish]

The models are fitted fold by fold, with whole patterns held out, and judged by the edges that they predict
for these patterns. Then the closed loop is run on the same folds, with a base model that has only a spot and
a threshold. An interrupted run continues when it is run again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.markdown_table import markdown_table, with_interval
from benchmarks.record import conclude, kept, options, origin, place_for
from litho_data.commands.progress import progress, run_script
from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.reports.pictures import new_figure
from litho_data.store import PrintedScan, Store, open_store
from litho_models.fitting.fit import common_geometry, fit
from litho_models.fitting.runs import training_config
from litho_models.fitting.small_models import fit_small_model
from litho_models.loop.record import CloseLoop
from litho_models.loop.run import close_loop
from litho_models.models import build_model
from litho_models.prediction.tiles import predict_scan
from litho_models.scoring.films import film_edge_um, films_of_scan
from litho_models.scoring.shapes import edges_of_scan
from litho_models.scoring.statistics import bootstrap_interval, over_units
from litho_models.simulator import Simulator
from litho_models.splits.folds import Fold, plan_folds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = Path(__file__).parents[1] / "docs" / "second_machine.md"
RESULT = PAGE.parent / "results" / "second-machine" / "second_machine.json"
BASELINES = ("identity", "affine", "blur-table")
BASE, WHOLE = "spot and threshold", "e-beam"
BARE: dict[str, Any] = {"parts": ["spot", "etch"], "spot.sigma_um": 0.02, "fixed": ["etch.bias_px"]}
# Models with few parameters are fitted to a window of 256 px in every second pattern, which is enough for
# them.
FITTED_EVERY = 2
LEARNED: dict[str, dict[str, int]] = {
    "features": {},
    "random-features": {},
    "pbl": {},
    "fno": {"steps": 300, "rounds": 1, "validation_scans": 0},
}
AROUND_PX = 40
Row = dict[str, Any]


def main() -> None:
    """Fit and judge the models, run the closed loop, write the record, and print the tables."""
    parser = options(__doc__, "write the tables into docs/second_machine.md", RESULT)
    parser.add_argument("store", type=Path, help="dataset store of the second machine")
    parser.add_argument(
        "--cache", type=Path, default=Path("runs/second-machine"), help="folder with a file for each fit"
    )
    parser.add_argument(
        "--learned",
        default="",
        help=f"further models to train, separated by commas, out of {', '.join(LEARNED)}",
    )
    parser.add_argument(
        "--loop",
        type=Path,
        help="folder of the closed loop, which is run if the folder does not contain its result",
    )
    arguments = parser.parse_args()
    store = open_store(arguments.store)
    folds = [fold for fold in plan_folds(store.scans(), store.locked_ids, "grouped") if not fold.locked]
    cache = place_for(arguments.cache, store.name, dataset=store.sha256)
    bench = Bench(folds, cache)
    learned = [name for name in LEARNED if name in arguments.learned.split(",")]
    tables = {name: bench.rows(name) for name in (*BASELINES, BASE, WHOLE, *learned)}
    folder = arguments.loop or cache / "loop"
    loop = (
        CloseLoop.read(folder)
        if (folder / CloseLoop.FILE_NAME).exists()
        else close_loop(arguments.store, folder, base="e-beam", base_settings=BARE, report=print)
    )
    if loop.dataset != store.dataset_id:
        raise InputError(f"loop in {folder}", got=loop.dataset, wanted=store.dataset_id)
    record = {
        "run": origin(),
        "dataset": store.dataset_id.model_dump(),
        "patterns": [row["scan"] for row in tables[BASE]],
        "fitted_every": FITTED_EVERY,
        "learned": {name: LEARNED[name] for name in learned},
        "models": [summary(name, rows, bench.values(name)) for name, rows in tables.items()],
        "loop": of_loop(loop, tables[WHOLE], store.scan(tables[BASE][0]["scan"]).pitch_um),
        "rows": tables,
    }
    if arguments.publish:
        draw_places(store, bench, WHOLE).savefig(arguments.out.with_name("places.png"), dpi=110)
    conclude(record, text_of(record), arguments.out, PAGE, "second machine", published=arguments.publish)


class Bench:
    """The fits of the models to the folds. The result of each fit is kept in a file."""

    def __init__(self, folds: Sequence[Fold], cache: Path):
        self.folds, self._cache = folds, cache

    def rows(self, name: str) -> list[Row]:
        """Return the scores of a model on every pattern, each from the fit that did not use the pattern."""
        kept = [self.fit(name, fold) for fold in progress(self.folds, name)]
        return sorted((row for one in kept for row in one["rows"]), key=lambda row: row["scan"])

    def values(self, name: str) -> list[dict[str, float]]:
        """Return the values of a model's parameters, fitted in every fold."""
        return [self.fit(name, fold)["values"] for fold in self.folds]

    def fit(self, name: str, fold: Fold) -> dict[str, Any]:
        """Return the fitted values of a model in one fold, and its scores on the held-out patterns of the
        fold.
        """
        file = self._cache / f"{name.replace(' ', '-')}-{fold.number}.json"
        bare = self.fit(BASE, fold)["values"] if name == WHOLE else {}
        return kept(file, partial(fit_and_judge, name, fold, bare))


def fit_and_judge(name: str, fold: Fold, bare: Mapping[str, float]) -> dict[str, Any]:
    """Fit one model to the training patterns of a fold, and judge it on the held-out patterns.

    If ``bare`` contains the fitted values of the base model (only a spot and a threshold), the model is
    fitted twice. One fit starts from the default values of the model, the other from the values in ``bare``.
    The better fit is used.
    """
    geometry = common_geometry(fold.training)
    if name in LEARNED:
        config = training_config("fast", name, LEARNED[name], film=True)
        model = fit(name, fold.training, config).model
    else:
        fits = []
        for start in ({}, started(bare)) if bare else ({},):
            model = made(name, start, **geometry)
            losses = fit_small_model(model, fold.training[::FITTED_EVERY], "none")
            fits.append((losses[-1] if losses else 0.0, model))
        model = min(fits, key=lambda one: one[0])[1]
    values = {key: value.item() for key, value in getattr(model, "values", {}).items()}
    return {"values": values, "rows": [judged(scan, predict_scan(model, scan)) for scan in fold.held_out]}


def made(name: str, values: Mapping[str, Any], **geometry: Any) -> Simulator:
    """Return an unfitted model of the table, with the given values of its parameters."""
    fields = {**BARE, **values} if name == BASE else values
    return build_model("e-beam" if name == BASE else name, **geometry, **fields)


def started(bare: Mapping[str, float]) -> dict[str, float]:
    """Return starting values for the model with all components, taken from the fitted base model."""
    return {"two-spots.sigma_um": bare["spot.sigma_um"], "hill.threshold": bare["etch.threshold"]}


def judged(scan: PrintedScan, prediction_um: np.ndarray) -> Row:
    """Return the errors of the edges, the area, the features and the heights that were predicted for one
    pattern.
    """
    residual_um = np.where(scan.usable, scan.height_um - prediction_um, np.nan)
    edges = edges_of_scan(scan, prediction_um, residual_um)
    films = films_of_scan(scan, prediction_um, residual_um)
    return {
        "scan": scan.id,
        "edge_mean_nm": edges.mean_nm,
        "edge_p95_nm": edges.p95_nm,
        "edge_unmatched": edges.unmatched,
        **films._asdict(),
        "mae_nm": NM_PER_UM * float(np.nanmean(np.abs(residual_um))),
    }


def of_loop(loop: CloseLoop, whole: Sequence[Row], pitch_um: float) -> dict[str, Any]:
    """Return the findings of the loop, its edge errors, and the comparison of its final model with the model
    that has all components.
    """
    before, after = loop.error("base"), loop.error("all")
    assert before is not None
    assert after is not None
    edges = [{"scan": one, "edge_mean_nm": nm} for one, nm in sorted(after.edge_by_scan_nm.items())]
    return {
        "run": loop.run.model_dump(mode="json"),
        "settings": loop.settings,
        "pitch_um": pitch_um,
        "verdict": loop.verdict,
        "effects": [one.model_dump(mode="json") for one in loop.effects],
        "candidates": [one.model_dump(mode="json") for one in loop.candidates],
        "edges_nm": [before.leading_nm, after.leading_nm],
        "gain": loop.over_scans.model_dump(mode="json"),
        "whole_over_corrected": compared(edges, whole),
    }


def compared(before: Sequence[Row], after: Sequence[Row]) -> dict[str, Any]:
    """Return by how much the mean edge error falls from ``before`` to ``after``, with its interval and its
    p-value, and the number of patterns whose error falls.
    """
    gains = [was["edge_mean_nm"] - now["edge_mean_nm"] for was, now in zip(before, after, strict=True)]
    found = over_units(gains)
    better = [found.positive, found.count]
    return {"gain_nm": float(np.mean(gains)), "ci95_nm": found.ci95_nm, "p": found.p, "better": better}


def summary(name: str, rows: Sequence[Row], values: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return the row of a model: its mean errors over the patterns, its numbers of wrong features in all
    patterns, and the range of each fitted value over the folds.
    """
    errors = [row["edge_mean_nm"] for row in rows]
    means = {
        key: float(np.mean([row[key] for row in rows]))
        for key in ("edge_p95_nm", "area_error_percent", "mae_nm")
    }
    sums = {key: sum(row[key] for row in rows) for key in ("missing", "extra", "merged", "edge_unmatched")}
    spread = {key: [min(v[key] for v in values), max(v[key] for v in values)] for key in values[0]}
    return {
        "model": name,
        "edge_mean_nm": float(np.mean(errors)),
        "edge_mean_ci95_nm": bootstrap_interval(errors),
        **means,
        **sums,
        "values": spread,
    }


def draw_places(store: Store, bench: Bench, name: str) -> Figure:
    """Draw three places in the patterns: the narrowest neck, the smallest island and the most rounded corner.
    Each is drawn with the prediction of the fit that did not use the pattern.
    """
    kept = [bench.fit(name, fold) for fold in bench.folds]
    values = {row["scan"]: one["values"] for one in kept for row in one["rows"]}
    scans = [store.scan(scan_id) for scan_id in values]
    figure = new_figure(10, 3.6)
    for axes, (what, find) in zip(figure.subplots(1, 3), PLACES.items(), strict=True):
        found = [(*find(scan), scan) for scan in scans]
        _, (y, x), scan = min(found, key=lambda one: one[0])
        window = tuple(slice(max(0, place - AROUND_PX), place + AROUND_PX) for place in (y, x))
        film = scan.height_um[window]
        axes.imshow(film, cmap="Greys_r", alpha=0.5)
        edge = film_edge_um(scan)
        printed = predict_scan(made(name, values[scan.id], **common_geometry([scan])), scan)[window]
        for one, colour, style in (
            (scan.layout_um[window], "#4a74b0", ":"),
            (film, "#111111", "-"),
            (printed, "#c23b22", "-"),
        ):
            axes.contour(one, [edge], colors=[colour], linestyles=[style], linewidths=1.3)
        axes.set_title(f"{what}: {scan.id}", fontsize=9)
        axes.set_axis_off()
    return figure


def neck(scan: PrintedScan) -> tuple[float, tuple[int, int]]:
    """Return half the width, in px, and the place (y, x) of the narrowest neck, which is a narrow part of the
    film that continues at both ends.
    """
    from scipy.ndimage import binary_dilation, convolve
    from skimage.morphology import medial_axis

    line, half = medial_axis(_inner_film(scan), return_distance=True)
    neighbours = convolve(line.astype(int), np.ones((3, 3), int)) - 1
    ends = binary_dilation(line & (neighbours < 2), iterations=12)
    return _least(np.where(line & ~ends & scan.valid, half, np.inf))


def island(scan: PrintedScan) -> tuple[float, tuple[int, int]]:
    """Return the area, in px, and a place (y, x) of the smallest island."""
    from scipy.ndimage import label as labels

    parts, _ = labels(_inner_film(scan))
    size = np.bincount(parts.ravel())
    return _least(np.where((parts > 0) & (size[parts] > 4), size[parts], np.inf))


def corner(scan: PrintedScan) -> tuple[float, tuple[int, int]]:
    """Return the largest difference between film and layout at an edge, with a minus sign, and the place (y,
    x) of this difference.
    """
    from scipy.ndimage import binary_dilation, gaussian_filter

    film = _inner_film(scan)
    edge = binary_dilation(film & binary_dilation(~film & scan.usable), iterations=6)
    off = np.where(scan.usable & edge, np.abs(scan.height_um - scan.layout_um), 0)
    return _least(-gaussian_filter(off, 3.0))


def _inner_film(scan: PrintedScan) -> np.ndarray:
    return scan.usable & (np.nan_to_num(scan.height_um) > film_edge_um(scan))


def _least(field: np.ndarray) -> tuple[float, tuple[int, int]]:
    inner = np.full(field.shape, np.inf)
    cut = (slice(AROUND_PX, -AROUND_PX),) * 2
    inner[cut] = field[cut]
    y, x = np.unravel_index(int(np.argmin(inner)), inner.shape)
    return float(inner[y, x]), (int(y), int(x))


PLACES = {"neck": neck, "island": island, "corner": corner}


def text_of(record: Mapping[str, Any]) -> str:
    """Return the table of the models, the table of the loop's findings, and the edge errors of the loop, in
    Markdown.
    """
    heads = (
        "model",
        "mean edge error (95 % interval over patterns)",
        "95th percentile of the edge error",
        "area error",
        "missing",
        "extra",
        "merged",
        "height error",
    )
    rows = [
        (
            one["model"],
            with_interval(one["edge_mean_nm"], one["edge_mean_ci95_nm"]),
            f"{one['edge_p95_nm']:.2f} nm",
            f"{one['area_error_percent']:.2f} %",
            *(str(one[key]) for key in ("missing", "extra", "merged")),
            f"{one['mae_nm']:.2f} nm",
        )
        for one in record["models"]
    ]
    loop = record["loop"]
    found = [
        (
            one["name"],
            ", ".join(f"{key} {own[0]['value']:.3g}" for key, own in one["strengths"].items()),
            f"{one['gain_nm2']:.1f} of {one['before_nm2']:.0f} nm²",
            "{} of {}".format(*one["scans_improved"]),
            f"added, {one['verdict']}",
        )
        for one in loop["effects"]
    ]
    found += [
        (one["name"], "–", "–", "–", f"{one['verdict']}: {one['reason']}") for one in loop["candidates"]
    ]
    edges = "Mean edge error on held-out patterns: {:.2f} nm before the loop, {:.2f} nm after it.".format(
        *loop["edges_nm"]
    )
    loop_heads = ("effect", "size", "squared error removed", "patterns improved", "verdict")
    return f"{markdown_table(heads, rows)}\n\n{markdown_table(loop_heads, found)}\n\n{edges}"


if __name__ == "__main__":
    run_script(main)
