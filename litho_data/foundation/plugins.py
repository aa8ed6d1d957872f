"""Load plug-ins. A plug-in is a module that a user wrote. When it is imported, it registers additional
readers, effects or models.

A plug-in is found through its entry point in the group ``litholoop.plugins``, or given as a file. Every
command and every worker loads all plug-ins before its work begins.
"""

import importlib.util
import inspect
import linecache
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256, record_sha256, source_sha256

SOURCES = ("litho_data", "litho_models", "litho_design")
_PACKAGES = [Path(__file__).parents[2] / name for name in SOURCES]
GROUP, OPTION = "litholoop.plugins", "--plugin"
# Maps the name of each installed plug-in to its version, and the path of each plug-in file to the beginning
# of the file's hash.
_LOADED: dict[str, str] = {}


def load_plugins(files: Iterable[str | Path] = ()) -> None:
    """Import all installed plug-ins and the given plug-in files. Each is imported once per process.

    Raises:
        InputError: a file is not Python, or a plug-in fails to load.
    """
    for point in _installed(*sys.path):
        version = point.dist.version if point.dist else ""
        _load(point.name, version, point.load)
    for file in files:
        path = Path(file).absolute()
        if path.suffix != ".py" or not path.is_file():
            raise InputError("plug-in", got=str(file), wanted="a Python file")
        _load(str(path), file_sha256(path)[:12], lambda path=path: _import(path))  # type: ignore[misc]


@lru_cache(maxsize=1)
def _installed(*path: str) -> metadata.EntryPoints:
    """Return the entry points of the plug-ins that are installed in the folders of ``path``, which is
    ``sys.path``. The result is cached, because reading it takes as long as a small job of a worker.
    """
    return metadata.entry_points(group=GROUP)


def plugin_files() -> list[str]:
    """Return the paths of the loaded plug-in files, so that other processes can load the same files."""
    return [name for name in _LOADED if Path(name).is_absolute()]


def plugin_versions() -> dict[str, str]:
    """Return a dict that maps each loaded plug-in to its version, or to the beginning of the hash of its
    file.
    """
    return {f"plug-in {Path(name).name}": version for name, version in _LOADED.items()}


def foreign_sha256(function: Callable[..., Any]) -> str:
    """Return the hash of the file, package or notebook cell that defines a function or a class. For code of
    this project and for compiled code, the result is empty.
    """
    code = inspect.unwrap(function.func if isinstance(function, partial) else function)
    named = inspect.isroutine(code) or inspect.isclass(code)
    file = _file_of(code if named else type(code))
    if not file:
        return ""
    source = Path(file)
    while (source.parent / "__init__.py").is_file():
        source = source.parent
    if source in _PACKAGES:
        return ""
    return source_sha256(source) if source.exists() else record_sha256(linecache.getlines(str(source)))


def _file_of(code: Callable[..., Any]) -> str:
    try:
        return inspect.getfile(code)
    except TypeError:
        return ""
    except OSError:
        # Python knows the cell of a notebook that defines a method, but not the cell that defines a class.
        return next((_file_of(own) for own in vars(code).values() if inspect.isfunction(own)), "")


def without_plugins(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Remove the options ``--plugin FILE`` from a command line. Return the remaining words and the list of
    the plug-in files.

    Raises:
        InputError: the option is given without a file.
    """
    kept, files, left = [], [], iter(words)
    for word in left:
        name, equals, file = word.partition("=")
        if name != OPTION:
            kept.append(word)
            continue
        file = file if equals else next(left, "")
        if not file:
            raise InputError(
                OPTION, got="none", wanted="a Python file that registers a reader, an effect or a model"
            )
        files.append(file)
    return kept, files


def _load(name: str, version: str, load: Callable[[], object]) -> None:
    if name in _LOADED:
        return
    try:
        load()
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"plug-in {name}", got=f"{type(error).__name__}: {error}") from error
    _LOADED[name] = version


def _import(path: Path) -> None:
    """Run a file as a module with the file's name, so that other processes can import its classes by this
    name.
    """
    known = sys.modules.get(path.stem)
    if known is not None:
        got = f"{path.name}, whose name is used by {getattr(known, '__file__', None) or 'a part of Python'}"
        raise InputError("plug-in", got=got, wanted="a file with an unused name")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[path.stem]
        raise
