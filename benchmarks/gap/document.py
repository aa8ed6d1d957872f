"""Write the results of the comparison (record, tables and figures), and publish them in the documentation."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from benchmarks.gap.figures import draw_images, draw_lens
from benchmarks.gap.plan import ARMS, Plan
from benchmarks.gap.tables import as_markdown, figure_file
from benchmarks.gap.tasks import FAB, REDUCED, Task
from benchmarks.record import origin, publish, usable_cores, write_record
from litho_design.judging.gap import GapResult, design_folder
from litho_design.tasks.design import Design
from litho_design.tasks.task import registered_task
from litho_models.fitting.runs import TrainingRun

DOCS = Path(__file__).parents[2] / "docs"
PAGE, RESULTS = DOCS / "gap.md", DOCS / "results" / "gap"
RESULT_FILE, TABLE_FILE = "gap.json", "gap.csv"


def write_results(out: Path, plan: Plan, tasks: Sequence[Task]) -> Path:
    """Write the record, the tables and the figures of finished tasks, which are all of one part of the
    comparison, into a folder below ``out/results``. Return that folder.
    """
    part = tasks[0].part
    folder = out / "results" / part
    folder.mkdir(parents=True, exist_ok=True)
    gaps = {task.name: GapResult.read(out / task.name) for task in tasks}
    summary = pd.concat([_frame(name, gap) for name, gap in gaps.items()])
    summary.to_csv(folder / TABLE_FILE, index=False, float_format="%.6g")
    record = {
        "schema": "litho-design/benchmark-gap/1",
        "plan": plan.model_dump(mode="json", by_alias=True, exclude={"corrected"}),
        "machine": {"cores": usable_cores(), "threads_per_process": 1},
        **origin(),
        "training_scans": len(TrainingRun.read(out / "runs" / ARMS[1]).training_ids),
        "models": _models(out) if part == FAB else {},
        "tasks": {
            name: {
                "target": gap.target,
                "iterations": gap.settings.search.iterations,
                "seeds": gap.seeds,
                "printers": {arm: used.sha256 for arm, used in gap.arms.items()},
                "minutes": _search_minutes(out / name, gap),
                "paired": [item.model_dump(mode="json") for item in gap.paired if item.judge not in gap.arms],
                "ceiling": _ceiling(out / name, gap),
            }
            for name, gap in gaps.items()
        },
        "summary": json.loads(summary.to_json(orient="records")),
    }
    write_record(folder / RESULT_FILE, record)
    for task in tasks:
        if task.name.endswith(REDUCED):
            continue
        judge = next(iter(task.judges.items()), None)
        draw = draw_images if task.kind == "hoe" else draw_lens
        draw(out / task.name, gaps[task.name], judge, folder / figure_file(task.name))
    (folder / "tables.md").write_text(as_markdown(record) + "\n", encoding="utf-8")
    return folder


def publish_results(out: Path, part: str) -> None:
    """Copy the folder ``results/`` into a folder of the documentation, and write its tables into the page.
    ``part`` is the part of the comparison (see ``Task.part``).
    """
    folder = RESULTS / part
    folder.mkdir(parents=True, exist_ok=True)
    for file in sorted((out / "results" / part).iterdir()):
        if file.suffix != ".md":
            shutil.copyfile(file, folder / file.name)
    record = json.loads((folder / RESULT_FILE).read_text(encoding="utf-8"))
    publish(PAGE, f"gap-{part}", as_markdown(record))


def _models(out: Path) -> dict[str, dict[str, float]]:
    """Return the mean absolute errors of every trained model on the test prints, in nm, by the terms that are
    fitted to each scan.
    """
    errors = {}
    for arm in ARMS:
        file = out / "test" / arm / "evaluation.json"
        if file.exists():
            scores = json.loads(file.read_text(encoding="utf-8"))["scores"]
            policies = {item["policy"]: item["mae_nm"] for item in scores["by_policy"]}
            errors[arm] = {"offset": scores["mae_datum_free_nm"], "full": policies["full"]}
    return errors


def _ceiling(folder: Path, gap: GapResult) -> dict[str, float] | None:
    """Return the scores of an unprinted continuous phase on the grid of the designs. For a lens, return
    None.
    """
    design = Design.read(design_folder(folder, next(iter(gap.arms)), gap.seeds[0]))
    return (design.baselines or {}).get("continuous phase")


def _search_minutes(folder: Path, gap: GapResult) -> dict[str, float]:
    """Return the time that the searches of each arm took, in minutes, summed over the seeds."""

    def minutes(arm: str) -> float:
        return sum(Design.read(design_folder(folder, arm, seed)).run.seconds for seed in gap.seeds) / 60

    return {arm: round(minutes(arm), 2) for arm in sorted(gap.arms)}


def _frame(name: str, gap: GapResult) -> pd.DataFrame:
    """Return the mean scores by every judge. If some judges are no arms, only their scores are returned."""
    every = {item.judge for item in gap.summary}
    judges = every - {*gap.arms} or every
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
        if item.figure in registered_task(gap.task).headline and item.judge in judges
    ]
    return pd.DataFrame(rows)
