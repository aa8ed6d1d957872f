"""Blind trials of the closed loop on the virtual fab.

    python -m benchmarks.blind_trials --out runs/blind-trials --workers 2
    python -m benchmarks.blind_trials --out runs/development --seed 0 --only 0,1,2

Draws what the fab hides over all of its knobs, gives the loop scans and layouts only, and judges its answers.
An interrupted run resumes. Writes scoreboard.json, scoreboard.csv and report.html; --publish also
puts them into the documentation.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.blind_trials.campaign import finished, open_campaign, run_campaign, run_one
from benchmarks.blind_trials.document import figures_of, publish
from benchmarks.blind_trials.report import CSV_NAME, write_report
from benchmarks.blind_trials.scoreboard import make_scoreboard
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError

# Drawn from once the loop was finished; development uses seed 0.
REPORTED_SEED = 20266
DOCS = Path(__file__).parents[2] / "docs"
PAGE, RESULTS = DOCS / "blind_trials.md", DOCS / "results" / "blind-trials"


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
    out = arguments.out
    draws = open_campaign(
        out,
        count=arguments.count,
        seed=arguments.seed,
        n_scans=arguments.scans,
        size_px=arguments.size_px,
    )
    run_campaign(
        out,
        draws,
        numbers=arguments.only or [draw.number for draw in draws.trials],
        workers=arguments.workers,
        timeout_s=arguments.timeout_s,
        keep_data=arguments.keep_data,
    )
    scoreboard = make_scoreboard(draws, finished(out, draws))
    scoreboard.write(out)
    page = write_report(scoreboard, out)
    if arguments.publish:
        publish(PAGE, scoreboard)
        scoreboard.write(RESULTS)
        (RESULTS / CSV_NAME).write_bytes((out / CSV_NAME).read_bytes())
    for what, value in figures_of(scoreboard):
        print(f"{value:>16}  {what}")
    print(f"report: {page}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.blind_trials",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the campaign")
    parser.add_argument("--count", type=int, default=24, help="trials (default 24)")
    parser.add_argument("--seed", type=int, default=REPORTED_SEED, help=f"draws (default {REPORTED_SEED})")
    parser.add_argument("--scans", type=int, default=12, help="scans per trial (default 12)")
    parser.add_argument("--size-px", type=int, default=256, help="side of a layout, pixels (default 256)")
    parser.add_argument("--workers", type=int, default=1, help="trials side by side, one thread each")
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
