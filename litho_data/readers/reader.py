"""The interface of a reader, which recognises a file and describes its channels before they are loaded."""

import logging
import re
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from litho_data.foundation import YX, Array, InputError, Shape, is_length, um_per
from litho_data.scan import Axis

# Largest scan, 2 GiB as float64. A larger size is far more likely to come from a damaged header than from a
# scan.
_MAX_PIXELS = 2**28
# Largest compression ratio: that of Deflate, the strongest compression in use.
MOST_BYTES_PER_PACKED_BYTE = 1032
_LOGGERS = ("tifffile", "igor2", "SurfaceTopography")
_LONGEST_MESSAGE = 160

# Words of parsers' messages about a truncated or changed file. Any other message means that the kind of file
# is unknown.
_CUT = re.compile(
    r"truncat|too (small|short)|not (large )?enough|end of (file|data|stream)|ended|corrupt|damage|checksum|"
    r"crc|incomplete|reach(es)? beyond",
    re.IGNORECASE,
)
_OF_CUT_FILES = (EOFError, MemoryError, OSError, struct.error, zlib.error, BadZipFile)
DAMAGED = "the file may be damaged"

Loaded = tuple[Array, Array | None]


@dataclass(frozen=True)
class Channel:
    """One two-dimensional map in a file.

    Args:
        name: unique within the file.
        shape: (ny, nx) in pixels.
        unit: unit of the values as the file states it; None if it does not.
        size_um: (y, x) extent from edge to edge; None if the file does not state it.
        load: function that returns the values (ny, nx) in ``unit``, with row 0 at the top, and the mask of
            the file or None.
        full_scale: the largest value of an integer image; None for real numbers.
        fast_axis: axis along which the tip moved; None if the file does not state it.
        header: everything that the file states, as strings.
        problem: why the channel cannot be read; empty if it can.
        x_is: the direction in the file that runs along x, in words, such as "a row of the file".
        extent: (y, x) extent from edge to edge, in a unit that the file does not state.
        words: words that occur in the file in place of numbers, each with the line where it first occurs. The
            pixels with these words are NaN.
        notes: warnings for whoever uses the map.
    """

    name: str
    shape: Shape
    unit: str | None
    size_um: YX | None
    load: Callable[[], Loaded]
    full_scale: float | None = None
    fast_axis: Axis | None = None
    header: dict[str, str] = field(default_factory=dict)
    problem: str = ""
    x_is: str = "a row of the file"
    extent: YX | None = None
    words: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.problem and (min(self.shape) < 2 or self.shape[0] * self.shape[1] > _MAX_PIXELS):
            raise InputError(
                f"channel {self.name!r}: size in pixels",
                got=f"{self.shape[0]} x {self.shape[1]}",
                wanted=f"at least 2 x 2 and at most {_MAX_PIXELS} pixels",
                hint=DAMAGED,
            )

    @property
    def is_height(self) -> bool:
        """Return whether the channel may contain heights: its unit is a length, or the file does not state
        the unit.
        """
        return not self.problem and (self.unit is None or is_length(self.unit))

    def describe(self) -> str:
        """Return the name, size and unit in a few words, for messages."""
        if self.problem:
            return f"{self.name!r} (not read: {self.problem})"
        unit = "no unit" if self.unit is None else self.unit
        return f"{self.name!r} ({self.shape[0]} x {self.shape[1]}, {unit})"


@dataclass(frozen=True)
class Reader:
    """A file format: how to recognise and read it.

    Args:
        name: as in ``format = "…"`` of a card and ``--format`` of the commands.
        recognises: ``recognises(path, head)``: whether a file has this format; ``head`` is its first 64 KiB.
        read_channels: function that returns the channels of a file, in the order of the file. Any exception
            here, or when a channel is loaded, becomes one line about the file.
        parsers: modules of other projects that ``read_channels`` uses. If there are any, ``read_channels``
            runs in a child process within limits of time and memory, so it must be importable by name, and
            its results must be picklable.
    """

    name: str
    recognises: Callable[[Path, bytes], bool]
    read_channels: Callable[[Path], list[Channel]]
    parsers: tuple[str, ...] = ()


def one_by_one(name: str, make: Callable[[], Channel]) -> Channel:
    """Make a channel. If this fails, make a substitute that says why the channel cannot be read, so that the
    other channels stay usable.
    """
    try:
        with foreign_parser("a map"):
            return make()
    except InputError as error:
        return Channel(name, (0, 0), None, None, partial(_refuse, str(error)), problem=str(error))


def _refuse(problem: str) -> Loaded:
    raise InputError(problem)


def in_memory(values: Array) -> Callable[[], Loaded]:
    """Make a loader for a map that has already been read."""
    return partial(_copied, values)


def _copied(values: Array) -> Loaded:
    return np.array(values), None


def extent_um(y: float, x: float, unit: str | None) -> YX | None:
    """Convert a stated extent to (y, x) in µm; return None unless both are positive and the unit is a
    length.
    """
    if unit is None or not is_length(unit):
        return None
    size = float(y) * um_per(unit), float(x) * um_per(unit)
    return size if all(np.isfinite(size)) and min(size) > 0 else None


def unknown_content(head: bytes) -> InputError:
    """Make the error for a file that no reader recognises."""
    return InputError("format", got=f"unknown content {head[:8]!r}", wanted="a known AFM format")


def with_unique_names(channels: list[Channel]) -> list[Channel]:
    """Number channels with the same name, such as trace and retrace, so that each can be chosen."""
    seen: dict[str, int] = {}
    unique = []
    for channel in channels:
        count = seen[channel.name] = seen.get(channel.name, 0) + 1
        unique.append(channel if count == 1 else replace(channel, name=f"{channel.name} #{count}"))
    return unique


@contextmanager
def quiet(*loggers: str, above: int = logging.CRITICAL) -> Iterator[None]:
    """Silence Python warnings, and silence these loggers up to and including the level ``above``."""
    named = [logging.getLogger(name) for name in loggers]
    levels = [logger.level for logger in named]
    try:
        for logger in named:
            logger.setLevel(above + 1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(named, levels, strict=True):
            logger.setLevel(level)


@contextmanager
def foreign_parser(kind: str) -> Iterator[None]:
    """Run another project's parser on a file; turn any exception into one InputError.

    If a file is damaged, such parsers raise errors of many types (struct, index, key, value, memory, decode,
    assertion and types of their own) and log to stderr. A caller could not handle these errors in any useful
    way.
    """
    try:
        with quiet(*_LOGGERS):
            yield
    except InputError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, MemoryError):
            reason = "a parser that asked for more memory than such a file can need"
        cut = isinstance(error, _OF_CUT_FILES) or _CUT.search(reason)
        what = f"cannot be read as {kind}" if cut else f"unknown kind of {kind}"
        raise InputError(what, got=reason[:_LONGEST_MESSAGE], hint=DAMAGED if cut else "") from error
