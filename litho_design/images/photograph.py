"""Clean a photograph and register it to the expected image, which was predicted for the design."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import correlate

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record
from litho_data.register.geometry import ORIENTATIONS, orient, orientation_matrix
from litho_design.images.measurements import PhotoSource
from litho_design.images.noise import DRAWS, covariance_by_tiles, noise_of_light
from litho_design.images.targets import ImagedObject, read_grey

_HOT_SIGMAS = 6.0
# If a camera pixel contains more than this number of periods of the finest fringes, real spots are as narrow
# as hot pixels.
_COARSE = 0.25
_SMALLEST_CORRELATION = 0.45
# Largest allowed share of pixels clipped at the bright or dark end. A larger share would change the
# similarity.
_LARGEST_SATURATED = 0.01
# Limits of |log(gamma)|, where the counts are proportional to light^gamma. Above the first limit, a
# photograph is rejected; above the second, a remark is made. Even for prints close to the expected one, the
# fitted gamma lies between 0.9 and 1.1, not exactly at 1.
_LARGEST_GAMMA_OFF, _OPEN_GAMMA_OFF = 0.2, 0.1
_SMALLEST_COVERAGE = 0.9
# Standard deviation of the relative loss of light in the corners of a photograph, which depends on the
# objective.
_VIGNETTING_SD = 0.1
# Another printer moves the whole image of a hologram, which the scatter between the tiles of a photograph
# does not show. These are typical standard deviations of the shifts, the rotation, the scale and the tilts,
# as shares of half the window (rms over twenty holograms and five models, less the scatter between tiles).
_PRINT_MOVES_SD = np.array([0.004, 0.004, 0.0, 0.015, 0.0, 0.0])
# Standard deviation of the tilts that a camera may plausibly have. A tilt is the relative change of scale
# over half the window.
_TILT_SD = 0.1
# Orientations are compared on images with about this side, px; correlations that differ by less than ``_TIE``
# are a tie.
_SMALL_PX = 192
_TIE = 0.03


class CameraRecord(Record):
    """Source and processing of a photograph. If the photograph was taken through a printed lens, ``imaged``
    is the photographed object.

    ``orientation`` is the operation that brings the photograph into the orientation of the expected image.
    ``ambiguous`` lists other operations with which the photograph fits equally well. ``photo_to_window`` is a
    3 x 3 matrix that acts on ``(x, y, 1)`` and maps pixels of the file to pixels of the expected image.
    ``noise_counts`` is the standard deviation of the noise in the dark, and ``noise_share`` is the standard
    deviation of the noise that is proportional to the light, as a share of the light. ``position_sd_um`` is
    the standard deviation of the fitted position along one axis, and ``scale_sd`` is the relative standard
    deviation of the fitted scale. ``vignetting_sd`` is the standard deviation of the relative loss of light
    in the corners of the photograph. ``blur_um`` is the standard deviation (radius) of the fitted blur that
    is added to the expected image. ``gamma`` is a fitted exponent: in the fit, the counts are proportional to
    light^gamma.
    """

    name: str
    sha256: str
    pitch_um: float
    pitch_sd: float
    dark_level: float
    replaced_pixels: int
    saturated_share: float
    correlation: float
    photo_to_window: list[list[float]]
    imaged: ImagedObject | None = None
    orientation: str
    ambiguous: list[str]
    noise_counts: float
    noise_share: float
    dark_level_sd: float
    position_sd_um: float
    scale_sd: float
    vignetting_sd: float
    blur_um: float
    gamma: float
    coverage: float
    notes: list[str]

    def remarks(self) -> list[str]:
        """Return remarks about the photograph, one phrase each."""
        found = list(self.notes)
        if self.orientation != "identity":
            found.append(
                f"the orientation of the photograph was corrected by {self.orientation}, as requested"
            )
        if self.ambiguous:
            others = ", ".join(self.ambiguous)
            found.append(
                f"ambiguous: the photograph fits equally well if the operation is {others}, so a mirrored "
                "print would go unnoticed"
            )
        if self.coverage < 1:
            found.append(
                f"{100 * (1 - self.coverage):.1f} % of the image lies outside the photograph and was "
                "replaced by the expected image"
            )
        if self.vignetting_sd:
            found.append(
                "without --camera-flat, the score may include vignetting; its uncertainty allows for this"
            )
        if abs(math.log(self.gamma)) > _OPEN_GAMMA_OFF:
            found.append(
                f"counts seem to be proportional to the light to the power {self.gamma:.2f}; check that the "
                "file is raw"
            )
        return found


@dataclass(frozen=True)
class Photograph:
    """A photograph, and the position of the expected image on it.

    Attributes:
        counts: counts of the cleaned, upright photograph minus the dark level, shape (ny, nx).
        window_to_photo: projective map from pixels of the window to pixels of the photograph, a matrix of
            shape (3, 3). The window is the area of the expected image.
        side_px: side of the window, in window pixels.
        pitch_um: side length of a window pixel.
        finest_per_um: the highest spatial frequency that the image can have, in cycles/µm.
        averaged_um: side, µm, of the pixels over which ``image`` averages the light (see
            ``photographed_image``).
        record: source and processing of the photograph.
        expected: expected counts, shape (m, m). They are used for window pixels that lie outside the
            photograph.
        other_warps: pairs of maps like ``window_to_photo``, one pair for each independent movement of the
            camera in the fit. In the two maps, the camera is moved by plus and minus the standard deviation
            of this movement.
    """

    counts: np.ndarray
    window_to_photo: np.ndarray
    side_px: int
    pitch_um: float
    finest_per_um: float
    averaged_um: float
    record: CameraRecord
    expected: np.ndarray
    other_warps: list[list[np.ndarray]]

    def image(self) -> np.ndarray:
        """Return the photograph resampled on the pixels of the window, shape (m, m), in counts per camera
        pixel. Some counts may be negative because of noise.
        """
        return self._warped(self.counts, self.window_to_photo)

    def power_share(self, image: np.ndarray, power_counts: float) -> np.ndarray:
        """Convert the counts in ``image`` to shares of the light that is incident on the element.
        ``power_counts`` is the sum of the counts that all of this light would give.
        """
        return image * self._camera_pixels(self.window_to_photo) / power_counts

    def with_more_noise(self) -> Iterator[np.ndarray]:
        """Yield pairs of images to which random noise as strong as that of the photograph is added. The two
        images of a pair have the same noise with opposite signs.
        """
        generator = np.random.default_rng(0)
        record, light = self.record, self.counts.clip(0)
        sd = np.sqrt(record.noise_counts**2 + (record.noise_share * light) ** 2)
        for _ in range(DRAWS):
            noise = sd * generator.standard_normal(light.shape)
            for sign in (1, -1):
                yield self._warped((self.counts + sign * noise).astype(np.float32), self.window_to_photo)

    def with_other_faults(self) -> Iterator[np.ndarray]:
        """Yield the pair of images in which the vignetting of the camera differs by plus and minus its
        standard deviation. Nothing is yielded if a flat field was given.
        """
        for sign in (1, -1) if self.record.vignetting_sd else ():
            yield self._warped(self.counts, self.window_to_photo, sign * self.record.vignetting_sd)

    def with_other_fits(self) -> Iterator[np.ndarray]:
        """Yield pairs of images in which one fitted property of the camera differs by plus and minus its
        standard deviation. The properties are the independent movements of the camera and the dark level.
        """
        yield from (self._warped(self.counts, warp) for pair in self.other_warps for warp in pair)
        for sign in (1, -1) if self.record.dark_level_sd else ():
            darker = self.counts - np.float32(sign * self.record.dark_level_sd)
            yield self._warped(darker, self.window_to_photo)

    def _camera_pixels(self, warp: np.ndarray) -> float:
        """Return the number of camera pixels per window pixel in the middle of the window."""
        middle = np.array([self.side_px / 2, self.side_px / 2, 1])
        return float(abs(np.linalg.det(warp) / (warp[2] @ middle) ** 3))

    def _warped(self, counts: np.ndarray, warp: np.ndarray, vignetting: float = 0.0) -> np.ndarray:
        import cv2
        from scipy.fft import dctn, idctn

        side = self.side_px
        flat = counts / (1 - vignetting * _radius_squared(counts.shape))
        way: Any = {"flags": cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
        found = cv2.warpPerspective(flat.astype(np.float32), warp, (side, side), **way)
        # With the map ``warp``, a window pixel collects the light of more or fewer camera pixels than with
        # the fitted map.
        found = found * (self._camera_pixels(warp) / self._camera_pixels(self.window_to_photo))
        found = np.where(_inside(warp, flat.shape, side), found, self.expected)
        # Detail that is finer than the light from the element can form is noise, and it is removed. The
        # contrast of the remaining detail is corrected, because the camera pixels and the pixels of the
        # expected image average over different areas.
        frequency = np.arange(side) / (2 * side * self.pitch_um)
        camera = np.sinc(frequency * self.record.pitch_um).clip(min=0.5)
        sharp = (frequency <= self.finest_per_um) * np.sinc(frequency * self.averaged_um) / camera
        kept: np.ndarray = idctn(dctn(found, norm="ortho") * np.outer(sharp, sharp), norm="ortho")
        return kept


def photographed_image(
    wanted: np.ndarray,
    wanted_pitch_um: float,
    source: PhotoSource,
    finest_per_um: float,
    averaged_um: float = 0.0,
    others: Sequence[np.ndarray] = (),
) -> Photograph:
    """Register a photograph to the expected image, which was predicted for the design.

    The dark level is subtracted, and single hot or dead pixels are replaced by the median of their
    neighbours. Then a model of the camera is fitted by least squares, so that the photograph matches the
    expected image. The parameters of the camera are position, rotation, tilt, gain and background. The scale
    is fitted only if the pitch has an uncertainty, because a fitted scale would conceal that a print makes
    its image too large. All eight orientations are tried. A photograph that fits another orientation better
    than ``orientation`` is rejected.

    Args:
        wanted: expected image in any unit, shape (m, m).
        wanted_pitch_um: side of the pixels of ``wanted``, µm.
        source: greyscale image of any bit depth whose counts are proportional to the light. If the dark level
            is unknown, it is chosen so that the darkest pixels have the expected brightness.
        finest_per_um: highest spatial frequency of the image, 2 NA / wavelength; finer detail is removed.
        averaged_um: side, µm, of the pixels over which the expected image is averaged; the photograph is
            averaged over the same area. Give 0 if the expected image contains values at points.
        others: images behind the prints that other models predict for the same layout, each of shape (m, m).
            They show how far the image may move from printer to printer. This movement is added to the
            uncertainty of the position.

    Raises:
        InputError: the file is not an image, the pitch is not positive or too coarse for the finest detail of
            the image, or the orientation is unknown. The error is also raised if the photograph is
            overexposed or not linear, if it does not resemble the expected image, or if it is mirrored or
            rotated.
    """
    photo_file, pitch_um, pitch_sd = source.path, source.pitch_um, source.pitch_sd
    dark_level, orientation = source.dark_level, source.orientation
    if not pitch_um > 0 or not pitch_sd >= 0:
        raise InputError("camera pitch", got=f"{pitch_um} µm ± {pitch_sd}", wanted="a positive number")
    # The finest fringes need two pixels per period. The limit is rounded down to whole nanometres.
    coarsest_um = math.floor(500 / finest_per_um) / 1000
    if pitch_um > coarsest_um:
        raise InputError(
            "camera pitch",
            got=f"{pitch_um:g} µm, too coarse for the finest detail of the light",
            wanted=f"at most {coarsest_um:g} µm",
            hint="use a higher magnification",
        )
    require_known("camera orientation", orientation, ORIENTATIONS)
    raw, notes = read_grey(photo_file, "photograph")
    photo = raw.astype(np.float32)
    saturated = _saturated(raw)
    may_cut_off = raw.min() == 0 and (dark_level is None or dark_level > 0)
    cut_off = float((raw == 0).mean()) if may_cut_off else 0.0
    if max(saturated, cut_off) > _LARGEST_SATURATED:
        raise InputError(
            f"photograph {photo_file}",
            got=f"{100 * max(saturated, cut_off):.1f} % of its pixels at the lowest or highest value",
            wanted=f"at most {100 * _LARGEST_SATURATED:g} %",
            hint="use a shorter exposure" if saturated > cut_off else "raise the black level above the noise",
        )
    cleaned, replaced = _replace_outliers(photo, pitch_um * finest_per_um)
    if source.flat is not None:
        cleaned = _flattened(cleaned, source.flat, dark_level)
    wanted, scale = wanted.astype(np.float32) / wanted.max(), pitch_um / wanted_pitch_um
    ambiguous = _check_orientation(cleaned, wanted, scale, pitch_sd, orientation, photo_file)
    upright = np.ascontiguousarray(orient(cleaned, orientation))
    fit = _fit(upright, wanted, scale, pitch_sd, _print_moves(wanted, others))
    if fit.correlation < _SMALLEST_CORRELATION:
        raise _unlike(photo_file, fit.correlation)
    coverage = float(_inside(fit.window_to_photo, upright.shape, len(wanted)).mean())
    if coverage < _SMALLEST_COVERAGE:
        got = f"{100 * coverage:.0f} % of the image"
        wanted_share = f"at least {100 * _SMALLEST_COVERAGE:.0f} %"
        raise InputError(f"photograph {photo_file}", got=got, wanted=wanted_share)
    # If the print differs from the expected one, its image is bright and dark in other places. The fit can
    # mistake this difference for a gamma other than 1.
    open_gamma = _LARGEST_GAMMA_OFF + 2 * (1 - fit.correlation)
    if abs(math.log(fit.gamma)) > max(open_gamma, 3 * fit.gamma_sd):
        raise InputError(
            f"photograph {photo_file}",
            got=f"counts proportional to the light to the power {fit.gamma:.2f} ± {fit.gamma_sd:.2f}",
            wanted="counts proportional to the light",
            hint="use the camera's raw file, or undo its gamma",
        )
    dark, dark_sd = (dark_level, 0.0) if dark_level is not None else _dark_level(upright, wanted, fit)
    counts = upright - np.float32(dark)
    noise_counts, noise_share = noise_of_light(counts)
    to_window = np.linalg.inv(fit.window_to_photo) @ orientation_matrix(orientation, cleaned.shape)
    record = CameraRecord(
        name=Path(photo_file).name,
        sha256=file_sha256(photo_file),
        pitch_um=pitch_um,
        pitch_sd=pitch_sd,
        dark_level=dark,
        replaced_pixels=replaced,
        saturated_share=saturated,
        correlation=fit.correlation,
        photo_to_window=(to_window / to_window[2, 2]).tolist(),
        orientation=orientation,
        ambiguous=ambiguous,
        noise_counts=noise_counts,
        noise_share=noise_share,
        dark_level_sd=dark_sd,
        position_sd_um=fit.position_sd_px * wanted_pitch_um,
        scale_sd=fit.scale_sd,
        vignetting_sd=_VIGNETTING_SD if source.flat is None else 0.0,
        blur_um=fit.blur_px * wanted_pitch_um,
        gamma=fit.gamma,
        coverage=coverage,
        notes=notes,
    )
    side = len(wanted)
    where, lit, warps = fit.window_to_photo, fit.gain * wanted, fit.other_warps
    return Photograph(counts, where, side, wanted_pitch_um, finest_per_um, averaged_um, record, lit, warps)


def _saturated(raw: np.ndarray) -> float:
    """Return the share of saturated pixels. The pixels with the highest count of the photograph are saturated
    if this count is the end of the range of 8, 10, 12, 14 or 16 bits, or if unusually many pixels have this
    count.
    """
    top = int(raw.max())
    ends = [2**bits - 1 for bits in (8, 10, 12, 14, 16)]
    at_top = float((raw == top).mean())
    # If many pixels have the highest count and few others come close to it, this count is the end of the
    # camera's range.
    beside = float(((raw < top) & (raw >= top - max(1, top // 500))).mean())
    return at_top if top in ends or at_top > max(4 * beside, _LARGEST_SATURATED) else 0.0


def _flattened(photo: np.ndarray, flat_file: str | Path, dark_level: float | None) -> np.ndarray:
    """Divide a photograph by a photograph of uniform light, which is scaled to a mean of 1. The dark level is
    preserved.
    """
    from scipy.ndimage import gaussian_filter

    flat = read_grey(flat_file, "photograph of uniform light")[0].astype(np.float32)
    if flat.shape != photo.shape or dark_level is None or not np.median(flat) > dark_level:
        wanted = f"{photo.shape} px, and counts above a --camera-dark-level that is also given"
        raise InputError("photograph of uniform light", got=f"{flat.shape} px", wanted=wanted)
    light = gaussian_filter(flat - dark_level, 2.0)
    even: np.ndarray = (photo - dark_level) * (light.mean() / light.clip(min=0.05 * light.max()))
    return (even + dark_level).astype(np.float32)


def _dark_level(photo: np.ndarray, wanted: np.ndarray, fit: _Fit) -> tuple[float, float]:
    """Return the dark level with which the darkest pixels have the expected brightness, and the standard
    deviation of the dark level. Window pixels outside the photograph are ignored.
    """
    import cv2

    way: Any = {"flags": cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
    seen: Any = cv2.warpPerspective(photo, fit.window_to_photo, wanted.shape, **way)
    # Noise is averaged over three camera pixels. The expected image must be averaged over the same area,
    # because its dark gaps may be as narrow.
    averaged_px = math.sqrt(2 / 3 / abs(np.linalg.det(fit.window_to_photo)))
    seen = cv2.GaussianBlur(seen, (0, 0), averaged_px)
    blurred = cv2.GaussianBlur(wanted, (0, 0), math.hypot(averaged_px, max(fit.blur_px, 0.5)))
    inside = _inside(fit.window_to_photo, photo.shape, len(wanted))
    shares = [1, 3, 10]
    found, expected = (np.percentile(one[inside], shares) for one in (seen, blurred))
    levels = found - fit.gain * expected
    return float(levels[1]), float(np.ptp(levels)) / 2 + 0.3 * fit.gain * float(expected[1])


def _check_orientation(
    photo: np.ndarray, wanted: np.ndarray, scale: float, pitch_sd: float, asked: str, photo_file: str | Path
) -> list[str]:
    """Return the names of the other orientations in which the photograph fits the expected image as well as
    in the requested orientation.

    Raises:
        InputError: the photograph fits better in another orientation, or it fits in no orientation.
    """
    import cv2

    shrink = max(1, wanted.shape[0] // _SMALL_PX)
    side = wanted.shape[0] // shrink
    small: Any = cv2.resize(wanted, (side, side), interpolation=cv2.INTER_AREA)
    # The photograph is averaged over pixels as large as those of the reduced expected image, so that
    # the noise of the photograph does not influence which orientation fits best.
    finer = max(1, round(wanted.shape[0] / side / scale))
    counts: Any = cv2.blur(photo, (finer, finer)) if finer > 1 else photo
    small_scale = scale * side / wanted.shape[0]
    found = {
        name: _fit(np.ascontiguousarray(orient(counts, name)), small, small_scale, pitch_sd).correlation
        for name in ORIENTATIONS
    }
    best = max(found, key=lambda name: found[name])
    if found[best] < _SMALLEST_CORRELATION:
        raise _unlike(photo_file, found[best])
    if found[asked] < found[best] - _TIE:
        raise InputError(
            f"photograph {photo_file}",
            got=f"an image that fits better after {best} (correlation {found[best]:.2f}) than after {asked} "
            f"({found[asked]:.2f})",
            wanted="an upright photograph",
            hint=f"if the camera and not the print caused this, use --camera-orientation {best}",
        )
    return [name for name in found if name != asked and found[name] > found[asked] - _TIE]


def _unlike(photo_file: str | Path, correlation: float) -> InputError:
    return InputError(
        f"photograph {photo_file}",
        got=f"a correlation of {correlation:.2f} with the expected image in any orientation",
        wanted=f"at least {_SMALLEST_CORRELATION}",
        hint="check the camera pitch; give --camera-pitch-sd if it is uncertain",
    )


def _replace_outliers(photo: np.ndarray, finest_per_px: float) -> tuple[np.ndarray, int]:
    """Replace outliers by the median of their 3 x 3 neighbourhood. An outlier deviates from this median by
    more than a limit, which few pixels reach. If the image may contain detail almost as narrow as a pixel, an
    outlier must also lie above all of its neighbours, or below all of them, by more than the limit.
    ``finest_per_px`` is the highest spatial frequency of the image, in cycles/px.
    """
    import cv2

    lit = photo - np.percentile(photo, 1)
    median = cv2.medianBlur(lit.astype(np.float32), 3)
    difference = lit - median
    spread = 1.4826 * float(np.median(np.abs(difference))) + 1e-6 * float(lit.max())
    # The brightest value is taken from the median-filtered image, so that a hot pixel cannot determine it.
    bright = float(median.max())
    limit = np.maximum(_HOT_SIGMAS * spread, 0.5 * median + 0.05 * bright)
    outliers = np.abs(difference) > limit
    if finest_per_px > _COARSE:
        ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
        outliers &= (lit - cv2.dilate(lit, ring) > limit) | (cv2.erode(lit, ring) - lit > limit)
    return np.where(outliers, photo - difference, photo).astype(np.float32), int(outliers.sum())


@dataclass(frozen=True)
class _Fit:
    """A fitted camera: the map from window pixels to photograph pixels (a matrix of shape (3, 3)), the pairs
    of maps ``other_warps`` (see ``Photograph``), and the other parameters of the camera with their standard
    deviations.
    """

    window_to_photo: np.ndarray
    correlation: float
    gain: float = 1.0
    position_sd_px: float = math.inf
    scale_sd: float = 0.0
    gamma: float = 1.0
    gamma_sd: float = 0.0
    blur_px: float = 0.0
    other_warps: list[list[np.ndarray]] = field(default_factory=list)
    steps_px: np.ndarray = field(default_factory=lambda: np.zeros(6))
    scatter_px2: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))


def _print_moves(wanted: np.ndarray, others: Sequence[np.ndarray]) -> np.ndarray:
    """Return how far the image moves from printer to printer, as a covariance of the six parameters of the
    pose, px², shape (6, 6).

    The covariance is the mean over the other models. Typical movements count as those of one more model.
    ``others`` is as in ``photographed_image``.
    """
    found = [np.diag((_PRINT_MOVES_SD * len(wanted) / 2) ** 2)]
    for image in others:
        # With a relative uncertainty of 1, the scale is practically free.
        fit = _fit((image / image.max()).astype(np.float32), wanted, 1.0, 1.0, np.zeros((6, 6)))
        found.append(np.outer(fit.steps_px, fit.steps_px) - fit.scatter_px2)
    sizes, ways = np.linalg.eigh(np.mean(found, axis=0))
    return ways * sizes.clip(0) @ ways.T


def _fit(photo: Any, wanted: Any, scale: float, pitch_sd: float, moves_px2: np.ndarray | None = None) -> _Fit:
    """Fit a camera, so that its photograph of the expected image is as close as possible to ``photo``. If
    ``moves_px2`` is given (see ``_print_moves``), the tilt of the camera and the relation between counts and
    light are also fitted, and the fit has a higher accuracy.
    """
    import cv2

    side, blur_px = wanted.shape[0], 2 * max(1.0, scale)
    fixed = cv2.GaussianBlur(wanted, (0, 0), blur_px)
    smooth = cv2.GaussianBlur(photo, (0, 0), blur_px / scale)
    pose = np.zeros(6)

    def seen(image: Any, pose: np.ndarray) -> np.ndarray:
        warp = _camera(pose, photo.shape, side, scale)
        found: np.ndarray = cv2.warpPerspective(
            image, warp, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return found.astype(np.float64)

    pose[:2] = _shift_px(fixed, seen(smooth, pose))
    free = [0, 1, 2] + ([3] if pitch_sd else [])
    # If the angle, the log scale or a tilt changes by 1, the edge of the window moves by half a window.
    unit = np.array([1, 1, *[2 / side] * 4])
    # The images are blurred, so residuals of neighbouring pixels are correlated. This number of pixels counts
    # as one independent pixel.
    alike = 4 * math.pi * blur_px**2
    # The fit ends when a step reduces the sum of squares by less than this share. If only the correlation is
    # needed, 1e-4 is accurate enough.
    close = 1e-4 if moves_px2 is None else 1e-8

    def solved(columns: list[int], image: Any, model: Any, start: np.ndarray, known: dict[int, float]) -> Any:
        target = (model - model.mean()) / model.std()

        def residual(step: np.ndarray) -> np.ndarray:
            at = start.copy()
            at[columns] += step * unit[columns]
            one = seen(image, at)
            off = (one - one.mean()) / max(float(one.std()), 1e-12) - target
            # These residuals express prior knowledge of scale or tilts.
            prior = [at[column] / sd for column, sd in known.items()]
            return np.append(off.ravel() / math.sqrt(alike), prior)

        def slopes(step: np.ndarray) -> np.ndarray:
            # The derivatives use steps of half a pixel, because cv2 resolves positions only to 1/32 of a
            # pixel.
            ways = 0.5 * np.eye(len(columns))
            return np.stack([residual(step + way) - residual(step - way) for way in ways], axis=1)

        found = least_squares(
            residual, np.zeros(len(columns)), jac=slopes, method="lm", max_nfev=60, ftol=close, xtol=close
        )  # fmt: skip
        at = start.copy()
        at[columns] += found.x * unit[columns]
        return at, found

    # The fit starts with more strongly blurred images. With their fine structure, it could end in a false
    # optimum next to the right one.
    for more in (4 * blur_px, 0.0):
        images = smooth, fixed
        if more:
            images = cv2.GaussianBlur(smooth, (0, 0), more / scale), cv2.GaussianBlur(fixed, (0, 0), more)
        pose, _ = solved(free, *images, pose, {3: pitch_sd} if pitch_sd else {})

    def placed() -> _Fit:
        correlation = float(np.corrcoef(seen(smooth, pose).ravel(), fixed.ravel())[0, 1])
        return _Fit(_camera(pose, photo.shape, side, scale), correlation)

    if moves_px2 is None:
        return placed()
    free += [4, 5]
    known = {4: _TILT_SD, 5: _TILT_SD}
    if pitch_sd:
        # Without this, a print whose image resembles the expected one little may fit best at a wrong scale.
        known[3] = math.hypot(pitch_sd, math.sqrt(moves_px2[3, 3]) * unit[3])
    pose, found = solved(free, smooth, fixed, pose, known)
    scatter = covariance_by_tiles(found.jac, found.fun, (side, side))
    steps_px, scatter_px2 = pose / unit, np.zeros((6, 6))
    scatter_px2[np.ix_(free, free)] = scatter
    spread = scatter + moves_px2[np.ix_(free, free)]
    scale_sd = 0.0
    if pitch_sd:
        # The photograph shows the scale of the camera times that of the print. Both are known to be close to
        # 1, so the most probable scale of the camera is closer to 1 (linear Bayesian update).
        share = spread[:, 3] / (spread[3, 3] + (pitch_sd / unit[3]) ** 2)
        pose[free] -= share * pose[3] / unit[3] * unit[free]
        spread -= np.outer(share, spread[3])
        scale_sd = float(np.sqrt(spread[3, 3]) * unit[3])
    fit = placed()
    if not fit.correlation > 0:
        return fit
    # One pair of maps for each independent movement of the camera.
    variance, ways = np.linalg.eigh(spread)
    steps = np.zeros((len(free), len(pose)))
    steps[:, free] = (ways * np.sqrt(variance.clip(0))).T * unit[free]
    return replace(
        fit,
        other_warps=[
            [_camera(at, photo.shape, side, scale) for at in (pose + one, pose - one)] for one in steps
        ],
        position_sd_px=float(np.sqrt(np.diag(spread)[:2].mean())),
        scale_sd=scale_sd,
        steps_px=steps_px,
        scatter_px2=scatter_px2,
        **_light(seen(photo, pose), wanted, alike),
    )


def _light(seen: np.ndarray, expected: np.ndarray, alike: float) -> dict[str, Any]:
    """Fit the counts by least squares as background + gain * (blurred expected light)^gamma."""
    import cv2

    found = {}
    for blur_px in np.arange(0.25, 4.1, 0.25).tolist():
        light = cv2.GaussianBlur(expected, (0, 0), blur_px).clip(1e-6).ravel()
        gamma = 1.0
        for _ in range(2):
            bent = light**gamma
            matrix = np.stack([np.ones_like(light), bent, bent * np.log(light)], axis=1)
            inverse = np.linalg.inv(matrix.T @ matrix)
            part = inverse @ (matrix.T @ seen.ravel())
            left = float(np.square(seen.ravel() - matrix @ part).mean())
            gamma = float(np.clip(gamma + part[2] / part[1], 0.3, 3.0))
        plain = np.polyfit(light, seen.ravel(), 1)
        sd = math.sqrt(inverse[2, 2] * left * alike) / abs(part[1])
        found[left] = {"gain": float(plain[0]), "gamma": gamma, "gamma_sd": sd, "blur_px": blur_px}
    return found[min(found)]


def _camera(pose: np.ndarray, shape: tuple[int, ...], side: int, scale: float) -> np.ndarray:
    """Return the map from window pixels to photograph pixels, a matrix of shape (3, 3), for a camera with the
    given pose. The pose consists of a shift (two values, px), a rotation, the logarithm of the scale and two
    tilts.
    """
    turn, size, half = pose[2], math.exp(-pose[3]) / scale, (side - 1) / 2
    centre = (np.array(shape[1::-1]) - 1) / 2
    cos, sin = size * math.cos(turn), size * math.sin(turn)
    linear = np.array([[cos, -sin, centre[0]], [sin, cos, centre[1]], [0, 0, 1]])
    tilted = np.array([[1, 0, 0], [0, 1, 0], [pose[4] / half, pose[5] / half, 1]])
    start = np.array([[1, 0, pose[0] - half], [0, 1, pose[1] - half], [0, 0, 1]])
    return linear @ tilted @ start


def _inside(warp: np.ndarray, shape: tuple[int, ...], side: int) -> np.ndarray:
    """Return a boolean mask, shape (side, side), which is True at window pixels inside the photograph."""
    import cv2

    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(np.ones(shape[:2], np.uint8), warp, (side, side), flags=flags) > 0


def _radius_squared(shape: tuple[int, ...]) -> np.ndarray:
    """Return the squared distance from the middle of a photograph, scaled to 1 in the corners."""
    y, x = (np.linspace(-1, 1, size) for size in shape)
    return (y[:, None] ** 2 + x**2) / 2


def _shift_px(reference: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Return the shift (x, y) of the image ``moving``, in whole pixels, at which its correlation with the
    image ``reference`` is largest. Both images have shape (n, n).
    """
    correlation = correlate(moving - moving.mean(), reference - reference.mean(), method="fft")
    y, x = np.unravel_index(int(correlation.argmax()), correlation.shape)
    return np.array([x, y]) - (len(reference) - 1)
