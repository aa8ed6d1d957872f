"""Publish the results of a board on a page of the documentation."""

from __future__ import annotations

from pathlib import Path

from benchmarks.markdown_table import markdown_table
from benchmarks.record import publish
from litho_data.foundation.errors import InputError
from litho_models.boards.figures import figures_of
from litho_models.boards.records import Scoreboard


def publish_scoreboard(page: Path, scoreboard: Scoreboard) -> None:
    """Write the results of a board into the page, between the two marks of this board.

    Raises:
        InputError: some trials have not been run, or the page lacks the marks.
    """
    if scoreboard.pending:
        raise InputError("scoreboard to publish", got=f"pending trials {scoreboard.pending}", wanted="none")
    publish(page, mark_of(scoreboard), as_markdown(scoreboard))


def mark_of(scoreboard: Scoreboard) -> str:
    """Return the name of the two marks between which the results of a board stand on the page."""
    return f"board of {scoreboard.board} {scoreboard.seed}"


def as_markdown(scoreboard: Scoreboard) -> str:
    """Return the command that ran the trials, and the table of their results, in Markdown."""
    rows = [tuple(figure) for figure in figures_of(scoreboard)]
    return f"```\n{scoreboard.command}\n```\n\n{markdown_table(('', '', 'goal'), rows)}"
