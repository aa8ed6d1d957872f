"""Read height maps from text files that contain matrices, with or without axes, or the points of a grid."""

import re
from functools import partial
from pathlib import Path

import numpy as np

from litho_data.foundation import Array, InputError, Shape
from litho_data.readers.reader import Channel, Reader, in_memory, one_by_one
from litho_data.readers.text_blocks import Block, blocks_of, cells_of, is_row, read_text, without_quotes
from litho_data.readers.text_grid import Map, map_of_points, without_axes
from litho_data.readers.text_numbers import Table, numbers_of, refuse_cut_end

_MOST_HEADER_LINES = 1000
# A table with few columns and many rows may contain points instead of the lines of a map. Points are looked
# for if the table has at most 3 columns and at least 3 rows per column, or at most 8 columns and at least 16
# rows per column.
_POINT_COLUMNS, _POINT_ROWS_PER_COLUMN = (3, 8), (3, 16)
_IGOR = "IGOR\n"


def read_channels(path: Path) -> list[Channel]:
    """Read one channel per block of numbers. The unit and the size of a channel are known only if the lines
    above its numbers state them.

    Lines of words, and lines that start with ``#`` or ``%``, are the header of the numbers below them. If the
    first row and column contain coordinates, they are taken as axes. A table of points that fill a regular
    grid is converted to a map.

    Raises:
        InputError: the file is binary or contains no numbers, rows have different numbers of cells, different
            separators are mixed, a number is too large, or the last number was cut off. The message names the
            line.
    """
    text = read_text(path)
    if text.startswith(_IGOR):
        raise InputError("format", got="an Igor text wave, whose rows run along x", wanted="an IBW file")
    blocks = blocks_of(text)
    if not blocks:
        raise InputError("holds no numbers", wanted="one line per row of the height map")
    refuse_cut_end(text)
    names = [one.name or ("height" if len(blocks) == 1 else f"block {k}") for k, one in enumerate(blocks, 1)]
    if len(blocks) == 1:
        return [_channel(names[0], blocks[0])]
    pairs = zip(names, blocks, strict=True)
    return [one_by_one(name, partial(_channel, name, block)) for name, block in pairs]


def _channel(name: str, block: Block) -> Channel:
    table = numbers_of(block)
    found, factor = _map_of(block, table), block.factor
    block.require_pixels(found.values.shape)
    values = found.values
    for number in block.missing:
        values = np.where(np.isclose(values, number, rtol=1e-6, atol=0), np.nan, values)
    shape = values.shape
    words = dict(table.words)
    if table.corner is not None and not found.corner:
        words[table.corner] = block.first_line
    return Channel(
        name=name,
        shape=shape,
        unit=block.unit,
        size_um=block.size_um(shape) or found.size_um,
        load=in_memory(values if factor is None else values * factor),
        header=block.header,
        x_is=found.x_is,
        extent=found.extent,
        words=words,
        notes=found.notes,
    )


def _map_of(block: Block, table: Table) -> Map:
    if _may_be_points(table.values.shape):
        return map_of_points(table.values, block.words) or Map(table.values)
    return without_axes(table.values, block.words)


def _may_be_points(shape: Shape) -> bool:
    pairs = zip(_POINT_COLUMNS, _POINT_ROWS_PER_COLUMN, strict=True)
    return any(shape[1] <= most and shape[0] >= rows * shape[1] for most, rows in pairs)


def write_text_matrix(path: str | Path, height_um: Array) -> None:
    """Write heights in metres as text with five significant digits, one line per row.

    Args:
        path: the file to write.
        height_um: heights in µm, shape (ny, nx), finite and smaller than 10 m.

    Raises:
        InputError: a height is NaN or infinite, which the format cannot hold.
    """
    if not np.isfinite(height_um).all():
        raise InputError("height in a text matrix", got="NaN or infinity", wanted="finite numbers")
    # Adding zero avoids -0.
    metres = (height_um * 1e-6 + 0.0).ravel().tolist()
    row = "\t".join(["%.4e"] * height_um.shape[1]) + "\r\n"
    text = row * len(height_um) % tuple(metres)
    # Exponents have three digits, as microscope programs write them.
    Path(path).write_bytes(text.replace("e-", "e-0").replace("e+", "e+0").encode())


def _recognises(path: Path, head: bytes) -> bool:
    """Return whether the first bytes of the file are text that contains rows of at least two numbers.

    Raises:
        InputError: the rows are the points of a profile or of a point cloud, which is not a map.
    """
    lines = re.split("\r\n|\r|\n", _start_of_text(head))
    rows = [line for line in lines[:_MOST_HEADER_LINES] if is_row(line)]
    if not rows or "\0" in "".join(lines) or len(cells_of(rows[0][:_MOST_HEADER_LINES])) < 2:
        return False
    if _may_be_points((len(rows), len(cells_of(rows[0])))):
        _refuse_points(path)
    return True


def _refuse_points(path: Path) -> None:
    """Reject a file with a table of points that do not fill a regular grid."""
    for block in blocks_of(read_text(path)):
        table = numbers_of(block)
        columns = table.values.shape[1]
        if _may_be_points(table.values.shape) and map_of_points(table.values, block.words) is None:
            raise InputError(
                f"holds {'a profile' if columns == 2 else 'a point cloud or profiles'}",
                got=f"{columns} numbers per row, in the first row {' '.join(cells_of(block.rows[0]))}",
                wanted="a height map, or the points of a complete regular grid",
            )


def _start_of_text(head: bytes) -> str:
    """Return the first bytes of a file as text, or an empty text if they are not text."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return head[: len(head) // 2 * 2].decode("utf-16", errors="ignore")
    if b"\0" in head:
        halves = [half for half in (head[::2], head[1::2]) if b"\0" not in half]
        return halves[0].decode("latin-1") if halves else ""
    return without_quotes(head.decode("utf-8-sig", errors="replace"))


READER = Reader("text-matrix", _recognises, read_channels)
