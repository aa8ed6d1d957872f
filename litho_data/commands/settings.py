"""Define each setting in one place: as a field of a settings record that states its default, limits, unit,
help text and option.

The command lines make their options from these fields, and every field can be changed by its dotted path,
such as ``layout.pitch_um``.
"""

import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo

from litho_data.foundation import Facts, InputError, parsed, unknown_name
from litho_data.foundation.quantities import LENGTH_UM

M = TypeVar("M", bound=BaseModel)
# Squares of larger numbers overflow single precision.
_LARGEST = 1e15


def setting(
    default: Any, help: str, *, unit: str = "", option: str | tuple[str, ...] = (), **limits: Any
) -> Any:
    """Make a field of a settings record.

    Args:
        default: value of the setting if none is given; ``...`` makes the setting required.
        help: what the setting is, in a few words without a full stop.
        unit: unit of the value, such as µm.
        option: name or names on the command line, such as ``--pitch-um``; none for settings that can be
            changed only by their dotted path.
        limits: as for pydantic's ``Field`` (``ge``, ``gt``, ``le``, ``lt``); a setting in µm is at most
            ``LENGTH_UM.high`` by default.
    """
    if unit == "µm":
        limits = {"le": LENGTH_UM.high} | limits
    options: Any = [option] if isinstance(option, str) else list(option)
    return Field(
        default=default, description=help, json_schema_extra={"unit": unit, "options": options}, **limits
    )


@dataclass(frozen=True)
class Leaf:
    """One setting of a settings record or of a record nested in it, as ``leaves`` finds it.

    Attributes:
        path: dotted path of the setting, as in ``layout.pitch_um``.
        kind: type annotation of the field, without limits.
        value: value that the record has.
        options: names on the command line.
        group: description of the nested record that contains the setting; empty for a setting of the
            outermost record.
    """

    path: str
    kind: Any
    value: Any
    help: str
    unit: str
    options: tuple[str, ...]
    group: str = ""


def leaves(settings: BaseModel, prefix: str = "", group: str = "") -> Iterator[Leaf]:
    """Yield every setting of a record and of the records nested in it."""
    for name, field in type(settings).model_fields.items():
        value, path = getattr(settings, name), f"{prefix}{name}"
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{path}.", field.description or name)
            continue
        yield leaf_of(field, path, value, group)


def leaf_of(field: FieldInfo, path: str, value: Any = None, group: str = "") -> Leaf:
    """Return the setting that a field of a record defines, with the given path and value."""
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    return Leaf(
        path=path,
        kind=field.annotation,
        value=value,
        help=field.description or "",
        unit=str(extra.get("unit", "")),
        options=tuple(map(str, extra.get("options", ()))),  # type: ignore[arg-type]
        group=group,
    )


def flattened(settings: BaseModel, content: Facts, what: str = "setting") -> dict[str, Any]:
    """Convert content with nested or dotted keys to a flat dict that maps dotted paths to values.

    Args:
        settings: a record, which must have a field for every key.
        content: a mapping with nested keys, as read from a file, or with dotted keys, as in
            ``{"layout.pitch_um": 0.2}``.
        what: the word for a setting in messages.

    Raises:
        InputError: the record has no field for a key; the message lists the fields that it has.
    """
    flat: dict[str, Any] = {}
    for key, value in content.items():
        part = _find(settings, key, what)
        if not isinstance(part, BaseModel):
            flat[key] = value
        elif isinstance(value, Mapping):
            flat |= flattened(settings, {f"{key}.{name}": inner for name, inner in value.items()}, what)
        else:
            raise InputError(
                f"{what} {key}", got=repr(value), wanted=f"a value for one of {', '.join(_names(part, key))}"
            )
    return flat


def _find(settings: BaseModel, path: str, what: str) -> Any:
    part: Any = settings
    done: list[str] = []
    for name in path.split("."):
        above = ".".join(done)
        if not isinstance(part, BaseModel):
            raise InputError(
                f"{what} {path}",
                got=f"a name below {above}",
                wanted=f"{above} itself, which is a single value",
            )
        if name not in type(part).model_fields:
            raise unknown_name(what, path, _names(part, above))
        part = getattr(part, name)
        done.append(name)
    return part


def _names(part: BaseModel, above: str) -> list[str]:
    return [f"{above}.{name}" if above else name for name in type(part).model_fields]


def changed(settings: M, changes: Facts) -> M:
    """Return a copy of ``settings`` in which the values at the given dotted paths are changed. The whole copy
    is validated.

    Raises:
        InputError: a name is unknown, or the record does not accept a value.
    """
    content = settings.model_dump()
    for path, value in flattened(settings, changes).items():
        numbers = value if isinstance(value, list | tuple) else [value]
        if any(isinstance(one, int | float) and not abs(one) <= _LARGEST for one in numbers):
            raise InputError(f"setting {path}", got=value, wanted=f"a finite number up to {_LARGEST:g}")
        *parts, last = path.split(".")
        place = content
        for part in parts:
            place = place[part]
        place[last] = value
    try:
        return type(settings).model_validate(content)
    except ValidationError as error:
        raise refused(error) from None


def refused(error: ValidationError) -> InputError:
    """Return the error for the first setting that a record does not accept."""
    first = error.errors()[0]
    where, said = ".".join(map(str, first["loc"])), first["msg"]
    limit = said.removeprefix("Input should be ")
    if limit != said:
        return InputError(f"setting {where}", got=repr(first["input"]), wanted=limit)
    return InputError(f"setting {where}", got=said.removeprefix("Value error, "))


def assigned(words: Iterable[str]) -> dict[str, Any]:
    """Parse words of the form ``path=value``, and return a dict from dotted path to value. A value that is
    not valid JSON is taken as a string.

    Raises:
        InputError: a word has no ``=``, or a path is repeated.
    """
    values: dict[str, Any] = {}
    for word in words:
        path, equals, text = word.partition("=")
        if not equals or not path.strip():
            raise InputError("--set", got=repr(word), wanted="PATH=VALUE, such as layout.pitch_um=0.1")
        if path.strip() in values:
            raise InputError("--set", got=f"{path.strip()} twice", wanted="each setting once")
        try:
            values[path.strip()] = json.loads(text)
        except (ValueError, RecursionError):
            values[path.strip()] = text
    return values


def read_settings(path: str | Path) -> dict[str, Any]:
    """Read a settings file. Its suffix says whether it is TOML or JSON.

    Raises:
        InputError: the file does not exist, has another suffix, or is not valid TOML or JSON.
    """
    file = Path(path)
    read = {".toml": tomllib.loads, ".json": json.loads}.get(file.suffix.lower())
    if read is None:
        raise InputError("settings file", got=str(file), wanted="a .toml or .json file")
    content = parsed(file, read, f"settings file {file}", file.suffix[1:].upper())
    if not isinstance(content, dict):
        raise InputError(
            f"settings file {file}", got=type(content).__name__, wanted="a table of settings by name"
        )
    return content
