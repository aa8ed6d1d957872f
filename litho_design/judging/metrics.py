"""Scores of a holographic image, with their definitions written down; all on the printable layout."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.grid import PixelGrid
from litho_data.foundation.results import Record
from litho_design.optics import Optics

SSIM_WINDOW_PX = 11


class CameraView(Record):
    """The camera that looks at the image: its pixel in object space, µm, and the objective's aperture.

    The default is a 3.45 µm pixel behind a 10x / 0.3 objective; the paper does not state its own.
    """

    pitch_um: float = 0.345
    numerical_aperture: float = 0.3


class HologramScore(Record):
    """Efficiencies are shares of the power incident on the element."""

    eff_signal: float
    eff_paper: float
    eff_window: float
    zero_order_share: float
    si_psnr_db: float
    rmse_paper: float
    ssim: float
    clipped_share: float
    ssim_camera: float
    speckle_contrast: float
    uniformity: float
    background_ratio: float


def hologram_score(
    field: Tensor, element: Tensor, target: Tensor, grid: PixelGrid, optics: Optics, camera: CameraView
) -> HologramScore:
    """Score the wave in the image plane against the wanted image.

    S = {T > 0.5}; scale before comparison c = sum(I T) / sum(I^2); SSIM with an 11 px Gaussian
    window, sigma 1.5, data range 1, on c I clipped to [0, 1].

    Args:
        field: complex (m, m) in the image plane, for unit incident power, 1/µm.
        element: complex (n, n) just behind the element on the same pixels; its mean gives the
            zero order, the share of power that goes straight on as a plane wave.
        target: real (m, m) in [0, 1].
        grid: geometry of ``field``.
    """
    area = math.prod(grid.pitch_um)
    share = field.abs().square().double() * area
    wanted = target.double()
    signal = wanted > 0.5
    scaled = matched_scale(share, wanted) * share
    lit, dark = share[signal], share[~signal]
    low, high = (float(torch.quantile(lit, q)) for q in (0.05, 0.95))
    return HologramScore(
        eff_signal=float(lit.sum()),
        eff_paper=float(share[wanted > 0].sum()),
        eff_window=float(share.sum()),
        zero_order_share=zero_order_share(element),
        si_psnr_db=si_psnr_db(share, wanted),
        rmse_paper=float(paper_rmse(share, wanted)),
        ssim=ssim(scaled.clamp(0, 1), wanted),
        clipped_share=float((scaled > 1).double().mean()),
        ssim_camera=_camera_ssim(field, wanted, grid, optics, camera),
        speckle_contrast=float(lit.std(correction=0) / lit.mean()),
        uniformity=1 - (high - low) / (high + low),
        background_ratio=float(lit.mean() / dark.mean()),
    )


def matched_scale(image: Tensor, target: Tensor) -> Tensor:
    """The factor c = sum(I T) / sum(I^2) that brings ``image`` closest to ``target``."""
    return (image * target).sum() / image.square().sum().clamp(min=torch.finfo(image.dtype).tiny)


def si_psnr_db(image: Tensor, target: Tensor) -> float:
    """-10 log10 mean((c I - T)^2): unchanged by any scale of the image; peak is 1 by definition."""
    error = (matched_scale(image, target) * image - target).square().mean()
    return float(-10 * torch.log10(error.clamp(min=1e-30)))


def paper_rmse(image: Tensor, target: Tensor) -> Tensor:
    """RMSE of I / I_avg against T, with I_avg = sum(I T) / sum(T), the mean over the wanted light."""
    average = (image * target).sum() / target.sum()
    return (image / average - target).square().mean().sqrt()


def ssim(image: Tensor, target: Tensor) -> float:
    """Structural similarity of two images in [0, 1] (Wang et al. 2004), window 11, sigma 1.5.

    Windows that reach over the edge do not count.
    """
    from skimage.metrics import structural_similarity

    return float(
        structural_similarity(
            image.double().cpu().numpy(),
            target.double().cpu().numpy(),
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def zero_order_share(element: Tensor) -> float:
    """Share of the power behind the element that is its mean: the undiffracted plane wave."""
    power = element.abs().square().double().mean()
    return float(element.to(torch.complex128).mean().abs().square() / power)


def _camera_ssim(field: Tensor, target: Tensor, grid: PixelGrid, optics: Optics, camera: CameraView) -> float:
    import cv2

    seen = through_aperture(field, grid, optics.wavelength_um, camera.numerical_aperture).abs().square()
    pixels = tuple(max(SSIM_WINDOW_PX, round(size / camera.pitch_um)) for size in reversed(grid.size_um))

    def sample(image: Tensor) -> Tensor:
        return torch.from_numpy(
            cv2.resize(image.double().cpu().numpy(), pixels, interpolation=cv2.INTER_AREA)
        )

    image, wanted = sample(seen), sample(target)
    return ssim((matched_scale(image, wanted) * image).clamp(0, 1), wanted)


def through_aperture(
    field: Tensor, grid: PixelGrid, wavelength_um: float, numerical_aperture: float
) -> Tensor:
    """The field after an ideal objective: spatial frequencies above NA / wavelength removed.

    The window is mirrored once so that its edges do not meet across the period of the transform.
    """
    rows, columns = field.shape
    mirrored = torch.cat([field, field.flip(0)], 0)
    mirrored = torch.cat([mirrored, mirrored.flip(1)], 1)
    fy, fx = (np.fft.fftfreq(2 * n, p) for n, p in zip((rows, columns), grid.pitch_um, strict=True))
    passed = torch.from_numpy(np.hypot(fy[:, None], fx[None, :]) <= numerical_aperture / wavelength_um)
    filtered = torch.fft.ifft2(torch.fft.fft2(mirrored) * passed.to(field.device))
    return filtered[:rows, :columns]
