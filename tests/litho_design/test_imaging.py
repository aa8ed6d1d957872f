"""Test incoherent imaging and Richardson-Lucy deconvolution."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d

from litho_design.images.targets import draw_target
from litho_design.optics import imaging
from litho_design.optics.imaging import Blur, bin_pixels, richardson_lucy

pytestmark = pytest.mark.numerics


def gaussian_psf(size, sigma, energy=1.0, shift=(0.0, 0.0)):
    x = torch.arange(size, dtype=torch.float64) - size // 2
    psf = torch.exp(-((x[:, None] - shift[0]) ** 2 + (x[None, :] - shift[1]) ** 2) / (2 * sigma**2))
    return psf * (energy / psf.sum())


# The last PSF is more than twice as wide as the frame, so that its rim never overlaps the image.
@pytest.mark.parametrize(("rows", "columns"), [(7, 9), (19, 27), (43, 61)])
def test_blur_is_a_linear_convolution_and_its_transpose(rows, columns):
    generator = torch.Generator().manual_seed(0)
    psf = torch.rand((rows, columns), generator=generator).double()
    image, other = torch.rand((2, 20, 25), generator=generator).double()
    blur = Blur(psf, (20, 25))
    expected = convolve2d(image.numpy(), psf.numpy(), mode="full")
    expected = expected[rows // 2 :, columns // 2 :][:20, :25]
    # The sums have up to 500 products below one, in double precision.
    assert np.abs(blur.forward(image).numpy() - expected).max() < 1e-11
    left, right = (blur.forward(image) * other).sum(), (image * blur.transpose(other)).sum()
    assert float(left) == pytest.approx(float(right), rel=1e-12)


def test_binning_keeps_the_power():
    image = torch.rand(12, 12).double()
    assert float(bin_pixels(image, 3).sum()) == pytest.approx(float(image.sum()), rel=1e-12)


@pytest.mark.parametrize(("size", "energy"), [(40, 0.3), (41, 1.0), (41, 2.0)])
def test_richardson_lucy_finds_the_object_for_any_psf_energy(energy, size):
    wanted = torch.zeros(size, size).double()
    wanted[size // 2 - 6 : size // 2 - 2, 12:20] = 1
    wanted[25, 25] = 4
    psf = gaussian_psf(9, 0.9, energy)
    seen = Blur(psf, (size, size)).forward(wanted)
    estimate = richardson_lucy(seen, psf, iterations=2000)
    # Every step conserves flux, so a wrong factor of the energy is noticed at once.
    assert float(Blur(psf, (size, size)).forward(estimate).sum()) == pytest.approx(
        float(seen.sum()), rel=1e-4
    )
    assert float(estimate.sum()) == pytest.approx(float(wanted.sum()), rel=1e-4)
    # After 2000 steps, the error is a few thousandths of the brightest pixel, whatever the energy.
    assert float((estimate - wanted).abs().max()) < 0.01
    rows = torch.arange(size).double()
    for axis in (0, 1):
        centroid = [(image.sum(1 - axis) * rows).sum() / image.sum() for image in (estimate, wanted)]
        assert float(centroid[0] - centroid[1]) == pytest.approx(0, abs=1e-3)


def test_richardson_lucy_equals_scikit_image_away_from_the_border():
    from skimage.restoration import richardson_lucy as reference

    wanted = np.zeros((64, 64))
    wanted[24:40, 24:40] = draw_target("chart", 16)
    psf = gaussian_psf(7, 1.0)
    seen = Blur(psf, (64, 64)).forward(torch.from_numpy(wanted)) + 1e-3
    ours = richardson_lucy(seen, psf, iterations=10)
    theirs = reference(seen.numpy(), psf.numpy(), num_iter=10, clip=False)
    # The effect of the different flat starts decays. The reference ignores H^T 1, which is 1 only inside.
    middle = slice(20, 44)
    assert np.abs(ours.numpy() - theirs)[middle, middle].max() < 0.05 * theirs.max()


def test_gradient_through_the_reconstruction_kept_and_computed_again(monkeypatch):
    psf = gaussian_psf(5, 0.8).requires_grad_()
    wanted = torch.rand(8, 8, generator=torch.Generator().manual_seed(0)).double() + 0.1

    def error(kernel):
        seen = Blur(kernel, (8, 8)).forward(wanted)
        return (richardson_lucy(seen, kernel, iterations=12) - wanted).square().mean()

    assert torch.autograd.gradcheck(error, (psf,), atol=1e-7)
    (kept,) = torch.autograd.grad(error(psf), psf)
    monkeypatch.setattr(imaging, "_MOST_KEPT_BYTES", 0)
    (again,) = torch.autograd.grad(error(psf), psf)
    # Both use the same operations in the same order.
    assert torch.equal(again, kept)
