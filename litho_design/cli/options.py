"""Options made from the fields of the settings, so that every setting is stated in one place."""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_origin

import typer
from pydantic import BaseModel

from litho_data.commands.app import keyword, takes_more, with_further_options
from litho_data.commands.settings import Leaf, assigned, flattened, leaves, read_settings
from litho_data.foundation.errors import InputError

if TYPE_CHECKING:
    from litho_design.judging.measured import MeasuredSource

N = TypeVar("N", int, float)

Out = Annotated[Path, typer.Option(help="folder of the result; one that holds anything else is refused")]
Device = Annotated[str, typer.Option(help="cpu, cuda, cuda:0 …")]
Extrapolate = Annotated[
    bool,
    typer.Option(
        "--extrapolate",
        help="accept heights beyond the model's calibration; recorded in the result",
        hidden=True,
    ),
]
BandPx = Annotated[
    int,
    typer.Option(
        help="rows of a band at most, px: with --large or --stream memory grows with its square",
        min=8,
        hidden=True,
    ),
]
Scan = Annotated[Path | None, typer.Option(help="AFM height map of the printed part")]
ScanUnit = Annotated[
    str | None, typer.Option(help="unit of the scan's heights, if the file has none", hidden=True)
]
ScanSizeUm = Annotated[
    float | None, typer.Option(help="side of the scan, µm, if the file has none", hidden=True)
]
ScanLevelling = Annotated[
    Literal["none", "plane", "bow"],
    typer.Option(
        help="what is removed from the scan: nothing, a plane, or a bow of second order", hidden=True
    ),
]
ScanAligned = Annotated[
    bool,
    typer.Option(
        "--scan-aligned",
        hidden=True,
        help="the scan lies upright on the pixels of the element; for one that looks alike in several places",
    ),
]


def measured_source(
    scan: Path | None,
    unit: str | None,
    size_um: float | None,
    levelling: Literal["none", "plane", "bow"],
    **further: Any,
) -> MeasuredSource | None:
    """The measured print that the options of a scan describe, with further fields; None without a scan."""
    if scan is None:
        return None
    from litho_design.judging.measured import MeasuredSource

    return MeasuredSource(scan, unit, None if size_um is None else (size_um, size_um), levelling, **further)


def numbers(option: str, words: str, kind: Callable[[str], N]) -> list[N]:
    """The comma-separated numbers of an option."""
    try:
        return [kind(word) for word in words.split(",")]
    except ValueError:
        raise InputError(option, got=repr(words), wanted="numbers, separated by commas") from None


_Config = Annotated[
    Path | None,
    typer.Option(
        "--config", help="TOML or JSON file of settings, as `litho-design settings` prints it; options win"
    ),
]
_Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="PATH=VALUE for any setting, such as loss.efficiency_weight=0.2; repeatable. "
        "`litho-design settings` lists all of them",
    ),
]


@dataclass(frozen=True)
class Given:
    """The settings given on a command line.

    Attributes:
        options: values by path, of options and of ``--set``.
        names: how each value was given, for messages.
        config: settings file.
    """

    options: Mapping[str, Any]
    names: Mapping[str, str]
    config: Path | None

    def over(self, preset: BaseModel, task: str) -> dict[str, Any]:
        """Values by path, from the file, overridden by those of the command line.

        Args:
            preset: settings that define the paths.
            task: what is designed, for messages.

        Raises:
            InputError: an option of another task, or an unknown name in the file.
        """
        known = {leaf.path for leaf in leaves(preset)}
        for path, name in self.names.items():
            if name != "--set" and path not in known:
                raise InputError(name, got=f"the {task} task", wanted="a task that has this setting")
        content = {} if self.config is None else read_settings(self.config)
        return flattened(preset, content, f"setting of {self.config}") | flattened(preset, self.options)


# The settings whose options a command shows first; the others are behind --help-all.
_FIRST = {
    *("variant", "task", "layout.size_px", "layout.cell_um", "optics.wavelength_um", "optics.distance_um"),
    *("search.iterations", "search.seed", "height_um"),
}


def takes_settings(
    *presets: BaseModel, leave_out: Collection[str] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of all settings that define one, plus ``--set`` and ``--config``.

    The command takes them as its argument ``given``, a ``Given``.

    Args:
        presets: settings, one record per task; the help shows their values as defaults.
        leave_out: paths that get no option.
    """
    found: dict[str, list[Leaf]] = {}
    for leaf in (leaf for preset in presets for leaf in leaves(preset)):
        if leaf.options and leaf.path not in leave_out:
            found.setdefault(leaf.path, []).append(leaf)
    paths = {path.replace(".", "_"): path for path in found}
    extra = [_parameter(name, found[path], len(presets)) for name, path in paths.items()]
    extra += [keyword("config", _Config), keyword("set_", _Set)]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**values: Any) -> None:
            config, words = values.pop("config"), assigned(values.pop("set_") or [])
            said = {path: values.pop(name) for name, path in paths.items()}
            options = {path: value for path, value in said.items() if value is not None}
            twice = sorted(set(options) & set(words))
            if twice:
                raise InputError("--set", got=f"{twice[0]}, which an option sets too", wanted="one of them")
            unused = sorted(set(leave_out) & set(words))
            if unused:
                raise InputError("--set", got=unused[0], wanted="a setting that this command leaves open")
            names = {path: found[path][0].options[0] for path in options} | dict.fromkeys(words, "--set")
            command(**values, given=Given({**options, **words}, names, config))

        return with_further_options(takes_more(run, command, extra, without="given"))

    return decorate


def as_toml(settings: BaseModel) -> str:
    """Settings as a file for ``--config``, each with its meaning, unit, choices and option."""
    lines: list[str] = []
    # Each table is written once, even if its settings are apart.
    tables: dict[str, list[Leaf]] = {"": []}
    for leaf in leaves(settings):
        tables.setdefault(leaf.path.rpartition(".")[0], []).append(leaf)
    for table, inside in tables.items():
        lines += ["", f"[{table}]"] if table else []
        for leaf in inside:
            notes = [_described(leaf)]
            if get_origin(leaf.kind) is Literal:
                notes.append(", ".join(map(str, get_args(leaf.kind))))
            notes += [" or ".join(leaf.options)] if leaf.options else []
            value = leaf.value.model_dump() if isinstance(leaf.value, BaseModel) else leaf.value
            name = leaf.path.rpartition(".")[2]
            lines += [f"# {'; '.join(notes)}", f"{name} = {json.dumps(value, ensure_ascii=False)}"]
    return "\n".join(lines) + "\n"


def _parameter(name: str, same: Sequence[Leaf], presets: int) -> inspect.Parameter:
    """One option for a setting that one or several presets have."""
    leaf = same[0]
    described = _described(leaf)
    values = list(dict.fromkeys(_shown(one.value) for one in same))
    option = typer.Option(
        *leaf.options,
        # Options begin in lower case; in a file of settings the text starts a line.
        help=described[:1].lower() + described[1:],
        show_default=" or ".join(values),
        rich_help_panel=leaf.group or None,
        hidden=leaf.path not in _FIRST,
    )
    return keyword(name, Annotated[leaf.kind | None, option])


def _described(leaf: Leaf) -> str:
    return f"{leaf.help}, {leaf.unit}" if leaf.unit else leaf.help


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
