"""Define the interface of a reader. A reader recognises files of one format, and describes the channels of a
file before their values are loaded.
"""

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

# Largest number of pixels of a scan (2 GiB as float64). If a header states a larger number, it is assumed to
# be damaged.
_MAX_PIXELS = 2**28
# Largest accepted ratio of unpacked to packed size. It is the limit of Deflate, the strongest compression
# that the supported formats use.
MOST_BYTES_PER_PACKED_BYTE = 1032
_LOGGERS = ("tifffile", "igor2", "SurfaceTopography")
_LONGEST_MESSAGE = 160

# Words that occur in a parser's message if the file is truncated or changed. Any other message is taken as a
# sign that the file is of an unknown kind.
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
        name: name of the channel, unique within the file.
        shape: shape (ny, nx) of the map in pixels.
        unit: unit of the values as the file states it; None if the file does not state it.
        size_um: side lengths (y, x) of the map in µm, from edge to edge; None if the file does not state
            them.
        load: function that reads the map. It returns two items. The first is an array of the values in
            ``unit``, of shape (ny, nx), with row 0 at the top. The second is the file's mask of the same
            shape, or None if the file has no mask.
        full_scale: the largest value that the integer type of an image can hold; None for real numbers.
        fast_axis: axis along which the tip moved fast; None if the file does not state it.
        header: everything that the file states about the channel, as strings.
        problem: the reason why the channel cannot be read; empty if it can be read.
        x_is: the part of the file that runs along x, in words, such as "a row of the file".
        extent: side lengths (y, x) of the map from edge to edge, if the file states them without a unit.
        words: the words that the file contains in place of numbers. Each is mapped to the line where it first
            occurs. Pixels with such a word are NaN.
        notes: warnings for the user of the map.
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
        """Return whether the channel may contain heights. This is the case if its unit is a length, or if the
        file does not state its unit.
        """
        return not self.problem and (self.unit is None or is_length(self.unit))

    def describe(self) -> str:
        """Return a short description of the channel for messages: its name, size in pixels and unit."""
        if self.problem:
            return f"{self.name!r} (not read: {self.problem})"
        unit = "no unit" if self.unit is None else self.unit
        return f"{self.name!r} ({self.shape[0]} x {self.shape[1]}, {unit})"


@dataclass(frozen=True)
class Reader:
    """A file format, with functions that recognise and read files of this format.

    Args:
        name: name of the format. It is written as ``format = "…"`` in a dataset card and after ``--format``
            in the commands.
        recognises: function ``recognises(path, head)`` that returns True if the file has this format.
            ``head`` contains the first 64 KiB of the file.
        read_channels: function ``read_channels(path)`` that returns the channels of a file, in the order of
            the file. If this function or a channel's ``load`` raises any exception, the user sees a one-line
            message about the file.
        parsers: names of the modules of other projects that ``read_channels`` uses. If there are any,
            ``read_channels`` runs in a child process within limits of time and memory. The function must then
            be importable by name, and its results must be picklable.
    """

    name: str
    recognises: Callable[[Path, bytes], bool]
    read_channels: Callable[[Path], list[Channel]]
    parsers: tuple[str, ...] = ()


def one_by_one(name: str, make: Callable[[], Channel]) -> Channel:
    """Make a channel. If this fails, return a substitute channel whose ``problem`` gives the reason. The
    other channels of the file then stay usable.
    """
    try:
        with foreign_parser("a map"):
            return make()
    except InputError as error:
        return Channel(name, (0, 0), None, None, partial(_refuse, str(error)), problem=str(error))


def _refuse(problem: str) -> Loaded:
    raise InputError(problem)


def in_memory(values: Array) -> Callable[[], Loaded]:
    """Return a function for the field ``Channel.load`` of a map that has already been read. The function
    returns a copy of the map.
    """
    return partial(_copied, values)


def _copied(values: Array) -> Loaded:
    return np.array(values), None


def extent_um(y: float, x: float, unit: str | None) -> YX | None:
    """Convert stated side lengths to (y, x) in µm. Return None if a length is not positive and finite, or if
    the unit is not a length.
    """
    if unit is None or not is_length(unit):
        return None
    size = float(y) * um_per(unit), float(x) * um_per(unit)
    return size if all(np.isfinite(size)) and min(size) > 0 else None


def unknown_content(head: bytes) -> InputError:
    """Return the error to raise for a file that no reader recognises."""
    return InputError("format", got=f"unknown content {head[:8]!r}", wanted="a known AFM format")


def with_unique_names(channels: list[Channel]) -> list[Channel]:
    """Return the channels with unique names. If a name occurs again, a number is added to it, so that each
    channel can be chosen by its name.
    """
    seen: dict[str, int] = {}
    unique = []
    for channel in channels:
        count = seen[channel.name] = seen.get(channel.name, 0) + 1
        unique.append(channel if count == 1 else replace(channel, name=f"{channel.name} #{count}"))
    return unique


@contextmanager
def quiet(*loggers: str, above: int = logging.CRITICAL) -> Iterator[None]:
    """Silence Python warnings and the messages of the named loggers. Only messages of a level higher than
    ``above`` are still logged.
    """
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
    """Guard a ``with`` block that runs another project's parser. Any exception in the block is raised as an
    InputError.

    Args:
        kind: name of the format that the parser reads, for the message, such as ``"TIFF"``.

    If a file is damaged, such a parser writes to the log and may raise an error of almost any type: a struct,
    index, key, value, memory, decoding or assertion error, or a type of its own. A caller could not handle so
    many types in any useful way.
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
