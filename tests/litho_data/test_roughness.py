"""Test roughness against closed forms and on surfaces with a known spectrum."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.roughness import (
    amplitude_parameters,
    autocorrelation,
    effective_samples,
    exponential_correlation,
    gaussian_correlation,
    groove_depth,
    psd_along,
    retained_variance,
    sq_uncertainty_nm,
    stair_steps,
)

PITCH_UM = 0.1


def gaussian_surface(shape: tuple[int, int], length_um: float, seed: int) -> np.ndarray:
    """Return a random periodic surface in µm with autocorrelation exp(−r²/T²) and a mean rms of 10 nm."""
    frequency = np.hypot(
        np.fft.fftfreq(shape[0], PITCH_UM)[:, None], np.fft.rfftfreq(shape[1], PITCH_UM)[None]
    )
    # The transform of exp(−r²/T²) is proportional to exp(−π²T²f²). Amplitudes are filtered by its root.
    transfer = np.exp(-((np.pi * length_um * frequency) ** 2) / 2)
    field = np.fft.irfft2(
        np.fft.rfft2(np.random.default_rng(seed).standard_normal(shape)) * transfer, s=shape
    )
    full = np.exp(
        -((np.pi * length_um) ** 2)
        * (np.fft.fftfreq(shape[0], PITCH_UM)[:, None] ** 2 + np.fft.fftfreq(shape[1], PITCH_UM)[None] ** 2)
    )
    return 0.010 * field / np.sqrt(full.mean())


class TestAmplitudes:
    def test_sine_has_its_closed_form_values(self):
        x = np.arange(400) / 400 * 2 * np.pi * 5
        found = amplitude_parameters(0.05 * np.sin(x)[None, :].repeat(3, 0))
        # With 80 pixels per period, the sums of sin² and sin⁴ equal their integrals. The mean of the sampled
        # |sin| is 2/80·cot(π/80).
        assert found.sq_nm == pytest.approx(50 / 2**0.5, rel=1e-12)
        assert found.sa_nm == pytest.approx(50 * 2 / 80 / np.tan(np.pi / 80), rel=1e-12)
        assert found.ssk == pytest.approx(0, abs=1e-12)
        assert found.sku == pytest.approx(1.5, rel=1e-12)
        assert found.sz_nm == pytest.approx(100, rel=1e-12)

    def test_two_heights_have_the_skewness_of_a_coin(self):
        height = np.zeros(1000)
        height[:100] = 0.01
        found = amplitude_parameters(height)
        # A Bernoulli variable has skewness (1 − 2p)/√(p(1 − p)) and kurtosis 3 + (1 − 6p(1 − p))/(p(1 − p)).
        assert found.ssk == pytest.approx(0.8 / 0.3, rel=1e-9)
        assert found.sku == pytest.approx(3 + (1 - 0.54) / 0.09, rel=1e-9)

    def test_an_offset_changes_nothing_and_missing_pixels_are_ignored(self):
        height = np.random.default_rng(0).standard_normal((40, 50)) * 0.01
        holes = np.where(np.random.default_rng(1).random(height.shape) < 0.2, np.nan, height)
        assert amplitude_parameters(height + 3).sq_nm == pytest.approx(amplitude_parameters(height).sq_nm)
        assert amplitude_parameters(holes) == amplitude_parameters(height, np.isfinite(holes))

    def test_flat_surface_has_no_shape(self):
        found = amplitude_parameters(np.full((8, 8), 0.3))
        assert (found.sq_nm, found.ssk, found.sku) == (0, 0, 0)

    def test_nothing_valid_is_an_error(self):
        with pytest.raises(InputError, match="no valid pixel"):
            amplitude_parameters(np.full((4, 4), np.nan))


class TestSpectra:
    def test_parseval_without_window(self):
        height = np.random.default_rng(2).standard_normal((30, 101)) * 0.01
        for axis, lines in (("x", height), ("y", height.T)):
            spectrum = psd_along(height, PITCH_UM, axis, window=False)
            step = spectrum.frequency_per_um[1] - spectrum.frequency_per_um[0]
            assert spectrum.density.sum() * step == pytest.approx(1e6 * lines.var(axis=1).mean(), rel=1e-12)

    def test_sine_sits_in_its_bin(self):
        x_um = (np.arange(500) + 0.5) * PITCH_UM
        height = 0.02 * np.sin(2 * np.pi * 1.2 * x_um)[None, :].repeat(4, 0)
        spectrum = psd_along(height, PITCH_UM, "x", window=False)
        peak = np.argmax(spectrum.density)
        assert spectrum.frequency_per_um[peak] == pytest.approx(1.2)
        # The whole power, amplitude²/2, lies in one bin of width 1/50 per µm.
        assert spectrum.density[peak] / 50 == pytest.approx(20**2 / 2, rel=1e-9)

    def test_white_noise_is_level_also_through_the_window(self):
        height = np.random.default_rng(3).standard_normal((400, 256)) * 0.002
        spectrum = psd_along(height, PITCH_UM, "x")
        # The one-sided density of white noise is 2 σ² pitch = 0.8 nm²µm. The mean of 400 lines gives each bin
        # to 5 %, and the mean of 100 bins to 1 %.
        assert spectrum.density[10:110].mean() == pytest.approx(2 * 4 * PITCH_UM, rel=0.03)

    def test_nan_is_an_error(self):
        with pytest.raises(InputError, match="NaN"):
            psd_along(np.full((9, 9), np.nan), PITCH_UM, "x")


class TestCorrelation:
    def test_cosine_is_its_own_autocorrelation(self):
        x = np.arange(400)
        correlation = autocorrelation(np.cos(2 * np.pi * x / 40)[None, :].repeat(8, 0))
        centre = correlation.shape[1] // 2
        # Only at multiples of half a period do the pairs span whole periods. There the value is exact, and at
        # half a period it is −1.
        assert correlation[0, centre + 20] == pytest.approx(-1, abs=1e-9)
        assert correlation[0, centre + 40] == pytest.approx(1, abs=1e-9)

    @pytest.mark.parametrize("shape", [(128, 128), (48, 200), (1, 4000), (4000, 1)])
    def test_white_noise_counts_every_pixel(self, shape):
        rng = np.random.default_rng(4)
        counts = [effective_samples(rng.standard_normal(shape)) for _ in range(10)]
        assert np.mean(counts) == pytest.approx(shape[0] * shape[1], rel=0.03)

    @pytest.mark.parametrize("length_um", [0.2, 0.8])
    def test_uncertainty_of_sq_matches_its_scatter(self, length_um):
        # Each surface is cut from a larger periodic one, because opposite edges of a measured field differ.
        surfaces = [gaussian_surface((96, 96), length_um, seed)[:64, :64] for seed in range(400)]
        scatter = np.std([amplitude_parameters(s).sq_nm for s in surfaces])
        stated = np.mean([sq_uncertainty_nm(s) for s in surfaces])
        # The sd of 400 draws is known to 1/√800 = 3.5 %. Allow two and a half such errors.
        assert stated == pytest.approx(scatter, rel=0.09)

    @pytest.mark.parametrize("shape", [(1, 64), (64, 1), (1, 2), (2, 3), (3, 2), (5, 5)])
    def test_profiles_and_tiny_surfaces_have_an_autocorrelation(self, shape):
        height = np.random.default_rng(5).standard_normal(shape)
        found = autocorrelation(height)
        assert found.shape == tuple(max(1, n) for n in (shape[0] // 2, 2 * (shape[1] // 2) - 1))
        assert found[0, found.shape[1] // 2] == pytest.approx(1)
        assert 1 <= effective_samples(height) <= height.size


class TestStepHeight:
    def test_groove_on_a_tilt_is_exact(self):
        x_um = (np.arange(300) + 0.5) * PITCH_UM
        groove = np.where((x_um > 10) & (x_um < 20), -0.25, 0.0) + 0.01 * x_um + 0.3
        found = groove_depth(groove[None, :].repeat(5, 0), PITCH_UM, left_um=10, right_um=20)
        assert found.height_nm == pytest.approx(-250, abs=1e-9)
        assert found.line_sd_nm == pytest.approx(0, abs=1e-9)

    def test_rounded_edges_do_not_affect_a_step_height(self):
        x_um = (np.arange(300) + 0.5) * PITCH_UM
        smooth = 0.1 * (np.tanh((x_um - 10) / 0.3) - np.tanh((x_um - 20) / 0.3)) / 2
        found = groove_depth(smooth[None, :].repeat(3, 0), PITCH_UM, left_um=10, right_um=20)
        # A third of 10 µm is 11 times the length of the tanh, so e^−22 of the step remains there.
        assert found.height_nm == pytest.approx(100, abs=1e-6)

    def test_stairs_along_y_with_missing_pixels(self):
        y_um = (np.arange(250) + 0.5) * PITCH_UM
        stairs = 0.1 * np.floor(y_um / 5)
        height = stairs[:, None].repeat(40, 1)
        height[10:14, 3] = np.nan
        steps = stair_steps(height, PITCH_UM, edges_um=[5, 10, 15, 20], axis="y")
        assert [step.height_nm for step in steps] == pytest.approx([100] * 4, abs=1e-9)

    def test_uncertainty_covers_the_error(self):
        rng = np.random.default_rng(5)
        x_um = (np.arange(300) + 0.5) * PITCH_UM
        errors = []
        for _ in range(200):
            noisy = np.where((x_um > 10) & (x_um < 20), 0.1, 0) + rng.standard_normal((30, 300)) * 0.005
            found = groove_depth(noisy, PITCH_UM, left_um=10, right_um=20)
            errors.append((found.height_nm - 100) / found.uncertainty_nm)
        # Normal errors would give 1. With an uncertainty from 30 lines, a t distribution gives 1.0 to 1.2.
        assert 0.85 < np.std(errors) < 1.3

    def test_bad_edges_are_an_error(self):
        with pytest.raises(InputError, match="one width free on both sides"):
            groove_depth(np.zeros((4, 100)), PITCH_UM, left_um=1, right_um=6)
        with pytest.raises(InputError, match="ascending"):
            stair_steps(np.zeros((4, 100)), PITCH_UM, edges_um=[5, 4])


class TestLevellingBias:
    def test_white_noise_loses_its_degrees_of_freedom(self):
        def white(y_um, x_um):
            return ((y_um == 0) & (x_um == 0)).astype(float)

        # A second-order polynomial uses 6 terms for 32 × 40 pixels.
        assert retained_variance((32, 40), PITCH_UM, white, degree=2) == pytest.approx(
            1 - 6 / 1280, rel=1e-12
        )
        # Independent degrees 1 × 2 use 2 · 3 terms.
        assert retained_variance((32, 40), PITCH_UM, white, degree=(1, 2)) == pytest.approx(
            1 - 6 / 1280, rel=1e-12
        )
        # A single row uses two terms for 40 pixels.
        assert retained_variance((1, 40), PITCH_UM, white, degree=(0, 1)) == pytest.approx(
            1 - 2 / 40, rel=1e-12
        )

    def test_row_mean_of_an_exponential_profile_has_a_closed_form(self):
        # For exp(−|x|/T), the continuous mean over L has the variance 2T/L − 2(T/L)²(1 − e^(−L/T)).
        ratio = 0.05
        closed = 1 - 2 * ratio + 2 * ratio**2 * (1 - np.exp(-1 / ratio))
        found = retained_variance((1, 1000), 0.01, exponential_correlation(0.5), degree=0)
        # Sampling at T/50 differs from the integral by about (pitch/T)²/6.
        assert found == pytest.approx(closed, rel=2e-4)

    @pytest.mark.parametrize("degree", [0, 1, 2])
    def test_the_levelling_bias_agrees_with_a_monte_carlo_simulation(self, degree):
        shape, length_um = (64, 64), 0.6
        y, x = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij"))
        basis = np.stack([x**p * y**q for p in range(degree + 1) for q in range(degree + 1 - p)], axis=1)
        q, _ = np.linalg.qr(basis)
        kept = []
        for seed in range(200):
            # Each surface is cropped from a larger periodic one, so that its opposite edges are independent.
            surface = gaussian_surface((128, 128), length_um, seed)[:64, :64].ravel() / 0.010
            kept.append(np.mean((surface - q @ (q.T @ surface)) ** 2))
        expected = retained_variance(shape, PITCH_UM, gaussian_correlation(length_um), degree=degree)
        # A surface has 6.4²/(π·0.36/2) = 72 independent spots, so the relative sd is √(2/72/200) = 1.2 %.
        assert np.mean(kept) == pytest.approx(expected, rel=0.04)

    def test_levelling_rows_removes_more_variance_than_levelling_the_field(self):
        correlation = gaussian_correlation(0.8)
        by_rows = retained_variance((1, 128), PITCH_UM, correlation, degree=(0, 1))
        assert by_rows < retained_variance((128, 128), PITCH_UM, correlation, degree=1)
