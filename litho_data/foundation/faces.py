"""Load the public names of a package lazily: each name is imported when it is first used."""

from __future__ import annotations

import ast
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_DISTRIBUTION = "litholoop"
# The extras `models` and `design` both install torch, which litho_data alone does not need. If torch is
# missing, neither extra is installed.
_OF_EXTRAS = "torch"
# These environment variables make waiting threads sleep. The first is read by GNU's OpenMP, the second by
# Intel's.
_SLEEP = {"OMP_WAIT_POLICY": "PASSIVE", "KMP_BLOCKTIME": "0"}


def let_waiting_threads_sleep() -> None:
    """Make torch's threads sleep while they wait for one another. By default, waiting threads spin, i.e. they
    keep a processor busy. Call this before torch is loaded.

    If another process keeps a processor busy, a computation with two spinning threads takes ten times as
    long. Environment variables that are already set are not changed.
    """
    for variable, value in _SLEEP.items():
        os.environ.setdefault(variable, value)


def lazy_face(package: str, file: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__all__``, ``__getattr__`` and ``__dir__`` of a package that loads its public names lazily.

    Use it in a package's ``__init__``, as shown below. Type checkers follow the imports under
    ``TYPE_CHECKING``. At run time these imports are not executed; the function only reads the names from the
    file::

        if TYPE_CHECKING:
            from litho_data.readers.read import read_scan as read_scan
        else:
            __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)

    Args:
        package: ``__name__`` of the package. No public name may equal the name of a module or subpackage of
            the package, because importing such a module would replace the public name.
        file: the package's ``__init__`` file; every name that it imports with ``as`` is public.

    ``__version__`` is always among the public names. It is the version of the distribution, or ``"0"`` if the
    distribution is not installed.
    """
    homes = {
        alias.asname: (str(node.module), alias.name)
        for node in ast.walk(ast.parse(Path(file).read_text("utf-8")))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname
    }

    def load(name: str) -> Any:
        if name == "__version__":
            value: Any = _version()
        elif name in homes:
            let_waiting_threads_sleep()
            module, inner = homes[name]
            try:
                home = __import__(module, fromlist=[inner])
            except ModuleNotFoundError as error:
                if error.name != _OF_EXTRAS:
                    raise
                extra = package.removeprefix("litho_")
                raise ModuleNotFoundError(f"{package}.{name} {_missing(extra)}", name=error.name) from None
            value = getattr(home, inner)
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(sys.modules[package], name, value)
        return value

    names = sorted([*homes, "__version__"])
    return names, load, lambda: names


def require_extra(command: str, extra: str) -> None:
    """If a command needs optional packages that are not installed, end it with one line on stderr and exit
    code 2. ``extra`` is the name under which pip installs these packages.
    """
    let_waiting_threads_sleep()
    if importlib.util.find_spec(_OF_EXTRAS) is None:
        print(f"{command}: {_missing(extra)}", file=sys.stderr)
        raise SystemExit(2)


def _missing(extra: str) -> str:
    return (
        f"needs {_OF_EXTRAS}, which is not installed; install it with pip install '{_DISTRIBUTION}[{extra}]'"
    )


def _version() -> str:
    from importlib import metadata  # this import takes 30 ms, and most users do not need it

    try:
        return metadata.version(_DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return "0"
