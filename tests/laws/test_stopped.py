"""Check that a command that is stopped after any write and run again leaves the same files as an
uninterrupted run.

``python -m tests.stopped_commands NAME FOLDER every`` stops a command after each of its writes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from typer.main import get_command

from litho_data.cli.app import app as data
from litho_design.cli.app import app as design
from litho_models.cli.app import app as models
from tests.stopped_commands import COMMANDS, stop_everywhere

# Each of these commands writes in another way: a store, a growing folder, a whole folder, a plan that
# continues from kept tiles, and a file.
QUICK = ("build", "train-network", "freeze", "next-print", "export-design")
# These commands write one file, or a folder whose parts are written by other commands.
ELSEWHERE = {"level", "predict", "sheet-read"}


def test_every_command_that_writes_a_folder_is_stopped() -> None:
    """Check that every command with the option ``out`` is in ``COMMANDS``, possibly with a suffix."""
    for app in (data, models, design):
        for name, command in _commands(get_command(app)):
            if name not in ELSEWHERE and any(one.name == "out" for one in command.params):
                assert any(one == name or one.startswith(f"{name}-") for one in COMMANDS), name


def _commands(group: click.Command, before: str = "") -> Iterator[tuple[str, click.Command]]:
    if not isinstance(group, click.Group):
        yield before, group
        return
    for name, command in group.commands.items():
        yield from _commands(command, f"{before}-{name}".strip("-"))


@pytest.mark.parametrize(
    "name",
    [*QUICK, *(pytest.param(one, marks=pytest.mark.long) for one in COMMANDS if one not in QUICK)],
)
def test_a_stopped_command_that_is_given_again_ends_like_one_that_was_not(name: str, tmp_path: Path) -> None:
    assert stop_everywhere(name, tmp_path) > 0
