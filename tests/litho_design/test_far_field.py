"""Test the far field, and illumination other than a uniform plane wave, against closed forms."""

from __future__ import annotations

import math

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design import design_hologram, hologram_settings
from litho_design.holograms.bench import HologramBench
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import draw_target
from litho_design.optics import (
    Optics,
    blaze_efficiency,
    centred_grid,
    element_field,
    intensity_share,
    make_propagator,
)
from litho_design.optics.far_field import FarFieldPropagator
from litho_design.optimisation.process_window import ProcessWindow, draws, spreads
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer

FAR = Optics(distance_um=100.0, propagation="far-field")


def test_orders_of_a_blaze_have_the_power_of_the_formula():
    """Check a blaze whose diffraction orders are single pixels of the image."""
    size, period, levels = 96, 8, 8
    grid = centred_grid((size, size), 0.2)
    height = (torch.arange(size) % period * (FAR.wave_height_um / levels)).repeat(size, 1)
    # A pixel of the image is a step of the discrete transform, lambda f / (N pitch).
    step_um = FAR.wavelength_um * FAR.distance_um / (size * 0.2)
    odd = centred_grid((size - 1, size - 1), step_um)
    wave = make_propagator(grid, odd, FAR)(element_field(height, grid, FAR))
    power = intensity_share(wave, odd)
    first = power[size // 2 - 1, size // 2 - 1 + size // period]
    assert float(first) == pytest.approx(blaze_efficiency(levels, 1.0), rel=1e-4)
    # With eight steps per wave, the next orders are 8 orders away, so the other light misses the window.
    assert float(power.sum() - first) < 1e-5


def test_the_adjoint_and_the_largest_angle():
    grid, window = centred_grid((20, 24), 0.3), centred_grid((16, 30), 1.7)
    far = FarFieldPropagator(grid, window, 90.0, 0.6, dtype=torch.complex128)
    draw = torch.Generator().manual_seed(0)
    one = torch.randn(20, 24, dtype=torch.complex128, generator=draw)
    other = torch.randn(16, 30, dtype=torch.complex128, generator=draw)
    assert torch.allclose(
        (far(one).conj() * other).sum(), (one.conj() * far.adjoint(other)).sum(), rtol=1e-12
    )
    with pytest.raises(InputError, match="focal length of the far field"):
        FarFieldPropagator(grid, centred_grid((16, 30), 8.0), 90.0, 0.6)


def test_a_gaussian_beam_and_a_near_point():
    """Check that a beam of radius w gives a spot of radius lambda f / (pi w). Also check the phase of the
    light from a nearby point.
    """
    size, beam_um = 128, 4.0
    grid = centred_grid((size, size), 0.2)
    optics = FAR.model_copy(update={"beam_um": beam_um})
    field = element_field(torch.zeros(size, size), grid, optics)
    assert float(intensity_share(field, grid).sum()) == pytest.approx(1, rel=1e-5)
    window = centred_grid((101, 101), 0.2)
    seen = intensity_share(make_propagator(grid, window, optics)(field), window)
    spot_um = optics.wavelength_um * optics.distance_um / (math.pi * beam_um)
    along = seen[50] / seen[50, 50]
    wanted = torch.exp(-2 * torch.from_numpy(window.x_um) ** 2 / spot_um**2)
    # At 12.8 µm, where the field ends, a beam of 4 µm has an amplitude of exp(-(12.8 / 4)^2) = 4e-5.
    assert (along - wanted).abs().max() < 1e-3
    near = element_field(torch.zeros(size, size), grid, Optics(source_distance_um=50.0))
    x = torch.from_numpy(grid.x_um)
    phase = 2 * math.pi / 0.6328 * (torch.hypot(x, torch.tensor(float(grid.y_um[64]))) ** 2 / 100.0)
    turned = near[64] * torch.polar(torch.ones_like(phase), -phase)
    # The paraxial error is r^4 / (8 d^3) = 0.03 µm at 12.8 µm, or 0.27 rad.
    assert turned.angle().sub(turned[64].angle()).abs().max() < 0.4


def test_oblique_light_keeps_its_direction_or_is_refused():
    """Check that light goes to f times its sine, and that a steeper wave than pixels can sample is refused,
    whatever makes it steep.
    """
    grid = centred_grid((48, 48), 0.4)
    line = centred_grid((1, 301), FAR.wavelength_um * FAR.distance_um / (0.4 * 301))
    for sine in (0.3, -0.75):
        optics = FAR.model_copy(update={"incidence_x": sine})
        wave = make_propagator(grid, line, optics)(element_field(torch.zeros(48, 48), grid, optics))
        where = line.x_um[int(intensity_share(wave, line).argmax())]
        assert where == pytest.approx(sine * FAR.distance_um, abs=3)
    # The limit is 0.6328 / 0.8 = 0.791. The outermost pixel is 9.4 µm from the axis.
    for steep in (
        {"incidence_x": 0.9},
        {"incidence_x": 0.75, "incidence_y": 0.75},
        {"source_distance_um": 7.0},
        {"source_distance_um": 50.0, "incidence_y": -0.7},
    ):
        with pytest.raises(InputError, match="light on the element"):
            element_field(torch.zeros(48, 48), grid, FAR.model_copy(update=steep))
    element_field(torch.zeros(48, 48), grid, FAR.model_copy(update={"source_distance_um": 8.0}))
    # A source around a tilt, and a shorter wavelength in a draw, are refused before the search.
    changes = {"layout.size_px": 32, "layout.pitch_um": 0.4, "layout.cell_um": 0.4, "optics.incidence_x": 0.7}
    for change in ({"optics.source_sine": 0.15}, {"window.wavelength_sd_um": 0.05}):
        settings = hologram_settings(changes=changes | change)
        printer = Printer(None, settings.layout, source="none")
        with pytest.raises(InputError, match="light on the element"):
            HologramTask(settings, printer, inputs={"target": draw_target("ring", 32)})


def test_the_resolution_of_the_far_field_is_that_of_its_focus():
    """Check that a point, blurred to the resolution of the element, is the focus of a flat element. The focal
    length is half of its side.
    """
    size = 65
    optics = FAR.model_copy(update={"distance_um": size * 0.1 / 2})
    bench = HologramBench(LayoutSettings(size_px=size), optics)
    point = torch.zeros(size, size, dtype=torch.float64)
    point[size // 2, size // 2] = 1
    focus, blurred = bench(torch.zeros(size, size)).double(), bench.resolved(point)
    assert (blurred / blurred.max() - focus / focus.max()).abs().max() < 1e-5


def test_a_far_field_has_no_draws_out_of_focus():
    """Check that the focal length only rescales the image, whose peak power falls off as 1 / f^2 without
    defocus, so that the draws of the process window keep it.
    """
    grid, flat = centred_grid((64, 64), 0.2), torch.zeros(64, 64)
    middle = centred_grid((1, 1), 0.2)
    peaks = []
    for focal_um in (40.0, 46.0):
        optics = FAR.model_copy(update={"distance_um": focal_um})
        wave = make_propagator(grid, middle, optics)(element_field(flat, grid, optics))
        peaks.append(float(intensity_share(wave, middle)))
    assert peaks[1] / peaks[0] == pytest.approx((40 / 46) ** 2, rel=1e-5)
    window = ProcessWindow()
    assert {draw.optics.distance_um for draw in draws(window, FAR, 9)} == {FAR.distance_um}
    near = FAR.model_copy(update={"propagation": "auto"})
    assert len({draw.optics.distance_um for draw in draws(window, near, 9)}) == 9
    assert "distance to the image plane 0 µm" in spreads(window, FAR)


def test_a_fan_out_in_the_far_field_stands_beside_its_baselines(tmp_path):
    changes = {
        "layout.size_px": 64,
        "layout.cell_um": 0.2,
        "optics.distance_um": 12.0,
        "optics.propagation": "far-field",
        "search.iterations": 30,
        "search.polish_rounds": 3,
        "window.yield_draws": 2,
        "window.defocus_sd_um": 0.0,
    }
    settings = hologram_settings(changes=changes)
    made = design_hologram("spots", "none", tmp_path, settings=settings, announce=False)
    assert made.predicted["eff_signal"] > 0.5 * made.baselines["continuous phase"]["eff_signal"]
    assert made.predicted["si_psnr_db"] > made.baselines["black image"]["si_psnr_db"]
    assert {"weighted GS", "continuous phase"} <= made.baselines.keys()
