"""Draw target images, or read them from image files. Their values are in [0, 1] on a square grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from litho_data.foundation.errors import InputError, unknown_name
from litho_data.foundation.hashes import array_sha256, file_sha256
from litho_data.foundation.results import Record

if TYPE_CHECKING:
    from torch import Tensor

DrawnTarget = Literal["text", "ring", "chart", "spots", "letters"]
_OVERSAMPLE = 4
# Number of rows that are drawn at a time. If a large picture were drawn at once in double precision, it would
# need more memory than the search for its design.
_ROWS = 256


class TargetRecord(Record):
    """The source of an image, and the steps by which the image was fitted to the square."""

    name: str
    sha256: str
    adaptation: str = ""

    @classmethod
    def of_file(cls, path: Path, notes: Sequence[str]) -> TargetRecord:
        """Make the record of a file. ``notes`` lists its conversions, one phrase each."""
        return cls(name=path.name, sha256=file_sha256(path), adaptation="; ".join(notes))

    @classmethod
    def of_array(cls, name: str, pixels: np.ndarray, unit: str) -> TargetRecord:
        """Make the record of a drawing or of an array, whose pixels, shape (ny, nx), are used unchanged."""
        return cls(name=name, sha256=array_sha256(pixels, unit, ("y", "x")))


# The object of a lens: the name of a drawing, or the record of a picture, whose pixels are stored with the
# settings.
ImagedObject = str | TargetRecord


def object_name(item: ImagedObject) -> str:
    """Return the name of the drawing or of the image file."""
    return item if isinstance(item, str) else item.name


@dataclass(frozen=True)
class Target:
    """A target image and its record. The image is a float32 array of shape (size, size) with values in [0, 1]
    and row 0 at the top.
    """

    pixels: np.ndarray
    record: TargetRecord


def load_target(source: str | Path | np.ndarray | Tensor | Target, size_px: int) -> Target:
    """Load a target image with a side of ``size_px`` pixels. The source is the name of a drawing, the path of
    an image, or an array. A ``Target`` is returned unchanged.

    Args:
        source: name of a drawing (``text``, ``ring``, ``chart``, ``spots`` or ``letters``); an image file; or
            an array or tensor of shape (ny, nx) with values in [0, 1]. An image is converted to grey values
            and divided by its brightest value; the values of an array are not rescaled. Images and arrays are
            placed on a black square and resampled to ``size_px``.

    Raises:
        InputError: the source is not a drawing, a readable image or an array of numbers, or the image has no
            light.
    """
    if isinstance(source, Target):
        return source
    if not isinstance(source, str | Path):
        pixels, notes = _fitted(_numbers(source), size_px)
        record = TargetRecord.of_array("array", pixels, "1")
        return Target(pixels, record.model_copy(update={"adaptation": "; ".join(notes)}))
    name = str(source)
    if name in get_args(DrawnTarget):
        pixels = draw_target(name, size_px)
        return Target(pixels, TargetRecord.of_array(name, pixels, "1"))
    if not Path(name).is_file():
        raise unknown_name("target", name, get_args(DrawnTarget), also="an image file")
    pixels, notes = read_image(Path(name), size_px, "target")
    return Target(pixels, TargetRecord.of_file(Path(name), notes))


def _numbers(source: Any) -> np.ndarray:
    """Return an array or tensor as a float32 array of shape (ny, nx)."""
    try:
        pixels = np.ascontiguousarray(
            source.detach().cpu() if hasattr(source, "detach") else source, np.float32
        )
    except (TypeError, ValueError) as error:
        raise InputError("target", got=error, wanted="a drawing, an image file, or an array") from None
    if pixels.ndim != 2 or not pixels.size:
        raise InputError("target", got=f"an array of shape {np.shape(source)}", wanted="an image, (ny, nx)")
    return pixels


def stroke_width_px(pixels: np.ndarray) -> float:
    """Return the width of the strokes of a target, in pixels: the median of the widths along the centre lines
    of the strokes. The target has shape (size, size) and values in [0, 1].
    """
    import cv2

    # The target is enlarged to twice its size. Then the distance from the middle pixels of a stroke to the
    # nearest dark pixel equals the width of the original stroke, whether this width is even or odd.
    bright = (pixels > 0.5).astype(np.uint8).repeat(2, 0).repeat(2, 1)
    distance = cv2.distanceTransform(bright, cv2.DIST_L2, 5)
    middle = (distance > 0) & (distance >= cv2.dilate(distance, np.ones((3, 3))))
    return float(np.median(distance[middle])) if middle.any() else math.inf


def draw_target(name: str, size_px: int) -> np.ndarray:
    """Draw a target with anti-aliased edges. The result is a float32 array of shape (size, size) with values
    in [0, 1].
    """
    fine = size_px * _OVERSAMPLE
    draw = {"text": _text, "ring": _ring, "chart": _chart, "spots": _spots, "letters": _letters}[name]
    # The drawing lies on a unit square with the origin in the middle and y down.
    place = (np.arange(fine) + 0.5) / fine - 0.5
    picture = np.empty((size_px, size_px), np.float32)
    for first in range(0, size_px, _ROWS):
        rows = slice(first * _OVERSAMPLE, (first + _ROWS) * _OVERSAMPLE)
        drawn = draw(*np.meshgrid(place[rows], place, indexing="ij"))
        blocks = drawn.reshape(-1, _OVERSAMPLE, size_px, _OVERSAMPLE)
        picture[first : first + _ROWS] = blocks.mean((1, 3))
    return picture


def _text(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    return _words(y, ((0.44, "LITHO"), (0.72, "LOOP")), 150)


def _letters(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Draw rows of small letters and digits, which have fine detail in many directions."""
    return _words(y, ((0.25, "RSWKG"), (0.5, "28395"), (0.75, "aekxm")), 130)


def _words(y: np.ndarray, rows: tuple[tuple[float, str], ...], line_height: float) -> np.ndarray:
    import cv2

    size, first = y.shape[1], round((y[0, 0] + 0.5) * y.shape[1] - 0.5)
    canvas = np.zeros(y.shape, np.uint8)
    for row, word in rows:
        scale = size / line_height
        thickness = max(1, round(size / 45))
        (width, _), _ = cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
        where = (int((size - width) / 2), int(row * size) - first)
        cv2.putText(canvas, word, where, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thickness, cv2.LINE_8)
    return canvas / 255.0


def _ring(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    radius = np.hypot(y, x)
    return ((radius > 0.2) & (radius < 0.28)).astype(float)


def _chart(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Draw bars of four widths in two directions, and a spoke target."""
    picture = np.zeros_like(x)
    for index, width in enumerate((0.032, 0.024, 0.016, 0.01)):
        top = -0.36 + 0.19 * index
        for left, along, across in ((-0.36, x, y), (-0.17, y, x)):
            start_along, start_across = (left, top) if along is x else (top, left)
            stripe = np.floor((along - start_along) / width).astype(int)
            inside = (
                (stripe >= 0) & (stripe < 5) & (across >= start_across) & (across < start_across + 5 * width)
            )
            picture[inside & (stripe % 2 == 0)] = 1
    spoke_y, spoke_x = y + 0.0, x - 0.22
    radius, angle = np.hypot(spoke_y, spoke_x), np.arctan2(spoke_y, spoke_x)
    picture[(radius > 0.03) & (radius < 0.17) & (np.sin(10 * angle) > 0)] = 1
    return picture


def _spots(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Draw a 7 x 7 array of spots without the central one."""
    row, column = (np.round(at / 0.11) for at in (y, x))
    in_spot = np.hypot(y - 0.11 * row, x - 0.11 * column) < 0.016
    drawn = (np.maximum(np.abs(row), np.abs(column)) <= 3) & ((row != 0) | (column != 0))
    return (in_spot & drawn).astype(x.dtype)


def read_grey(path: str | Path, what: str) -> tuple[np.ndarray, list[str]]:
    """Return an image as a greyscale array of shape (ny, nx), and a list of the conversions, one phrase each.
    The values are not rescaled.

    Raises:
        InputError: the file does not exist, is not a readable image, or has values that are not numbers.
    """
    import cv2

    if not Path(path).is_file():
        raise InputError(what, got=f"{path}, which does not exist", wanted="an image file")
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if stored is None or grey is None:
        raise InputError(what, got=str(path), wanted="an image that OpenCV can read (PNG, TIFF, JPEG, BMP)")
    notes = ["colour to grey (ITU-R BT.601 luma)"] if stored.ndim == 3 else []
    if stored.ndim == 3 and stored.shape[2] == 4:
        opaque = stored[..., 3] / float(2 ** (8 * stored.dtype.itemsize) - 1)
        if (opaque < 1).any():
            grey = np.rint(cv2.cvtColor(stored[..., :3], cv2.COLOR_BGR2GRAY) * opaque).astype(stored.dtype)
            notes.append("alpha channel composed on black")
    if not np.isfinite(grey.astype(np.float32)).all():
        raise InputError(
            what, got=f"{path} with values that are not numbers", wanted="finite values of brightness"
        )
    return grey, notes


def read_image(path: Path, size_px: int, what: str) -> tuple[np.ndarray, list[str]]:
    """Read an image as greyscale, place it on a black square, and divide it by its brightest value.

    Args:
        path: a file of any format and bit depth that OpenCV can read; grey values are used as brightness.
        size_px: side of the square.
        what: name of the image in error messages.

    Returns:
        The image as a float32 array of shape (size, size) with values in [0, 1], and a list of the
        conversions, one phrase each.

    Raises:
        InputError: the image is not readable, has values that are not numbers, or has no light.
    """
    found, notes = read_grey(path, what)
    grey: np.ndarray = found.astype(np.float32)
    if grey.max() <= 0:
        raise InputError(what, got=f"{path} without any light", wanted="an image with bright pixels")
    grey, changes = _fitted(grey, size_px)
    return np.clip(grey / grey.max(), 0, 1).astype(np.float32), notes + changes


def _fitted(grey: np.ndarray, size_px: int) -> tuple[np.ndarray, list[str]]:
    """Place a float32 image of shape (ny, nx) on a black square, and resample it to the side ``size_px``.
    Return it with a list of these conversions, one phrase each.
    """
    import cv2

    notes = []
    height, width = grey.shape
    if height != width:
        side = max(height, width)
        square = np.zeros((side, side), np.float32)
        top, left = (side - height) // 2, (side - width) // 2
        square[top : top + height, left : left + width] = grey
        grey = square
        notes.append(f"{height} x {width} px centred on a black square")
    if grey.shape[0] != size_px:
        shrink = grey.shape[0] > size_px
        method = cv2.INTER_AREA if shrink else cv2.INTER_LINEAR
        notes.append(f"resampled from {grey.shape[0]} to {size_px} px")
        grey = cv2.resize(grey, (size_px, size_px), interpolation=method)
    return grey, notes
