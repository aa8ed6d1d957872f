"""A photograph that is registered to the expected image, which was predicted for the design."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.foundation.results import Record
from litho_design.images.camera_fit import inside_photograph
from litho_design.images.camera_pose import resampled
from litho_design.images.noise import DRAWS
from litho_design.images.targets import ImagedObject

# Limit of |log(gamma)| above which a remark is made. The counts are proportional to light^gamma. Even for
# prints close to the expected one, the fitted gamma lies between 0.9 and 1.1, not exactly at 1.
_OPEN_GAMMA_OFF = 0.1
# Standard deviation of the unknown part of a photograph's blur, as a share of the whole blur.
_BLUR_SD = 0.2


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

    def with_other_cameras(self) -> Iterator[np.ndarray]:
        """Yield pairs of images in which one property of the camera differs by plus and minus its standard
        deviation. The properties are the independent movements of the camera, its blur and, unless they are
        known, the vignetting and the dark level.
        """
        yield from (self._warped(self.counts, warp) for pair in self.other_warps for warp in pair)
        for sign in (1, -1) if self.record.vignetting_sd else ():
            yield self._warped(self.counts, self.window_to_photo, sign * self.record.vignetting_sd)
        for sign in (1, -1) if self.record.dark_level_sd else ():
            darker = self.counts - np.float32(sign * self.record.dark_level_sd)
            yield self._warped(darker, self.window_to_photo)
        # If the photograph is blurrier than the expected image, the cause may be the camera or the print.
        blurred = gaussian_filter(self.expected, self.record.blur_um / self.pitch_um) - self.expected
        yield from (self.image() + sign * _BLUR_SD * blurred for sign in (1, -1))

    def _camera_pixels(self, warp: np.ndarray) -> float:
        """Return the number of camera pixels per window pixel in the middle of the window."""
        middle = np.array([(self.side_px - 1) / 2, (self.side_px - 1) / 2, 1])
        return float(abs(np.linalg.det(warp) / (warp[2] @ middle) ** 3))

    def _warped(self, counts: np.ndarray, warp: np.ndarray, vignetting: float = 0.0) -> np.ndarray:
        from scipy.fft import dctn, idctn

        side = self.side_px
        flat = counts / (1 - vignetting * _radius_squared(counts.shape))
        found = resampled(flat.astype(np.float32), warp, side, sharp=True)
        # With the map ``warp``, a window pixel collects the light of more or fewer camera pixels than with
        # the fitted map.
        found = found * (self._camera_pixels(warp) / self._camera_pixels(self.window_to_photo))
        found = np.where(inside_photograph(warp, flat.shape, side), found, self.expected)
        # Detail that is finer than the light from the element can form is noise, and it is removed. The
        # contrast of the remaining detail is corrected, because the camera pixels and the pixels of the
        # expected image average over different areas.
        frequency = np.arange(side) / (2 * side * self.pitch_um)
        camera = np.sinc(frequency * self.record.pitch_um).clip(min=0.5)
        sharp = (frequency <= self.finest_per_um) * np.sinc(frequency * self.averaged_um) / camera
        kept: np.ndarray = idctn(dctn(found, norm="ortho") * np.outer(sharp, sharp), norm="ortho")
        return kept


def _radius_squared(shape: tuple[int, ...]) -> np.ndarray:
    """Return the squared distance from the middle of a photograph, scaled to 1 in the corners."""
    y, x = (np.linspace(-1, 1, size) for size in shape)
    return (y[:, None] ** 2 + x**2) / 2
