"""Check that the list of capabilities is complete and that each entry names tests or a reason for none."""

from __future__ import annotations

import ast
import importlib
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

ROOT = Path(__file__).parents[1]
LIST = ROOT / "tests" / "capabilities.toml"
PACKAGES = ("litho_data", "litho_models", "litho_design")
# Rooms whose `__all__` is meant only for other rooms, so no page documents it.
INNER = {"litho_data.foundation", "litho_models.fitting"}
# Options that every command has, and one option of torchrun.
ANYWHERE = {"--help", "--version", "--install-completion", "--show-completion", "--no-python", "--plugin"}


def entries() -> list[dict[str, Any]]:
    groups = tomllib.loads(LIST.read_text("utf-8"))
    return [entry for tasks in groups.values() for listed in tasks.values() for entry in listed]


@cache
def names_in_file(file: str) -> frozenset[str]:
    """Return the test names of a file without importing it; in a class they read `Class::test_name`."""

    def names(nodes: list[ast.stmt], place: str) -> Iterator[str]:
        for node in nodes:
            if isinstance(node, ast.ClassDef):
                yield from names(node.body, f"{place}{node.name}::")
            elif isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                yield place + node.name

    path = ROOT / file
    return frozenset(names(ast.parse(path.read_text("utf-8")).body, "")) if path.is_file() else frozenset()


def faults(entry: dict[str, Any]) -> list[str]:
    """Describe in words what is wrong with an entry."""
    kinds = entry.keys() & {"test", "gone", "untested"}
    found = []
    if len(kinds) != 1 or entry.keys() - kinds != {"what", "how"}:
        found.append(f"keys {sorted(entry)}, wanted what, how and one of test, gone, untested")
    tests = entry.get("test", [])
    tests = [tests] if isinstance(tests, str) else tests
    texts = [value for key, value in entry.items() if key != "test"] + tests
    if not all(isinstance(text, str) and text.strip() for text in texts) or ("test" in entry and not tests):
        found.append("an empty text")
    for test in tests:
        file, _, name = test.partition("::")
        if name not in names_in_file(file):
            found.append(f"no test {test}")
    return found


def commands() -> dict[str, set[str]]:
    """Return the options of every command of the three command lines."""
    found: dict[str, set[str]] = {}

    def walk(command: Any, name: str) -> None:
        for word, inner in getattr(command, "commands", {}).items():
            walk(inner, f"{name} {word}")
        if not hasattr(command, "commands"):
            found[name] = {option for parameter in command.params for option in parameter.opts}

    for package in PACKAGES:
        app = importlib.import_module(f"{package}.cli.app").app
        walk(get_command(app), package.replace("_", "-"))
    return found


def public_names() -> set[str]:
    """Return `room.name` for every name that the `__init__.py` of a package or room exports."""
    names = set()
    for file in (one for package in PACKAGES for one in (ROOT / package).rglob("__init__.py")):
        room = ".".join(file.parent.relative_to(ROOT).parts)
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                names |= {f"{room}.{name}" for name in ast.literal_eval(node.value)}
            elif isinstance(node, ast.ImportFrom):
                names |= {f"{room}.{alias.name}" for alias in node.names if alias.asname == alias.name}
    return {name for name in names if name.rpartition(".")[0] not in INNER}


def names_in(how: str) -> set[str]:
    """Return the public names in a `how` text, where they are written `room.name` or `room: name, name`."""
    named = set(re.findall(r"litho_\w+(?:\.\w+)+(?=[\s,;()]|$)", how))
    for room, listed in re.findall(r"(litho_[\w.]+): ([^;]+)", how):
        named |= {f"{room}.{name}" for name in re.findall(r"\w+", listed)}
    return named


@pytest.fixture(scope="module")
def hows() -> list[str]:
    return [entry["how"] for entry in entries()]


def test_every_entry_has_tests_that_exist_or_says_why_not():
    wrong = {entry.get("what"): faults(entry) for entry in entries() if faults(entry)}
    assert not wrong
    told = [entry["what"] for entry in entries()]
    assert len(told) == len(set(told)) >= 150


def test_a_fault_in_an_entry_is_found():
    here = "tests/test_capabilities.py::test_a_fault_in_an_entry_is_found"
    good = {"what": "Find faults", "how": "a list", "test": here}
    assert faults(good) == faults({**good, "test": [here, here]}) == []
    for spoiled, said in (
        ({**good, "test": f"{here}_not"}, "no test"),
        ({**good, "test": [here, "tests/test_nowhere.py::test_nothing"]}, "no test"),
        # A test inside a class needs the name of the class.
        (
            {**good, "test": "tests/litho_data/test_layouts.py::test_a_random_layout_follows_the_equation"},
            "no test",
        ),
        ({**good, "test": ""}, "empty"),
        ({**good, "test": []}, "empty"),
        ({**good, "gone": "nobody misses it"}, "keys"),
        ({"what": "Find faults", "how": "a list"}, "keys"),
        ({"what": "Find faults", "how": "a list", "gone": " "}, "empty"),
        ({**good, "tset": here}, "keys"),
    ):
        assert any(said in fault for fault in faults(spoiled)), spoiled


def test_every_command_is_listed(hows):
    words = " ".join(hows)
    assert len(commands()) > 30
    missing = [name for name in commands() if not re.search(rf"{name}(?![\w-])", words)]
    assert not missing


def test_every_public_name_is_listed(hows):
    listed = {name for how in hows for name in names_in(how)}
    assert len(public_names()) > 150
    assert not public_names() - listed


def test_every_command_option_and_name_in_the_list_exists():
    """Check that all listed names exist, except in entries for capabilities that were removed."""
    known, public = commands(), public_names()
    options = ANYWHERE | {option for own in known.values() for option in own}
    for how in (entry["how"] for entry in entries() if "gone" not in entry):
        assert set(re.findall(r"--[a-z][a-z-]*", how)) <= options, how
        for name in re.findall(r"litho-(?:data|models|design) [a-z-]+", how):
            assert any(f"{command} ".startswith(f"{name} ") for command in known), how
        for name in names_in(how):
            parts = name.split(".")
            prefixes = {".".join(parts[:end]) for end in range(1, len(parts) + 1)}
            assert (
                prefixes & public
                or parts[-1] == "__version__"
                or any(shown.startswith(f"{name}.") for shown in public)
            ), f"{name} in {how}"


def test_the_help_of_every_command_fits_one_screen() -> None:
    """Check 50 lines of 80 characters. Further options are shown by ``--help-all``."""
    helps = {}
    for package in PACKAGES:
        app = importlib.import_module(f"{package}.cli.app").app
        for words in commands_of(get_command(app)):
            helps[package, *words] = CliRunner().invoke(app, [*words, "--help"]).output.splitlines()
    assert len(helps) > 35
    assert {name: len(lines) for name, lines in helps.items() if len(lines) > 50} == {}
    assert max(len(line) for lines in helps.values() for line in lines) <= 80


@pytest.mark.parametrize(
    ("program", "command", "headings"),
    [
        ("models", "noise", ["Arguments", "Options"]),
        ("models", "benchmark", ["Arguments", "Options", "Where it runs"]),
        ("design", "hoe", ["Options", "Where it runs", "Layout", "Optics", "Search"]),
    ],
)
def test_a_help_has_headings_and_leaves_the_rest_to_help_all(
    program: str, command: str, headings: list[str]
) -> None:
    app = importlib.import_module(f"litho_{program}.cli.app").app
    said = CliRunner().invoke(app, [command, "--help"]).output
    assert re.findall(r"^([A-Z][\w ]*):$", said, re.MULTILINE) == headings
    if "--help-all" in said:
        more = CliRunner().invoke(app, [command, "--help-all"]).output
        hidden = {"benchmark": "--figures", "hoe": "--band-px"}[command]
        assert hidden in more
        assert hidden not in said


def commands_of(command: Any, *words: str) -> Iterator[tuple[str, ...]]:
    """Return the words that call each command of a program, the program itself included."""
    yield words
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands_of(inner, *words, name)
