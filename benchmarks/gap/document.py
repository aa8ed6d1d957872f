"""What the comparison found: one result file, tables, figures, and their place in the documentation."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.gap.figures import draw_images, draw_lens
from benchmarks.gap.plan import ARMS, Plan
from benchmarks.gap.tasks import Task
from benchmarks.record import origin, publish, usable_cores, write_record
from litho_design.compare import HEADLINE, GapResult
from litho_design.design import Design

DOCS = Path(__file__).parents[2] / "docs"
PAGE, RESULTS = DOCS / "optics.md", DOCS / "results" / "gap"
NAME = "gap"
RESULT_FILE, TABLE_FILE = "gap.json", "gap.csv"
# Two or three figures per table, with their sign: +1 where more is better.
SHOWN = {
    "hoe": {"si_psnr_db": +1, "ssim": +1, "eff_signal": +1},
    "lens-direct": {"cbr": +1, "strehl": +1, "focusing_efficiency": +1},
    "lens-computational": {"mae_calibrated": -1, "mae_design": -1, "strehl": +1},
}
_LABELS = {
    "si_psnr_db": "SI-PSNR, dB",
    "ssim": "SSIM",
    "eff_signal": "power on the signal",
    "cbr": "centre-to-background ratio",
    "strehl": "Strehl ratio",
    "focusing_efficiency": "focusing efficiency",
    "mae_calibrated": "image MAE, calibrated PSF",
    "mae_design": "image MAE, design PSF",
}
_FIGURES = {
    "hoe": "Image in design and after printing, and the print in its middle",
    "lens-direct": "PSF and its spectrum in design and after printing",
    "lens-computational": "PSF and its spectrum in design and after printing",
}
_TITLES = {
    "hoe": "Hologram",
    "lens-direct": "Lens, direct imaging",
    "lens-computational": "Lens, computational imaging",
    "hoe-measured": "The same hologram through the models of the measured prints",
}


def write_results(
    out: Path, plan: Plan, tasks: Sequence[Task], expected: Sequence[Mapping[str, Any]]
) -> Path:
    """Write ``results/`` of a finished comparison: JSON, CSV and figures; returns the folder."""
    folder = out / "results"
    folder.mkdir(exist_ok=True)
    gaps = {task.name: GapResult.read(out / task.name) for task in tasks}
    summary = pd.concat([_frame(name, gap) for name, gap in gaps.items()])
    summary.to_csv(folder / TABLE_FILE, index=False, float_format="%.6g")
    record = {
        "schema": "litho-design/benchmark-gap/1",
        "plan": plan.model_dump(mode="json", by_alias=True, exclude={"corrected"}),
        "machine": {"cores": usable_cores(), "threads_per_process": 1},
        **origin(),
        "models": _models(out),
        "tasks": {
            name: {
                "target": gap.target,
                "iterations": gap.settings.search.iterations,
                "seeds": gap.seeds,
                "minutes": _minutes(out / name, gap.seeds),
                "paired": [item.model_dump(mode="json") for item in gap.paired if item.judge not in gap.arms],
            }
            for name, gap in gaps.items()
        },
        "expected_minutes": {row["part"]: round(row["minutes"], 1) for row in expected},
        "summary": json.loads(summary.to_json(orient="records")),
    }
    write_record(folder / RESULT_FILE, record)
    for task in tasks:
        judge = next(iter(task.judges.items()), None)
        draw = draw_images if task.kind == "hoe" else draw_lens
        draw(out / task.name, gaps[task.name], judge, folder / figure_file(task.name))
    (folder / "tables.md").write_text(as_markdown(record) + "\n", encoding="utf-8")
    return folder


def publish_results(out: Path) -> None:
    """Copy ``results/`` into the documentation and write its tables into the page."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    for file in sorted((out / "results").iterdir()):
        if file.suffix != ".md":
            shutil.copyfile(file, RESULTS / file.name)
    record = json.loads((RESULTS / RESULT_FILE).read_text(encoding="utf-8"))
    publish(PAGE, NAME, as_markdown(record))


def as_markdown(record: Mapping[str, Any]) -> str:
    """Every table with what it rests on, as the result file has it."""
    effort = record["plan"]["effort"]
    knobs = ", ".join(f"`{name}` {value:g}" for name, value in record["plan"]["print_knobs"].items())
    parts = [
        f"The fab holds {knobs} (10 nm rms each); the models saw {effort['scans']} scans of its prints, "
        f"{effort['scan_px']} px; the networks were trained for {effort['training_steps']:,} steps and "
        f"searched through in {effort['search_precision']}; what is printed and judged is float32.\n\n"
        + _model_table(record["models"])
    ]
    for name, task in record["tasks"].items():
        parts.append(_task_part(name, task, [row for row in record["summary"] if row["task"] == name]))
    minutes = sum(sum(task["minutes"].values()) for task in record["tasks"].values())
    designs = sum(len(task["seeds"]) * len(task["minutes"]) for task in record["tasks"].values())
    parts.append(
        f"{designs} designs, {minutes / 60:.1f} core hours of search; intervals: Student's, 95 %, over seeds."
    )
    return "\n\n".join(parts)


def _task_part(name: str, task: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    kind = next(kind for kind in ("lens-computational", "lens-direct", "hoe") if name.startswith(kind))
    shown = SHOWN[kind]
    values = {(row["arm"], row["judge"], row["figure"]): row for row in rows}
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    judges = [judge for judge in dict.fromkeys(row["judge"] for row in rows) if judge not in arms]
    independent = bool(judges)
    if not independent:
        judges = [judge for judge in dict.fromkeys(row["judge"] for row in rows) if judge != "none"]
        shown = dict(list(shown.items())[:1])
    # Judged by one printer, the expectation stands beside it; by several, each is a column.
    lines = [
        "| designed with | "
        + " | ".join(f"{_LABELS[figure]}, in design → by {judge}" for judge in judges for figure in shown)
        + " |",
        "|---" * (1 + len(judges) * len(shown)) + "|",
    ]
    for arm in arms:
        cells = [_cell(values[arm, judge, figure]) for judge in judges for figure in shown]
        lines.append(f"| {arm} | {' | '.join(cells)} |")
    seeds = len(task["seeds"])
    head = f"### {_TITLES[name]}\n\n{task['iterations']} iterations for every arm, {seeds} seed(s).\n\n"
    verdict = ""
    # Among printers that are arms themselves each prefers its own design: nobody wins.
    if seeds > 1 and independent:
        verdict = _verdict(task["paired"], values, arms, next(iter(shown.items())), judges[0])
    figure = f"![{_FIGURES[kind]}](results/gap/{figure_file(name)})"
    return "\n\n".join(part for part in (head + "\n".join(lines), verdict, figure) if part)


def figure_file(name: str) -> str:
    """Name of a task's figure."""
    return f"{name}.{'jpg' if name.startswith('hoe') else 'png'}"


def _cell(row: Mapping[str, Any]) -> str:
    text = f"{row['designed']:.3f} → {row['judged']:.3f}"
    if row["low"] is None:
        return text
    return f"{text} ± {(row['high'] - row['low']) / 2:.3f}"


def _verdict(
    paired: Sequence[Mapping[str, Any]],
    values: Mapping[tuple[str, str, str], Mapping[str, Any]],
    arms: Sequence[str],
    figure_sign: tuple[str, int],
    judge: str,
) -> str:
    """Who wins by the first figure, and by how much against every other arm, paired by seed."""
    figure, sign = figure_sign
    best = max(arms, key=lambda arm: sign * values[arm, judge, figure]["judged"])
    against = []
    for other in arms:
        for item in paired:
            pair = {item["arm"], item["against"]}
            if item["judge"] == judge and item["figure"] == figure and pair == {best, other}:
                turn = 1 if item["arm"] == best else -1
                low, high = sorted(turn * end for end in item["ci95"])
                open_ = "" if low * high > 0 else ", undecided"
                against.append(f"{other} by {turn * item['mean']:+.3f} [{low:+.3f}, {high:+.3f}]{open_}")
    return f"Printed by {judge}, {best} is best in {_LABELS[figure]}; it beats " + "; ".join(against) + "."


def _model_table(models: Mapping[str, Mapping[str, float]]) -> str:
    lines = [
        "| model | error on unseen prints of the fab, zero free | tilt, bow and gain free |",
        "|---|---|---|",
    ]
    lines += [
        f"| {name} | {item['offset']:.2f} nm | {item['full']:.2f} nm |" for name, item in models.items()
    ]
    return "\n".join(lines)


def _models(out: Path) -> dict[str, dict[str, float]]:
    """Mean absolute error of every trained model on the prints of the test run."""
    errors = {}
    for arm in ARMS:
        file = out / "test" / arm / "evaluation.json"
        if file.exists():
            scores = json.loads(file.read_text(encoding="utf-8"))["scores"]
            policies = {item["policy"]: item["mae_nm"] for item in scores["by_policy"]}
            errors[arm] = {"offset": scores["mae_datum_free_nm"], "full": policies["full"]}
    return errors


def _minutes(folder: Path, seeds: Sequence[int]) -> dict[str, float]:
    """Minutes of search per arm, over the judged seeds, as the designs recorded them."""
    minutes: dict[str, float] = {}
    for place in sorted(place for seed in seeds for place in (folder / "designs").glob(f"*/seed{seed}")):
        arm = place.parent.name
        minutes[arm] = minutes.get(arm, 0.0) + Design.read(place).run.seconds / 60
    return {arm: round(value, 2) for arm, value in minutes.items()}


def _frame(name: str, gap: GapResult) -> pd.DataFrame:
    rows = [
        {
            "task": name,
            "arm": item.arm,
            "judge": item.judge,
            "figure": item.figure,
            "seeds": item.seeds,
            "designed": item.designed_mean,
            "judged": item.judged_mean,
            "low": None if item.judged_ci95 is None else item.judged_ci95[0],
            "high": None if item.judged_ci95 is None else item.judged_ci95[1],
        }
        for item in gap.summary
        if item.figure in HEADLINE[gap.task]
    ]
    return pd.DataFrame(rows)
