"""Check the version, examples and option texts of commands, and that each ends by saying what to open."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

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
    """Check that help texts start in lower case, do not end with a full stop, and contain no brackets, which
    rich would drop.
    """
    for command in commands_in(get_command(importlib.import_module(f"{package}.cli.app").app)):
        for parameter in command.params:
            if parameter.name == "help" or getattr(parameter, "hidden", False):
                continue
            said = parameter.help
            name = f"{command.name} {parameter.name}"
            assert said, name
            # Only an abbreviation or a metavar may start with a capital, which another capital follows.
            assert not re.match(r"[A-Z][^A-Z]", said), f"{name}: {said}"
            assert not said.endswith("."), f"{name}: {said}"
            assert not re.search(r"\[[a-z]", said), f"{name}: {said}"
            assert "(repeatable)" not in said, f"{name}: {said}"


def silent_about_its_result(source: str) -> list[str]:
    """Return the commands that have the option ``out`` but print neither that path nor a file in it."""
    made = {one.name: one for one in ast.parse(source).body if isinstance(one, ast.FunctionDef)}

    def printed(function: ast.FunctionDef) -> str:
        calls = [one for one in ast.walk(function) if isinstance(one, ast.Call)]
        own = [ast.unparse(one) for one in calls if ast.unparse(one.func) in ("print", "typer.echo")]
        helpers = {ast.unparse(one.func) for one in calls} & {
            name for name in made if name.startswith("_print")
        }
        return " ".join([*own, *(printed(made[name]) for name in helpers)])

    def takes_out(function: ast.FunctionDef) -> bool:
        return "out" in [one.arg for one in function.args.args + function.args.kwonlyargs]

    commands = [one for name, one in made.items() if takes_out(one) and not name.startswith("_")]
    return [one.name for one in commands if not re.search(r"\b(out|file|card|target)\b", printed(one))]


def test_every_command_that_writes_says_what_to_open():
    folders = [Path(f"litho_{package}/cli") for package in ("data", "models", "design")]
    sources = {path: path.read_text("utf-8") for folder in folders for path in folder.glob("*.py")}
    assert len(sources) > 10
    assert not {
        path.name: silent for path, text in sources.items() if (silent := silent_about_its_result(text))
    }


def test_a_command_that_does_not_say_what_to_open_is_found():
    silent = "def make(out):\n    print('done')\n"
    telling = "def _print_it(out):\n    print(out)\ndef tell(out):\n    _print_it(out)\n"
    assert silent_about_its_result(silent + telling) == ["make"]
