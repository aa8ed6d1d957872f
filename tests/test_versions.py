"""The three commands say their version, and keep asking for a command without one."""

from __future__ import annotations

import importlib

import pytest
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
