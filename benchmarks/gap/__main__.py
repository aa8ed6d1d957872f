"""The design-to-manufacturing gap at the paper's size, with the virtual fab as judge.

    python -m benchmarks.gap --out runs/gap --workers 2
    python -m benchmarks.gap --out runs/gap-small --small 128

Prints fields in a fab whose effects no model was told of, trains six arms on the scans, designs one
hologram and two lenses through each of them with equal budgets, and lets the fab print the designs; then
the same hologram through the models of measured prints that come with the package. Time and memory are
measured on trial iterations and told before the long part; ``--tasks`` does some of the tasks. Every step
is skipped where its result exists, and an interrupted design resumes from its checkpoint.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from benchmarks.gap.cost import as_text, estimate, read_records, run_trial, trial_job
from benchmarks.gap.document import publish_results, write_results
from benchmarks.gap.jobs import run_commands
from benchmarks.gap.plan import Effort, Plan, open_plan
from benchmarks.gap.steps import fab_jobs, model_jobs
from benchmarks.gap.tasks import Task, chosen, tasks
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError
from litho_data.foundation.workers import Workers
from litho_models.frozen import zoo


def main() -> None:
    """Run what is not finished; bad input or a failed step ends with exit code 2."""
    given = _arguments()
    out = given.out
    try:
        if given.trial:
            name, _, arm = given.trial.partition("/")
            run_trial(out, next(task for task in _tasks(out, Plan.read(out)) if task.name == name), arm)
            return
        _run(given)
    except InputError as error:
        print(f"gap: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _run(given: argparse.Namespace) -> None:
    out, logs = given.out, given.out / "logs"
    workers = Workers(given.workers, given.dask)
    if given.publish and given.tasks:
        raise InputError("--publish", got="with --tasks", wanted="all tasks: the page shows all of them")
    effort = _effort(given)
    plan = open_plan(out, effort, None if given.corrected is None else str(given.corrected.resolve()))
    todo = chosen(_tasks(out, plan), given.tasks)
    print("trial iterations", flush=True)
    # One at a time: what is timed should not share its memory bus.
    trials = {
        trial.name: trial for task in todo for arm in task.models for trial in [trial_job(out, task, arm)]
    }
    run_commands(list(trials.values()), logs)
    rows = estimate(read_records(out), todo, effort)
    print(as_text(rows, given.workers), flush=True)
    if given.estimate:
        return
    started = time.monotonic()
    for stage in (*fab_jobs(out, effort), *model_jobs(out, effort)):
        run_commands(stage, logs, workers)
    for task in todo:
        print(f"{task.name}: {len(task.designs(out))} designs", flush=True)
        run_commands(task.designs(out), logs, workers)
    run_commands([task.compare(out) for task in todo], logs, workers)
    results = write_results(out, plan, todo, rows)
    print(f"{results} ({(time.monotonic() - started) / 3600:.2f} h in this run)")
    if given.publish:
        publish_results(out)


def _tasks(out: Path, plan: Plan) -> list[Task]:
    return tasks(out, plan.effort, {name: str(zoo.folder(name)) for name in zoo.list()}, plan.corrected)


def _effort(given: argparse.Namespace) -> Effort:
    effort = Effort() if given.small is None else Effort.small(given.small)
    names = ("hoe_iterations", "lens_iterations", "seeds", "zoo_seeds", "training_steps")
    changed = {name: value for name in names if (value := getattr(given, name)) is not None}
    return effort.model_copy(update=changed)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gap",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the comparison")
    parser.add_argument("--workers", type=int, default=1, help="processes side by side, one thread each")
    parser.add_argument("--dask", help="address of a Dask scheduler: its workers in the place of --workers")
    parser.add_argument("--small", type=int, metavar="PX", help="tiny elements, to try the machinery")
    parser.add_argument("--hoe-iterations", type=int, help="of every hologram, at most 300")
    parser.add_argument("--lens-iterations", type=int, help="of every lens, at most 200")
    parser.add_argument("--seeds", type=int, help="of the designs judged by the fab")
    parser.add_argument("--zoo-seeds", type=int, help="of the designs through models of measured prints")
    parser.add_argument("--training-steps", type=int, help="of the two networks")
    parser.add_argument(
        "--corrected", type=Path, help="model of a closed loop on the measured prints: one arm more"
    )
    parser.add_argument("--tasks", metavar="NAMES", help="only these, separated by commas; all by default")
    parser.add_argument("--estimate", action="store_true", help="trial iterations and estimate only")
    parser.add_argument("--publish", action="store_true", help="write tables and figures into docs/gap.md")
    parser.add_argument("--trial", help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    run_script(main)
