"""Plug-ins: modules that register something of one's own (a reader, an effect, a model) when imported.

One is found by its entry point in the group ``litholoop.plugins``, or named as a file. Every command and
every worker loads them before its work begins.
"""

import importlib.util
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib import metadata
from pathlib import Path

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256

GROUP, OPTION = "litholoop.plugins", "--plugin"
# Name of an installed one, or the file, to what tells one state of it from another.
_LOADED: dict[str, str] = {}


def load_plugins(files: Iterable[str | Path] = ()) -> None:
    """Import all plug-ins that are installed, and these files; each once in a process.

    Raises:
        InputError: no file of Python, or a plug-in that fails.
    """
    for point in metadata.entry_points(group=GROUP):
        version = point.dist.version if point.dist else ""
        _load(point.name, version, point.load)
    for file in files:
        path = Path(file).absolute()
        if path.suffix != ".py" or not path.is_file():
            raise InputError("plug-in", got=str(file), wanted="a file of Python")
        _load(str(path), file_sha256(path)[:12], lambda path=path: _import(path))  # type: ignore[misc]


def plugin_files() -> list[str]:
    """The files that were loaded, for other processes."""
    return [name for name in _LOADED if Path(name).is_absolute()]


def plugin_versions() -> dict[str, str]:
    """What was loaded, each with its version, or the beginning of the hash of its file."""
    return {f"plug-in {Path(name).name}": version for name, version in _LOADED.items()}


def without_plugins(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words of a command line without ``--plugin FILE``, and the files.

    Raises:
        InputError: the option without a file.
    """
    kept, files, left = [], [], iter(words)
    for word in left:
        name, equals, file = word.partition("=")
        if name != OPTION:
            kept.append(word)
            continue
        file = file if equals else next(left, "")
        if not file:
            raise InputError(OPTION, got="none", wanted="a file of Python that registers something")
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
    """Run a file as a module that goes by its own name, by which its classes reach other processes."""
    known = sys.modules.get(path.stem)
    if known is not None:
        got = f"{path.name}, by whose name goes {getattr(known, '__file__', None) or 'a part of Python'}"
        raise InputError("plug-in", got=got, wanted="a file with a name of its own")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[path.stem]
        raise
