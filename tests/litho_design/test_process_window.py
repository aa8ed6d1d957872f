"""Prints and optics that differ: depth of focus of a perfect lens, draws, measured spreads."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_data.store.lock_box import locked_ids
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
from litho_design.optimisation.stitching import Stitching, in_fields
from litho_design.printers.layout import LayoutSettings


def test_a_perfect_lens_has_the_depth_of_focus_of_its_aperture():
    # Defocus by d is a path of d NA^2 / 2 at the edge; the axial intensity behind a circle is
    # sinc^2(d NA^2 / (2 lambda)), which is 0.8 at an argument of 0.2535 on both sides.
    layout = LayoutSettings(size_px=600, cell_um=0.1, symmetry="radial")
    bench = LensBench(layout, Optics(distance_um=100.0), LensView(window_px=64))
    ideal, depth = bench.ideal_height_um(), 2 * 0.2535 * 0.6328 / bench.numerical_aperture**2
    peak = float(bench(ideal).max())
    for defocus_um in (-depth, depth):
        moved = LensBench(layout, Optics(distance_um=100.0 + defocus_um), LensView(window_px=64))
        # The focus also falls off as 1 / z^2: 4 % over the depth.
        assert float(moved(ideal).max()) / peak == pytest.approx(0.8, rel=0.06)
    # Gain g leaves sinc^2(1 - g) in the first order of a blazed zone.
    for gain in (0.85, 1.15):
        assert float(bench(gain * ideal).max()) / peak == pytest.approx(np.sinc(1 - gain) ** 2, abs=0.02)


def test_rings_are_blurred_like_a_plane_wave_of_their_radius():
    ring = torch.cos(2 * torch.pi * (torch.arange(400) + 0.5) * 0.1 / 1.6).double()
    blurred = Draw(1.0, 0.0, 0.2, Optics()).apply(ring, 0.1)
    expected = np.exp(-2 * np.pi**2 * 0.2**2 / 1.6**2)
    # The mirror at the centre continues a cosine as it is; the outer end is left out.
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
        return locked_ids(self._scans)


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
    # Whatever the locked print measures changes nothing.
    gains[locked], offsets[locked] = 40.0, -3.0
    assert measured_window(_store(gains, offsets), ProcessWindow(samples=4)) == window


def test_a_spread_needs_three_scans_outside_the_lock_box():
    gains, offsets = np.array([0.5, 0.6, 0.7, 0.6]), np.array([0.12, 0.2, 0.16, 0.16])
    assert measured_window(_store(gains, offsets), ProcessWindow()).gain_sd > 0
    with pytest.raises(InputError, match=r"got 2 scans .* 1 locked .* three"):
        measured_window(_store(gains[:3], offsets[:3]), ProcessWindow())


def test_a_draw_of_another_wavelength_has_the_index_of_its_resin():
    window = ProcessWindow(wavelength_sd_um=0.01)
    for draw in draws(window, Optics(), 3):
        shift_um = draw.optics.wavelength_um - 0.6328
        # IP-Dip: dn / dlambda = -2 b / lambda^3 - 4 c / lambda^5 = -0.0516 - 0.0100 per µm; the curvature,
        # 6 b / lambda^4 + 20 c / lambda^6 = 0.33 per µm^2, adds half its square.
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
    # Wilson's interval of 90 in 100, as in tables.
    assert found.ci95 == pytest.approx((0.8256, 0.9448), abs=1e-4)
    assert found.figures == ["si_psnr_db", "eff_signal", "rms_nm"]


def test_gain_and_offset_are_drawn_together():
    many = draws(ProcessWindow(gain_offset_correlation=-0.8), Optics(), 4000)
    measured = np.corrcoef([d.gain for d in many], [d.offset_um for d in many])[0, 1]
    # Standard error of a correlation: (1 - r^2) / sqrt(n) = 0.006.
    assert measured == pytest.approx(-0.8, abs=0.03)


def _first_order(height_um: torch.Tensor, period_px: int) -> complex:
    """Amplitude of the first order behind rows of a weak grating, which is that of its heights."""
    wave = torch.exp(-2j * torch.pi * torch.arange(height_um.shape[1]).double() / period_px)
    return complex((height_um.double() * wave).mean())


def test_a_displaced_field_turns_its_first_order_by_the_displacement_over_the_period():
    # Two fields of 80 px; a grating of 16 px; the second is moved by 3 px along x and by 5 along y.
    grating = torch.cos(2 * torch.pi * torch.arange(160).double() / 16).repeat(160, 1)
    offsets_um = np.zeros((2, 2, 2))
    offsets_um[0, 1] = (0.5, 0.3)
    moved = in_fields(grating, 0.1, 80, offsets_um)
    # Four whole periods well within each field, which begin at the same phase.
    inside = slice(10, 70)
    plain, turned = (_first_order(moved[inside, left : left + 64], 16) for left in (8, 88))
    assert np.angle(turned / plain) == pytest.approx(-2 * np.pi * 3 / 16)
    assert abs(turned) == pytest.approx(abs(plain))
    # Fields that stay are as they were, and so is a print all of whose fields stay.
    assert torch.equal(moved[80:, :80], grating[80:, :80])
    assert torch.equal(in_fields(grating, 0.1, 80, np.zeros((2, 2, 2))), grating)
    # Between pixels a wave of k = 2 pi / 16 per px lies along chords: at 1/4 px its phase is off by k^3 / 64.
    offsets_um[0, 1] = (0.0, 0.025)
    turned = _first_order(in_fields(grating, 0.1, 80, offsets_um)[inside, 88:152], 16)
    assert np.angle(turned / plain) == pytest.approx(-2 * np.pi * 0.25 / 16, abs=(2 * np.pi / 16) ** 3 / 60)


def test_seams_are_bare_where_fields_part_and_no_taller_where_they_overlap():
    plate = torch.full((40, 60), 0.8, dtype=torch.float64, requires_grad=True)
    offsets_um = np.zeros((2, 3, 2))
    offsets_um[:, 0, 1], offsets_um[:, 2, 1] = -0.15, -0.4
    moved = in_fields(plate, 0.1, 20, offsets_um)
    # The first field is 1.5 px to the left of its place: a gap of as much, and what left the element is lost.
    gap = 0.8 * torch.tensor([1.0, 0.5, 0.0, 1.0])
    assert moved[7, 17:21].tolist() == pytest.approx(gap.tolist())
    # The last covers 4 px of the middle one, and leaves as many bare at the rim.
    assert moved[7, 20:56].tolist() == pytest.approx([0.8] * 36)
    assert moved[:, 56:].abs().max() == 0
    # The gradient of each height is the share of it that is left: nothing of the first column and a half.
    moved.sum().backward()
    assert plate.grad[7, :4].tolist() == pytest.approx([0.0, 0.5, 1.0, 1.0])
    assert plate.grad[7, 36:44].tolist() == pytest.approx([0.5] * 8)


def test_displaced_fields_lose_of_an_order_what_their_spread_says_and_other_draws_stay():
    # N fields with phases of sd s: the intensity on the axis is exp(-s²) + (1 - exp(-s²)) / N of the whole.
    stitch = Stitching(field_um=6.4, sigma_um=0.2)
    window = ProcessWindow(gain_sd=0.0, offset_sd_um=0.0, blur_sd_um=0.0, stitch=stitch)
    grating = torch.cos(2 * torch.pi * torch.arange(512).double() / 16).repeat(512, 1)
    whole = abs(_first_order(grating, 16)) ** 2
    found = []
    for draw in draws(window, Optics(), 4):
        offsets_um = stitch.offsets_um(512, 0.1, list(draw.stitch_seed))
        phases = np.exp(-2j * np.pi * offsets_um[..., 1] / 1.6)
        seen = abs(_first_order(draw.apply(grating, 0.1), 16)) ** 2 / whole
        # Neighbours are 2.8 px (sd) apart: 1.1 px in 64 are bare on average, along both axes, and chords
        # between pixels take k² / 12 = 0.013 of the amplitude: 0.91 of the power is left, by draw.
        assert seen == pytest.approx(0.91 * abs(phases.mean()) ** 2, rel=0.05)
        found.append(abs(phases.mean()) ** 2)
    spread = np.exp(-((2 * np.pi * 0.2 / 1.6) ** 2))
    # 64 fields each: the mean phase has an sd of 0.8 / 8, its square 0.2 of the whole, over four draws 0.1.
    assert np.mean(found) == pytest.approx(spread + (1 - spread) / 64, rel=0.3)
    assert [draw.gain for draw in draws(ProcessWindow(stitch=stitch), Optics(), 3)] == [
        draw.gain for draw in draws(ProcessWindow(), Optics(), 3)
    ]
