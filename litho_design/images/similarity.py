"""Measures of similarity between two images, with their definitions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

SSIM_WINDOW_PX = 11


def matched_scale(image: Tensor, target: Tensor) -> Tensor:
    """Return the factor c = sum(I T) / sum(I^2) that brings ``image`` closest to ``target``."""
    return (image * target).sum() / image.square().sum().clamp(min=torch.finfo(image.dtype).tiny)


def si_psnr_db(image: Tensor, target: Tensor) -> float:
    """Return the scale-invariant PSNR, -10 log10 mean((c I - T)^2), where c is ``matched_scale``. The peak
    value is 1 by definition.
    """
    error = (matched_scale(image, target) * image - target).square().mean()
    return float(-10 * torch.log10(error.clamp(min=1e-30)))


def paper_rmse(image: Tensor, target: Tensor) -> Tensor:
    """Return the RMSE between I / I_avg and T, where I is the image and T the target. I_avg = sum(I T) /
    sum(T) is the mean of I, weighted with T.
    """
    average = (image * target).sum() / target.sum()
    return (image / average - target).square().mean().sqrt()


def ssim(image: Tensor, target: Tensor) -> float:
    """Return the structural similarity of two images in [0, 1], the mean of ``ssim_map``.

    Pixels whose window extends beyond the edge are left out.
    """
    edge = SSIM_WINDOW_PX // 2
    found = ssim_map(image.double().cpu().numpy(), target.double().cpu().numpy())
    return float(found[edge:-edge, edge:-edge].mean())


def ssim_map(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the SSIM of two images in [0, 1] at each pixel, with a window of 11 px and sigma 1.5 (Wang et
    al. 2004).
    """
    from skimage.metrics import structural_similarity

    found: np.ndarray = structural_similarity(
        image,
        target,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]
    return found


def likeness(image: Tensor, target: Tensor, resolved: Tensor) -> dict[str, float]:
    """Return the SI-PSNR and the SSIM of an image. The image is compared with its target, and also with the
    target blurred to the resolution of the element. All images have shape (m, m).
    """
    figures = {}
    for name, wanted in (("", target), ("_resolved", resolved)):
        scaled = matched_scale(image, wanted) * image
        figures[f"si_psnr{name}_db"] = si_psnr_db(image, wanted)
        figures[f"ssim{name}"] = ssim(scaled.clamp(0, 1), wanted)
    return figures


def similarity(estimate: Tensor, wanted: Tensor, name: str) -> dict[str, float]:
    """Compare an estimate with the true object ``wanted``, which has values in [0, 1], and return the scores
    ``mae_NAME``, ``psnr_NAME_db`` and ``ssim_NAME``, where NAME is ``name``. Both images have shape (n, n).

    For PSNR and SSIM, the estimate is clipped to [0, 1].
    """
    clipped = estimate.clamp(0, 1)
    error = (clipped - wanted).square().mean().clamp(min=1e-12)
    return {
        f"mae_{name}": float((estimate - wanted).abs().mean()),
        f"psnr_{name}_db": float(-10 * torch.log10(error)),
        f"ssim_{name}": ssim(clipped, wanted),
    }


def light_figures(share: Tensor, target: Tensor) -> dict[str, float]:
    """Return the shares of the incident power in the whole image and on its signal, and measures of
    uniformity and contrast. The signal consists of the pixels whose target exceeds 0.5. Both arguments have
    shape (m, m).
    """
    lit, dark = share[target > 0.5], share[target <= 0.5]
    # torch.quantile accepts at most 16 million values.
    low, high = np.quantile(lit.detach().cpu().numpy(), (0.05, 0.95)).tolist()
    return {
        "eff_signal": float(lit.sum()),
        "eff_window": float(share.sum()),
        "speckle_contrast": float(lit.std(correction=0) / lit.mean()),
        "uniformity": 1 - (high - low) / (high + low),
        "background_ratio": float(lit.mean() / dark.mean().clamp(min=1e-12)),
    }
