"""Read Wyko ASCII files.

Such a file consists of a header of tab-separated cells, followed by blocks of numbers. Heights are in
wavelengths or in nm. The word ``Bad`` marks missing pixels.
"""

from pathlib import Path

import numpy as np

from litho_data.foundation import InputError, Shape
from litho_data.readers.reader import DAMAGED, Channel, Reader, in_memory
from litho_data.readers.text_blocks import NUMBER, Block, number, read_text
from litho_data.readers.text_numbers import numbers_of

_MAGIC = "Wyko ASCII Data File Format"
_HEIGHTS = ("OPD", "RAW_DATA", "RAW DATA", "SAMPLE_DATA")
_INTENSITIES = ("Image", "Intensity", "SecArr_0")
_BAD = "Bad"


def read_channels(path: Path) -> list[Channel]:
    """Return one channel per block of numbers. A flag in the first line says whether heights are in nm or in
    wavelengths.

    A line of the file usually contains a column of the map, from bottom to top. If the numbers of lines and
    cells show that a line contains a row instead, each line is read as a row of the map.

    Raises:
        InputError: heights are in wavelengths but the header does not state the wavelength, or a block does
            not have the size that the header states.
    """
    lines = read_text(path).split("\n")
    in_nm = lines[0].removeprefix(_MAGIC).split()[1:2] == ["1"]
    says: dict[str, str] = {}
    channels = []
    position = 1
    while position < len(lines):
        cells = [cell.strip() for cell in lines[position].split("\t")]
        position += 1
        if cells[0] in _HEIGHTS + _INTENSITIES and len(cells) > 2:
            nx, ny = (int(number(says.get(key, "0"))) for key in ("X Size", "Y Size"))
            end = position
            while end < len(lines) and NUMBER.match(lines[end].strip().replace(_BAD, "0")):
                end += 1
            block = Block({}, [], position + 1, lines[position:end])
            channels.append(_channel(cells[0], block, (ny, nx), says, in_nm))
            position = end
        elif len(cells) > 1:
            says[cells[0]] = cells[-1]
    return channels


def _channel(name: str, block: Block, shape: Shape, says: dict[str, str], in_nm: bool) -> Channel:
    if not block.rows:
        raise InputError(name, got="no numbers", hint=DAMAGED)
    table = numbers_of(block)
    values, by_columns = table.values, table.values.shape == shape[::-1]
    if not by_columns and values.shape != shape:
        got = f"{values.shape[0]} lines of {values.shape[1]}"
        raise InputError(name, got=got, wanted=f"{shape[1]} lines of {shape[0]}", hint=DAMAGED)
    values = values.T[::-1] if by_columns else values
    wavelength_nm, pitch_mm = number(says.get("Wavelength", "")), number(says.get("Pixel_size", ""))
    multiplier, aspect = (number(says.get(key, "1")) or 1.0 for key in ("Mult", "Aspect"))
    scale = 1.0 if in_nm else wavelength_nm / multiplier
    if name in _HEIGHTS and not np.isfinite(scale):
        raise InputError("Wavelength", got=says.get("Wavelength"), wanted="a wavelength in nm")
    pitch_um = abs(pitch_mm) * 1e3
    return Channel(
        name=name,
        shape=shape,
        unit="nm" if name in _HEIGHTS else "not a length",
        size_um=(shape[0] * pitch_um * aspect, shape[1] * pitch_um) if pitch_um > 0 else None,
        load=in_memory(values * (scale if name in _HEIGHTS else 1.0)),
        header=dict(says),
        words={word: line for word, line in table.words.items() if word != _BAD},
        x_is="the lines, each a column" if by_columns else "a row of the file",
    )


READER = Reader("wyko", lambda path, head: head.startswith(_MAGIC.encode()), read_channels)
