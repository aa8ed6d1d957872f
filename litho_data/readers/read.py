"""Read one scan. The channel, the unit and the size are chosen in the same way for all formats."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from litho_data.foundation import YX, Array, InputError, about, um_per
from litho_data.foundation.quantities import HEIGHT_UM
from litho_data.readers.confined import parse
from litho_data.readers.missing import extreme_note, without_missing
from litho_data.readers.packed import unpacked
from litho_data.readers.reader import (
    DAMAGED,
    MOST_BYTES_PER_PACKED_BYTE,
    Channel,
    Loaded,
    Reader,
    with_unique_names,
)
from litho_data.readers.registry import PICTURE, detect_format, reader_of, registered, require_file
from litho_data.scan import Axis, Scan

_NAMED_UNIT = re.compile(r"[_\[( ]([nuµp]m|mm)[\])]?$")
# Relative tolerance when two stated sizes are compared, because files state sizes rounded to a few digits.
_SIZE_TOLERANCE = 1e-4
# The sides of a scan are assumed to lie in this range. If a file states coordinates without a unit, the range
# decides which units are possible.
_SMALLEST_UM, _LARGEST_UM = 0.1, 1000.0


def read_scan(
    path: str | Path,
    *,
    format: str = "auto",
    unit: str | None = None,
    size_um: YX | None = None,
    channel: str | None = None,
    fast_axis: Axis | None = None,
    full_scale_um: float | None = None,
    missing: Sequence[float | str] | None = None,
    defaults: Sequence[str] = (),
) -> Scan:
    """Read one height map.

    Args:
        path: the file that the instrument wrote.
        format: one of ``formats()``, or ``"auto"`` to detect it from the content.
        unit: unit of the heights in the file. It is needed if the file does not state the unit.
        size_um: side lengths (y, x) of the scan in µm, from edge to edge, for files that do not state them.
            If neither the file nor the caller states the size, the pitch stays unknown (None).
        channel: name of the channel to read. It is needed if the file has several height channels.
        fast_axis: ``"x"`` or ``"y"``, the axis along which the tip moved fast, for files that do not state
            it.
        full_scale_um: for images of integers, the height in µm that the largest possible integer stands for:
            height = value / largest integer · full_scale_um. It is given in place of ``unit``.
        missing: numbers (as stored in the file) and words that mark pixels without a measurement, in addition
            to the marks that the file itself states. An empty list states that there are no such additional
            marks.
        defaults: names of those of the arguments ``unit`` and ``size_um`` that are only default values. Such
            a default is ignored if the file itself states the unit or the size. An argument that is not named
            here must agree with the file.

    Raises:
        InputError: the file is unreadable; it has no height channel, or it has several and ``channel`` is not
            given; its unit is missing; its unit or size contradicts the arguments; the file contains a word
            that is not in ``missing``; ``missing`` is None and a number looks like a mark of missing pixels;
            the heights are impossibly large; or no height is finite.
    """
    given = require_file(path)
    with about(str(given)), unpacked(given) as file:
        reader = _settle_format(file, format)
        chosen = _choose(_read_channels(reader, file), channel)
        values, mask = chosen.load()
        values = without_missing(chosen, values, missing)
        notes = list(chosen.notes)
        if "unit" in defaults and unit is not None and chosen.unit is not None:
            if um_per(unit) != um_per(chosen.unit):
                notes.append(f"heights in {chosen.unit}, as the file states, not in {unit}")
            unit = None
        if "size_um" in defaults and size_um is not None and chosen.size_um is not None:
            if not np.allclose(size_um, chosen.size_um, rtol=_SIZE_TOLERANCE, atol=0):
                side_y, side_x = chosen.size_um
                notes.append(f"size {side_y:g} × {side_x:g} µm, as the file states, not {size_um}")
            size_um = None
        stated_unit, factor = _settle_unit(chosen, values, unit, full_scale_um)
        height = _to_um(values, factor)
        finite = height[np.isfinite(height)]
        ends_um = [float(finite.min(initial=0)), float(finite.max(initial=0))]
        stated_size = chosen.size_um or _size_of_extent(chosen, stated_unit)
        if stated_size and not chosen.size_um and size_um is None:
            side_y, side_x = stated_size
            assumed = "µm" if stated_size == chosen.extent else stated_unit
            likely = f"a size of {side_y:g} × {side_x:g} µm is likely: confirm it with size_um"
            notes.append(f"its coordinates have no unit; {assumed} was assumed, because {likely}")
        HEIGHT_UM.require(f"heights in µm, converted from unit {stated_unit!r}", ends_um)
        return Scan(
            height_um=height,
            pitch_um=_settle_pitch(chosen, size_um, stated_size),
            name=file.stem,
            channel=chosen.name,
            unit=stated_unit,
            fast_axis=_settle_fast_axis(chosen, fast_axis),
            mask=mask,
            header=chosen.header,
            source=str(path),
            format=reader.name,
            sized_by_file=stated_size is not None,
            notes=(*notes, *filter(None, [extreme_note(values)])),
        )


def list_channels(path: str | Path, *, format: str = "auto") -> list[Channel]:
    """Return all channels of a file, both those that contain heights and those that do not.

    Raises:
        InputError: the file is unreadable or has an unknown format.
    """
    given = require_file(path)
    with about(str(given)), unpacked(given) as file:
        channels = _read_channels(_settle_format(file, format), file)
    # The temporary unpacked file is deleted before a channel is loaded, so ``load`` must unpack the file
    # again.
    return [replace(one, load=partial(_load, given, format, one.name)) for one in channels]


def own_reader_sha256(path: str | Path, format: str = "auto") -> str:
    """If the user registered the reader that ``read_scan`` uses for a file, return the hash of this reader's
    source code. For a reader of this package, return an empty text.

    Raises:
        InputError: a reader has been registered, and the file is unreadable or has an unknown format.
    """
    if not (own := registered()):
        return ""
    given = require_file(path)
    with about(str(given)), unpacked(given) as file:
        return own.get(_settle_format(file, format).name, "")


def _load(path: Path, format: str, name: str) -> Loaded:
    with about(str(path)), unpacked(path) as file:
        channels = _read_channels(_settle_format(file, format), file)
        return next(channel for channel in channels if channel.name == name).load()


def _read_channels(reader: Reader, file: Path) -> list[Channel]:
    run = partial(parse, path=file, kind=reader.name, parsers=reader.parsers)
    channels = with_unique_names(run(partial(reader.read_channels, file)))
    if not channels:
        raise InputError(f"holds no two-dimensional map of numbers ({reader.name})")
    size = file.stat().st_size
    for channel in channels:
        if channel.shape[0] * channel.shape[1] > MOST_BYTES_PER_PACKED_BYTE * size:
            got = f"{size} bytes for {channel.shape[0]} x {channel.shape[1]} pixels"
            raise InputError(reader.name, got=got, wanted="more bytes", hint=DAMAGED)
    return [_with_unit_of_name(replace(one, load=partial(run, one.load))) for one in channels]


def _with_unit_of_name(channel: Channel) -> Channel:
    """If the file does not state the unit of a channel, take the unit from the name of the channel, as in
    ``height_nm``, and return the channel with this unit. Otherwise return the channel unchanged.
    """
    ends = _NAMED_UNIT.search(channel.name)
    return replace(channel, unit=ends[1]) if ends and channel.unit is None else channel


def _settle_format(file: Path, format: str) -> Reader:
    kind = detect_format(file) if format == "auto" else format
    if kind == PICTURE:
        raise InputError("format", got=f"a picture ({kind})", wanted="a file with heights")
    return reader_of(kind)


def _choose(channels: list[Channel], name: str | None) -> Channel:
    listed = ", ".join(channel.describe() for channel in channels) or "none"
    if name is not None:
        for channel in channels:
            if channel.name == name:
                if channel.problem:
                    raise InputError(channel.problem)
                if not channel.is_height:
                    raise InputError(
                        f"channel {name!r} does not contain heights", got=f"unit {channel.unit!r}"
                    )
                return channel
        raise InputError("channel", got=repr(name), wanted=f"one of {listed}")
    heights = [channel for channel in channels if channel.is_height]
    if len(heights) == 1:
        return heights[0]
    problem = "several height channels" if heights else "no height channel"
    hint = "choose one by its name with the option channel" if heights else ""
    raise InputError(problem, got=listed, wanted="one", hint=hint)


def _settle_unit(
    channel: Channel, values: Array, unit: str | None, full_scale_um: float | None
) -> tuple[str, float]:
    """Return the unit of the heights, and the factor that converts the values of the file to µm."""
    if full_scale_um is not None:
        if channel.full_scale is None or channel.unit is not None or unit is not None:
            raise InputError("full scale", got=full_scale_um, wanted="an integer image and no unit")
        if not (np.isfinite(full_scale_um) and full_scale_um > 0):
            raise InputError("full scale in µm", got=full_scale_um, wanted="a positive number")
        return f"{full_scale_um:g} µm / {channel.full_scale:g}", full_scale_um / channel.full_scale
    if unit is None and channel.unit is None:
        first = ", ".join(f"{value:g}" for value in np.asarray(values)[0, :3])
        raise InputError(
            "the file does not state the unit of its heights",
            wanted="their unit, for example unit = 'm', --unit m or --scan-unit m",
            hint=f"the first row begins {first}: with unit 'm' these are metres, with 'nm' nanometres",
        )
    if unit is not None and channel.unit is not None and um_per(unit) != um_per(channel.unit):
        raise InputError("unit", got=repr(unit), wanted=f"{channel.unit!r} as in the file, or none")
    stated = channel.unit if channel.unit is not None else str(unit)
    return stated, um_per(stated)


def _to_um(values: Array, factor: float) -> Array:
    """Convert the values to µm by multiplying them by the factor. If the factor is 1/n with an integer n, the
    values are divided by n instead, so that 100 nm become exactly 0.1 µm.
    """
    inverse = round(1 / factor)
    return values / inverse if factor < 1 and np.isclose(inverse * factor, 1, rtol=1e-12) else values * factor


def _settle_pitch(channel: Channel, size_um: YX | None, stated: YX | None) -> YX | None:
    if size_um is not None:
        if np.shape(size_um) != (2,) or not all(np.isfinite(size) and size > 0 for size in size_um):
            raise InputError("size_um", got=size_um, wanted="two positive numbers (y, x) in µm")
        if stated is not None and not np.allclose(size_um, stated, rtol=_SIZE_TOLERANCE, atol=0):
            raise InputError("size_um", got=size_um, wanted=f"{stated} as in the file, or none")
    size = stated if stated is not None else size_um
    return None if size is None else (size[0] / channel.shape[0], size[1] / channel.shape[1])


def _size_of_extent(channel: Channel, unit: str) -> YX | None:
    """Return the size (y, x) in µm from coordinates whose unit the file does not state.

    Two units are tried: µm, and the unit of the heights. If exactly one of them gives a plausible size,
    return this size. Otherwise return None.
    """
    if channel.extent is None or channel.full_scale is not None:
        return None
    sizes = {(channel.extent[0] * factor, channel.extent[1] * factor) for factor in (1.0, um_per(unit))}
    likely = [size for size in sizes if min(size) >= _SMALLEST_UM and max(size) <= _LARGEST_UM]
    return likely[0] if len(likely) == 1 else None


def _settle_fast_axis(channel: Channel, fast_axis: Axis | None) -> Axis | None:
    if fast_axis not in (None, "x", "y"):
        raise InputError("fast axis", got=repr(fast_axis), wanted="'x' or 'y'")
    if fast_axis is not None and channel.fast_axis is not None and fast_axis != channel.fast_axis:
        raise InputError("fast axis", got=fast_axis, wanted=f"{channel.fast_axis} as in the file")
    return channel.fast_axis or fast_axis
