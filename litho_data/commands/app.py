"""What the three command lines share: settings, exit codes, and one-line errors."""

import errno
import functools
import inspect
import os
import re
import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper
from typing import Annotated, Any

import typer
import typer.core
from typer.models import CommandFunctionType

from litho_data.commands.progress import command_line, given_words, never_silent
from litho_data.foundation import InputError, unknown_name
from litho_data.foundation.plugins import OPTION, load_plugins, without_plugins
from litho_data.foundation.run_facts import running_command

# The base class of Typer's usage errors, which Typer does not export.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]


def option(help: str, *names: str, **more: Any) -> Any:
    """Make an option of a command. ``names`` are needed only if the option is not named after its parameter.
    The keyword arguments ``more`` are passed to typer.
    """
    return typer.Option(*names, help=help, **more)


def argument(help: str) -> Any:
    """Make an argument of a command."""
    return typer.Argument(help=help)


# The heading under which the help lists options that say where a result is computed.
COMPUTING = "Where it runs"
_CHOICE = re.compile(r"(?:Value error, )?'(.*)' is not one of (.*?)\.?$", re.DOTALL)
_LIMIT = re.compile(r"Input should be (?:a valid )?([^,]*)")
WorkersOption = Annotated[
    int, option("number of local processes", "--workers", min=1, rich_help_panel=COMPUTING)
]
DaskOption = Annotated[
    str | None,
    option(
        "address of a Dask scheduler, such as tcp://host:8786; its workers replace the local processes",
        "--dask",
        rich_help_panel=COMPUTING,
    ),
]

_LONGEST = 200
_AGAIN = "finished parts are kept: run the command again"
_WAYS_OUT = {
    errno.ENOSPC: f"make room; {_AGAIN}",
    errno.EDQUOT: f"make room; {_AGAIN}",
    errno.EROFS: "choose another --out",
    errno.EACCES: "choose another path, or get permission to write there",
    errno.EMFILE: f"allow more open files (ulimit -n), or fewer workers; {_AGAIN}",
    errno.ENFILE: f"close other programs; {_AGAIN}",
}


def _show_all(context: typer.Context, asked: bool) -> None:
    if asked and not context.resilient_parsing:
        for parameter in context.command.params:
            if hasattr(parameter, "hidden"):
                parameter.hidden = False
        typer.echo(context.get_help())
        raise typer.Exit()


HelpAll = Annotated[
    bool,
    typer.Option(
        "--help-all", help="show all options, including the hidden ones", is_eager=True, callback=_show_all
    ),
]


def takes(run: Callable[..., None], parameters: Sequence[inspect.Parameter]) -> Callable[..., None]:
    """Return ``run``, which takes ``**values``, with a signature made of ``parameters``. Typer reads this
    signature.
    """
    # Typer reads the signature and the annotations.
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return run


def keyword(name: str, annotation: Any, default: Any = None) -> inspect.Parameter:
    """Make a parameter that typer turns into an option of a command."""
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def takes_more(
    run: Callable[..., None],
    command: Callable[..., None],
    more: Sequence[inspect.Parameter],
    without: str = "",
) -> Callable[..., None]:
    """Give the wrapper ``run`` all parameters of ``command``, followed by the parameters in ``more``. The
    parameter whose name is the value of ``without`` is left out.
    """
    own = inspect.signature(command, eval_str=True).parameters.values()
    kept = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in own if one.name != without]
    return takes(run, [*kept, *more])


def with_further_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the option ``--help-all`` to a command. It shows all options, including those that the command
    hides.
    """

    @functools.wraps(command)
    def run(**values: Any) -> None:
        values.pop("help_all")
        command(**values)

    return takes_more(run, command, [keyword("help_all", HelpAll, False)])


class _Command(typer.core.TyperCommand):
    """A command whose help lists the options under headings."""

    def format_options(self, context: Any, formatter: Any) -> None:
        """Write the arguments and the visible options into the help, each under its heading."""
        found: dict[str, list[Any]] = {"Arguments": [], "Options": []}
        for one in self.get_params(context):
            usual = "Arguments" if one.param_type_name == "argument" else "Options"
            if record := one.get_help_record(context):
                found.setdefault(getattr(one, "rich_help_panel", None) or usual, []).append(record)
        for heading, records in found.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


class App(typer.Typer):
    """A program, or a group of commands of a program. The help of each command lists the options under
    headings.
    """

    def command(self, *names: Any, **more: Any) -> Callable[[CommandFunctionType], CommandFunctionType]:
        """Return typer's decorator that makes a function a command."""
        return super().command(*names, cls=_Command, **more)


def new_app(help_text: str) -> typer.Typer:
    """Make a typer application with the settings of this project."""

    def options(
        context: typer.Context,
        version: bool = typer.Option(False, "--version", help="Print the version and exit.", is_eager=True),
        # This option is declared only for the help: run_app removes it from the command line before parsing.
        plugin: Annotated[
            list[str] | None,
            option(
                "Load a Python file that registers additions, such as models or readers; works "
                "with every command.",
                OPTION,
            ),
        ] = None,
    ) -> None:
        if version:
            from litho_data import __version__

            typer.echo(__version__)
            raise typer.Exit()
        if context.invoked_subcommand is None:
            typer.echo(context.get_help())
            raise typer.Exit(2)

    # Without invoke_without_command, --version alone would fail because no command is given.
    return App(
        help=help_text,
        callback=options,
        invoke_without_command=True,
        pretty_exceptions_enable=False,
        # Rich's boxes would leave only a third of an 80-character line for the help text of an option.
        rich_markup_mode=None,
    )


def run_app(app: typer.Typer, name: str) -> None:
    """Run a typer application. If the input or the system causes an error, print one line and exit with code
    2.

    Any other exception is a defect of this project and shows its traceback.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # Not every terminal can show µ.
            stream.reconfigure(errors="replace")
    try:
        with running_command(command_line(name)), never_silent(name):
            words, files = without_plugins(given_words())
            load_plugins(files)
            code = app(words, prog_name=name, standalone_mode=False)
    except BrokenPipeError:
        # The program that reads the output, such as `head`, has closed the pipe. Unless stdout is redirected,
        # Python prints an error at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except UsageError as error:
        said = _in_one_line(error, name, given_words())
    except Exception as error:
        refusal = error if isinstance(error, InputError) else _not_allowed(error)
        if refusal is None:
            raise
        said = f"{name}: {refusal}"
    else:
        raise SystemExit(code if isinstance(code, int) else 0)
    print(said, file=sys.stderr)
    raise SystemExit(2)


def _not_allowed(error: Exception) -> InputError | None:
    """Return the InputError to print if the system or the input caused the exception. Return None if the
    exception is a defect of this project.
    """
    # PyTorch and safetensors raise their own errors for a full disk.
    text = str(error)
    if isinstance(error, MemoryError) or "out of memory" in text or "can't allocate memory" in text:
        got = text.partition("\n")[0][:_LONGEST]
        return InputError("not enough memory", got=got or None, wanted="a smaller field, or fewer workers")
    if isinstance(error, OSError):
        what = f"cannot use {error.filename}" if error.filename else "the system refuses"
        # NumPy does not say why it wrote only part of a file; the usual cause is a full disk.
        code = errno.ENOSPC if text.endswith(" written") else error.errno or 0
        return InputError(what, got=error, hint=_WAYS_OUT.get(code, _AGAIN))
    if "Symlink loop" in text:
        return InputError("a symbolic link that leads to itself", got=text.partition("'")[2].rstrip("'"))
    if isinstance(error, RecursionError):
        return InputError(
            "input", got="parts nested too deeply", wanted="a file with fewer levels of nesting"
        )
    if type(error).__name__.endswith("LinAlgError"):  # of NumPy or PyTorch; PyTorch may not be loaded
        return InputError(
            "numbers to fit", got=error, wanted="data that determine them, such as layouts of several levels"
        )
    if isinstance(error, OverflowError):
        return InputError("number in the input", got=error, wanted="a number within the supported range")
    return None


def _in_one_line(error: Any, name: str, words: Sequence[str]) -> str:
    """Return one line that says, in this project's words, why Typer cannot parse a command line.

    Args:
        error: a ``UsageError``.
        name: name of the program.
        words: arguments of the program.
    """
    command = error.ctx.command_path if error.ctx else " ".join([name, *words[:1]])
    parameter = getattr(error, "param", None)
    help_line = f"`{command} --help` shows its arguments and options"
    if parameter is None:
        near = getattr(error, "possibilities", None)
        text = re.sub(r"\.? Did you mean (.*)\?$", r"; did you mean \1?", error.message.rstrip("."))
        hint = f"did you mean {' or '.join(near)}?" if near else "" if "; did" in text else help_line
        return f"{command}: {InputError(text[:1].lower() + text[1:], hint=hint)}"
    option = parameter.opts[0] if parameter.opts[0].startswith("-") else parameter.name.upper()
    if type(error).__name__ == "MissingParameter":
        wanted = re.split(r"\.(?: (?=[A-Z])|$)", parameter.help)[0]
        wanted = wanted[:1].lower() + wanted[1:] if wanted[1:2].islower() else wanted
        return f"{command}: {InputError(option, got='none', wanted=wanted, hint=help_line)}"
    if choice := _CHOICE.match(error.message):
        known = re.findall(r"'([^']*)'", choice[2])
        return f"{command}: {unknown_name(option, choice[1], known, help_line)}"
    limit = _LIMIT.match(error.message)
    wanted = f"a number ({limit[1]})" if limit else error.message
    return f"{command}: {InputError(option, got=_given(parameter.opts, words), wanted=wanted)}"


def _given(options: Sequence[str], words: Sequence[str]) -> str | None:
    """Return the value that follows an option on the command line. Return None for an argument, which no
    option name precedes.
    """
    for word, value in zip(words, [*words[1:], None], strict=True):
        name, equals, rest = word.partition("=")
        if name in options:
            return repr(rest) if equals else value and repr(value)
    return None
