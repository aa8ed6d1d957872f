"""The three commands say their version, and keep asking for a command without one."""

from __future__ import annotations

import importlib
import re

import pytest
from typer.main import get_command
from typer.testing import CliRunner

import litho_data


@pytest.mark.parametrize("package", ["litho_data", "litho_models", "litho_design"])
def test_every_command_says_its_version(package):
    app = importlib.import_module(f"{package}.cli.app").app
    said = CliRunner().invoke(app, ["--version"])
    assert (said.exit_code, said.stdout.strip()) == (0, litho_data.__version__)
    assert "Usage" in CliRunner().invoke(app, []).output


@pytest.mark.parametrize("package", ["litho_data", "litho_models", "litho_design"])
def test_every_help_has_an_example_of_its_own_command(package):
    app = importlib.import_module(f"{package}.cli.app").app
    groups = {"": app} | {f"{group.name} ": group.typer_instance for group in app.registered_groups}
    for prefix, group in groups.items():
        for command in group.registered_commands:
            name = command.name or command.callback.__name__.replace("_", "-")
            wanted = f"Example: {package.replace('_', '-')} {prefix}{name}"
            assert wanted in command.callback.__doc__, wanted


def commands_in(command):
    return [inner for sub in getattr(command, "commands", {}).values() for inner in commands_in(sub)] or [
        command
    ]


@pytest.mark.parametrize("package", ["litho_data", "litho_models", "litho_design"])
def test_every_option_is_described_in_one_style(package):
    """A few words that start small and have no full stop; nothing that rich takes for markup and swallows."""
    for command in commands_in(get_command(importlib.import_module(f"{package}.cli.app").app)):
        for parameter in command.params:
            if parameter.name == "help" or getattr(parameter, "hidden", False):
                continue
            said = parameter.help
            name = f"{command.name} {parameter.name}"
            assert said, name
            # A capital is an abbreviation's or a metavar's: two in a row.
            assert not re.match(r"[A-Z][^A-Z]", said), f"{name}: {said}"
            assert not said.endswith("."), f"{name}: {said}"
            assert not re.search(r"\[[a-z]", said), f"{name}: {said}"
            assert "(repeatable)" not in said, f"{name}: {said}"
