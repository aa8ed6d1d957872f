"""Test the printer as an optical element: its wave, its gradient, tiles, torchoptics and examples."""

from __future__ import annotations

import importlib.util
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design import Element
from litho_design.optics import centred_grid, element_field
from litho_design.optics.materials import refractive_index
from litho_design.printers.layout import LayoutSettings

EXAMPLES = Path(__file__).parents[2] / "examples"
LAYOUT = LayoutSettings(size_px=40, cell_um=0.2)


@pytest.fixture
def element(make_printer):
    return Element(make_printer(LAYOUT), LAYOUT, seed=1)


def test_the_wave_is_that_of_the_printed_levels(element, make_printer):
    """Check phase and amplitude against the closed form for the layout that would be printed."""
    levels = torch.from_numpy(element.levels())[None, None].float()
    height = make_printer(LAYOUT)(levels)[0, 0]
    assert torch.equal(element.height_um(), height)
    wave = torch.randn(3, 40, 40, dtype=torch.complex64)
    for um in (0.473, 0.6328):
        expected = wave * torch.exp(2j * math.pi * (refractive_index("ip-dip", um) - 1) * height / um)
        # The phase is a few waves, in float32.
        assert (element(wave, um) - expected).abs().max() < 1e-5 * wave.abs().max()
    dark = Element(
        element.printer, LAYOUT, seed=1, absorption_per_um=0.3, resin=lambda um: 1.5, surroundings=1.33
    )
    kept = wave.abs().square() * (-0.3 * height).exp()
    assert torch.allclose(dark(wave, 0.5).abs().square(), kept, rtol=1e-5)
    assert dark.optics(0.5).index_step == pytest.approx(0.17)
    known = torch.full((40, 40), 0.5 / 0.17)
    # This height is exactly one wave.
    assert dark.transmission(0.5, known).angle().abs().max() < 1e-5


@pytest.mark.parametrize("kind", ["thin", "thick"])
def test_a_known_print_may_be_an_array_without_gaps(make_printer, kind):
    """Check that measured heights give the wave of the same tensor, and that none may be missing."""
    element = Element(make_printer(LAYOUT), LAYOUT, kind=kind)
    wave = torch.ones(40, 40, dtype=torch.complex64)
    height = element.height_um().detach()
    wanted = element(wave, 0.6328)
    for given in (height, height.numpy(), height.numpy().astype(">f8")):
        assert torch.equal(element(wave, 0.6328, given), wanted)
    height[3, 4] = math.nan
    for given in (height, height.numpy()):
        with pytest.raises(InputError, match=r"got no finite number at 1 of 1600 pixels, .*; fill"):
            element(wave, 0.6328, given)
    with pytest.raises(InputError, match="heights of a print"):
        element(wave, 0.6328, "print.gsf")


def test_a_thick_element_is_that_of_the_designs(make_printer):
    thick = Element(make_printer(LAYOUT), LAYOUT, kind="thick", resin=lambda um: 1.548)
    wave = torch.full((40, 40), 1 / math.sqrt(16), dtype=torch.complex64)
    expected = element_field(thick.height_um(), centred_grid((40, 40), 0.1), thick.optics(0.6328))
    assert (thick(wave, 0.6328) - expected).abs().max() < 1e-5


def test_the_gradient_passes_straight_through_rounding_and_limits(element):
    """Check that integer levels have the same gradient as real-valued levels at the same place, also at the
    limits.
    """

    def slope():
        (found,) = torch.autograd.grad(element.height_um().square().sum(), element.free.height)
        return found

    whole = slope()
    with torch.no_grad():
        element.free.height.round_()
    element.whole = False
    assert torch.allclose(whole, slope(), rtol=1e-5)
    with torch.no_grad():
        step, place = 0.25, (3, 5)
        element.free.height[place] = 6
    middle = slope()[place]
    with torch.no_grad():
        element.free.height[place] += step
        above = element.height_um().square().sum()
        element.free.height[place] -= 2 * step
        below = element.height_um().square().sum()
    # For a square, the central difference is exact.
    assert float((above - below) / (2 * step)) == pytest.approx(float(middle), rel=1e-3)
    with torch.no_grad():
        element.free.height[0, 0], element.free.height[0, 1] = 99.0, -7.0
    element.whole = True
    assert element.levels()[0, [0, 2]].tolist() == [12, 0]
    assert slope()[0, 0] != 0


def test_tiles_print_the_same_with_the_same_gradient(element):
    def found(tile):
        element.tile_px = tile
        height = element.height_um()
        (slope,) = torch.autograd.grad(height.square().sum(), element.free.height)
        return height.detach(), slope

    # The 40 px are split into tiles of 16, so the last tiles are smaller. The blur has a reach of 8 px.
    for one, other in zip(found(16), found(None), strict=True):
        assert torch.allclose(one, other, rtol=1e-5, atol=1e-6)


def test_an_element_starts_from_a_layout_or_a_phase(element):
    levels = np.random.default_rng(0).integers(0, 13, (20, 20)).repeat(2, 0).repeat(2, 1)
    element.start_from_levels(levels)
    assert np.array_equal(element.levels(), levels)
    # The start is the level that, printed in a wide area, has the nearest phase. The printed levels are
    # 0.62 x 0.1 µm apart.
    element.start_from_phase(torch.full((40, 40), 1.0), 0.6328)
    assert len(np.unique(element.levels())) == 1


def test_levels_that_the_layout_does_not_have_are_refused(element):
    """Check that a start never changes the levels that it is given, also for rings."""
    before = element.levels()
    for level, said in ((13, "got 13 to 13"), (-1, "got -1 to -1"), (math.nan, "wanted 0 to 12")):
        with pytest.raises(InputError, match=said):
            element.start_from_levels(np.full((40, 40), level))
    with pytest.raises(InputError, match=r"differ within a cell, wanted one level per cell of 0\.2 µm"):
        element.start_from_levels(np.arange(1600).reshape(40, 40) % 13)
    assert np.array_equal(element.levels(), before)
    element.start_from_levels(np.full((40, 40), 3.6))
    assert (element.levels() == 4).all()
    rings = Element("none", {"size_px": 40, "cell_um": 0.3, "symmetry": "radial"}, seed=2)
    levels = rings.levels()
    rings.start_from_levels(levels)
    assert np.array_equal(rings.levels(), levels)
    with pytest.raises(InputError, match="within a ring"):
        rings.start_from_levels(before)


def test_two_sources_of_a_resin_agree():
    """Check that Cauchy (2017) and Sellmeier (2019) differ by a constant 0.004 in the visible range."""
    um = np.linspace(0.45, 1.0, 24)
    older, newer = (
        np.array([refractive_index(name, one) for one in um]) for name in ("ip-dip", "ip-dip-2019")
    )
    assert np.abs(newer - older - 0.004).max() < 5e-4
    assert refractive_index("ip-dip-2019", 0.6328) == pytest.approx(1.5494, abs=1e-4)


def test_torchoptics_accepts_an_element(element):
    torchoptics = pytest.importorskip("torchoptics")
    data = torch.randn(40, 40, dtype=torch.complex128)
    field = torchoptics.Field(data, 532e-9, z=3e-6, spacing=0.1e-6)
    placed = element.as_torchoptics(z=3e-6, unit_um=1e6)
    assert (placed(field).data - element(data, 0.532)).abs().max() < 1e-5
    system = torchoptics.System(placed)
    seen = system.measure_at_z(field, 20e-6)
    seen.intensity().sum().backward()
    assert element.free.height.grad.abs().sum() > 0


def test_a_field_in_metres_is_refused_where_micrometres_are_meant(element):
    torchoptics = pytest.importorskip("torchoptics")
    field = torchoptics.Field(torch.ones(40, 40), 532e-9, spacing=0.1e-6)
    with pytest.raises(InputError, match=r"5\.32e-07 µm.*unit_um=1e6"):
        element.as_torchoptics().modulation_profile(field.wavelength)


@pytest.mark.parametrize("model", ["blur", "zoo:physics", "zoo:pbl"])
def test_gradients_of_torch_func_are_those_of_autograd(model, make_printer):
    """Test single layouts and batches, also for models that define their own gradients."""
    layout = LayoutSettings(size_px=24, cell_um=0.4)
    element = Element(make_printer(layout) if model == "blur" else model, layout, seed=1)
    wave = torch.ones(24, 24, dtype=torch.complex64)

    def loss(levels):
        behind = torch.func.functional_call(element, {"free.height": levels}, (wave, 0.6328))
        return (behind.real - 0.3).square().mean()

    first, other = element.free.height.detach().clone(), element.free.height.detach().flip(0)
    wanted = [torch.autograd.grad(loss(one.requires_grad_()), one)[0] for one in (first, other)]
    first, other = first.detach(), other.detach()
    # The order of operations differs, so float32 rounding does too.
    assert torch.allclose(torch.func.grad(loss)(first), wanted[0], rtol=1e-4, atol=1e-8)
    both = torch.func.vmap(torch.func.grad(loss))(torch.stack([first, other]))
    assert torch.allclose(both, torch.stack(wanted), rtol=1e-4, atol=1e-8)


def test_batches_and_double_precision(element):
    wave = torch.randn(3, 2, 40, 40, dtype=torch.complex128)
    single = element(wave, 0.6328)
    assert single.shape == wave.shape
    exact = element.double()(wave, 0.6328)
    assert exact.dtype == torch.complex128
    # A phase of a few waves in float32 is exact to 1e-6.
    assert (exact - single).abs().max() < 1e-5 * wave.abs().max()
    element.float()


def test_wrong_shapes_and_units_are_one_line(element):
    wave = torch.ones(40, 40, dtype=torch.complex64)
    for call in (
        lambda: element(wave[:39], 0.6),
        lambda: element(wave, 0.6, torch.zeros(39, 40)),
        lambda: element(wave, 600.0),
        lambda: element.start_from_levels(np.zeros((20, 20))),
        lambda: element.start_from_phase(torch.zeros(20, 20), 0.6),
    ):
        with pytest.raises(InputError) as refused:
            call()
        assert len(str(refused.value).splitlines()) == 1


@pytest.mark.long
def test_a_compiled_element_gives_the_same_wave(element):
    wave = torch.ones(40, 40, dtype=torch.complex64)
    compiled = torch.compile(element, backend="aot_eager")
    assert torch.allclose(compiled(wave, 0.6328), element(wave, 0.6328), rtol=1e-5)


def test_what_cannot_be_an_element_is_refused(element, make_printer, monkeypatch):
    printer = make_printer(LAYOUT)
    with pytest.raises(InputError, match="wanted air"):
        Element(printer, LAYOUT, kind="thick", surroundings=1.33)
    with pytest.raises(InputError, match="resin"):
        Element(printer, LAYOUT, resin="constant").optics(0.5)
    for said, bad in (
        ("resin, got 'su8', wanted .* its refractive index; did you mean su-8", {"resin": "su8"}),
        ("resin, got 'None'", {"resin": None}),
        ("kind of an element, got 'Thick', wanted thin, thick", {"kind": "Thick"}),
        ("absorption_per_um, got -1, wanted a number from 0", {"absorption_per_um": -1}),
        ("surroundings, got 0, wanted a number from 1", {"surroundings": 0}),
    ):
        with pytest.raises(InputError, match=said):
            Element(printer, LAYOUT, **bad)
    assert Element(printer, LAYOUT, resin=1.5).optics(0.5).index_step == 0.5
    for several in (torch.tensor([0.5, 0.6]), np.array([0.5, 0.6]), [0.5, 0.6]):
        with pytest.raises(InputError, match="wanted one number in µm; call the element once"):
            element.transmission(several)
    with pytest.raises(InputError, match="a thin element"):
        Element(printer, LAYOUT, kind="thick").as_torchoptics()
    printer.simulator.card = {"process_effects": {"edge-bead": {}}}
    with pytest.raises(InputError, match="one piece"):
        Element(printer, LAYOUT, tile_px=20)
    monkeypatch.setitem(sys.modules, "torchoptics.elements", None)
    monkeypatch.delitem(sys.modules, "litho_design.elements.in_torchoptics", raising=False)
    with pytest.raises(InputError, match=r"litholoop\[torchoptics\]"):
        element.as_torchoptics()


@pytest.mark.parametrize(
    ("name", "options", "better"),
    [
        ("rgb_hologram", ["--distance-um", "6", "--iterations", "12"], min),
        ("structured_light_4f", ["--focal-um", "20", "--waist-um", "1.5", "--iterations", "12"], max),
        ("extended_focus", ["--focal-um", "10", "--range-um", "6", "--iterations", "8"], max),
        ("microscope_phase_mask", ["--iterations", "6"], min),
    ],
)
def test_examples_train_through_the_printer(monkeypatch, capsys, name, options, better):
    """Check that an element designed through the printer model performs better than an element designed for a
    perfect printer.
    """
    if name == "structured_light_4f":
        pytest.importorskip("torchoptics")
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", [name, "zoo:physics", "--size-px", "48", *options])
    module.main()
    said = capsys.readouterr().out.splitlines()
    figures = {line.split(":")[0]: float(re.search(r"[\d.]+", line.split(": ")[-1])[0]) for line in said}
    perfect, through = (next(v for k, v in figures.items() if w in k) for w in ("none", "zoo"))
    assert through == better(perfect, through) != perfect
