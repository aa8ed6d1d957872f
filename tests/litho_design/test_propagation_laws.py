"""Test propagators against the laws of any linear wave propagation and against a reference."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_design.optics import (
    ASMPropagator,
    Optics,
    RSPropagator,
    angular_spectrum,
    centred_grid,
    element_field,
    intensity_share,
    make_propagator,
    sampling_limit_um,
)
from litho_design.optics.angular_spectrum import spectrum_axes
from litho_design.optics.convolution import wrapped_order

pytestmark = pytest.mark.numerics

WAVELENGTH_UM = 0.6328


def random_field(shape, dtype=torch.complex128, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, dtype=dtype, generator=generator)


def direct_sum(field, source, target, distance):
    y = target.y_um[:, None, None, None] - source.y_um[None, None, :, None]
    x = target.x_um[None, :, None, None] - source.x_um[None, None, None, :]
    r = np.sqrt(x**2 + y**2 + distance**2)
    k = 2 * np.pi / WAVELENGTH_UM
    kernel = distance / (2 * np.pi * r**2) * (1 / r - 1j * k) * np.exp(1j * k * r)
    return np.einsum("abcd,cd->ab", kernel, field.numpy()) * source.pitch_um[0] * source.pitch_um[1]


GRIDS = {
    "same": centred_grid((32, 32), 0.1),
    "offset": centred_grid((30, 41), 0.1, (1.234, -7.7)),
    "coarse": centred_grid((17, 9), 0.2, (0.3, 0.01)),
    "fine": centred_grid((31, 32), 0.05, (-0.4, 2.0)),
    "rational": centred_grid((20, 33), 0.15, (5.0, 0.0)),
    "mixed": PixelGrid((13, 21), (0.25, 0.04), (-3.0, 1.0)),
}


@pytest.mark.parametrize("name", GRIDS)
def test_fft_equals_the_direct_sum_on_any_output_grid(name):
    source, target = centred_grid((32, 32), 0.1, (0.02, -0.5)), GRIDS[name]
    field = random_field((32, 32))
    expected = direct_sum(field, source, target, 30.0)
    scale = np.abs(expected).max()
    for dtype, tolerance in ((torch.complex128, 1e-10), (torch.complex64, 1e-5)):
        out = RSPropagator(source, target, 30.0, WAVELENGTH_UM, dtype=dtype)(field.to(dtype))
        assert np.abs(out.numpy() - expected).max() < tolerance * scale


@pytest.mark.parametrize("name", GRIDS)
def test_adjoint_and_gradient(name):
    source, target = centred_grid((32, 32), 0.1), GRIDS[name]
    propagate = RSPropagator(source, target, 30.0, WAVELENGTH_UM, dtype=torch.complex128)
    u = random_field((32, 32)).requires_grad_()
    v = random_field(target.shape, seed=1)
    forward = (propagate(u).conj() * v).sum()
    backward = (u.conj() * propagate.adjoint(v)).sum()
    # Both are the same sum of products, so only rounding differs.
    assert (forward - backward).abs().item() < 1e-10 * forward.abs().item()
    forward.real.backward()
    assert torch.allclose(u.grad, propagate.adjoint(v), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("here", "there"), [(34, 31), (31, 34), (33, 33), (1, 40), (40, 1)])
def test_every_separation_lies_at_its_index_of_a_circular_convolution(here, there):
    order = wrapped_order(here, there).tolist()
    for separation in range(1 - here, there):
        assert order[separation % len(order)] == separation
    assert set(order) == set(range(1 - here, there))


@pytest.mark.parametrize("distance", [900.0, 6000.0, -6000.0])
@pytest.mark.parametrize("offset_um", [0.0, 240.0, -31.0])
@pytest.mark.parametrize(
    ("here", "there"), [((30, 33), (400, 21)), ((401, 64), (26, 333)), ((32, 32), (32, 32))]
)
def test_the_band_holds_the_rays_that_do_not_come_back_wrapped(here, there, offset_um, distance):
    """Check that the band contains the frequencies whose rays hit the target once and do not hit it again a
    period away.
    """
    source, target = centred_grid(here, 0.4), centred_grid(there, 0.4, (offset_um, -offset_um))
    for axis, band in enumerate(spectrum_axes(source, target, distance, WAVELENGTH_UM)):
        sine = WAVELENGTH_UM * band.frequency.numpy()
        step = distance * sine / np.sqrt(1 - sine**2)
        period = 0.4 * len(sine)
        from_centre_to_centre = offset_um if axis == 0 else -offset_um
        room = period - 0.4 * (here[axis] + there[axis]) / 2
        clear = np.abs(np.abs(step - from_centre_to_centre) - room) > 1e-6 * period
        wanted = np.abs(step - from_centre_to_centre) <= room
        assert np.array_equal(band.inside.numpy()[clear], wanted[clear])
        assert band.start_um == pytest.approx(
            (target.y_um if axis == 0 else target.x_um)[0] - (source.y_um if axis == 0 else source.x_um)[0]
        )
    if abs(distance) > 5000:
        assert not band.inside.all(), "the period is so long that this tests nothing"


@pytest.mark.parametrize(
    ("there", "offset"), [((70, 41), (3, -9)), ((25, 90), (0, 0)), ((31, 32), (-11, 20))]
)
def test_asm_to_a_part_of_a_plane_equals_that_part_of_asm_to_the_whole_plane(there, offset):
    """Check that the wave at a point does not depend on the size or the position of the target."""
    source = centred_grid((34, 45), 0.4)
    whole = centred_grid((160, 170), 0.4)
    row, column = ((n - m) // 2 + shift for n, m, shift in zip(whole.shape, there, offset, strict=True))
    origin = whole.origin_um[0] + row * 0.4, whole.origin_um[1] + column * 0.4
    y, x = torch.tensor(source.y_um)[:, None], torch.tensor(source.x_um)[None, :]
    field = torch.exp(-(y**2 + x**2) / (2 * 1.5**2) + 1j * (1.1 * x - 0.7 * y))
    options = {"distance_um": 60.0, "wavelength_um": WAVELENGTH_UM, "dtype": torch.complex128}
    everywhere = ASMPropagator(source, whole, **options)(field)
    part = ASMPropagator(source, PixelGrid(there, (0.4, 0.4), origin), **options)(field)
    wanted = everywhere[row : row + there[0], column : column + there[1]]
    # The source contains the beam to nine decimals, and the band contains all its rays.
    assert (part - wanted).abs().max() < 1e-6 * everywhere.abs().max()


def test_asm_adjoint():
    source, target = centred_grid((32, 30), 0.4), centred_grid((25, 40), 0.4, (1.0, -2.0))
    propagate = ASMPropagator(source, target, 12.0, WAVELENGTH_UM, dtype=torch.complex128)
    u, v = random_field((32, 30)), random_field((25, 40), seed=1)
    forward = complex((propagate(u).conj() * v).sum())
    assert abs(forward - complex((u.conj() * propagate.adjoint(v)).sum())) < 1e-10


def test_agrees_with_torchoptics():
    torchoptics = pytest.importorskip("torchoptics")
    source, target = centred_grid((48, 48), 0.2), centred_grid((40, 56), 0.2, (3.0, -4.0))
    field = random_field((48, 48))
    ours = RSPropagator(source, target, 60.0, WAVELENGTH_UM, dtype=torch.complex128)(field)
    reference = torchoptics.Field(field, wavelength=WAVELENGTH_UM, z=0.0, spacing=0.2).propagate(
        (40, 56), 60.0, spacing=0.2, offset=(3.0, -4.0), propagation_method="DIM"
    )
    assert (ours - reference.data).abs().max() < 1e-5 * ours.abs().max()


def test_asm_and_rs_agree_where_both_hold():
    source = centred_grid((160, 160), 0.1)
    spot = torch.exp(-((torch.from_numpy(np.hypot(source.y_um[:, None], source.x_um[None, :])) / 2) ** 2))
    target = centred_grid((120, 180), 0.1, (2.0, 1.55))
    arguments = (source, target, 10.0, WAVELENGTH_UM)
    rs = RSPropagator(*arguments, dtype=torch.complex128)(spot.to(torch.complex128))
    asm = ASMPropagator(*arguments, dtype=torch.complex128)(spot.to(torch.complex128))
    # The frequencies of the beam are well inside the band, so both methods are exact.
    assert (rs - asm).abs().max() < 1e-5 * rs.abs().max()


def test_asm_and_rs_agree_on_a_rough_element():
    # With padding to twice the grid, the error was 6 to 13 %. Pixels below half a wavelength have grazing
    # rays, for which no period is long enough. The promised accuracy is 1 %.
    source = centred_grid((96, 96), 0.1)
    cells = torch.randint(0, 13, (24, 24), generator=torch.Generator().manual_seed(0)) * 0.1
    height = torch.nn.functional.avg_pool2d(
        cells.repeat_interleave(4, 0).repeat_interleave(4, 1)[None], 5, 1, 2
    )
    wave = element_field(height[0].double(), source, Optics())
    for distance in (2.0, 12.0, 40.0):
        arguments = (source, source, distance, WAVELENGTH_UM)
        rs, asm = (kind(*arguments, dtype=torch.complex128)(wave) for kind in (RSPropagator, ASMPropagator))
        assert (rs - asm).norm() < 0.01 * rs.norm()


@pytest.mark.parametrize("distance", [5.0, 30.0])
def test_asm_is_exact_on_pixels_too_coarse_for_the_kernel(distance):
    """Check a band-limited wave on pixels so coarse that the Rayleigh-Sommerfeld kernel is aliased."""
    count, pitch = 64, 0.4
    coarse, fine = centred_grid((count,) * 2, pitch), centred_grid((4 * count,) * 2, pitch / 4)
    assert distance < 2 * sampling_limit_um(coarse, coarse, WAVELENGTH_UM)
    frequency = torch.fft.fftfreq(count, dtype=torch.float64)
    low = torch.hypot(frequency[:, None], frequency[None, :]) < 0.3
    x = torch.arange(count) - (count - 1) / 2
    window = torch.exp(-(((x[:, None] ** 2 + x[None, :] ** 2) / (count / 6) ** 2) ** 2))
    wave = torch.fft.ifft2(torch.fft.fft2(random_field((count, count))) * low) * window
    # Compute the same wave on finer pixels, on which the kernel is not aliased.
    offset = torch.from_numpy(fine.x_um)[:, None] - coarse.x_um[0]
    between = torch.exp(2j * math.pi * offset * frequency[None, :] / pitch)
    finer = between @ torch.fft.fft2(wave) @ between.T / count**2
    expected = RSPropagator(fine, coarse, distance, WAVELENGTH_UM, dtype=torch.complex128)(finer)
    optics = Optics(distance_um=distance)
    seen = make_propagator(coarse, coarse, optics, dtype=torch.complex128)
    assert isinstance(seen, ASMPropagator) == (distance < sampling_limit_um(coarse, coarse, WAVELENGTH_UM))
    # The window widens the band, so about 1e-5 of the wave is beyond the Nyquist frequency.
    assert (seen(wave) - expected).abs().max() < 1e-4 * expected.abs().max()
    forced = make_propagator(
        coarse, coarse, optics.model_copy(update={"propagation": "angular-spectrum"}), dtype=torch.complex128
    )
    assert (forced(wave) - expected).abs().max() < 1e-4 * expected.abs().max()


def gaussian(grid, waist=3.0):
    r = np.hypot(grid.y_um[:, None], grid.x_um[None, :])
    return torch.from_numpy(np.exp(-((r / waist) ** 2))).to(torch.complex128)


# Pixels below half a wavelength hold evanescent waves, which grow without limit on the way back.
@pytest.mark.parametrize(("count", "pitch"), [(128, 0.35), (256, 0.1)])
def test_asm_semigroup_and_reversal(monkeypatch, count, pitch):
    # This beam has no grazing rays, which alone need a long period.
    monkeypatch.setattr(angular_spectrum, "_LONGEST_PERIOD", 1024)
    grid = centred_grid((count, count), pitch)

    def asm(z):
        return ASMPropagator(grid, grid, z, WAVELENGTH_UM, dtype=torch.complex128)

    u = gaussian(grid)
    once = asm(20.0)(u)
    assert (asm(12.0)(asm(8.0)(u)) - once).abs().max() < 1e-5
    assert (asm(-20.0)(once) - u).abs().max() < 1e-5
    assert (asm(0.0)(u) - u).abs().max() < 1e-12


# A pitch above half a wavelength excludes evanescent waves. At the finer pitch, this beam has none.
@pytest.mark.parametrize("pitch", [0.35, 0.1])
def test_energy_is_kept_by_asm(pitch):
    grid = centred_grid((360, 360), pitch)
    u = gaussian(grid)
    power = float(u.abs().square().sum())
    out = ASMPropagator(grid, grid, 25.0, WAVELENGTH_UM, dtype=torch.complex128)(u)
    assert float(out.abs().square().sum()) == pytest.approx(power, rel=1e-6)


def test_energy_is_never_exceeded_by_rs():
    element = centred_grid((64, 64), 0.1)
    rough = torch.exp(2j * np.pi * torch.rand((64, 64), generator=torch.Generator().manual_seed(3)).double())
    shares = []
    for size in (64, 128, 256, 512):
        window = centred_grid((size, size), 0.1)
        seen = RSPropagator(element, window, 20.0, WAVELENGTH_UM, dtype=torch.complex128)(rough)
        shares.append(float(seen.abs().square().sum()) / 64**2)
    assert shares == sorted(shares)
    assert shares[-1] <= 1 + 1e-6


@pytest.mark.parametrize("size", [64, 65])
def test_a_centred_lens_focuses_on_the_axis_for_even_and_odd_sizes(size):
    grid = centred_grid((size, size), 0.2)
    r2 = torch.from_numpy(grid.y_um[:, None] ** 2 + grid.x_um[None, :] ** 2)
    lens = torch.exp(-2j * math.pi / WAVELENGTH_UM * (r2 + 60.0**2).sqrt())
    window = centred_grid((size + 7, size + 7), 0.1)
    field = RSPropagator(grid, window, 60.0, WAVELENGTH_UM, dtype=torch.complex128)(lens)
    intensity = field.abs().square()
    for axis, coordinate in ((0, window.x_um), (1, window.y_um)):
        centroid = float((intensity.sum(axis) * torch.from_numpy(coordinate)).sum() / intensity.sum())
        assert abs(centroid) / 0.1 < 1e-3
    assert torch.allclose(field, field.T)
    assert torch.allclose(field, field.flip(0))


def test_transposed_and_flipped_fields_give_transposed_and_flipped_waves():
    grid = centred_grid((40, 40), 0.1)
    propagate = RSPropagator(grid, grid, 25.0, WAVELENGTH_UM, dtype=torch.complex128)
    u = random_field((40, 40))
    for operation in (lambda a: a.T, lambda a: a.flip(0), lambda a: a.flip(1)):
        assert (propagate(operation(u)) - operation(propagate(u))).abs().max() < 1e-12


def test_transfer_is_cached_on_the_device_but_not_saved():
    grid = centred_grid((16, 16), 0.1)
    propagate = RSPropagator(grid, grid, 10.0, WAVELENGTH_UM)
    assert dict(propagate.named_buffers())["transfer"].dtype == torch.complex64
    assert propagate.state_dict() == {}


def test_distance_below_the_sampling_limit_is_refused():
    coarse = centred_grid((256, 256), 0.4)
    limit = sampling_limit_um(coarse, coarse, WAVELENGTH_UM)
    # The largest separation is 255 pixels. Nyquist requires x / (wavelength r) <= 1 / (2 pitch).
    assert limit == pytest.approx(255 * 0.4 * math.sqrt((0.8 / WAVELENGTH_UM) ** 2 - 1))
    with pytest.raises(InputError, match="angular spectrum"):
        RSPropagator(coarse, coarse, 0.99 * limit, WAVELENGTH_UM)
    with pytest.raises(InputError, match="at least"):
        RSPropagator(coarse, coarse, -5.0, WAVELENGTH_UM)
    with pytest.raises(InputError, match="a ratio of integers"):
        RSPropagator(coarse, centred_grid((32, 32), 0.4 * math.sqrt(2)), 1.1 * limit, WAVELENGTH_UM)


def test_draft_pitch_is_close_inside_the_window():
    # Pixels of 0.2 µm average 2 x 2 heights of a layout with cells of 0.4 µm. The heights are the same, and
    # only the sampling of the source differs. Angles inside the window are below 19°.
    cells = torch.randint(0, 13, (64, 64), generator=torch.Generator().manual_seed(0)) * 0.1
    optics = Optics()
    images = []
    for pitch, repeat in ((0.1, 4), (0.2, 2)):
        height = cells.repeat_interleave(repeat, 0).repeat_interleave(repeat, 1).double()
        grid = centred_grid(tuple(height.shape), pitch)
        window = centred_grid((64, 64), 0.4)
        propagate = RSPropagator(grid, window, 75.0, WAVELENGTH_UM, dtype=torch.complex128)
        images.append(intensity_share(propagate(element_field(height, grid, optics)), window))
    difference = (images[0] - images[1]).abs().sum() / images[0].sum()
    # The midpoint rule on 0.2 µm pixels weakens a wave at 19° by (pi 0.2 0.33 / 0.6328)^2 / 6 = 1.8 %.
    assert difference < 0.02
