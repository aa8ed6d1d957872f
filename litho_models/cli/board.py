"""The commands `litho-models board new` and `litho-models board judge`. `board new` makes stores with hidden
causes. `board judge` runs a loop on these stores and scores the causes that the loop names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from litho_data.commands.app import App, argument, option
from litho_data.commands.progress import say

board = App(
    help="Blind boards: simulated stores that show whether a loop can name hidden causes.",
    no_args_is_help=True,
)


@board.command("new")
def new(
    out: Annotated[Path, option("folder for the board")],
    kind: Annotated[
        Literal["singles", "mixtures"], option("singles: one hidden cause per store; mixtures: two to four")
    ] = "singles",
    seed: Annotated[int, option("seed of all random draws", min=0)] = 0,
    trials: Annotated[int | None, option("number of stores; by default all (about 40)", min=1)] = None,
    scans: Annotated[int, option("scans in each store", min=2)] = 12,
    size_px: Annotated[int, option("side of a layout, in pixels of 0.1 µm")] = 256,
) -> None:
    """Simulate prints and scans with hidden causes in the virtual fab. The loop that is tested receives only
    the stores; ``board judge`` also reads the hidden causes.

    Example: litho-models board new --trials 8 --out board
    """
    from litho_models.boards.board import HIDDEN, STORES, new_board

    draws = new_board(out, board=kind, seed=seed, trials=trials, n_scans=scans, size_px=size_px)
    typer.echo(
        f"{len(draws.trials)} stores for the loop: {out / STORES}; "
        f"their hidden causes, for the judge only: {out / HIDDEN}"
    )


@board.command("judge")
def judge(
    board: Annotated[Path, argument("folder that `board new` wrote")],
    out: Annotated[Path, option("folder for the results of all trials, the scoreboard and its table")],
    loop: Annotated[
        str | None,
        option(
            "command that runs the loop; it receives STORE and FOLDER as its last arguments and writes "
            "FOLDER/answer.json; by default close-loop of this package"
        ),
    ] = None,
) -> None:
    """Run a loop on every store of a board, and compare the causes that it names with the hidden causes. An
    interrupted run resumes.

    Example: litho-models board judge board --loop "python my_loop.py" --out judged
    """
    from litho_models.boards.board import command_loop, judge_board
    from litho_models.boards.figures import figure_lines

    scoreboard = judge_board(
        board,
        out,
        command_loop(loop) if loop else None,
        name=loop,
        report=say,
    )
    for line in figure_lines(scoreboard):
        typer.echo(line)
    typer.echo(f"all trials: {out / 'scoreboard.csv'}")
