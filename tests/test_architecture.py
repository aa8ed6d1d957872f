"""Check the structure of the project: imports go one way only, and importing is cheap."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ALLOWED = {
    "litho_data": {"litho_data"},
    "litho_models": {"litho_data", "litho_models"},
    "litho_design": {"litho_data", "litho_models", "litho_design"},
}
# litho_design may use only those parts of litho_models that find and load a frozen model. Its room ``sheets``
# also trains on a sheet that a lab has printed and measured, so it may call the functions in LEARNING.
FROZEN_ONLY = {"load_frozen", "zoo"}
LEARNING = {"sheets": {"close_loop", "evaluate", "freeze"}}
# The rooms, starting with the lowest. A room imports only from the rooms before it. `simulator` is a module.
ROOMS = {
    "litho_data": (
        "foundation", "sharing", "commands", "reports", "scan", "readers", "register", "level",
        "roughness", "tip", "store", "cards", "layouts", "virtual_fab", "making",
        "provenance", "exchange", "cli",
    ),
    "litho_models": (
        "layers", "simulator", "prediction", "models", "scan_terms", "effects", "splits",
        "frozen", "scoring", "fitting", "evaluation", "noise", "monitoring", "loop", "planning",
        "boards", "cli",
    ),
    "litho_design": (
        "optics", "images", "scans", "printers", "optimisation", "elements", "tasks", "holograms", "lenses",
        "reliefs", "large", "judging", "exports", "reports", "workflows", "sheets", "cli",
    ),
}  # fmt: skip
HEAVY = ("torch", "cv2", "xarray", "zarr", "matplotlib", "pandas", "skimage", "SurfaceTopography")


def _sources(package: str, root: Path = ROOT) -> list[Path]:
    files = sorted((root / package).rglob("*.py"))
    assert files, f"{package} has no source files, so the test would check nothing"
    return files


@cache
def _imports(file: Path) -> frozenset[str]:
    """Return the dotted names of everything that a file imports, including the imports inside its
    functions.
    """
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} has a relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_imports_go_left_to_right(package: str) -> None:
    ours = set(ALLOWED)
    for file in _sources(package):
        reached = {name.split(".")[0] for name in _imports(file)} & ours
        assert reached <= ALLOWED[package], f"{file.relative_to(ROOT)} imports {reached - ALLOWED[package]}"


def test_data_does_not_import_torch() -> None:
    for file in _sources("litho_data"):
        assert not {n for n in _imports(file) if n.split(".")[0] == "torch"}, f"{file.name} imports torch"


def test_only_the_entry_of_the_commands_reads_the_command_line() -> None:
    readers = [file for package in ALLOWED for file in _sources(package) if "argv" in file.read_text("utf-8")]
    assert readers == [ROOT / "litho_data" / "commands" / "progress.py"]


def test_design_uses_only_frozen_models() -> None:
    for file in _sources("litho_design"):
        for name in _imports(file):
            parts = name.split(".")
            if parts[0] == "litho_models":
                allowed = FROZEN_ONLY | LEARNING.get(file.parent.name, set())
                assert parts[1] in allowed, f"{file.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_modules_import_each_other_in_no_circle(package: str) -> None:
    graph = _module_graph(package)
    assert sum(map(len, graph.values())) > len(graph), "hardly any imports were found"
    assert not (found := _circles(graph)), f"these modules import each other in a circle: {found}"


@pytest.mark.parametrize("package", sorted(ROOMS))
def test_rooms_import_only_from_those_before_them(package: str) -> None:
    assert not _upward(_module_graph(package), ROOMS[package])


def test_a_circle_and_an_import_upwards_are_found(tmp_path: Path) -> None:
    """Check that both tests above find a forbidden import that is inside a function."""
    for name, text in {
        "pack/__init__.py": "from pack.low.a import f",
        "pack/low/__init__.py": "",
        "pack/low/a.py": "def f():\n    from pack.high import b",
        "pack/high/__init__.py": "",
        "pack/high/b.py": "from pack.low.a import f\nfrom pack.low import c",
        "pack/low/c.py": "import os",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    graph = _module_graph("pack", tmp_path)
    assert _circles(graph) == [{"pack.low.a", "pack.high.b"}]
    assert _upward(graph, ("low", "high")) == ["pack.low.a imports pack.high.b: high lies above low"]


def _circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """Return the sets of modules that all import each other, directly or through other modules."""
    reached = {name: _reached(graph, name) for name in graph}
    circles = [{other for other in reached[name] if name in reached[other]} for name in graph]
    return [circle for place, circle in enumerate(circles) if circle and circle not in circles[:place]]


def _reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    found: set[str] = set()
    ahead = set(graph[start])
    while ahead:
        found |= ahead
        ahead = set().union(*(graph[name] for name in ahead)) - found
    return found


def _upward(graph: Mapping[str, set[str]], rooms: Sequence[str]) -> list[str]:
    """Return the imports of rooms (folders) that come later in the list than the importing room."""
    place = {room: number for number, room in enumerate(rooms)}
    pairs = [(name, other) for name, imported in graph.items() for other in imported]
    steps = [(name, other, name.split(".")[1], other.split(".")[1]) for name, other in pairs]
    return [
        f"{name} imports {other}: {its} lies above {own}"
        for name, other, own, its in steps
        if place[its] > place[own]
    ]


def _module_graph(package: str, root: Path = ROOT) -> dict[str, set[str]]:
    """Return, for each module of a package, the modules of the same package that it imports.

    The package's ``__init__.py`` is excluded: it names everything, but no module of the package imports it.
    """
    modules = {}
    for file in _sources(package, root):
        parts = file.relative_to(root).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    del modules[package]
    graph = {}
    for name, file in modules.items():
        # `from room.module import name` and `from room import module` both import room.module.
        whole = {n if n in modules else n.rpartition(".")[0] for n in _imports(file)}
        graph[name] = (whole & modules.keys()) - {name}
    return graph


def test_the_page_and_its_picture_show_the_rooms_in_their_order() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = _between(page, "rooms")
    assert re.findall(r"^\| `(\w+)` ", table, re.MULTILINE) == [
        room for rooms in ROOMS.values() for room in rooms
    ]
    picture = (ROOT / "docs" / "figures" / "rooms.svg").read_text(encoding="utf-8")
    drawn = [f"{number} {room}" for rooms in ROOMS.values() for number, room in enumerate(rooms, start=1)]
    assert re.findall(r">(\d+ \w+)<", picture) == drawn
    for file in re.findall(r"`(litho_\w+/[\w/]+(?:\.py)?)", page):
        assert (ROOT / file).exists(), f"docs/architecture.md names {file}"


def test_the_main_path_of_the_loop_takes_six_files() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    files = re.findall(r"^\d+\. `([\w/]+)\.py`", _between(page, "main path"), re.MULTILINE)
    assert len(files) == 6
    graph = _module_graph("litho_models")
    modules = [file.replace("/", ".") for file in files]
    assert importlib.import_module("litho_models").close_loop.__module__ == modules[0]
    for place, module in enumerate(modules[1:], start=1):
        used = set().union(*(graph[before] for before in modules[:place]))
        # A name may be imported through the ``__init__.py`` of its folder.
        faces = [graph[name] for name in used if (ROOT / name.replace(".", "/")).is_dir()]
        assert module in used.union(*faces), f"no earlier module of the list uses {module}"


def _between(page: str, name: str) -> str:
    """Return the text of a page between the two comments with this name."""
    return page.split(f"<!-- {name} -->")[1].split(f"<!-- end of {name} -->")[0]


def test_the_code_of_an_operation_contains_what_it_imports_from_the_rooms_of_processing() -> None:
    from litho_data.making.operations import OPERATIONS

    rooms = tuple(f"litho_data.{room}." for room in ("register", "level", "roughness", "tip"))
    for operation in OPERATIONS.values():
        paths = [ROOT / "litho_data" / name for name in operation.code if name != "making/operations.py"]
        code = {file for path in paths for file in (path.rglob("*.py") if path.is_dir() else [path])}
        for name in (one for file in code for one in _imports(file) if one.startswith(rooms)):
            package, room, module = name.split(".")[:3]
            file = ROOT / package / room / f"{module}.py"
            assert {file, file.with_name("__init__.py")} & code, f"{operation.name} also depends on {name}"


def test_virtual_fab_knows_no_model() -> None:
    for file in _sources("litho_data/virtual_fab"):
        assert not {n for n in _imports(file) if n.startswith("litho_models")}, file.name


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_importing_a_package_loads_nothing_heavy(package: str) -> None:
    code = f"import sys, {package}; print(*[m for m in {HEAVY!r} if m in sys.modules])"
    loaded = _python(code).split()
    assert not loaded, f"import {package} loads {loaded}"


def test_importing_litho_data_takes_less_than_half_a_second() -> None:
    # One of three is enough, because another process may slow this one down.
    code = "import time; t = time.perf_counter(); import litho_data; print(time.perf_counter() - t)"
    assert any(float(_python(code)) < 0.5 for _ in range(3))


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_a_public_face_is_small_and_every_name_on_it_is_there(package: str) -> None:
    face = importlib.import_module(package)
    assert face.__all__ == sorted(face.__all__)
    assert set(dir(face)) == {*face.__all__, "__version__"}
    assert len(face.__all__) <= 20
    rooms = {path.stem for path in (ROOT / package).iterdir()}
    assert not rooms & set(face.__all__), "importing a room would hide the public name that is the same"
    assert all(getattr(face, name) is not None for name in face.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = face.nothing


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_type_checkers_see_the_names_of_a_public_face(package: str) -> None:
    tree = ast.parse((ROOT / package / "__init__.py").read_text(encoding="utf-8"))
    listed = {
        alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    face = importlib.import_module(package)
    assert listed - {None} == set(face.__all__) - {"__version__"}


def _python(code: str) -> str:
    """Run code in a fresh interpreter and return what it prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
