"""Test a source with width and bandwidth against convolution, brute force and a point source."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design import design_hologram, hologram_settings, load_design
from litho_design.holograms.bench import HologramBench
from litho_design.large.hologram import LIGHT, only
from litho_design.lenses.bench import LensBench
from litho_design.lenses.settings import LensView
from litho_design.optics import Optics, element_field, intensity_share
from litho_design.optics.source import coherent_parts
from litho_design.printers.layout import LayoutSettings

LAYOUT = LayoutSettings(size_px=128)
OPTICS = Optics(distance_um=40.0)


@pytest.fixture
def height():
    rough = np.random.default_rng(0).standard_normal((128, 128))
    return torch.from_numpy(2 * cv2.GaussianBlur(rough, (0, 0), 3.0)).float()


def test_a_point_of_one_colour_is_the_plane_wave_bit_for_bit(height):
    bench = HologramBench(LAYOUT, OPTICS)
    assert coherent_parts(OPTICS, 12.8) == [(1.0, OPTICS)]
    wave = bench.propagator(element_field(height, bench.grid, OPTICS))
    assert torch.equal(bench(height), intensity_share(wave, bench.grid))


def test_a_wide_source_blurs_the_image_by_its_disc(height):
    """Check that a disc-shaped source blurs the image by a disc. Light that arrives at the sine s shifts the
    image by z s (Fresnel).
    """
    sine, z_um = 0.02, OPTICS.distance_um
    wide = HologramBench(LAYOUT, OPTICS.model_copy(update={"source_sine": sine}))(height).numpy()
    point = HologramBench(LAYOUT, OPTICS)(height).numpy()
    x = np.arange(-12, 13) * 0.1
    disc = (np.hypot(x[:, None], x) < z_um * sine).astype(np.float32)
    middle = np.s_[20:-20, 20:-20]
    expected = cv2.filter2D(point, -1, disc / disc.sum())[middle]
    # A few directions, less than lambda z / D = 2 µm apart, represent the disc. Without the disc, the error
    # is far larger.
    error = np.abs(wide[middle] - expected).mean() / expected.mean()
    assert error < 0.05
    assert np.abs(point[middle] - expected).mean() / expected.mean() > 4 * error
    # The variance of a disc along one axis is a quarter of its squared radius. Its centre does not move.
    parts = coherent_parts(OPTICS.model_copy(update={"source_sine": sine, "incidence_x": 0.1}), 100.0)
    sines = np.array([part.incidence_x for _, part in parts])
    assert sines.mean() == pytest.approx(0.1, abs=1e-12)
    assert sines.var() == pytest.approx(sine**2 / 4, rel=0.02)


def test_a_bandwidth_is_the_mean_over_a_gaussian_spectrum(height):
    sd_um = 0.06
    found = HologramBench(LAYOUT, OPTICS.model_copy(update={"bandwidth_um": sd_um}))(height)
    steps = np.linspace(-4, 4, 41)
    weights = np.exp(-(steps**2) / 2) / np.exp(-(steps**2) / 2).sum()
    every = sum(
        weight * HologramBench(LAYOUT, OPTICS.at_wavelength(OPTICS.wavelength_um + sd_um * step))(height)
        for step, weight in zip(steps.tolist(), weights.tolist(), strict=True)
    )
    error = (found - every).abs().mean()
    assert error < 0.01 * every.mean()
    assert (HologramBench(LAYOUT, OPTICS)(height) - every).abs().mean() > 10 * error


def test_scores_add_up_the_light_of_the_source(height):
    """Check that a wide source reduces speckle and preserves the power, except for the light outside the
    window.
    """
    target = torch.zeros(128, 128)
    target[30:100, 30:100] = 1
    contrast, power = {}, {}
    for sine in (0.0, 0.1):
        optics = OPTICS.model_copy(update={"source_sine": sine})
        score = HologramBench(LAYOUT, optics).score(height, target)
        contrast[sine], power[sine] = score.speckle_contrast, score.eff_signal
    assert contrast[0.1] < 0.6 * contrast[0.0]
    assert power[0.1] == pytest.approx(power[0.0], rel=0.3)


def test_a_hologram_is_designed_for_its_source(tmp_path):
    """Check that search, score, yield and a reloaded design use the source in the settings."""
    changes = {
        "layout.size_px": 64, "optics.distance_um": 20, "optics.source_sine": 0.05, "search.iterations": 4,
        "search.polish_rounds": 0, "window.yield_draws": 2,
    }  # fmt: skip
    made = design_hologram("ring", "none", tmp_path, settings=hologram_settings(changes=changes))
    loaded = load_design(tmp_path)
    again = loaded.score(loaded.expected_um)
    assert again.eff_signal == pytest.approx(made.predicted["eff_signal"], rel=1e-6)
    # A measured print is an array.
    seen = np.load(tmp_path / "image_share.npy")
    measured = loaded.expected_um.double().numpy()
    np.testing.assert_allclose(loaded.image(measured), seen, rtol=1e-5, atol=1e-9)
    with pytest.raises(InputError, match="heights of a print, got no finite number at 4096"):
        loaded.score(measured * np.nan)
    point = HologramBench(made.layout, made.optics.model_copy(update={"source_sine": 0.0}))
    assert np.abs(point(loaded.expected_um).numpy() - seen).mean() > 0.1 * seen.mean()


def test_a_wide_source_is_refused_where_only_one_plane_wave_is_computed():
    wide = OPTICS.model_copy(update={"source_sine": 0.02})
    with pytest.raises(InputError, match="source of a lens"):
        LensBench(LAYOUT, wide, LensView(window_px=64))
    with pytest.raises(InputError, match=r"source_sine of a large element"):
        only(hologram_settings(changes={"optics.source_sine": 0.02}), LIGHT)
    with pytest.raises(InputError, match="width of the source"):
        coherent_parts(OPTICS.model_copy(update={"source_sine": 0.5}), 100.0)
    with pytest.raises(InputError, match="bandwidth of the source"):
        coherent_parts(OPTICS.model_copy(update={"bandwidth_um": 0.1}), 1000.0)
