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
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.gap.document import PAGE, RESULTS, search_minutes
from benchmarks.gap.jobs import run_commands
from benchmarks.gap.paper_picture import search_figure
from benchmarks.gap.paper_tables import (
    ARMS,
    FAB,
    MEASURED,
    NAMES,
    SEARCHES,
    SEEDS_OF,
    as_markdown,
    task_name,
)
from benchmarks.gap.plan import Effort, Plan, model, open_plan
from benchmarks.gap.steps import fab_jobs, model_jobs
from benchmarks.gap.tables import SHOWN
from benchmarks.gap.tasks import Task, chosen, task_options
from benchmarks.record import publish, usable_cores, write_record
from litho_data.foundation.commands import command_line, run_script
from litho_data.foundation.units import NM_PER_UM
from litho_data.foundation.workers import Workers
from litho_design.judging.gap import GapResult, design_folder
from litho_design.tasks.design import Design
from litho_models.frozen import zoo

NAME, FILE_NAME, PICTURE = "paper-search", "paper_search.json", "paper_search.png"
# The paper's lens is square, ours a circle. Both searches make the circle, along a radius, which is exact
# for it: on the plane an iteration through PBL or the FNO takes thirty times as long. And both see as much of
# the focal plane, and the paper's display at its scale on the sensor, as its preset has it.
SAME_LENS = ("--set", "view.aperture=circle", "--set", "view.path=radial", "--window-px")
SAME_VIEW = {
    "direct": (*SAME_LENS, "254"),
    "computational": (*SAME_LENS, "1030", "--object-px", "137", "--set", "imaging.pixel_px=10"),
    "hoe": ("--target", "text"),
}
# Of lenses, beside what the tables show: what the paper shows as spectra of PSFs.
OF_SPECTRA = "mtf_volume_ratio"


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
    for task in todo:
        if not _is_judged(out, task):
            task.compare(out).result.unlink(missing_ok=True)
    run_commands([task.compare(out) for task in todo], logs, workers)
    record: dict[str, Any] = {
        "schema": "litho-design/benchmark-paper-search/1",
        "machine": {"cores": usable_cores(), "threads_per_process": 1},
        "command": command_line(),
        "tasks": {task.name: _found(out, task) for task in every if _is_judged(out, task)},
    }
    print(as_markdown(record))
    _write(out, record)
    if given.publish:
        record["tasks"] = _published_tasks(every) | record["tasks"]
        _write(RESULTS, record)
        publish(PAGE, NAME, as_markdown(record))


def paper_tasks(out: Path, effort: Effort) -> list[Task]:
    """Hologram and lenses, each by both searches with both budgets; the short ones first."""
    return [
        _task(out, effort, kind, search, iterations)
        for iterations in sorted(SEEDS_OF)
        for kind in ("direct", "computational", "hoe")
        for search in SEARCHES
    ]


def _task(out: Path, effort: Effort, kind: str, search: str, iterations: int) -> Task:
    hologram = kind == "hoe"
    size_px, distance_um = (
        (effort.hoe_px, effort.hoe_distance_um) if hologram else (effort.lens_px, effort.lens_distance_um)
    )
    options = task_options(
        *SEARCHES[search], "--size-px", size_px, "--distance-um", distance_um, "--iterations", iterations,
        "--yield-draws", 10,
    )  # fmt: skip
    options += SAME_VIEW[kind]
    models = {arm: "none" if arm == "none" else str(model(out, arm)) for arm in ARMS}
    judges = {FAB: str(out / "fab" / "truth")}
    judges |= {name: str(zoo.folder(model)) for name, model in MEASURED.items()}
    return Task(task_name(kind, search, iterations), kind, options, models, judges, SEEDS_OF[iterations])


def _write(folder: Path, record: Mapping[str, Any]) -> None:
    write_record(folder / FILE_NAME, record)
    search_figure(record).savefig(folder / PICTURE, dpi=100)


def _is_judged(out: Path, task: Task) -> bool:
    """Whether all of its arms have been printed by all of its judges: a folder may be of an earlier call."""
    if not task.compare(out).done:
        return False
    pairs = {(entry.arm, entry.judge) for entry in GapResult.read(out / task.name).entries}
    return all((arm, judge) in pairs for arm in task.models for judge in task.judges)


def _published_tasks(tasks: Sequence[Task]) -> dict[str, Any]:
    """Those of earlier calls, which may have had another folder, with the options of today."""
    file = RESULTS / FILE_NAME
    published = json.loads(file.read_text(encoding="utf-8"))["tasks"] if file.exists() else {}
    return {
        task.name: published[task.name]
        for task in tasks
        if published.get(task.name, {}).get("options") == list(task.options)
    }


def _found(out: Path, task: Task) -> dict[str, Any]:
    """The figures of a finished task, by arm and judge."""
    gap = GapResult.read(out / task.name)
    shown = SHOWN[NAMES[task.kind]]
    figure = next(iter(shown))
    kept = {*shown, OF_SPECTRA}
    return {
        **gap.model_dump(mode="json", include={"commit", "dirty", "versions"}),
        "iterations": task.iterations,
        "options": list(task.options),
        "seeds": len(gap.seeds),
        "printers": {arm: used.sha256 for arm, used in gap.arms.items()},
        "minutes": search_minutes(out / task.name, gap),
        "large_jump_share": _large_jump_shares(out / task.name, gap),
        "height_gap_nm": _height_gaps_nm(task, gap),
        "summary": [
            item.model_dump(mode="json")
            for item in gap.summary
            if item.figure in kept and item.judge in task.judges
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


def _large_jump_shares(folder: Path, gap: GapResult) -> dict[str, float]:
    """Neighbouring pixels that differ by many levels, as a share of all pairs: means over seeds."""
    return {
        arm: fmean(
            Design.read(design_folder(folder, arm, seed)).printability.large_jump_share for seed in gap.seeds
        )
        for arm in sorted(gap.arms)
    }


def _height_gaps_nm(task: Task, gap: GapResult) -> dict[str, dict[str, float]]:
    """By printer and arm: rms height of print less expected print, means over seeds."""
    return {
        judge: {
            arm: NM_PER_UM
            * fmean(e.rms_height_gap_um for e in gap.entries if (e.arm, e.judge) == (arm, judge))
            for arm in sorted(gap.arms)
        }
        for judge in task.judges
    }


if __name__ == "__main__":
    run_script(main)
