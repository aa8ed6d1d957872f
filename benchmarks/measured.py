"""Carry the results of the measured run into the documentation: small files, tables, figures.

    make demo DATASET=neural-lithography
    python benchmarks/measured.py runs/neural-lithography

What the pages quote is written here from the result files, and a test holds the pages to them.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measured_figures import draw_prediction, draw_steps
from benchmarks.record import publish
from litho_models import zoo
from litho_models.model_card import ModelCard
from litho_models.zoo_making import HELD_OUT, ZOO_MODELS

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "results" / "neural-lithography"
RESULTS = {
    "benchmark.json": "benchmark/benchmark.json",
    "benchmark_paper.json": "benchmark-paper/benchmark.json",
    "noise.json": "noise/noise.json",
    "close_loop.json": "close-loop/close_loop.json",
    "close_loop_pbl.json": "close-loop-pbl/close_loop.json",
    "close_loop_candidates.csv": "close-loop/candidates.csv",
    "gap.json": "compare/gap.json",
    "score.json": "score/score.json",
}
NAMES = ("benchmark", "paper split", "loop", "loop with PBL", "locked scans", "design")
PAGES = {
    ROOT / "README.md": NAMES,
    FOLDER / "README.md": (*NAMES, "paired differences", "further figures"),
    ROOT / "docs" / "noise.md": ("noise",),
}


def benchmark_table(benchmark: dict[str, Any]) -> str:
    """Held-out errors of every model, one row each."""
    heads = (
        "model",
        "datum-free error (zero of each scan free)",
        "the same without the shared background",
        "with tilt, bow and gain free",
        "absolute error",
        "parameters",
    )
    rows = []
    parameters = {fit["model"]: fit["parameters"] for fit in benchmark["fits"]}
    for score in benchmark["scores"]:
        policies = {entry["policy"]: entry["mae_nm"] for entry in score["by_policy"]}
        bare = {entry["policy"]: entry["mae_nm"] for entry in score["without_background"]}
        free = _with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"])
        absolute = _with_interval(score["mae_abs_nm"], score["mae_abs_ci95_nm"])
        without, relaxed = f"{bare['offset']:.2f} nm", f"{policies['full']:.2f} nm"
        rows.append((score["model"], free, without, relaxed, absolute, f"{parameters[score['model']]:,}"))
    split = benchmark["split"]
    return _table(
        heads,
        rows,
        f"Mean absolute error on held-out scans ({len(split['scored_ids'])} scans, {split['folds']} folds "
        f"by scan, seed {split['seed']}; {len(split['lock_box'])} locked scans are in no fold and in no "
        f"figure of this table; {_steps(benchmark)}), with 95 % bootstrap intervals over scans. Per-scan "
        "terms are fitted on pixels that are not scored. The shared background is what levelling leaves in "
        "every map: five numbers from the training scans, added to predictions of measured maps and to no "
        "design.",
    )


def paired_table(benchmark: dict[str, Any]) -> str:
    """How much better each model is than each other, scan by scan."""
    rows = [
        (
            f"{pair['first']} − {pair['second']}",
            _with_interval(pair["mean_nm"], pair["ci95_nm"]),
            f"{pair['p']:.4f}",
        )
        for pair in benchmark["paired"]
        if {pair["first"], pair["second"]} <= {"linear", "physics", "pbl", "fno"}
    ]
    return _table(("difference", "datum-free error", "p"), rows)


def paper_table(benchmark: dict[str, Any]) -> str:
    """Errors on the paper's split, one row each."""
    rows = [
        (
            score["model"],
            _with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"]),
            _with_interval(score["mae_abs_nm"], score["mae_abs_ci95_nm"]),
        )
        for score in benchmark["scores"]
    ]
    split = benchmark["split"]
    return _table(
        ("model", "datum-free error (zero of each quadrant free)", "absolute error"),
        rows,
        f"{len(split['scored_ids'])} of 96 quadrants drawn at random (seed {split['seed']}), the others "
        f"for training ({_steps(benchmark)}): one draw of the split, leaky as the paper's is. Quadrants of "
        f"the {len(split['lock_box'])} locked scans take part, in training and in the errors.",
    )


def further_table(benchmark: dict[str, Any]) -> str:
    """Phase, similarity, edges, crops, and training against held-out error, one row per model."""
    heads = ("model", "phase", "SSIM", "edges, mean", "edges, P95", "edges without partner")
    heads += ("other crop, largest", "on training scans", "on inner validation", "held out")
    rows = []
    for score in benchmark["scores"]:
        found = [fit["diagnostics"] for fit in benchmark["fits"] if fit["model"] == score["model"]]
        lost = score["edge_unmatched"] / (score["edge_matched"] + score["edge_unmatched"])
        crops = [entry["tiles"]["max_nm"] for entry in found if entry["tiles"]]
        errors = [
            _mean_nm([entry[key] for entry in found])
            for key in ("training_nm", "inner_validation_nm", "held_out_nm")
        ]
        rows.append(
            (
                score["model"],
                f"{score['phase_rms_waves']:.4f} waves",
                f"{score['ssim']:.3f}",
                f"{score['edge_mean_nm']:.0f} nm",
                f"{score['edge_p95_nm']:.0f} nm",
                f"{100 * lost:.1f} %",
                f"{max(crops):.2g} nm" if crops else "–",
                *errors,
            )
        )
    return _table(
        heads,
        rows,
        "The definitions are in [how models are judged](../../evaluation.md). The last three columns are "
        "datum-free errors without the shared background, means over folds.",
    )


def noise_table(noise: dict[str, Any]) -> str:
    """What bounds the noise of the measured prints, one row per figure."""
    rows = [
        (
            bound["name"],
            bound["of"],
            bound["direction"],
            _with_interval(bound["sigma_nm"], bound["ci95_nm"]),
            f"{bound['mae_nm']:.2f} nm",
        )
        for bound in noise["bounds"]
    ]
    floor = noise["noise_floor"]
    return _table(
        ("figure", "of noise", "errs as", "σ", "MAE"),
        rows,
        f"{noise['run']['n_scans']} development scans of the measured prints, 95 % intervals over scans. "
        f"No flat and no repeated print is among them: the floor, MAE {floor['mae_nm']:.2f} nm, is a "
        f"{floor['kind'].replace('-', ' ')}.",
    )


def loop_table(loop: dict[str, Any], on_physics: dict[str, Any] | None = None) -> str:
    """The closed loop step by step, then what is left.

    ``on_physics``: the loop on the Physics model, for what a network is said to carry.
    """
    before, after = loop["before"], loop["after"]
    rows = []
    for effect in loop["effects"]:
        alike = f" or {', '.join(effect['confusable_with'])}" if effect["confusable_with"] else ""
        known = ", known before" if effect["prior_hypothesis"] else ""
        figure = "absolute" if effect["name"] == "datum-offset" else "datum-free"
        better, count = effect["scans_improved"]
        rows.append(
            (
                f"`{effect['name']}`{alike}",
                f"{effect['role']}, {effect['verdict']}{known}",
                f"{effect['before_nm']:.2f} nm ({figure})",
                f"{effect['after_nm']:.2f} nm",
                f"{better} of {count}",
            )
        )
    return _table(
        ("step", "what it is", "held-out error before", "after", "scans better"),
        rows,
        "A row need not begin where the last one ended: both sides of a process effect leave each scan's "
        "shift, turn and stretch free, and both sides of one that acts as a gain go without the gain of "
        "single scans.",
        *_absorbed(loop, on_physics),
        f"Base model {loop['base_model']}: datum-free {before['mae_datum_free_nm']:.2f} nm before, "
        f"{after['mae_datum_free_nm']:.2f} nm after, {loop['split']['folds']} folds by scan. "
        f"What is left: {loop['residual']['state']}"
        + (f"; it {loop['residual']['signature']}." if loop["residual"]["signature"] else "."),
    )


def _absorbed(loop: dict[str, Any], on_physics: dict[str, Any] | None) -> list[str]:
    """What the Physics model lacks and the network does not.

    A network's loop screens on a Physics model in folds of its own, so it may take what the loop on Physics
    itself does not confirm: that is not called found.
    """
    absorbed = [c["name"] for c in loop["candidates"] if c["verdict"] == "absorbed"]
    if on_physics is None or not absorbed:
        return []
    confirmed = {
        name
        for effect in on_physics["effects"]
        if effect["verdict"] != "traced-to-covariate"
        for name in (effect["name"], *effect["confusable_with"])
    }
    found = [name for name in absorbed if name in confirmed]
    sentences = [f"Found on Physics and already carried by the network: {', '.join(found)}."] if found else []
    judged = {c["name"]: c for c in on_physics["candidates"]}
    sentences += [
        f"Taken on Physics in this run's own folds, without gain on the network: {name}. The loop on Physics "
        f"itself calls it {judged[name]['verdict']}: {judged[name]['reason']}."
        for name in absorbed
        if name not in confirmed
    ]
    return sentences


def locked_table(loops: Sequence[dict[str, Any]], cards: Sequence[ModelCard]) -> str:
    """The errors on the locked scans: the models of the zoo, and both loops before and after."""
    rows = []
    for card in cards:
        # The first of a name and policy is the one with the background.
        held_out = [metric for metric in reversed(card.metrics) if metric.split == HELD_OUT]
        errors = {(metric.name, metric.policy): metric.value for metric in held_out}
        figures = [("mae_datum_free", "offset"), ("mae_datum_free", "full+rows"), ("mae_abs", "none")]
        rows.append((card.name, *(f"{errors[key]:.2f} nm" for key in figures)))
    for loop in loops:
        before, after = (
            (_with_interval(state["mae_datum_free_nm"], state["mae_datum_free_ci95_nm"]), state["mae_abs_nm"])
            for state in (loop["locked_before"], loop["locked_after"])
        )
        rows.append((f"loop on {loop['base_model']}, before", before[0], "–", f"{before[1]:.2f} nm"))
        rows.append((f"loop on {loop['base_model']}, after", "–", after[0], f"{after[1]:.2f} nm"))
    locked = loops[0]["split"]["lock_box"]
    others = loops[0]["run"]["n_scans"] - len(locked)
    return _table(
        ("", "zero of each scan free", "tilt, bow, gain and lines free too", "absolute error"),
        rows,
        f"The {len(locked)} locked scans ({', '.join(locked)}), scored once, when model, recipe and loop "
        f"had been settled; all was fitted to the other {others}. Models: those of the package, with the "
        "background of their training scans. The loops on Physics and on PBL free what they accepted of "
        "single scans, on pixels that are not scored, the first the registration too.",
    )


def design_table(gap: dict[str, Any]) -> str:
    """Image quality of every arm's hologram under every judge."""
    judges = list(dict.fromkeys(entry["judge"] for entry in gap["summary"]))
    found = {
        (entry["arm"], entry["judge"]): entry["judged_mean"]
        for entry in gap["summary"]
        if entry["figure"] == "si_psnr_db"
    }
    settings = gap["settings"]
    return _table(
        ("designed with", *(f"judged by {judge}" for judge in judges)),
        [(arm, *(f"{found[arm, judge]:.2f} dB" for judge in judges)) for arm in gap["arms"]],
        "Scale-invariant PSNR of the hologram that the printed argmax layout makes, "
        f"{settings['layout']['size_px']} px, {settings['search']['iterations']} iterations, seeds "
        f"{gap['seeds']}: one small task, no ranking beyond it.",
    )


def texts(folder: Path) -> dict[str, str]:
    """The text of each mark, from the result files in a folder and the cards of the zoo."""

    def found(file: str) -> dict[str, Any]:
        return json.loads((folder / file).read_text(encoding="utf-8"))

    return {
        "benchmark": benchmark_table(found("benchmark.json")),
        "paper split": paper_table(found("benchmark_paper.json")),
        "paired differences": paired_table(found("benchmark.json")),
        "further figures": further_table(found("benchmark.json")),
        "noise": noise_table(found("noise.json")),
        "loop": loop_table(found("close_loop.json")),
        "loop with PBL": loop_table(found("close_loop_pbl.json"), found("close_loop.json")),
        "locked scans": locked_table(
            [found("close_loop.json"), found("close_loop_pbl.json")],
            [ModelCard.read(zoo.folder(name)) for name in ZOO_MODELS],
        ),
        "design": design_table(found("gap.json")),
    }


def main() -> None:
    """Copy, draw, publish."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, help="folder of `make demo DATASET=neural-lithography`")
    runs = parser.parse_args().runs
    for name, source in RESULTS.items():
        shutil.copyfile(runs / source, FOLDER / name)
    draw_steps(runs / "close-loop" / "errors.csv", FOLDER / "loop_steps.png")
    draw_prediction(runs / "store.zarr", runs / "benchmark", FOLDER / "prediction.jpg")
    for page, names in PAGES.items():
        for name in names:
            publish(page, name, texts(FOLDER)[name])


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], *notes: str) -> str:
    """A table in Markdown, and below it what it rests on, a paragraph each."""

    def line(cells: Sequence[str]) -> str:
        return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"

    lines = [line(heads), "|---" * len(heads) + "|", *map(line, rows), *(f"\n{note}" for note in notes)]
    return "\n".join(lines)


def _steps(benchmark: dict[str, Any]) -> str:
    """Optimiser steps of the networks."""
    steps = {name: own["steps"] for name, own in benchmark["training"].items() if name in ("pbl", "fno")}
    return ", ".join(f"{name.upper()}: {count:,} steps" for name, count in steps.items())


def _mean_nm(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.2f} nm" if known else "–"


def _with_interval(value: float, interval: list[float] | None) -> str:
    return f"{value:.2f} nm" + (f" ({interval[0]:.2f} … {interval[1]:.2f})" if interval else "")


if __name__ == "__main__":
    main()
