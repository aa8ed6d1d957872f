"""Check curves over spatial frequency against a known blur, white noise, and Parseval's theorem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from litho_models.scoring.transfer import transfer_curves
from tests.litho_models.prints import make_scan

PITCH_UM = 0.1


def scan_of(height_um):
    scan = make_scan(0, len(height_um))
    scan.height_um[...] = height_um
    scan.valid[...] = True
    return scan


def white(seed, sd_um, size_px=512):
    return np.random.default_rng(seed).normal(0, sd_um, (size_px, size_px)).astype(np.float32)


def test_white_error_has_a_flat_density_whose_integral_is_its_variance():
    height = white(0, 0.2)
    curves = transfer_curves([scan_of(height)], [height + white(1, 0.010)])
    width = curves.frequency_per_um[1] - curves.frequency_per_um[0]
    for density in (curves.error_psd_x, curves.error_psd_y):
        # The one-sided density spreads σ² over 0 … 5 cycles/µm. A band averages 512 lines and about 7
        # frequencies that are independent in spite of the Hann window. Its standard error is 1/√3500 = 1.7 %;
        # four are allowed. The lowest band is excluded, because each line's mean is removed.
        assert density[1:] == pytest.approx([100 / 5] * (len(density) - 1), rel=0.07)
        assert np.sum(density) * width == pytest.approx(100, rel=0.03)


def test_unmeasured_lines_do_not_change_the_curves():
    height = white(5, 0.2, 128)
    prediction = 0.8 * height + white(6, 0.1, 128)
    scan = scan_of(height)
    measured = slice(32, 64)
    scan.valid[: measured.start] = scan.valid[measured.stop :] = False
    scan.height_um[~scan.valid] = np.nan
    alone = replace(
        scan,
        mask_level=scan.mask_level[measured],
        height_um=height[measured],
        valid=scan.valid[measured],
    )
    found = transfer_curves([scan], [prediction])
    wanted = transfer_curves([alone], [prediction[measured]])
    for curve in ("gain_x", "coherence_x", "error_psd_x"):
        assert getattr(found, curve) == pytest.approx(getattr(wanted, curve))


def test_half_measured_lines_have_the_error_of_their_measured_half():
    height = white(0, 0.2)
    scan = scan_of(height)
    scan.valid[:, :256] = False
    curves = transfer_curves([scan], [height + white(1, 0.010)])
    assert curves.error_psd_x[1:] == pytest.approx([100 / 5] * (len(curves.error_psd_x) - 1), rel=0.1)


def test_a_blurred_prediction_follows_as_far_as_the_gaussian_does():
    height = white(2, 0.2)
    sigma_um = 0.15
    curves = transfer_curves([scan_of(height)], [gaussian_filter1d(height, sigma_um / PITCH_UM, axis=1)])
    frequency = np.array(curves.frequency_per_um)
    # Within a band, which is 0.2 cycles/µm wide, the Gaussian changes by at most 0.06.
    assert curves.gain_x == pytest.approx(np.exp(-2 * (np.pi * sigma_um * frequency) ** 2), abs=0.02)
    # The blur acts across the lines along y, so it reduces all their frequencies equally.
    assert np.ptp(curves.gain_y[1:]) < 0.05


def test_a_shifted_prediction_follows_as_well_as_an_unshifted_one():
    height = white(4, 0.2, 256)
    # From pixel to pixel the window is nearly constant, so it hides no part of a shift by one pixel.
    curves = transfer_curves([scan_of(height)], [np.roll(height, 1, axis=1)])
    assert curves.gain_x == pytest.approx([1] * len(curves.gain_x), abs=0.005)
    assert curves.coherence_x == pytest.approx([1] * len(curves.gain_x), abs=0.005)


def test_a_perfect_prediction_follows_to_the_end():
    height = white(3, 0.2, 64)
    curves = transfer_curves([scan_of(height)], [height])
    assert curves.gain_x == pytest.approx([1] * len(curves.gain_x))
    assert curves.coherence_y == pytest.approx([1] * len(curves.gain_x))
    assert np.max(curves.error_psd_x) == 0
