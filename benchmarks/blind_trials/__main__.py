"""Run blind trials of the closed loop in the virtual fab.

    python -m benchmarks.blind_trials --out runs/singles
    python -m benchmarks.blind_trials --out runs/mixtures --board mixtures --measured runs/measured.zarr
    python -m benchmarks.blind_trials --out runs/development --board mixtures --seed 1 --only 0,1,2

In each trial, hidden effects are drawn, the loop receives only the scans and the layouts, and its answer is
judged by the rules in docs/blind_trials.md. The results of all trials are written to scoreboard.json and
scoreboard.csv, and with --publish also into the documentation. An interrupted run continues when it is run
again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import get_args

from benchmarks.blind_trials.campaign import finished, open_campaign, run_campaign, run_one
from benchmarks.blind_trials.publishing import publish_scoreboard
from benchmarks.record import options
from litho_data.commands.progress import run_script
from litho_data.foundation.errors import InputError
from litho_data.sharing.workers import Workers
from litho_models.boards.board import BASE, make_draws
from litho_models.boards.figures import figure_lines, make_scoreboard, trial_table
from litho_models.boards.records import Board

# The seed of each board was announced before any of its trials was run. Other seeds are used for development.
ANNOUNCED: dict[Board, int] = {"singles": 20270, "mixtures": 20283}
DOCS = Path(__file__).parents[2] / "docs"
PAGE, RESULTS = DOCS / "blind_trials.md", DOCS / "results" / "blind-trials"


def results_of(board: Board, seed: int) -> Path:
    """Return the folder of the published results of a board."""
    return RESULTS / f"{board}-{seed}"


def main() -> None:
    """Run the unfinished trials, and write the scoreboard. Invalid input ends the run with exit code 2."""
    arguments = _arguments()
    try:
        if arguments.run_one is not None:
            run_one(
                arguments.out, arguments.run_one, measured=arguments.measured, keep_data=arguments.keep_data
            )
            return
        _campaign(arguments)
    except InputError as error:
        print(f"blind trials: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _campaign(arguments: argparse.Namespace) -> None:
    out, board, measured = arguments.out, arguments.board, arguments.measured
    seed = ANNOUNCED[board] if arguments.seed is None else arguments.seed
    base = arguments.base or BASE[board]
    size = {"n_scans": arguments.scans, "size_px": arguments.size_px}
    draws = make_draws(board=board, seed=seed, base=base, **size)
    numbers = arguments.only or [draw.number for draw in draws.trials]
    if measured is None and any(draw.kind == "measured" and draw.number in numbers for draw in draws.trials):
        raise InputError(
            "store of measured prints",
            got="none",
            wanted="--measured STORE",
            hint="give the store, or select other trials with --only",
        )
    open_campaign(out, draws)
    passed_on = ["--keep-data"] * arguments.keep_data
    passed_on += ["--measured", str(measured.resolve())] if measured else []
    run_campaign(
        out,
        draws,
        numbers=numbers,
        workers=Workers(arguments.workers, arguments.dask),
        timeout_s=arguments.timeout_s,
        options=passed_on,
    )
    settings = (
        f"--out {out} --board {board} --seed {seed} --scans {draws.n_scans} --size-px {draws.size_px} "
        f"--base {base}{f' --measured {measured}' * bool(measured)}"
    )
    scoreboard = make_scoreboard(draws, finished(out, draws), f"python -m benchmarks.blind_trials {settings}")
    scoreboard.write(out)
    trial_table(scoreboard).to_csv(out / "scoreboard.csv", index=False)
    if arguments.publish:
        publish_scoreboard(PAGE, scoreboard)
        scoreboard.write(results_of(board, seed))
    print(*figure_lines(scoreboard), sep="\n")
    print(f"all trials: {out / 'scoreboard.csv'}")


def _arguments() -> argparse.Namespace:
    parser = options(__doc__, "write the results into docs/blind_trials.md")
    parser.prog = "python -m benchmarks.blind_trials"
    add = parser.add_argument
    add("--out", type=Path, required=True, help="folder of the trials")
    add(
        "--board",
        choices=get_args(Board),
        default="singles",
        help="set of trials: with one cause per trial (singles), or with two to four (mixtures)",
    )
    add("--seed", type=int, help="seed of all random draws (default: the seed announced for the board)")
    add("--base", help="base model of the loop (default: physics for singles, auto for mixtures)")
    add("--measured", type=Path, help="store of measured prints, to whose heights causes are added")
    add("--scans", type=int, default=12, help="number of scans per trial (default 12)")
    add("--size-px", type=int, default=256, help="side of each layout in pixels (default 256)")
    add("--workers", type=int, default=1, help="number of parallel trials, each with one thread")
    add("--dask", help="address of a Dask scheduler, whose workers are used in place of local processes")
    add("--only", type=_numbers, help="numbers of the trials to run, such as 0,3,7")
    add("--timeout-s", type=float, default=3600.0, help="time limit of a trial in seconds (default 3600)")
    add("--keep-data", action="store_true", help="keep the raw files and stores of the trials")
    add("--run-one", type=int, help=argparse.SUPPRESS)
    return parser.parse_args()


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


if __name__ == "__main__":
    run_script(main)
