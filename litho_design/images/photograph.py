"""Photographs: cleaned, and registered on the image that a design expects."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record
from litho_data.register.geometry import ORIENTATIONS, orient, orientation_matrix
from litho_design.images.noise import DRAWS, white_noise
from litho_design.images.targets import ImagedObject

_HOT_SIGMAS = 6.0
_SMALLEST_CORRELATION = 0.45
_LARGEST_STRETCH = 1.2
# Of pixels at the end of their range: more of them change the likeness of an image.
_LARGEST_SATURATED = 0.01
# What undoes the encoding of pictures for a screen.
_SCREEN_GAMMA = 2.2
# A tilt is accepted if it leaves no more than this share of what is unexplained without it.
_TILTED = 0.8
# Orientations are told apart on images of about this side, px; correlations this close are a tie.
_SMALL_PX = 192
_TIE = 0.03


class CameraRecord(Record):
    """Source of a photograph and how it was processed; ``imaged`` is the object in front of a lens.

    ``orientation`` is the operation that brings the photograph onto the image, ``ambiguous`` lists others
    that fit as well. The last four are None in older results.
    """

    name: str
    sha256: str
    pitch_um: float
    dark_level: float
    replaced_pixels: int
    saturated_share: float
    correlation: float
    photo_to_window: list[list[float]]
    imaged: ImagedObject | None = None
    orientation: str | None = None
    ambiguous: list[str] | None = None
    noise_counts: float | None = None
    dark_level_sd: float | None = None
    position_sd_um: float | None = None

    def remarks(self) -> list[str]:
        """What to know about the orientation, one phrase each."""
        found = []
        if self.orientation not in (None, "identity"):
            found.append(f"the photograph was brought onto the image by {self.orientation}, as asked")
        if self.ambiguous:
            others = ", ".join(self.ambiguous)
            found.append(f"ambiguous: it fits as well after {others}, so a mirrored print would go unnoticed")
        return found


@dataclass(frozen=True)
class Photograph:
    """A photograph and where the image lies on it.

    Attributes:
        counts: cleaned, without the dark level (ny, nx).
        window_to_photo: projective map (3, 3) from window pixels to its pixels.
        side_px: side of the window.
        pitch_um: pixel of the window.
        finest_per_um: the highest spatial frequency that the light can have.
        record: source and processing.
    """

    counts: np.ndarray
    window_to_photo: np.ndarray
    side_px: int
    pitch_um: float
    finest_per_um: float
    record: CameraRecord

    def image(self) -> np.ndarray:
        """Counts per pixel of the photograph, on the pixels of the window (m, m); noise goes below 0."""
        return self._warped(self.counts, np.zeros(2))

    def power_share(self, image: np.ndarray, power_counts: float) -> np.ndarray:
        """``image`` as the share of the light that falls on the element, of its summed counts."""
        # Pixels of the photograph to a pixel in the middle of the window.
        warp, middle = self.window_to_photo, np.array([self.side_px / 2, self.side_px / 2, 1])
        return image * abs(np.linalg.det(warp) / (warp[2] @ middle) ** 3) / power_counts

    def as_it_might_be(self) -> Iterator[np.ndarray]:
        """Images that it would also allow: other noise, dark level and position, in opposite pairs."""
        generator = np.random.default_rng(0)
        record = self.record
        for _ in range(DRAWS):
            noise = (record.noise_counts or 0) * generator.standard_normal(self.counts.shape)
            noise = noise - (record.dark_level_sd or 0) * generator.standard_normal()
            moved = (record.position_sd_um or 0) / self.pitch_um * generator.standard_normal(2)
            for sign in (1, -1):
                yield self._warped((self.counts + sign * noise).astype(np.float32), sign * moved)

    def _warped(self, counts: np.ndarray, moved_px: np.ndarray) -> np.ndarray:
        import cv2
        from scipy.fft import dctn, idctn

        warp, side = self.window_to_photo.copy(), self.side_px
        warp[:, 2] += warp[:, :2] @ moved_px
        found: Any = cv2.warpPerspective(
            counts, warp, (side, side), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        )
        # What is finer than any light of the element is noise.
        passed = np.arange(side) / (2 * side * self.pitch_um) <= self.finest_per_um
        kept: np.ndarray = idctn(dctn(found, norm="ortho") * np.outer(passed, passed), norm="ortho")
        return kept


def photographed_image(
    wanted: np.ndarray,
    wanted_pitch_um: float,
    photo_file: str | Path,
    pitch_um: float,
    *,
    finest_per_um: float,
    dark_level: float | None = None,
    orientation: str = "identity",
) -> Photograph:
    """A photograph, registered on the image that the design expects.

    Dark level subtracted (where none is given, the 1st percentile of means over 5 px), single hot or dead
    pixels replaced by their neighbours' median, then brought onto the expected image as a camera sees it
    that is moved, turned and tilted: the shift by cross-correlation, the rest by maximising the correlation
    coefficient (Evangelidis and Psarakis 2008). All eight orientations are tried, and a photograph that fits
    another one better than ``orientation`` is refused.

    Args:
        wanted: expected image (m, m), any scale; ``wanted_pitch_um`` its pixel, µm.
        photo_file: grey image of any bit depth, counts proportional to the light.
        pitch_um: camera pixel in the plane of the image, µm.
        finest_per_um: highest spatial frequency of the light, 2 NA / wavelength; what is finer is left out.
        orientation: what brings the photograph upright, such as ``flip-x`` or ``rotate-180``.

    Raises:
        InputError: not an image, a pitch that is not positive, an unknown orientation, or a photograph that
            is overexposed, not linear, unlike the expected image, or mirrored or turned.
    """
    import cv2

    if not pitch_um > 0:
        raise InputError("camera pitch", got=f"{pitch_um} µm", wanted="a positive number")
    require_known("camera orientation", orientation, ORIENTATIONS)
    if not Path(photo_file).is_file():
        raise InputError("photograph", got=f"{photo_file}, which does not exist", wanted="an image file")
    raw = cv2.imread(str(photo_file), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if raw is None:
        raise InputError("photograph", got=str(photo_file), wanted="an image file")
    photo = raw.astype(np.float32)
    darkest = np.percentile(cv2.blur(photo, (5, 5)), [1, 10])
    dark = float(darkest[0]) if dark_level is None else dark_level
    top = float(2 ** (8 * raw.dtype.itemsize) - 1) if raw.dtype.kind == "u" else float(raw.max())
    # Below the dark level noise is cut off at zero.
    saturated, cut_off = float((raw >= top).mean()), float((raw == 0).mean()) if dark > 0 else 0.0
    if max(saturated, cut_off) > _LARGEST_SATURATED:
        raise InputError(
            f"photograph {photo_file}",
            got=f"{100 * max(saturated, cut_off):.1f} % of its pixels at an end of their range",
            wanted=f"at most {100 * _LARGEST_SATURATED:g} %",
            hint="a shorter exposure" if saturated > cut_off else "a black level above the noise",
        )
    cleaned, replaced = _replace_outliers(photo - np.float32(dark))
    wanted = wanted.astype(np.float32)
    ambiguous = _check_orientation(cleaned, wanted, pitch_um / wanted_pitch_um, orientation, photo_file)
    upright = np.ascontiguousarray(orient(cleaned, orientation))
    fit = _register(upright, wanted, pitch_um / wanted_pitch_um, tilted=True)
    if fit.correlation < _SMALLEST_CORRELATION:
        raise _unlike(photo_file, fit.correlation)
    back = np.linalg.inv(orientation_matrix(orientation, cleaned.shape))
    warp = back @ fit.window_to_photo
    record = CameraRecord(
        name=Path(photo_file).name,
        sha256=file_sha256(photo_file),
        pitch_um=pitch_um,
        dark_level=dark,
        replaced_pixels=replaced,
        saturated_share=saturated,
        correlation=fit.correlation,
        photo_to_window=warp.tolist(),
        orientation=orientation,
        ambiguous=ambiguous,
        noise_counts=white_noise(cleaned),
        dark_level_sd=float(np.diff(darkest)[0]) / 2 if dark_level is None else 0.0,
        position_sd_um=fit.position_sd_px * wanted_pitch_um,
    )
    found = Photograph(cleaned, warp, wanted.shape[0], wanted_pitch_um, finest_per_um, record)
    _check_linear(found.image(), wanted, photo_file)
    return found


def _check_linear(image: np.ndarray, wanted: np.ndarray, photo_file: str | Path) -> None:
    """Refuse counts that fit the expected image better once the encoding for a screen is undone."""
    import cv2

    light = image.clip(0)
    smooth = [cv2.GaussianBlur(one, (0, 0), 2.0).ravel() for one in (wanted, light, light**_SCREEN_GAMMA)]
    correlations: Any = np.corrcoef(smooth)
    _, as_it_is, decoded = correlations[0]
    if decoded > as_it_is:
        raise InputError(
            f"photograph {photo_file}",
            got=f"counts that fit the expected image better to the power {_SCREEN_GAMMA} (correlation "
            f"{decoded:.2f}) than as they are ({as_it_is:.2f})",
            wanted="counts proportional to the light",
            hint="take the camera's raw file, or undo its gamma",
        )


def _check_orientation(
    photo: np.ndarray, wanted: np.ndarray, scale: float, asked: str, photo_file: str | Path
) -> list[str]:
    """Other orientations that fit as well as the one asked for.

    Raises:
        InputError: another one fits better, or none fits.
    """
    import cv2

    shrink = max(1, wanted.shape[0] // _SMALL_PX)
    side = wanted.shape[0] // shrink
    small: Any = cv2.resize(wanted, (side, side), interpolation=cv2.INTER_AREA)
    # The camera is brought to the same pixels, or its noise would decide.
    finer = max(1, round(wanted.shape[0] / side / scale))
    counts: Any = cv2.blur(photo, (finer, finer)) if finer > 1 else photo
    small_scale = scale * side / wanted.shape[0]
    found = {
        name: _register(np.ascontiguousarray(orient(counts, name)), small, small_scale).correlation
        for name in ORIENTATIONS
    }
    best = max(found, key=lambda name: found[name])
    if found[best] < _SMALLEST_CORRELATION:
        raise _unlike(photo_file, found[best])
    if found[asked] < found[best] - _TIE:
        raise InputError(
            f"photograph {photo_file}",
            got=f"an image that fits after {best} (correlation {found[best]:.2f}), not after {asked} "
            f"({found[asked]:.2f})",
            wanted="an upright photograph",
            hint=f"if the camera and not the print did that: --camera-orientation {best}",
        )
    return [name for name in found if name != asked and found[name] > found[asked] - _TIE]


def _unlike(photo_file: str | Path, correlation: float) -> InputError:
    return InputError(
        f"photograph {photo_file}",
        got=f"correlation {correlation:.2f} with the expected image in any orientation",
        wanted=f"at least {_SMALLEST_CORRELATION}",
        hint="check the camera pitch",
    )


def _replace_outliers(photo: np.ndarray) -> tuple[np.ndarray, int]:
    """Pixels far from the median of their 3 x 3 neighbourhood, in units of the image's own spread."""
    import cv2

    median = cv2.medianBlur(photo, 3)
    difference = photo - median
    spread = 1.4826 * float(np.median(np.abs(difference))) + 1e-6 * float(photo.max())
    outliers = np.abs(difference) > np.maximum(_HOT_SIGMAS * spread, 0.5 * median + 0.05 * photo.max())
    return np.where(outliers, median, photo), int(outliers.sum())


@dataclass(frozen=True)
class _Fit:
    """Projective map (3, 3) from window to photograph pixels, its correlation, the shift's uncertainty."""

    window_to_photo: np.ndarray
    correlation: float
    position_sd_px: float


def _register(photo: Any, wanted: Any, scale: float, *, tilted: bool = False) -> _Fit:
    import cv2

    side = wanted.shape[0]
    blur_px = 2 * max(1.0, scale)
    reference: Any = cv2.GaussianBlur(wanted / wanted.max(), (0, 0), blur_px)
    centre = (np.array(photo.shape[::-1]) - 1) / 2
    # Window pixel (i, j) looks at photograph pixel (i - middle) / scale + centre.
    start = np.array([[1 / scale, 0, 0], [0, 1 / scale, 0]])
    start[:, 2] = centre - start[:, :2] @ np.full(2, (side - 1) / 2)
    moving: Any = cv2.warpAffine(photo, start, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    moving = cv2.GaussianBlur(moving / max(float(moving.max()), 1e-12), (0, 0), blur_px)
    warp: Any = np.eye(3, dtype=np.float32)
    warp[:2, 2] = _shift_px(reference, moving)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-7)
    correlation = 0.0
    # From coarse to fine: the fine structure of an image has maxima beside the right one.
    for rows, further in ((2, 3.0 * blur_px), (2, 0.0), *([(3, 0.0)] if tilted else [])):
        fixed, moved = reference, moving.astype(np.float32)
        if further:
            fixed, moved = (cv2.GaussianBlur(image, (0, 0), further) for image in (fixed, moved))
        motion = cv2.MOTION_AFFINE if rows == 2 else cv2.MOTION_HOMOGRAPHY
        try:
            reached, found = cv2.findTransformECC(fixed, moved, warp[:rows].copy(), motion, criteria)
        except cv2.error:
            reached, found = 0.0, warp[:rows]
        # Two numbers more fit what differs in the image, too, if no tilt asks for them.
        if rows == 2 or 1 - reached**2 < _TILTED * (1 - correlation**2):
            correlation, warp[:rows] = reached, found
    # A fit that strongly shrinks, shears or tilts the image has matched noise.
    middle = warp @ np.array([(side - 1) / 2, (side - 1) / 2, 1])
    linear = (warp[:2, :2] - np.outer(middle[:2] / middle[2], warp[2, :2])) / middle[2]
    tilt = np.abs(warp[2, :2]).sum() * side / 2 / middle[2]
    stretch = np.linalg.svd(linear, compute_uv=False)
    if max(stretch.max(), 1 / stretch.min(), 1 + tilt) > _LARGEST_STRETCH:
        correlation = 0.0
    whole = np.vstack([start, [0, 0, 1]]) @ warp
    return _Fit(whole, float(correlation), _position_sd_px(reference, correlation, blur_px))


def _shift_px(reference: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Whole pixels (x, y) by which ``moving`` (n, n) has to be read later: the maximum of the correlation."""
    n = len(reference)
    spectra = [np.fft.rfft2(image - image.mean(), s=(2 * n, 2 * n)) for image in (moving, reference)]
    correlation = np.fft.irfft2(spectra[0] * spectra[1].conj())
    y, x = np.unravel_index(int(correlation.argmax()), correlation.shape)
    return np.array([x - 2 * n * (x > n), y - 2 * n * (y > n)])


def _position_sd_px(reference: np.ndarray, correlation: float, blur_px: float) -> float:
    """Standard deviation of a least-squares shift, from what the correlation leaves unexplained.

    The residual has the variance (1 - r^2) / r^2 of the image and is correlated over 4 pi blur^2 pixels.
    """
    if not correlation > 0:
        return math.inf
    residual = reference.var() * (1 / correlation**2 - 1)
    slopes = min(float(np.square(slope).sum()) for slope in np.gradient(reference))
    return math.sqrt(residual * 4 * math.pi * blur_px**2 / slopes)
