"""Test the steps from levels to a scored image: gradients, normalisation, and scores by other code."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from litho_design.holograms.bench import HologramBench, hologram_score, through_aperture, zero_order_share
from litho_design.holograms.loss import hologram_loss
from litho_design.holograms.settings import HologramLoss
from litho_design.images.similarity import (
    SSIM_WINDOW_PX,
    light_figures,
    matched_scale,
    si_psnr_db,
    similarity,
    ssim,
)
from litho_design.images.targets import draw_target
from litho_design.optics import Optics, RSPropagator, centred_grid, element_field, intensity_share
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.phases import fresnel_lens_phase, gerchberg_saxton
from litho_design.printers.layout import LayoutSettings

pytestmark = pytest.mark.numerics

WAVELENGTH_UM = 0.6328
LIGHTS = [{}, {"incidence_x": 0.1, "incidence_y": -0.05}, {"beam_um": 6.0, "source_distance_um": 50.0}]


def test_gradient_from_mask_through_print_and_field_to_loss(make_printer):
    layout = LayoutSettings(size_px=16)
    printer = make_printer(layout).double()
    bench = HologramBench(layout, Optics(distance_um=5.0), dtype=torch.complex128)
    target = torch.from_numpy(draw_target("ring", 16)).double()

    def loss(level):
        return hologram_loss(bench(printer(level)[0, 0]), target, HologramLoss())[0]

    level = (torch.rand(1, 1, 16, 16, dtype=torch.float64) * 12).requires_grad_()
    assert torch.autograd.gradcheck(loss, (level,), atol=1e-6)


@pytest.mark.parametrize("scale", ["paper", "least-squares"])
def test_half_the_light_halves_the_efficiency_term(scale):
    # The published loss divides by the efficiency twice. Here, half the light must count half.
    target = torch.zeros(8, 8).double()
    target[2:4, 2:4] = 1
    share = torch.rand(8, 8).double() / 64
    share[2:4, 2:4] = 0.1
    settings = HologramLoss(scale=scale, efficiency_weight=0.3)
    loss, parts = hologram_loss(share, target, settings)
    dimmer_loss, dimmer = hologram_loss(share / 2, target, settings)
    assert parts["efficiency"] == pytest.approx(0.4, rel=1e-12)
    assert dimmer["efficiency"] == pytest.approx(0.2, rel=1e-12)
    assert dimmer["rmse"] == pytest.approx(parts["rmse"], rel=1e-12)
    assert float(dimmer_loss - loss) == pytest.approx(0.3 * 0.2, rel=1e-9)


def test_incident_power_is_one_with_and_without_an_aperture():
    grid = centred_grid((40, 40), 0.2)
    height = torch.rand(40, 40).double()
    disc = torch.from_numpy(np.hypot(grid.y_um[:, None], grid.x_um[None, :]) < 3).double()
    for aperture in (None, disc):
        field = element_field(height, grid, Optics(), aperture)
        assert float(intensity_share(field, grid).sum()) == pytest.approx(1, rel=1e-12)


def test_scores_of_a_perfect_image():
    layout = LayoutSettings(size_px=64)
    target = torch.from_numpy(draw_target("ring", 64)).double()
    grid = centred_grid((64, 64), layout.pitch_um)
    field = (target / (target.sum() * 0.01)).sqrt().to(torch.complex128)
    score = hologram_score([(1.0, field)], field, target, grid, Optics())
    assert score.eff_window == pytest.approx(1, rel=1e-12)
    assert score.ssim == pytest.approx(1, abs=1e-6)
    assert score.rmse_paper < 0.1  # I_avg is weighted by T, so it is exact only for a binary target
    assert score.si_psnr_db > 100
    assert score.uniformity > 0.3


def test_fully_developed_speckle_has_unit_contrast():
    target = torch.ones(256, 256).double()
    target[:, :128] = 0
    speckle = torch.randn(256, 256, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    grid = centred_grid((256, 256), 0.1)
    score = hologram_score([(1.0, speckle)], speckle, target, grid, Optics())
    # With 32768 independent samples of an exponential distribution, the contrast has an sd of about 0.006.
    assert score.speckle_contrast == pytest.approx(1, abs=0.03)
    # For a target without greys, both efficiencies select the same half of the light.
    assert score.eff_paper == score.eff_signal == pytest.approx(score.eff_window / 2, rel=0.03)


def test_the_light_of_four_pixels():
    share, target = torch.tensor([[1.0, 3.0], [0.5, 0.0]]), torch.tensor([[1.0, 0.6], [0.5, 0.0]])
    wanted = {
        "eff_signal": 4.0,
        "eff_window": 4.5,
        # Each of the lit pixels differs by 1 from the mean of 2.
        "speckle_contrast": 0.5,
        # The 5 % and 95 % quantiles are 1.1 and 2.9.
        "uniformity": 1 - 1.8 / 4,
        "background_ratio": 8.0,
    }
    assert light_figures(share, target) == pytest.approx(wanted)


def test_the_uniformity_of_more_than_16_million_pixels():
    """Check evenly spaced values from 0 to 1, whose percentiles are 0.05 and 0.95."""
    share = torch.linspace(0, 1, 2**24 + 2)
    target = torch.ones_like(share)
    target[0] = 0
    assert light_figures(share, target)["uniformity"] == pytest.approx(0.1, abs=1e-5)


@pytest.mark.parametrize("light", LIGHTS)
def test_the_zero_order_is_the_light_that_the_element_leaves_as_it_was(light):
    grid, optics = centred_grid((64, 64), 0.1), Optics(**light)
    flat = torch.full((64, 64), 0.3)
    assert zero_order_share(element_field(flat, grid, optics), grid, optics) == pytest.approx(1, abs=1e-6)
    # A checkerboard of the phases 0 and phi leaves cos^2(phi / 2).
    board = torch.from_numpy(np.indices((64, 64)).sum(0) % 2).float() * (optics.wave_height_um / 6)
    share = zero_order_share(element_field(board, grid, optics), grid, optics)
    assert share == pytest.approx(math.cos(math.pi / 6) ** 2, abs=1e-6)


def test_si_psnr_ignores_scale():
    generator = torch.Generator().manual_seed(0)
    image, target = (torch.rand(32, 32, generator=generator).double() for _ in range(2))
    assert si_psnr_db(image, target) == pytest.approx(si_psnr_db(37.5 * image, target), abs=1e-6)


@pytest.mark.parametrize("kind", ["noise", "smooth", "constant", "edges", "dark"])
def test_psnr_equals_scikit_image(kind):
    from skimage.metrics import peak_signal_noise_ratio

    image = example_image(kind)
    other = np.clip(image + 0.1 * np.random.default_rng(1).standard_normal(image.shape), 0, 1)
    target, seen = torch.from_numpy(image), torch.from_numpy(other)
    scaled = (matched_scale(seen, target) * seen).numpy()
    reference = peak_signal_noise_ratio(image, scaled, data_range=1.0) if image.any() else 300.0
    # For a dark target, a scale of 0 gives no error. The floor of the error, 1e-30, is 300 dB.
    assert si_psnr_db(seen, target) == pytest.approx(reference, abs=1e-6)
    figures = similarity(seen, target, "seen")
    assert figures["psnr_seen_db"] == pytest.approx(
        peak_signal_noise_ratio(image, other, data_range=1.0), abs=1e-6
    )


def example_image(kind: str) -> np.ndarray:
    return {
        "noise": np.random.default_rng(0).random((48, 48)),
        "smooth": np.sin(np.linspace(0, 3, 48))[:, None] * np.ones((48, 48)) * 0.5 + 0.5,
        "constant": np.full((48, 48), 0.4),
        "edges": (np.indices((48, 48)).sum(0) // 9 % 2).astype(float),
        "dark": np.zeros((48, 48)),
    }[kind]


@pytest.mark.parametrize("kind", ["noise", "smooth", "constant", "edges", "dark"])
def test_ssim_equals_torchmetrics(kind):
    from torchmetrics.functional.image import structural_similarity_index_measure

    image = example_image(kind)
    other = np.clip(image + 0.1 * np.random.default_rng(1).standard_normal(image.shape), 0, 1)
    for second in (image, other):
        pair = [torch.from_numpy(array) for array in (image, second)]
        _, similarity = structural_similarity_index_measure(
            *(array[None, None] for array in pair),
            sigma=1.5,
            kernel_size=SSIM_WINDOW_PX,
            data_range=1.0,
            return_full_image=True,
        )
        # The reference averages over windows that include reflected padding, but the definition does not.
        edge = SSIM_WINDOW_PX // 2
        reference = float(similarity[..., edge:-edge, edge:-edge].mean())
        assert ssim(*pair) == pytest.approx(reference, abs=1e-4)
    assert ssim(torch.from_numpy(image), torch.from_numpy(image)) == pytest.approx(1, abs=1e-4)


def test_an_aperture_passes_what_is_inside_it_and_nothing_else():
    grid = centred_grid((200, 200), 0.1)
    x = torch.from_numpy(grid.x_um)
    for angle_sine, passed in ((0.2, 1.0), (0.45, 0.0)):
        # The window contains whole half periods of the cosine, so it can be continued by mirroring.
        half_periods = round(2 * 20.0 * angle_sine / WAVELENGTH_UM)
        wave = (
            torch.cos(math.pi * half_periods * (x - x[0] + 0.05) / 20.0).expand(200, 200).to(torch.complex128)
        )
        out = through_aperture(wave, grid, WAVELENGTH_UM, 0.3)
        assert float(out.abs().square().sum() / wave.abs().square().sum()) == pytest.approx(passed, abs=1e-9)


@pytest.mark.parametrize("light", LIGHTS)
def test_gerchberg_saxton_error_never_rises(light):
    layout = LayoutSettings(size_px=96)
    bench = HologramBench(layout, Optics(distance_um=25.0, **light), dtype=torch.complex128)
    target = torch.from_numpy(draw_target("ring", 96)).double()
    arguments = {"iterations": 30, "weighted": False, "seed": 1}
    _, errors = gerchberg_saxton(bench.propagator, target, CellMap(layout), bench.illumination(), **arguments)
    assert all(after <= before * (1 + 1e-12) for before, after in itertools.pairwise(errors))
    assert errors[-1] < 0.85 * errors[0]


@pytest.mark.parametrize("light", LIGHTS)
def test_what_a_flat_plate_shows_is_made_by_a_flat_plate(light):
    layout = LayoutSettings(size_px=96)
    bench = HologramBench(layout, Optics(distance_um=25.0, **light), dtype=torch.complex128)
    seen = bench(torch.zeros(96, 96, dtype=torch.float64))
    for weighted in (False, True):
        phase, _ = gerchberg_saxton(
            bench.propagator, seen / seen.max(), CellMap(layout), bench.illumination(), iterations=40,
            weighted=weighted, seed=1,
        )  # fmt: skip
        # |mean exp(j phase)| is 1 for a flat plate, sin(1) / 1 = 0.84 for the first phase, which is within
        # 1 rad of its mean, and 1 / sqrt(cells) = 0.04 for random phases on the whole circle.
        assert float(torch.polar(torch.ones_like(phase), phase).mean().abs()) > 0.9


def test_weighting_makes_the_image_more_even():
    layout = LayoutSettings(size_px=96)
    bench = HologramBench(layout, Optics(distance_um=25.0))
    target = torch.from_numpy(draw_target("spots", 96))
    cells = CellMap(layout)
    spread = {}
    for weighted in (False, True):
        phase, _ = gerchberg_saxton(
            bench.propagator, target, cells, bench.illumination(), iterations=30, weighted=weighted, seed=0
        )
        lit = bench(cells(phase) * Optics().wave_height_um / (2 * math.pi))[target > 0.5]
        spread[weighted] = float(lit.std() / lit.mean())
    assert spread[True] < spread[False]


@pytest.mark.parametrize("light", LIGHTS[:2])
def test_fresnel_start_focuses_to_the_diffraction_limit(light):
    layout = LayoutSettings(size_px=200, cell_um=0.1)
    optics = Optics(distance_um=100.0, **light)
    cells = CellMap(layout)
    phase = cells(fresnel_lens_phase(cells, layout.pitch_um, optics))
    grid = centred_grid((200, 200), 0.1)
    line = centred_grid((1, 41), 0.1)
    propagate = RSPropagator(grid, line, 100.0, WAVELENGTH_UM)
    height = phase * optics.wave_height_um / (2 * math.pi)
    intensity = propagate(element_field(height, grid, optics)).abs().square()[0]
    assert int(intensity.argmax()) == 20
    # A square aperture of area A has a peak of A / (wavelength f)^2 per power, to 1.5 % at a/f = 0.1.
    assert float(intensity[20]) == pytest.approx(400 / (WAVELENGTH_UM * 100) ** 2, rel=0.02)
