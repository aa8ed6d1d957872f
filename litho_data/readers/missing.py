"""Handle missing pixels. A file may contain a number or a word (a mark) in place of the height of a missing
pixel. The caller must state the marks.
"""

from collections.abc import Sequence

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.readers.reader import Channel
from litho_data.readers.text_blocks import WORDS

_USUAL = np.array(WORDS["missing"]["marks"], float)
_USUAL_TOLERANCE = 1e-4
# An extreme value looks like a mark if its distance from the other values exceeds a multiple of the span of
# the other values. The first multiple applies if several pixels have the extreme value, and the second if
# only one pixel has it. For the usual marks, the multiple is 1.
_FAR, _FAR_ALONE = 10, 1000
_FEWEST_VALUES = 8
# Values count as equal within these relative tolerances, because they may be stored as float32. Values above
# the limit _LARGE are written with few digits, so their tolerance is wider.
_SAME, _SAME_OF_LARGE, _LARGE = 1e-6, 1e-3, 1e30
# The lowest or highest value is suspicious if the number of pixels with this value reaches all three limits:
# a share of all pixels, a fixed number of pixels, and a multiple of the mean number of pixels per distinct
# value.
_SHARE, _FEWEST, _TIMES = 0.002, 10, 20


def without_missing(channel: Channel, values: Array, missing: Sequence[float | str] | None) -> Array:
    """Return the values of a channel, with NaN in place of the marks of missing pixels.

    Args:
        channel: the channel from which the values were read.
        values: array of shape (ny, nx) of the numbers in the file.
        missing: the numbers and words that mark missing pixels. An empty list states that there are no marks.
            None states that the caller does not know whether there are any.

    Raises:
        InputError: the file contains a word that is not in ``missing``, or ``missing`` is None and a number
            looks like a mark.
    """
    marks = {one for one in missing or () if isinstance(one, str)}
    for word, line in channel.words.items():
        if word not in marks:
            shown = f"{word[:24]!r}" if word else "an empty cell"
            hint = f'if it marks pixels without a measurement, set missing = ["{word[:24]}"]'
            raise InputError(f"line {line}", got=shown, wanted="a number", hint=hint)
    values = np.array(values, dtype=float)
    for number in (one for one in missing or () if not isinstance(one, str)):
        tolerance = _SAME_OF_LARGE if abs(number) > _LARGE else _SAME
        values[np.isclose(values, number, rtol=tolerance, atol=0)] = np.nan
    if missing is None and (found := _marks(values)):
        shown = ", ".join(f"{value:g} in {count} pixels" for value, count in found)
        keys = ", ".join(f"{value:.8g}" for value, _ in found)
        hint = f"if it marks pixels without a measurement, set missing = [{keys}]; if not, set missing = []"
        raise InputError("heights", got=f"{shown}, far from all others", wanted="measured heights", hint=hint)
    return values


def _marks(values: Array) -> list[tuple[float, int]]:
    """Return the extreme values that look like marks of missing pixels, each with the number of pixels that
    have it. The most extreme value comes first.
    """
    numbers, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    found: list[tuple[float, int]] = []
    while len(numbers) > _FEWEST_VALUES:
        spans = numbers[-1] - numbers[1], numbers[-2] - numbers[0]
        gaps = numbers[1] - numbers[0], numbers[-1] - numbers[-2]
        end = 0 if gaps[0] * max(spans[1], 1e-300) > gaps[1] * max(spans[0], 1e-300) else -1
        value, count, gap, span = float(numbers[end]), int(counts[end]), float(gaps[end]), float(spans[end])
        usual = np.isclose(value, _USUAL, rtol=_USUAL_TOLERANCE, atol=0).any()
        if not (usual and gap > span) and not gap > (_FAR if count > 1 else _FAR_ALONE) * span:
            break
        found.append((value, count))
        numbers, counts = (numbers[1:], counts[1:]) if end == 0 else (numbers[:-1], counts[:-1])
    return found


def extreme_note(values: Array) -> str:
    """Return a warning if the lowest or the highest value of a map occurs in suspiciously many pixels.
    Otherwise return an empty text.
    """
    numbers, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    if not len(numbers):
        return ""
    least = max(_FEWEST, _SHARE * counts.sum(), _TIMES * counts.sum() / len(numbers))
    said = [f"{numbers[end]:.6g} in {counts[end]} pixels" for end in (0, -1) if counts[end] >= least]
    what = (
        f"its {'lowest' if counts[0] >= least else 'highest'} value occurs in many pixels ({'; '.join(said)})"
    )
    return f"{what}: was it cut off by the instrument, or does it mark missing pixels?" if said else ""
