"""Read TIFF images. Every page becomes a channel."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation import YX, Array, InputError, Shape, is_length, um_per
from litho_data.readers.reader import Channel, Loaded, Reader, foreign_parser, one_by_one
from litho_data.readers.text_blocks import header_of

if TYPE_CHECKING:
    from tifffile import TiffFile

_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_XRESOLUTION, _YRESOLUTION = 282, 283
_ORIENTATION, _UPRIGHT = 274, 1
_OME_SIZES = ("PhysicalSizeY", "PhysicalSizeX")
# Some instrument makers store the heights in private tags, in addition to a picture of the heights.
_SIGNED = {0x8000: "jpk", 50432: "ps"}
_LEXT, _FIRST_PAGES = "TiffTagDescData", 8
_FIRST_PRIVATE = 32768
_GDAL_METADATA, _GDAL_NODATA = 42112, 42113
_STRAIGHT_LINE = 0
_XML, _LOOKED_AT = "<", 200
_WITHOUT_MEANING = {"", "none", "gray value", "grey value", "pixel", "pixels", "inch"}


def read_channels(path: Path) -> list[Channel]:
    """Read one channel per page. In an RGB page, the three samples of each pixel must be identical.

    The pixel size is taken from OME metadata. Without OME metadata, it is taken from the resolution tags, but
    only if ImageJ's metadata name the unit of these tags. Resolution tags without such a unit usually state
    how large the image is when printed on paper, and not how large the sample is. If ImageJ or GDAL stored a
    calibration of the values, it is applied. Without a calibration, values are returned as stored. GDAL's
    no-data value marks missing pixels. Copies of a page at reduced resolution are skipped.

    Raises:
        InputError: the file is damaged.
    """
    with open_tiff(path) as file:
        pages: list[tuple[int, Any]] = [
            (k, page) for k, page in enumerate(file.pages) if not getattr(page, "is_reduced", False)
        ]
        imagej, ome = file.imagej_metadata or {}, file.ome_metadata or ""
        pitches = _ome_pitches_um(ome, len(pages))
        return [
            one_by_one(f"page {index}", partial(_channel, path, index, page, imagej, pitch))
            for (index, page), pitch in zip(pages, pitches, strict=True)
        ]


@contextmanager
def open_tiff(path: Path) -> Iterator[TiffFile]:
    """Open a TIFF file for use in a ``with`` block. Any error that a damaged file causes in the block is
    raised as an InputError.
    """
    import tifffile

    with foreign_parser("TIFF"), tifffile.TiffFile(path) as file:
        yield file


def require_upright(page: Any) -> None:
    """Reject a page that is marked as rotated or mirrored, because programs differ in how they show it.

    Raises:
        InputError: the page's orientation tag says that it is not upright.
    """
    stated = page.tags.valueof(_ORIENTATION, _UPRIGHT)
    if stated != _UPRIGHT:
        raise InputError("Orientation of the page", got=int(stated), wanted="1 (first row at the top)")


def maker_of(path: Path) -> str:
    """Recognise the TIFF files of instrument makers by their tags. Return the name that SurfaceTopography
    uses for the maker's format, or an empty string if the file is not recognised.
    """
    try:
        with open_tiff(path) as file:
            tags = file.pages.first.tags
            pages = islice(file.pages, _FIRST_PAGES)
            lext = any(_LEXT in str(getattr(page, "description", "")) for page in pages)
            return "lext" if lext else next((kind for code, kind in _SIGNED.items() if code in tags), "")
    except InputError:  # the next reader that tries the file reports the error
        return ""


def _channel(path: Path, index: int, page: Any, imagej: dict[str, Any], ome_um: YX | None) -> Channel:
    samples = page.samplesperpixel
    if page.ndim not in (2, 3) or (page.ndim == 3 and page.shape[-1] != samples):
        raise InputError("shape", got=page.shape, wanted="a two-dimensional image")
    shape = (int(page.shape[0]), int(page.shape[1]))
    require_upright(page)
    dtype = np.dtype(page.dtype)
    if dtype.kind not in "uif":
        raise InputError("type of the values", got=dtype, wanted="integers or real numbers")
    if page.photometric.name in ("PALETTE", "MINISWHITE") and dtype.kind in "ui":
        raise InputError(
            "values", got=page.photometric.name.lower(), wanted="larger values for larger heights"
        )
    if hidden := [tag.code for tag in page.tags if _may_hold_heights(tag, shape)]:
        raise InputError(f"heights may be in private tag {hidden[0]} of an unknown maker")
    scale, offset, unit, missing = _calibration(page, imagej)
    return Channel(
        name=f"page {index}",
        shape=shape,
        unit=unit,
        size_um=(shape[0] * ome_um[0], shape[1] * ome_um[1]) if ome_um else _size_um(page, imagej, shape),
        load=partial(_load, path, index, scale, offset, missing),
        full_scale=float(np.iinfo(dtype).max) if dtype.kind in "ui" and (scale, offset) == (1, 0) else None,
        header={str(key): str(value) for key, value in imagej.items()}
        | ({"ImageDescription": str(page.description)} if page.description else {}),
    )


def _may_hold_heights(tag: Any, shape: Shape) -> bool:
    import tifffile

    unknown = tag.code >= _FIRST_PRIVATE and tag.code not in tifffile.TIFF.TAGS
    return unknown and tag.valuebytecount >= shape[0] * shape[1]


def _calibration(page: Any, imagej: dict[str, Any]) -> tuple[float, float, str | None, float | None]:
    """Return the scale, offset, unit and no-data value of a page. Heights are computed as scale · value +
    offset.

    Raises:
        InputError: ImageJ's calibration is not linear, or the page's description contains a scale factor of
            unknown meaning.
    """
    scale, offset, unit, missing = 1.0, 0.0, None, None
    if not imagej and _XML not in str(page.description)[:_LOOKED_AT]:
        header = header_of(_plain_text(str(page.description)))
        scale, unit = header.factor or 1.0, header.unit
    if "c0" in imagej or "c1" in imagej or int(imagej.get("cf", _STRAIGHT_LINE)) != _STRAIGHT_LINE:
        if int(imagej.get("cf", _STRAIGHT_LINE)) != _STRAIGHT_LINE or "c2" in imagej:
            stated = ", ".join(f"{key} = {imagej[key]}" for key in ("cf", "c0", "c1", "c2") if key in imagej)
            raise InputError("calibration by ImageJ", got=stated, wanted="a straight line (cf = 0)")
        scale, offset = float(imagej.get("c1", 1.0)), float(imagej.get("c0", 0.0))
    if str(imagej.get("vunit", "")).strip().lower() not in _WITHOUT_MEANING:
        unit = _plain_unit(imagej["vunit"])
    if _GDAL_METADATA in page.tags:
        items = re.findall(r'<Item\s[^>]*role="(\w+)"[^>]*>([^<]*)<', str(page.tags[_GDAL_METADATA].value))
        says = {role.lower(): value.strip() for role, value in items}
        scale, offset = float(says.get("scale", scale)), float(says.get("offset", offset))
        unit = says.get("unittype") or unit
    if _GDAL_NODATA in page.tags:
        missing = float(str(page.tags[_GDAL_NODATA].value).strip("\0 "))
    return scale, offset, unit, missing


def _plain_text(description: str) -> str:
    """Return a page's description as lines of text. A description in JSON is converted to lines of the form
    ``key: value``.
    """
    try:
        return "\n".join(f"{key}: {value}" for key, value in json.loads(description).items())
    except (ValueError, AttributeError):  # no JSON, or no object
        return description


def _plain_unit(unit: Any) -> str:
    return str(unit).replace("\\u00B5", "µ").strip()


def _ome_pitches_um(text: str, pages: int) -> list[YX | None]:
    """Read the pixel size (y, x) in µm of every page from OME metadata. Lengths without a unit are in µm.

    In the file, the pages of the first image are followed by the pages of the second image, and so on. The
    number of pages of an image is the product of its sizes in z, channel and time. If these numbers do not
    add up to the number of pages in the file, every entry of the result is None.
    """
    pitches: list[YX | None] = []
    for image in re.findall(r"<(?:\w+:)?Pixels\s[^>]*", text):
        planes = [int(one) for one in re.findall(r'Size[ZCT]\s*=\s*"(\d{1,6})"', image)]
        pitches += [_ome_pitch_um(image)] * min(int(np.prod(planes, dtype=float)), pages)
    return pitches if len(pitches) == pages else [None] * pages


def _ome_pitch_um(image: str) -> YX | None:
    """Read the pixel size (y, x) in µm from the OME element of one image, or return None if it has none."""
    says = dict(re.findall(r'(PhysicalSize[XY](?:Unit)?)\s*=\s*"([^"]*)"', image))
    try:
        pitch = [float(says[key]) * um_per(says.get(f"{key}Unit", "µm")) for key in _OME_SIZES]
    except (KeyError, ValueError):  # the size is not stated, is not a number, or is in pixels
        return None
    return (pitch[0], pitch[1]) if all(0 < one < np.inf for one in pitch) else None


def _size_um(page: Any, imagej: dict[str, Any], shape: Shape) -> YX | None:
    unit = _plain_unit(imagej.get("unit", ""))
    if not is_length(unit) or _XRESOLUTION not in page.tags or _YRESOLUTION not in page.tags:
        return None
    pixels_per_unit = [page.tags[code].value for code in (_YRESOLUTION, _XRESOLUTION)]
    if any(numerator == 0 or denominator == 0 for numerator, denominator in pixels_per_unit):
        return None
    pitch = [denominator / numerator * um_per(unit) for numerator, denominator in pixels_per_unit]
    return shape[0] * pitch[0], shape[1] * pitch[1]


def _load(path: Path, index: int, scale: float, offset: float, missing: float | None) -> Loaded:
    with open_tiff(path) as file:
        pixels = single_sample(file.pages[index].asarray())
    if (scale, offset, missing) == (1, 0, None):
        return pixels, None
    values = pixels.astype(float)
    bad = (
        np.isclose(values, missing, rtol=1e-7, atol=0)
        if missing is not None
        else np.zeros(values.shape, bool)
    )
    return np.where(bad, np.nan, values * scale + offset), None


def single_sample(pixels: Array) -> Array:
    """Return the grey values of an image as an array of shape (ny, nx).

    The image has shape (ny, nx) or (ny, nx, samples) with one to four samples per pixel. All pixels must be
    grey and opaque.

    Raises:
        InputError: a pixel is not grey or is transparent, or the image has another shape.
    """
    if pixels.ndim == 3 and 1 <= pixels.shape[2] <= 4:
        if pixels.shape[2] in (2, 4) and (pixels[..., -1] != pixels[..., -1].max()).any():
            raise InputError("image", got="transparent pixels", wanted="an image without transparent pixels")
        colours = pixels[..., : (pixels.shape[2] - 1) | 1]
        if (colours == colours[..., :1]).all():
            return pixels[..., 0]
        raise InputError("image", got="colours that differ within a pixel", wanted="a grey image")
    if pixels.ndim != 2:
        raise InputError("shape", got=pixels.shape, wanted="a two-dimensional image")
    return pixels


def is_tiff(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is a TIFF."""
    return head.startswith(_MAGIC)


READER = Reader("tiff", lambda path, head: is_tiff(head), read_channels, ("tifffile", "imagecodecs"))
