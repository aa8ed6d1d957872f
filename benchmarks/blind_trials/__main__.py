"""Blind trials of the closed loop on the virtual fab.

    python -m benchmarks.blind_trials --out runs/blind-trials --workers 2
    python -m benchmarks.blind_trials --out runs/blind-trials --dask tcp://host:8786
    python -m benchmarks.blind_trials --out runs/development --seed 1 --only 0,1,2
    python -m benchmarks.blind_trials --out runs/development --seed 1 --plan
    python -m benchmarks.blind_trials --out runs/earlier --count 24 --seed 20266

Draws what the fab hides, gives the loop scans and layouts only, and judges its answers by the rules in
docs/blind_trials.md. An interrupted run resumes. Writes scoreboard.json, scoreboard.csv and report.html;
--publish also puts them into the documentation.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.blind_trials.campaign import (
    finished,
    make_draws,
    open_campaign,
    plan_lines,
    run_campaign,
    run_one,
)
from benchmarks.blind_trials.report import CSV_NAME, write_report
from benchmarks.blind_trials.scoreboard import figures_of, make_scoreboard, publish
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError
from litho_data.foundation.workers import Workers

# Of the last board, drawn from once the loop was finished; development uses other seeds.
REPORTED_SEED = 20270
DOCS = Path(__file__).parents[2] / "docs"
PAGE, RESULTS = DOCS / "blind_trials.md", DOCS / "results" / "blind-trials"


def results_of(seed: int) -> Path:
    """Where the published results of a board lie; the first published one has no folder of its own."""
    return RESULTS if seed == 20266 else RESULTS / str(seed)


def main() -> None:
    """Run what is not finished, then write the scoreboard; bad input ends with exit code 2."""
    arguments = _arguments()
    try:
        if arguments.run_one is not None:
            run_one(arguments.out, arguments.run_one, arguments.keep_data)
            return
        _campaign(arguments)
    except InputError as error:
        print(f"blind trials: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _campaign(arguments: argparse.Namespace) -> None:
    out, seed = arguments.out, arguments.seed
    draws = make_draws(count=arguments.count, seed=seed, n_scans=arguments.scans, size_px=arguments.size_px)
    numbers = arguments.only or [draw.number for draw in draws.trials]
    if arguments.plan:
        for line in plan_lines(draws, numbers):
            print(line, flush=True)
        return
    open_campaign(out, draws)
    run_campaign(
        out,
        draws,
        numbers=numbers,
        workers=Workers(arguments.workers, arguments.dask),
        timeout_s=arguments.timeout_s,
        keep_data=arguments.keep_data,
    )
    plan = [] if arguments.count is None else ["--count", str(arguments.count)]
    settings = [*plan, "--seed", str(seed), "--scans", str(draws.n_scans), "--size-px", str(draws.size_px)]
    command = " ".join(["python -m benchmarks.blind_trials", *settings])
    scoreboard = make_scoreboard(draws, finished(out, draws), command)
    scoreboard.write(out)
    page = write_report(scoreboard, out)
    if arguments.publish:
        publish(PAGE, scoreboard)
        results_of(seed).mkdir(parents=True, exist_ok=True)
        scoreboard.write(results_of(seed))
        (results_of(seed) / CSV_NAME).write_bytes((out / CSV_NAME).read_bytes())
    for what, value, wanted in figures_of(scoreboard):
        print(f"{value:>16}  {what}" + (f" (wanted: {wanted})" if wanted else ""))
    print(f"report: {page}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.blind_trials",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the campaign")
    parser.add_argument(
        "--count", type=int, help="so many trials by the plan of boards up to 20266, instead of a board of 48"
    )
    parser.add_argument(
        "--plan",
        action="store_true",
        help="only size what would be planted; runs no loop",
    )
    parser.add_argument("--seed", type=int, default=REPORTED_SEED, help=f"draws (default {REPORTED_SEED})")
    parser.add_argument("--scans", type=int, default=12, help="scans per trial (default 12)")
    parser.add_argument("--size-px", type=int, default=256, help="side of a layout, pixels (default 256)")
    parser.add_argument("--workers", type=int, default=1, help="trials side by side, one thread each")
    parser.add_argument("--dask", help="address of a Dask scheduler: its workers in the place of --workers")
    parser.add_argument("--only", type=_numbers, help="numbers of the trials to run, such as 0,3,7")
    parser.add_argument("--timeout-s", type=float, default=3600.0, help="longest time of a trial, seconds")
    parser.add_argument("--keep-data", action="store_true", help="keep raw files and stores")
    parser.add_argument("--publish", action="store_true", help="write the scoreboard into docs/")
    parser.add_argument("--run-one", type=int, help=argparse.SUPPRESS)
    return parser.parse_args()


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


if __name__ == "__main__":
    run_script(main)
