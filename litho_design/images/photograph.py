"""Photographs: cleaned, and registered on the image that a design expects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record
from litho_design.images.targets import ImagedObject

_HOT_SIGMAS = 6.0
_SMALLEST_CORRELATION = 0.45
_LARGEST_STRETCH = 1.2


class CameraRecord(Record):
    """Source of a photograph and how it was processed; ``imaged`` is the object in front of a lens."""

    name: str
    sha256: str
    pitch_um: float
    dark_level: float
    replaced_pixels: int
    saturated_share: float
    correlation: float
    photo_to_window: list[list[float]]
    imaged: ImagedObject | None = None


def photographed_image(
    wanted: np.ndarray,
    wanted_pitch_um: float,
    photo_file: str | Path,
    pitch_um: float,
    *,
    dark_level: float | None = None,
) -> tuple[np.ndarray, CameraRecord]:
    """A photograph, resampled onto the pixels of the image that the design expects.

    Dark level subtracted (the 1st percentile where none is given), single hot or dead pixels
    replaced by their neighbours' median, then shifted, rotated and scaled onto the expected image:
    the shift by cross-correlation, the rest by maximising the correlation coefficient (Evangelidis
    and Psarakis 2008). One interpolation.

    Args:
        wanted: expected image (m, m), any scale; ``wanted_pitch_um`` its pixel, µm.
        photo_file: grey image of any bit depth.
        pitch_um: camera pixel in the plane of the image, µm.

    Returns:
        Image (m, m) in counts, and its record.

    Raises:
        InputError: not an image, a pitch that is not positive, or a photograph unlike the expected image.
    """
    import cv2

    if not pitch_um > 0:
        raise InputError("camera pitch", got=f"{pitch_um} µm", wanted="a positive number")
    if not Path(photo_file).is_file():
        raise InputError("photograph", got=f"{photo_file}, which does not exist", wanted="an image file")
    raw = cv2.imread(str(photo_file), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if raw is None:
        raise InputError("photograph", got=str(photo_file), wanted="an image file")
    photo = raw.astype(np.float32)
    dark = float(np.percentile(photo, 1)) if dark_level is None else dark_level
    cleaned, replaced = _replace_outliers(np.clip(photo - dark, 0, None))
    warp, correlation = _register(cleaned, wanted.astype(np.float32), pitch_um / wanted_pitch_um)
    if correlation < _SMALLEST_CORRELATION:
        raise InputError(
            f"photograph {photo_file}",
            got=f"correlation {correlation:.2f} with the expected image",
            wanted=f"at least {_SMALLEST_CORRELATION}",
            hint="check the camera pitch and the orientation",
        )
    side = wanted.shape[0]
    image = cv2.warpAffine(cleaned, warp, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    top = float(2 ** (8 * raw.dtype.itemsize) - 1) if raw.dtype.kind == "u" else float(raw.max())
    record = CameraRecord(
        name=Path(photo_file).name,
        sha256=file_sha256(photo_file),
        pitch_um=pitch_um,
        dark_level=dark,
        replaced_pixels=replaced,
        saturated_share=float((raw >= top).mean()),
        correlation=correlation,
        photo_to_window=warp.tolist(),
    )
    return image, record


def _replace_outliers(photo: np.ndarray) -> tuple[np.ndarray, int]:
    """Pixels far from the median of their 3 x 3 neighbourhood, in units of the image's own spread."""
    import cv2

    median = cv2.medianBlur(photo, 3)
    difference = photo - median
    spread = 1.4826 * float(np.median(np.abs(difference))) + 1e-6 * float(photo.max())
    outliers = np.abs(difference) > np.maximum(_HOT_SIGMAS * spread, 0.5 * median + 0.05 * photo.max())
    return np.where(outliers, median, photo), int(outliers.sum())


def _register(photo: Any, wanted: Any, scale: float) -> tuple[np.ndarray, float]:
    """Affine map (2, 3) from window pixels to photograph pixels, and the correlation reached."""
    import cv2

    side = wanted.shape[0]
    smooth = max(1.0, scale)
    reference: Any = cv2.GaussianBlur(wanted / wanted.max(), (0, 0), 2 * smooth)
    centre = (np.array(photo.shape[::-1]) - 1) / 2
    # Window pixel (i, j) looks at photograph pixel (i - middle) / scale + centre.
    start = np.array([[1 / scale, 0, 0], [0, 1 / scale, 0]])
    start[:, 2] = centre - start[:, :2] @ np.full(2, (side - 1) / 2)
    moving: Any = cv2.warpAffine(photo, start, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    moving = cv2.GaussianBlur(moving / max(float(moving.max()), 1e-12), (0, 0), 2 * smooth)
    shift, _ = cv2.phaseCorrelate(reference.astype(np.float64), moving.astype(np.float64))
    warp: Any = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-7)
    try:
        correlation, warp = cv2.findTransformECC(
            reference, moving.astype(np.float32), warp, cv2.MOTION_AFFINE, criteria
        )
    except cv2.error:
        correlation = 0.0
    # A fit that strongly shrinks or shears the image has matched noise.
    stretch = np.linalg.svd(warp[:, :2], compute_uv=False)
    if stretch.max() > _LARGEST_STRETCH or stretch.min() < 1 / _LARGEST_STRETCH:
        correlation = 0.0
    whole = np.vstack([start, [0, 0, 1]]) @ np.vstack([warp, [0, 0, 1]])
    return whole[:2], float(correlation)
