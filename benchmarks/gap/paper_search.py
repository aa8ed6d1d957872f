"""The paper's own search beside ours, with equal iterations, through the models of the comparison.

    python -m benchmarks.gap.paper_search --out runs/gap --workers 2 [--tasks hoe-paper-333] [--publish]

The search of the paper is the preset ``--variant paper``: Gumbel-Softmax at its temperature, its rates and
losses, a random start, 1,000 iterations, the last layout. The models are those of ``benchmarks.gap`` in the
same ``--out``; what it has not made yet is made here. Finished designs are kept and interrupted ones resume.
The page keeps the tasks that it has and says which are not made yet.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.gap.document import PAGE, RESULTS, search_minutes
from benchmarks.gap.jobs import run_commands
from benchmarks.gap.plan import Effort, Plan, model, open_plan
from benchmarks.gap.steps import fab_jobs, model_jobs
from benchmarks.gap.tables import LABELS, SHOWN, TITLES, figure_digits, lead_text
from benchmarks.gap.tasks import Task, chosen, task_options
from benchmarks.markdown_table import markdown_table
from benchmarks.record import publish, usable_cores, write_record
from litho_data.foundation.commands import command_line, run_script
from litho_data.foundation.workers import Workers
from litho_design.judging.gap import GapResult
from litho_models.frozen import zoo

NAME, FILE_NAME = "paper-search", "paper_search.json"
# Iterations of a design, and seeds: all of the paper's once, a third of them three times.
SEEDS_OF = {1000: 1, 333: 3}
SEARCHES = {"paper": ("--variant", "paper"), "ours": ()}
# The paper's lens is square, ours a circle. Both searches make the circle, along a radius, which is exact
# for it: on the plane an iteration through PBL or the FNO takes thirty times as long.
SAME_LENS = ("--set", "view.aperture=circle", "--set", "view.path=radial")
# PBL with all it predicts, as the paper's: what lies along the scan lines is in the other models, too.
ARMS = ("none", "physics", "fno", "pbl-scan-axis")
FAB, MEASURED = "fab", "measured-pbl"
_NAMES = {"hoe": "hoe", "direct": "lens-direct", "computational": "lens-computational"}


def main() -> None:
    """Make the designs that are missing, judge them, write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the comparison")
    parser.add_argument("--workers", type=int, default=1, help="processes side by side, one thread each")
    parser.add_argument("--tasks", metavar="NAMES", help="only these, separated by commas; all by default")
    parser.add_argument("--publish", action="store_true", help="write the table into docs/gap.md")
    given = parser.parse_args()
    out, workers, logs = given.out, Workers(given.workers), given.out / "logs"
    found = (out / Plan.FILE_NAME).exists()
    effort = (Plan.read(out) if found else open_plan(out, Effort(), corrected=None)).effort
    every = paper_tasks(out, effort)
    todo = chosen(every, given.tasks)
    for stage in (*fab_jobs(out, effort), *model_jobs(out, effort)):
        run_commands(stage, logs, workers)
    run_commands([job for task in todo for job in task.designs(out)], logs, workers)
    run_commands([task.compare(out) for task in todo], logs, workers)
    record: dict[str, Any] = {
        "schema": "litho-design/benchmark-paper-search/1",
        "machine": {"cores": usable_cores(), "threads_per_process": 1},
        "command": command_line(),
        "tasks": {task.name: _found(out, task) for task in every if task.compare(out).done},
    }
    print(as_markdown(record))
    write_record(out / FILE_NAME, record)
    if given.publish:
        record["tasks"] = _published_tasks() | record["tasks"]
        write_record(RESULTS / FILE_NAME, record)
        publish(PAGE, NAME, as_markdown(record))


def paper_tasks(out: Path, effort: Effort) -> list[Task]:
    """Hologram and lenses, each by both searches with both budgets; the short ones first."""
    return [
        _task(out, effort, kind, search, iterations)
        for iterations in sorted(SEEDS_OF)
        for kind in ("direct", "computational", "hoe")
        for search in SEARCHES
    ]


def as_markdown(record: Mapping[str, Any]) -> str:
    """A table per kind of element, the searches side by side; of kinds without a result the names."""
    tasks = record["tasks"]
    made = [kind for kind, name in _NAMES.items() if any(task.startswith(f"{name}-") for task in tasks)]
    texts = [_table(kind, tasks) for kind in made]
    if missing := [TITLES[name].lower() for kind, name in _NAMES.items() if kind not in made]:
        texts.append(f"Not made yet: {'; '.join(missing)}.")
    return "\n\n".join(texts)


def _task(out: Path, effort: Effort, kind: str, search: str, iterations: int) -> Task:
    hologram = kind == "hoe"
    size_px, distance_um = (
        (effort.hoe_px, effort.hoe_distance_um) if hologram else (effort.lens_px, effort.lens_distance_um)
    )
    options = task_options(
        *SEARCHES[search], "--size-px", size_px, "--distance-um", distance_um, "--iterations", iterations,
        "--yield-draws", 10,
    )  # fmt: skip
    options += ("--target", "text") if hologram else SAME_LENS
    if kind == "computational":
        options += task_options("--window-px", effort.window_px, "--object-px", effort.object_px)
    models = {arm: "none" if arm == "none" else str(model(out, arm)) for arm in ARMS}
    judges = {FAB: str(out / "fab" / "truth"), MEASURED: str(zoo.folder("pbl"))}
    name = f"{_NAMES[kind]}-{search}-{iterations}"
    return Task(name, kind, options, models, judges, SEEDS_OF[iterations])


def _published_tasks() -> dict[str, Any]:
    """Those of earlier calls, which may have had another folder."""
    file = RESULTS / FILE_NAME
    return json.loads(file.read_text(encoding="utf-8"))["tasks"] if file.exists() else {}


def _found(out: Path, task: Task) -> dict[str, Any]:
    """The figures of a finished task, by arm and judge."""
    gap = GapResult.read(out / task.name)
    shown = SHOWN[_NAMES[task.kind]]
    figure = next(iter(shown))
    return {
        **gap.model_dump(mode="json", include={"commit", "dirty", "versions"}),
        "iterations": task.iterations,
        "seeds": len(gap.seeds),
        "printers": {arm: used.sha256 for arm, used in gap.arms.items()},
        "minutes": search_minutes(out / task.name, gap),
        "summary": [
            item.model_dump(mode="json")
            for item in gap.summary
            if item.figure in shown and item.judge in task.judges
        ],
        "paired": [
            item.model_dump(mode="json")
            for item in gap.paired
            if item.figure == figure and item.judge in task.judges
        ],
        # Means of three hide a start that the search did not leave.
        "of_each_seed": [
            {
                "arm": entry.arm,
                "judge": entry.judge,
                "seed": entry.seed,
                "designed": entry.designed[figure],
                "judged": entry.judged[figure],
            }
            for entry in gap.entries
            if entry.judge in task.judges
        ],
    }


def _table(kind: str, tasks: Mapping[str, Mapping[str, Any]]) -> str:
    """One row per arm and judge; a column per search and budget."""
    figure, sign = next(iter(SHOWN[_NAMES[kind]].items()))
    columns = [(search, iterations) for iterations in SEEDS_OF for search in SEARCHES]
    heads = [
        f"{search}, {iterations:,} iterations, {seeds} seed{'s' * (seeds > 1)}"
        for search, iterations in columns
        for seeds in (SEEDS_OF[iterations],)
    ]
    found = [tasks.get(f"{_NAMES[kind]}-{search}-{iterations}") for search, iterations in columns]
    rows = [(arm, judge, *_cells(found, arm, judge, figure)) for judge in (FAB, MEASURED) for arm in ARMS]
    better = "more" if sign > 0 else "less"
    return f"### {TITLES[_NAMES[kind]]}: {LABELS[figure]}, {better} is better\n\n" + markdown_table(
        ("designed with", "printed by", *heads),
        rows,
        _minutes_text(columns, found),
        *_leads(columns, found, figure, sign),
    )


def _cells(found: Sequence[Mapping[str, Any] | None], arm: str, judge: str, figure: str) -> Iterator[str]:
    for task in found:
        if task is None:
            yield "not made yet"
            continue
        row = _rows_of_arms(task, judge, figure)[arm]
        digits, interval = figure_digits(figure), row["judged_ci95"]
        spread = f" ± {(interval[1] - interval[0]) / 2:.{digits}f}" if interval else ""
        yield f"{row['designed_mean']:.{digits}f} → {row['judged_mean']:.{digits}f}{spread}"


def _leads(
    columns: Sequence[tuple[str, int]], found: Sequence[Mapping[str, Any] | None], figure: str, sign: int
) -> Iterator[str]:
    """The best arm of every search that ran from several seeds, by each printer."""
    for (search, iterations), task in zip(columns, found, strict=True):
        if task is None or task["seeds"] == 1:
            continue
        for judge in (FAB, MEASURED):
            means = {arm: row["judged_mean"] for arm, row in _rows_of_arms(task, judge, figure).items()}
            yield f"{search}, {iterations:,}: {lead_text(task['paired'], means, figure, sign, judge)}"


def _rows_of_arms(task: Mapping[str, Any], judge: str, figure: str) -> dict[str, Mapping[str, Any]]:
    """What one printer made of one figure, by the arm that it was designed with."""
    return {row["arm"]: row for row in task["summary"] if (row["judge"], row["figure"]) == (judge, figure)}


def _minutes_text(columns: Sequence[tuple[str, int]], found: Sequence[Mapping[str, Any] | None]) -> str:
    """What the searches took."""
    told = [
        f"{search} {iterations:,}: "
        + ", ".join(f"{arm} {minutes:.0f}" for arm, minutes in task["minutes"].items())
        for (search, iterations), task in zip(columns, found, strict=True)
        if task is not None
    ]
    return (
        "In design → as printed, means over seeds. Minutes of search, all seeds, one thread each: "
        f"{'; '.join(told)}."
    )


if __name__ == "__main__":
    run_script(main)
