"""What the three command lines share: exit codes, one-line errors, a progress bar on stderr."""

from __future__ import annotations

import errno
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import running_command

T = TypeVar("T")
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def new_app(help_text: str):
    """A typer application with the settings of this project."""
    import typer

    def options(
        version: bool = typer.Option(False, "--version", help="Print the version and exit.", is_eager=True),
    ) -> None:
        if version:
            from litho_data import __version__

            typer.echo(__version__)
            raise typer.Exit()

    return typer.Typer(
        help=help_text,
        callback=options,
        # Without this, --version alone would be asked for a command.
        invoke_without_command=True,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )


def run_app(app, name: str) -> None:
    """Run a typer application; bad input and a full disk become one line on stderr and exit code 2."""
    try:
        with running_command(command_line(name)):
            app(prog_name=name)
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except OSError as error:
        if error.errno not in _NO_ROOM:
            raise
        where = f" {error.filename}" if error.filename else ""
        hint = "a build goes on from here once there is room"
        print(f"{name}: cannot write{where}, got {error.strerror}; {hint}", file=sys.stderr)
        raise SystemExit(2) from None


def run_script(main: Callable[[], T]) -> T:
    """Run the main function of a script; the results that it makes record its command line."""
    with running_command(command_line()):
        return main()


def command_line(program: str | None = None) -> str:
    """The command that this process was started with; ``program`` by default the script or module."""
    if program is None:
        module = sys.modules["__main__"].__spec__
        started = (
            ["python", "-m", module.name.removesuffix(".__main__")] if module else [Path(sys.argv[0]).name]
        )
    else:
        started = [program]
    return shlex.join([*started, *sys.argv[1:]])


def progress(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """Iterate with a progress bar on stderr; without one if stderr is no terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(items, description=what, total=total, console=console, disable=not console.is_terminal)
