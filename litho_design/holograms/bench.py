"""The optics of a holographic element, which turn a printed height map into an image and its score."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from litho_data.foundation.grid import PixelGrid
from litho_data.foundation.results import Record
from litho_design.images.similarity import (
    SSIM_WINDOW_PX,
    light_figures,
    likeness,
    matched_scale,
    paper_rmse,
    ssim,
)
from litho_design.optics import Optics, element_field
from litho_design.optics.thin_element import flat_field
from litho_design.tasks.bench import ElementBench

# Side of a camera pixel in the image plane, and NA. The paper does not state its camera, so pixels of 3.45 µm
# behind an objective with a magnification of 10 and an NA of 0.3 are assumed.
_CAMERA_PITCH_UM, _CAMERA_NA = 0.345, 0.3

Waves = Sequence[tuple[float, Tensor]]


class HologramBench(ElementBench):
    """Compute the image behind a holographic element, and the score of this image."""

    @torch.no_grad()
    def score(self, height_um: Tensor, target: Tensor) -> HologramScore:
        """Compare the image behind printed heights, µm, with the target image, and return the scores. Both
        arguments have shape (size, size).
        """
        element = element_field(height_um, self.grid, self.optics)
        waves = list(self.waves(height_um))
        return hologram_score(waves, element, target, self.grid, self.optics)

    def resolved(self, target: Tensor) -> Tensor:
        """Return the target image of shape (size, size), blurred to the resolution of the element."""
        return at_resolution(target, self.grid, self.optics)


class HologramScore(Record):
    """The score of a hologram; efficiencies are shares of the power incident on the element."""

    eff_signal: float = Field(description="share of the incident power on the signal (T > 0.5)")
    eff_paper: float = Field(description="share of the incident power where T > 0")
    eff_window: float = Field(description="share of the incident power in the window")
    zero_order_share: float = Field(description="share of the incident power in the zero order")
    si_psnr_db: float = Field(description="scale-invariant PSNR, dB")
    rmse_paper: float = Field(description="RMSE of the image, scaled as in the paper")
    ssim: float = Field(description="SSIM")
    si_psnr_resolved_db: float = Field(
        description="scale-invariant PSNR relative to the target at the element's resolution, dB"
    )
    ssim_resolved: float = Field(description="SSIM against the target at the element's resolution")
    clipped_share: float = Field(description="share of pixels that are clipped before SSIM is computed")
    ssim_camera: float = Field(description="SSIM of the image as a camera records it")
    speckle_contrast: float = Field(description="speckle contrast (standard deviation / mean) on the signal")
    uniformity: float = Field(description="uniformity on the signal")
    background_ratio: float = Field(
        description="mean intensity of the signal divided by that of the background"
    )


class WindowedHologramScore(HologramScore):
    """The score of a hologram with a signal window. The loss and ``si_psnr_window_db`` ignore light outside
    the window, but the other scores count such light as an error.
    """

    si_psnr_window_db: float = Field(description="scale-invariant PSNR inside the signal window, dB")


def hologram_score(
    waves: Waves, element: Tensor, target: Tensor, grid: PixelGrid, optics: Optics
) -> HologramScore:
    """Compare the summed intensity of the waves in the image plane with the target image, and return the
    scores.

    The signal consists of the pixels whose target T exceeds 0.5. Before the comparison, the image I is scaled
    by c = sum(I T) / sum(I^2). SSIM is computed on the scaled image, clipped to [0, 1], with a Gaussian
    window of 11 px and sigma 1.5, and a data range of 1.

    Args:
        waves: one pair (share, field) for each wave. The first item is the share of the light in this wave.
            The second is the complex field of the wave in the image plane for unit incident power, in 1/µm, a
            tensor of shape (m, m).
        element: complex field just behind the element, shape (m, m), from which the zero order is computed.
        target: target image with values in [0, 1], shape (m, m).
        grid: grid of the pixels in the image plane. The element has the same grid.
    """
    area = math.prod(grid.pitch_um)
    share = _added(waves) * area
    wanted = target.double()
    scaled = matched_scale(share, wanted) * share
    return HologramScore(
        **light_figures(share, wanted),
        eff_paper=float(share[wanted > 0].sum()),
        zero_order_share=zero_order_share(element, grid, optics),
        **likeness(share, wanted, at_resolution(wanted, grid, optics)),
        rmse_paper=float(paper_rmse(share, wanted)),
        clipped_share=float((scaled > 1).double().mean()),
        ssim_camera=camera_ssim(waves, wanted, grid, optics),
    )


def at_resolution(target: Tensor, grid: PixelGrid, optics: Optics) -> Tensor:
    """Blur a target image of shape (m, m) to the resolution of an element of the same size.

    The target is convolved with the intensity in the focus of a square aperture, sinc^2(2 NA x / wavelength)
    along both axes. NA is the sine of the angle, seen from the image, between the axis and the middle of an
    edge of the element (see ``Optics.edge_sine``). The target is treated as dark outside its window.
    """
    blurs = []
    for size_um, pitch_um, count in zip(grid.size_um, grid.pitch_um, grid.shape, strict=True):
        aperture = optics.edge_sine(size_um / 2)
        x = torch.arange(1 - count, count, dtype=target.dtype, device=target.device) * pitch_um
        focus = torch.sinc(2 * aperture * x / optics.wavelength_um).square()
        # Each blur is a matrix whose row i contains the weights of all pixels in the blurred pixel i. Two
        # matrix products, one per axis, replace long convolutions.
        blurs.append((focus / focus.sum()).unfold(0, count, 1).flip(1))
    return blurs[0] @ target @ blurs[1].T


def zero_order_share(element: Tensor, grid: PixelGrid, optics: Optics) -> float:
    """Return the share of the power behind the element that is in the zero order, i.e. not diffracted.

    This is |sum u conj(i)|^2 / (sum |u|^2 sum |i|^2), where u is the wave behind the element and i the wave
    behind a flat element. ``element`` contains u on the pixels of ``grid``.
    """
    light = flat_field(grid, optics).to(element.device)
    overlap = (element * light.conj()).sum().abs().square()
    return float(overlap / (element.abs().square().double().sum() * light.abs().square().sum()))


def _added(waves: Waves) -> Tensor:
    found = [share * wave.abs().square().double() for share, wave in waves]
    return sum(found[1:], found[0])


def camera_ssim(waves: Waves, target: Tensor, grid: PixelGrid, optics: Optics) -> float:
    """Return the SSIM between a camera image of the waves and the target. Both are sampled on the pixels of
    the camera.
    """
    import cv2

    seen = _added(
        [(share, through_aperture(wave, grid, optics.wavelength_um, _CAMERA_NA)) for share, wave in waves]
    )
    pixels = tuple(max(SSIM_WINDOW_PX, round(size / _CAMERA_PITCH_UM)) for size in reversed(grid.size_um))

    def sample(image: Tensor) -> Tensor:
        return torch.from_numpy(
            cv2.resize(image.double().cpu().numpy(), pixels, interpolation=cv2.INTER_AREA)
        )

    image, wanted = sample(seen), sample(target)
    return ssim((matched_scale(image, wanted) * image).clamp(0, 1), wanted)


def through_aperture(
    field: Tensor, grid: PixelGrid, wavelength_um: float, numerical_aperture: float
) -> Tensor:
    """Return the field after an ideal objective, which removes spatial frequencies above NA / wavelength.

    The field is extended by its mirror image before the Fourier transform, because the transform is periodic
    and would otherwise join opposite edges.
    """
    rows, columns = field.shape
    mirrored = torch.cat([field, field.flip(0)], 0)
    mirrored = torch.cat([mirrored, mirrored.flip(1)], 1)
    fy, fx = (np.fft.fftfreq(2 * n, p) for n, p in zip((rows, columns), grid.pitch_um, strict=True))
    passed = torch.from_numpy(np.hypot(fy[:, None], fx[None, :]) <= numerical_aperture / wavelength_um)
    filtered = torch.fft.ifft2(torch.fft.fft2(mirrored) * passed.to(field.device))
    return filtered[:rows, :columns]
