"""Test propagators against closed forms of diffraction theory."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from litho_design.optics import ASMPropagator, RadialPropagator, RSPropagator, centred_grid

pytestmark = pytest.mark.numerics

WAVELENGTH_UM = 0.6328
WAVENUMBER = 2 * math.pi / WAVELENGTH_UM


def radius(grid, centre=(0.0, 0.0)):
    return torch.from_numpy(np.hypot(grid.y_um[:, None] - centre[0], grid.x_um[None, :] - centre[1]))


def point(offset=(0.0, 0.0), pitch=0.1):
    return centred_grid((1, 1), pitch, offset)


def circular_aperture(pitch, radius_um):
    size = 2 * math.ceil(radius_um / pitch)
    grid = centred_grid((size, size), pitch)
    return grid, (radius(grid) <= radius_um).to(torch.complex128)


@pytest.mark.parametrize(("pitch", "reported"), [(0.4, 8.8e-3), (0.2, 2.2e-3), (0.1, 1.3e-4)])
def test_on_axis_field_behind_a_circular_aperture(pitch, reported):
    a, z = 40.0, 300.0
    grid, field = circular_aperture(pitch, a)
    distance = math.hypot(a, z)
    exact = np.exp(1j * WAVENUMBER * z) - z / distance * np.exp(1j * WAVENUMBER * distance)
    propagate = RSPropagator(grid, point(), z, WAVELENGTH_UM, dtype=torch.complex128)
    error = abs(complex(propagate(field)) - exact) / abs(exact)
    # The error is due to the staircase edge of the pixelated circle.
    assert error == pytest.approx(reported, rel=0.1)
    if pitch == 0.1:
        assert error < 1e-3


def test_perfect_lens_focus():
    a, z = 40.0, 300.0
    grid, aperture = circular_aperture(0.1, a)
    converging = aperture * torch.exp(-1j * WAVENUMBER * (radius(grid) ** 2 + z**2).sqrt())
    propagate = RSPropagator(grid, point(), z, WAVELENGTH_UM, dtype=torch.complex128)
    intensity = abs(complex(propagate(converging))) ** 2
    exact = (1 - z / math.hypot(a, z)) ** 2 + (WAVENUMBER * z / 2 * math.log1p((a / z) ** 2)) ** 2
    assert intensity == pytest.approx(exact, rel=1e-3)
    # At a/f = 0.13, the paraxial peak (area / (wavelength f))^2 is already 1.8 % too high.
    assert (math.pi * a**2 / (WAVELENGTH_UM * z)) ** 2 == pytest.approx(1.018 * intensity, rel=1e-3)


def test_paraxial_square_lens_spot_is_a_sinc():
    side, focal = 40.0, 400.0  # half diagonal / f = 0.07: paraxial to 1 %
    grid = centred_grid((400, 400), 0.1)
    converging = torch.exp(-1j * WAVENUMBER * (radius(grid) ** 2 + focal**2).sqrt())
    line = centred_grid((1, 201), 0.1)
    propagate = RSPropagator(grid, line, focal, WAVELENGTH_UM, dtype=torch.complex128)
    intensity = propagate(converging).abs().square()[0]
    peak = (side**2 / (WAVELENGTH_UM * focal)) ** 2
    expected = peak * np.sinc(side * line.x_um / (WAVELENGTH_UM * focal)) ** 2
    assert np.abs(intensity.numpy() - expected).max() < 0.01 * peak


@pytest.mark.parametrize("propagator", [RSPropagator, ASMPropagator])
def test_gaussian_beam(propagator):
    waist, z = 10.0, 300.0
    rayleigh = math.pi * waist**2 / WAVELENGTH_UM
    assert rayleigh == pytest.approx(496, abs=0.5)
    grid = centred_grid((400, 400), 0.2)
    beam = torch.exp(-((radius(grid) / waist) ** 2)).to(torch.complex128)
    out = propagator(grid, grid, z, WAVELENGTH_UM, dtype=torch.complex128)(beam)
    width = waist * math.hypot(1, z / rayleigh)
    curvature = z * (1 + (rayleigh / z) ** 2)
    phase = WAVENUMBER * z - math.atan(z / rayleigh) + WAVENUMBER * radius(grid) ** 2 / (2 * curvature)
    expected = waist / width * torch.exp(-((radius(grid) / width) ** 2) + 1j * phase)
    # The closed form is paraxial. For a divergence of 0.02 rad, its error is about 2e-4 of the peak.
    assert (out - expected).abs().max() < 1e-3


def test_fresnel_zone_plate_focus_grows_with_the_square_of_its_zones():
    # The paths to the zone boundaries differ by half wavelengths, so every open zone adds twice the incident
    # amplitude. Only the obliquity (z/r, here within 1 %) weakens the outer ones.
    z, zones = 300.0, 5
    edges = [math.sqrt((z + m * WAVELENGTH_UM / 2) ** 2 - z**2) for m in range(2 * zones + 1)]
    grid = centred_grid((900, 900), 0.1)
    r = radius(grid)
    plate = sum(((r >= edges[2 * i]) & (r < edges[2 * i + 1])).to(torch.complex128) for i in range(zones))
    propagate = RSPropagator(grid, point(), z, WAVELENGTH_UM, dtype=torch.complex128)
    intensity = abs(complex(propagate(plate))) ** 2
    assert intensity == pytest.approx((2 * zones) ** 2, rel=0.02)


def test_first_order_of_a_zone_plate():
    """Check plates that block every second zone, and plates that delay it by half a wave.

    The efficiency is the intensity at the focus relative to that of a perfect lens of the same aperture.
    """
    z, count = 100.0, 40
    edges = [math.sqrt((z + m * WAVELENGTH_UM / 2) ** 2 - z**2) for m in range(count + 1)]
    grid = centred_grid((1050, 1050), 0.1)
    r = radius(grid)
    inside = r < edges[-1]
    odd = ((torch.floor(((r**2 + z**2).sqrt() - z) / (WAVELENGTH_UM / 2)) % 2) == 1) & inside
    propagate = RSPropagator(grid, point(), z, WAVELENGTH_UM, dtype=torch.complex128)
    lens = complex(propagate(inside * torch.exp(-1j * WAVENUMBER * ((r**2 + z**2).sqrt() - z))))
    for second, efficiency in ((0.0, 1 / math.pi**2), (-1.0, 4 / math.pi**2)):
        plate = torch.where(odd, torch.tensor(second, dtype=torch.complex128), inside.to(torch.complex128))
        # On the axis, undiffracted and diverging orders add a stray amplitude of a few parts in ``count``.
        ratio = abs(complex(propagate(plate)) / lens) ** 2
        assert ratio == pytest.approx(efficiency, rel=0.02)


def test_talbot_image_shifts_by_half_a_period_at_half_the_distance():
    period = 8.0
    talbot = WAVELENGTH_UM / (1 - math.sqrt(1 - (WAVELENGTH_UM / period) ** 2))
    grid = centred_grid((1, 1000), 0.25)
    wide = centred_grid((600, 1000), 0.25)
    grating = (1 + 0.5 * np.cos(2 * np.pi * wide.x_um / period))[None, :] * np.ones((600, 1))
    middle = slice(380, 620)  # exclude the edges, whose waves extend about 30 µm inwards
    for distance, shift in ((talbot, 0), (talbot / 2, 16)):
        propagate = RSPropagator(wide, grid, distance, WAVELENGTH_UM, dtype=torch.complex128)
        seen = propagate(torch.from_numpy(grating).to(torch.complex128)).abs().numpy()[0] ** 2
        wanted = np.roll(grating[0] ** 2, shift)
        assert np.corrcoef(seen[middle], wanted[middle])[0, 1] > 0.99


@pytest.mark.parametrize("order", [1, -1, 3])
def test_grating_order_lands_where_the_grating_equation_says(order):
    period, z, pitch = 9.0, 300.0, 0.2
    grid = centred_grid((300, 300), pitch)
    landing = z * math.tan(math.asin(order * WAVELENGTH_UM / period))
    tilt = torch.exp(2j * np.pi * order * torch.from_numpy(grid.x_um) / period)
    beam = torch.exp(-((radius(grid) / 12) ** 2)) * tilt
    target = centred_grid((400, 400), pitch, (0.0, 0.8 * landing))
    intensity = RSPropagator(grid, target, z, WAVELENGTH_UM, dtype=torch.complex128)(beam).abs().square()
    centroid = float((intensity.sum(0) * torch.from_numpy(target.x_um)).sum() / intensity.sum())
    # The spread of angles in a 12 µm beam shifts its centroid by sec^3(theta), here below 0.02 µm.
    assert centroid == pytest.approx(landing, abs=pitch / 2)


def test_radial_path_equals_the_closed_forms_and_the_plane_path():
    a, z = 40.0, 300.0
    radii = torch.tensor([0.0, 1.3, 7.05, 20.0])
    propagate = RadialPropagator(400, 0.1, radii, z, WAVELENGTH_UM, dtype=torch.complex128)
    distance = math.hypot(a, z)
    exact = np.exp(1j * WAVENUMBER * z) - z / distance * np.exp(1j * WAVENUMBER * distance)
    flat = propagate(torch.ones(400, dtype=torch.complex128))
    # With two Gauss nodes on a 0.1 µm ring, the phase spans 0.13 rad. The error is below span^4 / 4320.
    assert abs(complex(flat[0]) - exact) / abs(exact) < 1e-6
    fine, aperture = circular_aperture(0.05, a)
    for index, r in ((1, 1.3), (3, 20.0)):
        plane = RSPropagator(fine, point((0.0, r), 0.05), z, WAVELENGTH_UM, dtype=torch.complex128)
        # The pixelated circle of the plane path has an edge error of a few 1e-4.
        assert abs(complex(plane(aperture)) - complex(flat[index])) < 2e-3
    assert float(propagate.ring_area_um2.sum()) == pytest.approx(math.pi * a**2, rel=1e-12)
