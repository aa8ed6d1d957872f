"""Check the Gaussian blur: closed forms, derivatives with respect to the width, and edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from litho_data.foundation.errors import InputError
from litho_models.layers.gaussian import gaussian_blur, kernel_radius_px, pad_field

pytestmark = pytest.mark.numerics

PITCH = 0.1


def blur_interior(field, sigma_px, radius_px):
    """Blur a field, and return only the pixels whose kernel lies completely inside the field."""
    return gaussian_blur(field, sigma_px, 1.0, edge=None, radius_px=radius_px)


@pytest.mark.parametrize("edge", ["replicate", "zero"])
@pytest.mark.parametrize("sigma_um", [0.1, 0.25, 0.9])
def test_agrees_with_an_independent_implementation(edge, sigma_um):
    field = np.random.default_rng(0).uniform(0, 1, (90, 110))
    mode = {"replicate": "nearest", "zero": "constant"}[edge]
    wanted = gaussian_filter(
        field, sigma_um / PITCH, mode=mode, truncate=kernel_radius_px(sigma_um / PITCH) / (sigma_um / PITCH)
    )
    got = gaussian_blur(torch.from_numpy(field), sigma_um, PITCH, edge=edge)
    assert np.abs(got.numpy() - wanted).max() < 1e-12


def test_a_field_that_continues_is_blurred_the_same_with_and_without_its_border():
    field = torch.rand(1, 1, 70, 90, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    for sigma_um in (0.2, (0.2, 0.7)):
        sigmas = sigma_um if isinstance(sigma_um, tuple) else (sigma_um, sigma_um)
        radii = tuple(kernel_radius_px(sigma / PITCH) for sigma in sigmas)
        widths = tuple(torch.tensor(sigma / PITCH, dtype=torch.float64) for sigma in sigmas)
        bordered = blur_interior(pad_field(field, *radii), widths, radii)
        assert float((gaussian_blur(field, sigma_um, PITCH) - bordered).abs().max()) < 1e-14


def test_attenuates_a_grating_as_the_fourier_transform_of_a_gaussian():
    sigma_um, period_um = 0.3, 1.6
    x = torch.arange(400, dtype=torch.float64) * PITCH
    grating = torch.cos(2 * math.pi * x / period_um).expand(20, 400)
    blurred = gaussian_blur(grating, sigma_um, PITCH)[10, 100:300]
    gain = blurred.max() / 1.0
    # Truncation at four sigma removes 6e-5 of the weight.
    assert float(gain) == pytest.approx(math.exp(-2 * (math.pi * sigma_um / period_um) ** 2), abs=2e-4)


def test_widths_add_in_quadrature():
    field = torch.zeros(1, 1, 121, 121, dtype=torch.float64)
    field[..., 60, 60] = 1
    twice = gaussian_blur(gaussian_blur(field, 0.3, PITCH), 0.4, PITCH)
    once = gaussian_blur(field, 0.5, PITCH)
    # Both kernels are truncated at four sigma, at exp(-8) = 3e-4 of their peak of 1/(2π 25).
    assert float((twice - once).abs().max()) < 3e-4 * float(once.max()) * 2


def test_anisotropic_blur_has_its_own_width_per_axis():
    field = torch.zeros(81, 81, dtype=torch.float64)
    field[40, 40] = 1
    spot = gaussian_blur(field, (0.2, 0.4), PITCH)
    offset = (torch.arange(81, dtype=torch.float64) - 40) * PITCH
    variance_y = float((spot.sum(1) * offset**2).sum())
    variance_x = float((spot.sum(0) * offset**2).sum())
    # Truncation at four sigma reduces the variance by 0.1 %.
    assert variance_y == pytest.approx(0.04, rel=2e-3)
    assert variance_x == pytest.approx(0.16, rel=2e-3)


def test_derivative_with_respect_to_the_width_matches_finite_differences():
    field = torch.rand(1, 1, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    weight = torch.rand(1, 1, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    sigma = torch.tensor(0.33, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad((weight * gaussian_blur(field, sigma, PITCH)).sum(), sigma)
    step = 1e-5
    high, low = (float((weight * gaussian_blur(field, 0.33 + s, PITCH)).sum()) for s in (step, -step))
    # The error of a central difference is of order step², plus a rounding error of 1e-13/1e-5.
    assert float(gradient) == pytest.approx((high - low) / (2 * step), rel=1e-6)


def test_the_width_may_move_through_a_change_of_support_without_a_jump():
    field = torch.rand(1, 1, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    # At a width of 0.25 µm, four sigma are exactly 10 px. Just above, the kernel is one pixel longer.
    below, above = gaussian_blur(field, 0.2499999, PITCH), gaussian_blur(field, 0.2500001, PITCH)
    # The added ring is exp(-0.5 (11/2.5)²) = 6e-5 of the peak, and has 1e-5 of the sum.
    assert float((below - above).abs().max()) < 5e-5


def test_uniform_fields_and_zero_width_are_left_alone():
    field = torch.full((1, 1, 30, 30), 0.7)
    assert torch.allclose(gaussian_blur(field, 0.4, PITCH), field, atol=1e-6)
    rough = torch.rand(1, 1, 30, 30)
    assert torch.equal(gaussian_blur(rough, 0.0, PITCH), rough)


def test_bad_pitch_is_refused():
    with pytest.raises(InputError):
        gaussian_blur(torch.zeros(8, 8), 0.1, 0.0)


def test_a_field_without_pixels_is_refused():
    with pytest.raises(InputError, match="one pixel or more"):
        gaussian_blur(torch.zeros(0, 8), 0.1, 0.1)
    with pytest.raises(InputError, match="one pixel or more"):
        blur_interior(torch.zeros(0, 1, 20, 20), torch.tensor(1.0), 4)
    with pytest.raises(InputError, match="more than 8 px"):
        blur_interior(torch.zeros(8, 20), torch.tensor(1.0), 4)


@pytest.mark.parametrize("sigma_px", [(1.3, 9.0), (17.0, 4.0)])
def test_a_part_of_a_field_blurs_like_the_whole(sigma_px):
    # Blocks begin at different pixels in the part and in the whole field.
    radii = tuple(kernel_radius_px(sigma) for sigma in sigma_px)
    field = torch.rand(2, 1, 800, 830, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    strip = field[..., 100:500, 150:600]
    sigmas = tuple(torch.tensor(sigma, dtype=torch.float64, requires_grad=True) for sigma in sigma_px)
    field, strip = field.requires_grad_(), strip.clone().requires_grad_()
    wide, narrow = blur_interior(field, sigmas, radii), blur_interior(strip, sigmas, radii)
    assert wide.shape == (2, 1, 800 - 2 * radii[0], 830 - 2 * radii[1])
    part = wide[..., 100 : 100 + narrow.shape[-2], 150 : 150 + narrow.shape[-1]]
    # The sums have at most 137 terms, each at most 1, in double precision.
    assert torch.allclose(part, narrow, rtol=0, atol=1e-14)
    of_part = torch.autograd.grad(part.square().sum(), [field, *sigmas])
    of_narrow = torch.autograd.grad(narrow.square().sum(), [strip, *sigmas])
    assert torch.allclose(of_part[0][..., 100:500, 150:600], of_narrow[0], rtol=0, atol=1e-12)
    for a, b in zip(of_part[1:], of_narrow[1:], strict=True):
        assert torch.allclose(a, b, rtol=1e-10)


@pytest.mark.parametrize("samples", [1, 2])
def test_it_is_differentiable_forward_and_reverse_in_batches_and_twice(samples):
    generator = torch.Generator().manual_seed(0)
    # There are two blocks along y, of which the second is not full, and one block along x.
    field = torch.rand(samples, 1, 41, 11, dtype=torch.float64, generator=generator, requires_grad=True)
    widths = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.6, 1.1)]

    def blur(field: torch.Tensor, y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return blur_interior(field, (y, x), (3, 4))

    assert torch.autograd.gradcheck(blur, (field, *widths), fast_mode=True, check_forward_ad=True)
    fixed = [width.detach() for width in widths]
    assert torch.autograd.gradgradcheck(lambda f: blur(f, *fixed).square(), (field,), fast_mode=True)
    for argument in range(3):
        given = (field.detach()[:1, :, :34], *fixed)
        forward, reverse = (way(blur, argument)(*given) for way in (torch.func.jacfwd, torch.func.jacrev))
        assert torch.allclose(forward, reverse, rtol=0, atol=1e-12)


def test_without_gradients_the_blur_is_the_same_and_forward_derivatives_stay():
    field, width = torch.rand(2, 1, 41, 40, dtype=torch.float64), torch.tensor(0.7, dtype=torch.float64)

    def blur(sigma: torch.Tensor) -> torch.Tensor:
        return gaussian_blur(field, sigma, 1.0, radius_px=4)

    wanted = blur(width), torch.func.jacfwd(blur)(width), torch.func.vmap(blur)(width[None])
    with torch.no_grad():
        found = blur(width), torch.func.jacfwd(blur)(width), torch.func.vmap(blur)(width[None])
    assert all(map(torch.equal, found, wanted))
