"""Test variations of the print and the optics: the depth of focus of a perfect lens, draws, and measured
spreads.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_data.store.lock_box import lock_box
from litho_design.lenses.bench import LensBench
from litho_design.lenses.settings import LensView
from litho_design.optics import Optics
from litho_design.optimisation.process_window import (
    Draw,
    ProcessWindow,
    draws,
    measure_yield,
    measured_window,
)
from litho_design.printers.layout import LayoutSettings


def test_a_perfect_lens_has_the_depth_of_focus_of_its_aperture():
    # A defocus of d is a path of d NA^2 / 2 at the edge. So the axial intensity behind a circle is
    # sinc^2(d NA^2 / (2 lambda)), which is 0.8 at an argument of 0.2535 on both sides.
    layout = LayoutSettings(size_px=600, cell_um=0.1, symmetry="radial")
    bench = LensBench(layout, Optics(distance_um=100.0), LensView(window_px=64))
    ideal, depth = bench.ideal_height_um(), 2 * 0.2535 * 0.6328 / bench.numerical_aperture**2
    peak = float(bench(ideal).max())
    for defocus_um in (-depth, depth):
        moved = LensBench(layout, Optics(distance_um=100.0 + defocus_um), LensView(window_px=64))
        # The focus also falls off as 1 / z^2, which is 4 % over the depth.
        assert float(moved(ideal).max()) / peak == pytest.approx(0.8, rel=0.06)
    # At a gain of g, the first order of a blazed zone has sinc^2(1 - g) of the light.
    for gain in (0.85, 1.15):
        assert float(bench(gain * ideal).max()) / peak == pytest.approx(np.sinc(1 - gain) ** 2, abs=0.02)


def test_rings_are_blurred_like_a_plane_wave_of_their_radius():
    ring = torch.cos(2 * torch.pi * (torch.arange(400) + 0.5) * 0.1 / 1.6).double()
    blurred = Draw(1.0, 0.0, 0.2, Optics()).apply(ring, 0.1)
    expected = np.exp(-2 * np.pi**2 * 0.2**2 / 1.6**2)
    # Mirroring at the centre continues a cosine exactly. The outer end is excluded.
    assert torch.allclose(blurred[:360], expected * ring[:360], atol=1e-3)


class _Scan:
    def __init__(self, name: str, gain: float, offset_um: float):
        self.id = self.print_id = name
        generator = np.random.default_rng(0)
        self.layout_um = generator.integers(0, 13, (32, 32)) * 0.1
        self.height_um = gain * self.layout_um + offset_um
        self.valid = np.ones((32, 32), bool)


class _Store:
    def __init__(self, *scans: _Scan):
        self._scans = list(scans)

    def scans(self) -> list[_Scan]:
        return self._scans

    @property
    def locked_ids(self) -> list[str]:
        ids = [scan.id for scan in self._scans]
        return lock_box(ids, ids, ids)


def _store(gains: np.ndarray, offsets: np.ndarray) -> _Store:
    return _Store(*(_Scan(f"scan{i}", g, o) for i, (g, o) in enumerate(zip(gains, offsets, strict=True))))


def test_spreads_of_measured_prints_come_back_without_the_locked_ones():
    gains, offsets = np.array([0.5, 0.6, 0.7, 0.6, 0.65]), np.array([0.12, 0.2, 0.16, 0.16, 0.19])
    store = _store(gains, offsets)
    locked = [int(name.removeprefix("scan")) for name in store.locked_ids]
    assert len(locked) == 1
    kept_gains, kept_offsets = np.delete(gains, locked), np.delete(offsets, locked)
    window = measured_window(store, ProcessWindow(samples=4))
    assert window.samples == 4
    assert window.gain_sd == pytest.approx(kept_gains.std(ddof=1) / kept_gains.mean(), rel=1e-6)
    assert window.offset_sd_um == pytest.approx(kept_offsets.std(ddof=1), rel=1e-6)
    together = np.corrcoef(kept_gains, kept_offsets)[0, 1]
    assert window.gain_offset_correlation == pytest.approx(together, rel=1e-6)
    # The heights of the locked print do not matter.
    gains[locked], offsets[locked] = 40.0, -3.0
    assert measured_window(_store(gains, offsets), ProcessWindow(samples=4)) == window


def test_a_spread_needs_three_scans_outside_the_lock_box():
    gains, offsets = np.array([0.5, 0.6, 0.7, 0.6]), np.array([0.12, 0.2, 0.16, 0.16])
    assert measured_window(_store(gains, offsets), ProcessWindow()).gain_sd > 0
    with pytest.raises(InputError, match=r"got 2 scans .*1 locked .* three"):
        measured_window(_store(gains[:3], offsets[:3]), ProcessWindow())


def test_a_draw_of_another_wavelength_has_the_index_of_its_resin():
    window = ProcessWindow(wavelength_sd_um=0.01)
    for draw in draws(window, Optics(), 3):
        shift_um = draw.optics.wavelength_um - 0.6328
        # For IP-Dip, dn / dlambda = -2 b / lambda^3 - 4 c / lambda^5 = -0.0516 - 0.0100 per µm. The curvature
        # 6 b / lambda^4 + 20 c / lambda^6 = 0.33 per µm^2 adds half of it times the squared shift.
        change = draw.optics.index_step - 0.548
        assert change == pytest.approx(-0.0616 * shift_um, abs=0.2 * shift_um**2 + 1e-6)
    constant = Optics(dispersion="constant")
    assert {draw.optics.index_step for draw in draws(window, constant, 3)} == {0.548}


def test_a_yield_counts_prints_and_has_the_interval_of_a_share():
    modelled = {"si_psnr_db": 20.0, "eff_signal": 0.5, "rms_nm": 10.0, "ssim": 0.4}
    good = {"si_psnr_db": 19.1, "eff_signal": 0.46, "rms_nm": 11.0}
    bad = [good | {"si_psnr_db": 18.9}, good | {"eff_signal": 0.44}, good | {"rms_nm": 11.2}]
    found = measure_yield([good] * 90 + bad * 3 + bad[:1], modelled, ["rms_nm"])
    assert (found.draws, found.passed, found.share) == (100, 90, 0.9)
    # Tables give this Wilson interval of 90 in 100.
    assert found.ci95 == pytest.approx((0.8256, 0.9448), abs=1e-4)
    assert found.figures == ["si_psnr_db", "eff_signal", "rms_nm"]


def test_gain_and_offset_are_drawn_together():
    many = draws(ProcessWindow(gain_offset_correlation=-0.8), Optics(), 4000)
    measured = np.corrcoef([d.gain for d in many], [d.offset_um for d in many])[0, 1]
    # The standard error of a correlation is (1 - r^2) / sqrt(n) = 0.006.
    assert measured == pytest.approx(-0.8, abs=0.03)
