"""Make command-line options from the fields of the settings classes, so that every setting is defined in only
one place.
"""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from pydantic import BaseModel, ValidationError

from litho_data.commands.app import COMPUTING, keyword, takes, takes_more, with_further_options
from litho_data.commands.settings import Leaf, assigned, flattened, leaf_of, leaves, read_settings, refused
from litho_data.foundation.errors import InputError

Out = Annotated[Path, typer.Option(help="folder of the result")]
Device = Annotated[str, typer.Option(help="cpu, cuda, cuda:0 …", rich_help_panel=COMPUTING)]
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
        help="largest number of rows in a band. With --large or --stream, the memory needed grows with the "
        "square of this number",
        min=8,
        hidden=True,
    ),
]
_Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="TOML or JSON file of settings, as printed by `litho-design settings`",
    ),
]
_Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="PATH=VALUE for any setting of `litho-design settings`; repeatable",
    ),
]


@dataclass(frozen=True)
class Given:
    """The settings given on a command line.

    Attributes:
        options: values given by options and by ``--set``, as a mapping from the path of a setting to its
            value.
        names: mapping from the path of a setting to the option that gave its value; used in messages.
        config: path of the settings file, if one was given.
    """

    options: Mapping[str, Any]
    names: Mapping[str, str]
    config: Path | None

    def over(self, preset: BaseModel, task: str) -> dict[str, Any]:
        """Return a dict from the path of each given setting to its value; values from the command line
        override those from the file.

        Args:
            preset: settings of the task, whose fields define the valid paths.
            task: name of the task, used in messages.

        Raises:
            InputError: an option does not belong to this task, or the file contains an unknown name.
        """
        known = {leaf.path for leaf in leaves(preset)}
        for path, name in self.names.items():
            if name != "--set" and path not in known:
                raise InputError(
                    name, got="an option of another task", wanted=f"an option of the {task} task"
                )
        content = {} if self.config is None else read_settings(self.config)
        return flattened(preset, content, f"setting of {self.config}") | flattened(preset, self.options)


# The help of a command shows only the options of these settings; --help-all also shows those of all other
# settings.
_FIRST = {
    *("variant", "task", "layout.size_px", "layout.cell_um", "optics.wavelength_um", "optics.distance_um"),
    *("search.iterations", "search.seed", "height_um"),
    *("pedestal_um", "slicing_um", "hatching_um", "gds_layers"),
    *("gwl.mode", "gwl.field_um", "gwl.speed_um_s", "gwl.power_percent"),
    *("scan.path", "camera.path", "camera.pitch_um", "camera.dark_level", "camera.flat", "camera.imaged"),
    *("camera.orientation", "camera.power_counts"),
}


def takes_settings(
    *presets: BaseModel, leave_out: Collection[str] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command one option for each setting that names an option, and the
    options ``--set`` and ``--config``.

    The command receives the values of these options as a ``Given`` object in its argument ``given``.

    Args:
        presets: one record of settings for each task of the command. The help shows their values as defaults.
        leave_out: paths of settings that the command sets itself, and which therefore get no option.
    """
    found: dict[str, list[Leaf]] = {}
    for leaf in (leaf for preset in presets for leaf in leaves(preset)):
        if leaf.options and leaf.path not in leave_out:
            found.setdefault(leaf.path, []).append(leaf)
    paths = {path.replace(".", "_"): path for path in found}
    extra = [_parameter(name, found[path]) for name, path in paths.items()]
    extra += [keyword("config", _Config), keyword("set_", _Set)]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**values: Any) -> None:
            config, words = values.pop("config"), assigned(values.pop("set_") or [])
            said = {path: values.pop(name) for name, path in paths.items()}
            options = {
                path: _listed(found[path][0], value) for path, value in said.items() if value is not None
            }
            twice = sorted(set(options) & set(words))
            if twice:
                raise InputError(
                    "--set",
                    got=f"{twice[0]}, which another option sets too",
                    wanted="only one of the two options",
                )
            unused = sorted(set(leave_out) & set(words))
            if unused:
                got = f"{unused[0]}, which this command sets itself"
                raise InputError("--set", got=got, wanted="another setting")
            names = {path: found[path][0].options[0] for path in options} | dict.fromkeys(words, "--set")
            command(**values, given=Given({**options, **words}, names, config))

        return with_further_options(takes_more(run, command, extra, without="given"))

    return decorate


def takes_parts(**parts: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command one option for each field of the given record classes.

    The command receives one record of each class as a keyword argument. A record is None if none of its
    options was given.
    """
    found = {
        part: {name: leaf_of(field, f"{part}.{name}") for name, field in kind.__pydantic_fields__.items()}
        for part, kind in parts.items()
    }
    extra = [
        _parameter(f"{part}_{name}", [leaf]) for part, own in found.items() for name, leaf in own.items()
    ]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**values: Any) -> None:
            for part, own in found.items():
                said = {name: values.pop(f"{part}_{name}") for name in own}
                values[part] = _made(
                    parts[part], own, {name: value for name, value in said.items() if value is not None}
                )
            command(**values)

        names = inspect.signature(command).parameters.keys() - parts.keys()
        kept = [
            one for one in inspect.signature(command, eval_str=True).parameters.values() if one.name in names
        ]
        return takes(run, [*(one.replace(kind=one.KEYWORD_ONLY) for one in kept), *extra])

    return decorate


def _made(kind: type[Any], leaves: Mapping[str, Leaf], values: Mapping[str, Any]) -> Any:
    if not values:
        return None
    for name, field in kind.__pydantic_fields__.items():
        if field.is_required() and name not in values:
            given = leaves[next(iter(values))].options[0]
            raise InputError(given, got=f"no {leaves[name].options[0]}", wanted=_described(leaves[name]))
    try:
        return kind(**values)
    except ValidationError as error:
        raise refused(error) from None


def as_toml(settings: BaseModel) -> str:
    """Return the text of a settings file for ``--config``. A comment above each setting states its meaning,
    unit, choices and option.
    """
    lines: list[str] = []
    # Each table is written once, even if its settings are not adjacent.
    tables: dict[str, list[Leaf]] = {"": []}
    for leaf in leaves(settings):
        tables.setdefault(leaf.path.rpartition(".")[0], []).append(leaf)
    for table, inside in tables.items():
        lines += ["", f"[{table}]"] if table else []
        for leaf in inside:
            notes = [_told(leaf)]
            if get_origin(leaf.kind) is Literal:
                notes.append(", ".join(map(str, get_args(leaf.kind))))
            notes += [" or ".join(leaf.options)] if leaf.options else []
            value = leaf.value.model_dump() if isinstance(leaf.value, BaseModel) else leaf.value
            name = leaf.path.rpartition(".")[2]
            lines += [f"# {'; '.join(notes)}", f"{name} = {json.dumps(value, ensure_ascii=False)}"]
    return "\n".join(lines) + "\n"


def _parameter(name: str, same: Sequence[Leaf]) -> inspect.Parameter:
    """Make the parameter that declares one option, for a setting that occurs in one or more presets."""
    leaf, kind = same[0], same[0].kind
    if get_origin(kind) is UnionType:
        kind = get_args(kind)[0]
    values = list(dict.fromkeys(_shown(one.value) for one in same if one.value is not None))
    option = typer.Option(
        *leaf.options,
        help=_described(leaf),
        show_default=" or ".join(values) or False,
        rich_help_panel=leaf.group or None,
        hidden=leaf.path not in _FIRST,
    )
    return keyword(name, Annotated[(str if get_origin(kind) is tuple else kind) | None, option])


def _listed(leaf: Leaf, value: Any) -> Any:
    """Return the value of an option; if the setting takes several numbers, split the text at its commas."""
    if get_origin(leaf.kind) is not tuple:
        return value
    try:
        return [float(word) for word in value.split(",")]
    except ValueError:
        raise InputError(leaf.options[0], got=repr(value), wanted="numbers, separated by commas") from None


def _described(leaf: Leaf) -> str:
    """Return the help text of an option. It begins with a lower-case letter, unless it begins with an
    abbreviation.
    """
    told = _told(leaf)
    return told if told[1:2].isupper() else told[:1].lower() + told[1:]


def _told(leaf: Leaf) -> str:
    return f"{leaf.help}, {leaf.unit}" if leaf.unit else leaf.help


def _shown(value: Any) -> str:
    shown = value if isinstance(value, tuple) else (value,)
    return ",".join(f"{one:g}" if isinstance(one, float) else str(one) for one in shown)
