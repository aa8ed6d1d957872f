"""Measure the gap between designs and their prints at the paper's size, with the virtual fab as judge.

    python -m benchmarks.gap --out runs/gap --workers 2
    python -m benchmarks.gap --out runs/gap-small --small 128

The fab has effects that no model contains. It prints fields, and models are trained on the scans of these
prints. One hologram and two lenses are designed without a model and with each model (the arms of the
comparison), all with the same number of iterations, and the fab prints the designs. Then the same hologram is
designed with the models of the measured prints that come with the package.

The run takes hours. With ``--tasks``, only the named tasks are run. Steps whose result exists are skipped,
and an interrupted design continues from its checkpoint.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from benchmarks.gap.document import publish_results, write_results
from benchmarks.gap.jobs import run_commands
from benchmarks.gap.plan import Effort, open_plan
from benchmarks.gap.steps import fab_jobs, model_jobs
from benchmarks.gap.tasks import FAB, chosen, require_whole_parts, tasks
from litho_data.commands.progress import run_script
from litho_data.foundation.errors import InputError
from litho_data.sharing.workers import Workers
from litho_models.frozen import zoo


def main() -> None:
    """Run the unfinished steps. Invalid input or a failed step ends the run with exit code 2."""
    try:
        _run(_arguments())
    except InputError as error:
        print(f"gap: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _run(given: argparse.Namespace) -> None:
    out, logs = given.out, given.out / "logs"
    workers = Workers(given.workers, given.dask)
    effort = Effort() if given.small is None else Effort.small(given.small)
    corrected = None if given.corrected is None else str(given.corrected.resolve())
    measured = {name: str(zoo.folder(name)) for name in zoo.list()}
    every = tasks(out, effort, measured, corrected)
    todo = chosen(every, given.tasks)
    if given.publish:
        require_whole_parts(every, todo)
    plan = open_plan(out, effort, corrected)
    started = time.monotonic()
    for stage in (*fab_jobs(out, effort), *model_jobs(out, effort)):
        run_commands(stage, logs, workers)
    for task in todo:
        print(f"{task.name}: {task.seeds * len(task.models)} designs", flush=True)
        # A single design with a model of the zoo is also judged by the rest of the zoo. The comparison makes
        # such designs itself, with one model each.
        if task.part == FAB:
            run_commands(task.designs(out), logs, workers)
    run_commands([task.compare(out) for task in todo], logs, workers)
    for part in dict.fromkeys(task.part for task in todo):
        results = write_results(out, plan, [task for task in todo if task.part == part])
        print(f"{results} ({(time.monotonic() - started) / 3600:.2f} h in this run)")
        if given.publish:
            publish_results(out, part)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gap",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the comparison")
    parser.add_argument(
        "--workers", type=int, default=1, help="number of parallel processes, each with one thread"
    )
    parser.add_argument(
        "--dask", help="address of a Dask scheduler, whose workers are used in place of local processes"
    )
    parser.add_argument(
        "--small", type=int, metavar="PX", help="try the benchmark quickly, with elements PX pixels wide"
    )
    parser.add_argument(
        "--corrected",
        type=Path,
        help="frozen model of a closed loop on the measured prints, which is used as a further arm",
    )
    parser.add_argument("--tasks", metavar="NAMES", help="tasks to run, separated by commas; all by default")
    parser.add_argument("--publish", action="store_true", help="write tables and figures into docs/gap.md")
    return parser.parse_args()


if __name__ == "__main__":
    run_script(main)
