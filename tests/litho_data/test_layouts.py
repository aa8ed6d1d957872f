"""Test layouts: the equation of the paper, calibration patterns, and the statistics of sets."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data.cards.card import load_card
from litho_data.cards.tables import read_table
from litho_data.foundation.errors import InputError
from litho_data.layouts import (
    PATTERNS,
    LayoutStatistics,
    checkerboard,
    flat,
    framed_ladder,
    isolated_features,
    layout_statistics,
    line_space_sweep,
    random_layout,
    relative_doses,
    siemens_star,
    step_ladder,
    write_layout_set,
)
from litho_data.layouts.card_text import write_layout
from litho_data.layouts.layout_set import SetSettings
from litho_data.layouts.random_layout import low_pass, quantise
from litho_data.readers import read_layout


class TestRandomLayout:
    @pytest.mark.parametrize("passband", ["square", "round"])
    def test_a_random_layout_follows_the_equation(self, passband):
        shape, pitch_um, cutoff_per_um, levels = (48, 61), 0.1, 0.7, 13
        noise = np.random.default_rng(11).random(shape)
        fy, fx = np.meshgrid(np.fft.fftfreq(48, pitch_um), np.fft.fftfreq(61, pitch_um), indexing="ij")
        distance = np.maximum(abs(fy), abs(fx)) if passband == "square" else np.sqrt(fy**2 + fx**2)
        field = np.real(np.fft.ifft2(np.fft.fft2(noise) * (distance <= cutoff_per_um)))
        unit = (field - field.min()) / (field.max() - field.min())
        step = 1 / (levels - 1)
        expected = np.rint(step * np.floor(unit / step + 0.5) * (levels - 1))
        found = random_layout(
            shape, levels=levels, cutoff_per_um=cutoff_per_um, pitch_um=pitch_um, seed=11, passband=passband
        )
        np.testing.assert_array_equal(found, expected)

    def test_halves_are_rounded_up_and_both_ends_are_reached(self):
        assert quantise(np.array([0.0, 0.5 / 12, 1.5 / 12, 2.5 / 12, 1.0]), 13).tolist() == [0, 1, 2, 3, 12]
        layout = random_layout((64, 64), seed=1)
        assert (layout.min(), layout.max(), layout.dtype) == (0, 12, np.uint8)

    def test_nothing_passes_above_the_cutoff(self):
        field = low_pass(
            np.random.default_rng(2).random((64, 64)), cutoff_per_um=0.5, pitch_um=0.1, passband="square"
        )
        power = np.abs(np.fft.fft2(field)) ** 2
        fy, fx = np.meshgrid(*[np.fft.fftfreq(64, 0.1)] * 2, indexing="ij")
        stopped = (abs(fy) > 0.5) | (abs(fx) > 0.5)
        # Due to rounding, (1e-16)² of the power remains.
        assert power[stopped].max() < 1e-25 * power[~stopped].max()

    def test_the_seed_determines_the_layout(self):
        assert np.array_equal(random_layout((64, 64), seed=5), random_layout((64, 64), seed=5))
        assert not np.array_equal(random_layout((64, 64), seed=5), random_layout((64, 64), seed=6))

    def test_bad_settings_are_errors(self):
        with pytest.raises(InputError, match="levels"):
            random_layout((32, 32), levels=1)
        with pytest.raises(InputError, match="at least"):
            random_layout((32, 32), cutoff_per_um=0.01)
        with pytest.raises(InputError, match="passband"):
            random_layout((32, 32), passband="triangle")
        with pytest.raises(InputError, match="quantiser"):
            random_layout((64, 64), quantiser="ceil")
        with pytest.raises(InputError, match="at least 40"):
            random_layout((32, 40), field_px=39)

    def test_floor_gives_the_highest_level_to_the_largest_value_only(self):
        unit = np.array([0.0, 0.99 / 12, 1 / 12, 11.99 / 12, 1.0])
        assert quantise(unit, 13, "floor").tolist() == [0, 0, 1, 11, 12]
        layout = random_layout((64, 64), cutoff_per_um=0.5, seed=1, quantiser="floor")
        assert (layout == 12).sum() == 1

    def test_a_cut_layout_is_the_middle_of_the_larger_one(self):
        whole = random_layout((60, 60), cutoff_per_um=0.5, seed=8)
        cut = random_layout((41, 30), cutoff_per_um=0.5, seed=8, field_px=60)
        np.testing.assert_array_equal(cut, whole[9:50, 15:45])

    @pytest.mark.measured
    @pytest.mark.parametrize(
        ("prints", "cutoff_per_um", "largest"), [("1234", 0.25, 0.05), ("5678", 0.5, 0.02)]
    )
    def test_the_published_levels_come_from_floor_and_a_larger_field(
        self, measured_prints, prints, cutoff_per_um, largest
    ):
        published = [
            read_layout(path)
            for number in prints
            for path in sorted((measured_prints / "mask_ug").glob(f"FOV{number}?.tif"))
        ]
        made = {
            quantiser: [
                random_layout(
                    (512, 512), cutoff_per_um=cutoff_per_um, seed=seed, quantiser=quantiser, field_px=540
                )
                for seed in range(32)
            ]
            for quantiser in ("floor", "round")
        }
        assert level_distance(made["floor"], published) <= largest
        assert level_distance(made["round"], published) > largest
        # The maximum of the field is a single pixel. It lies inside the cut with a probability of
        # (512/540)² = 0.90. By the binomial law, 11 or more of 16 layouts contain it in 99.6 % of all sets.
        highest = [int((level == 12).sum()) for level in published]
        assert set(highest) <= {0, 1}
        assert sum(highest) >= 11
        assert {int((level == 12).sum()) for level in made["floor"]} == {0, 1}
        assert np.median([(level == 12).sum() for level in made["round"]]) > 10

    @pytest.mark.measured
    def test_measured_layouts_have_the_stated_passbands(self, measured_prints):
        for name, cutoff_per_um in (("FOV11", 0.25), ("FOV44", 0.25), ("FOV61", 0.5), ("FOV74", 0.5)):
            level = read_layout(measured_prints / "mask_ug" / f"{name}.tif").astype(float)
            power = np.abs(np.fft.fft2((level - level.mean()) * np.outer(*[np.hanning(512)] * 2))) ** 2
            frequency = np.abs(np.fft.fftfreq(512, 0.1))
            along_x = power.sum(axis=0)[frequency < 1]
            # The Hann window leaks power to 2 bins of 0.02 per µm beyond the edge. The quantisation noise
            # is spread over all frequencies. Its variance is 1/12 of a squared level; that of the layout 2.5.
            edge = frequency[frequency < 1]
            inside = along_x[edge < cutoff_per_um + 0.04].sum() / along_x.sum()
            below = along_x[edge < cutoff_per_um - 0.06].sum() / along_x.sum()
            assert inside > 0.97
            assert below < 0.93


def level_distance(layouts: list[np.ndarray], others: list[np.ndarray]) -> float:
    """Return the total-variation distance between the level distributions of two sets of layouts."""
    shares = [np.bincount(np.ravel(each), minlength=13) / np.size(each) for each in (layouts, others)]
    return 0.5 * float(np.abs(shares[0] - shares[1]).sum())


class TestPatterns:
    def test_flat_and_ladder(self):
        assert set(flat((8, 9), level=6).ravel()) == {6}
        ladder = step_ladder((4, 26), highest=12)
        assert ladder[0].tolist() == np.repeat(np.arange(13), 2).tolist()
        assert np.array_equal(ladder[0], ladder[3])

    def test_a_framed_ladder_has_wide_steps_amid_the_frame(self):
        frame = random_layout((100, 200), seed=3)
        layout = framed_ladder(frame, highest=12, tread_px=20)
        inner = layout[20:-20, 40:-40]
        # 120 px have room for six steps of 20 px, so the ladder has six levels, evenly spaced from 0 to 12.
        assert inner[0].tolist() == np.repeat([0, 2, 5, 7, 10, 12], 20).tolist()
        assert (inner == inner[0]).all()
        outside = np.ones(frame.shape, bool)
        outside[20:-20, 40:-40] = False
        np.testing.assert_array_equal(layout[outside], frame[outside])
        with pytest.raises(InputError, match="at least 350 px"):
            framed_ladder(frame, highest=12, tread_px=70)

    def test_checkerboard_inverts_under_a_shift_by_one_cell(self):
        board = checkerboard((32, 48), cell_px=8, high=12)
        assert board[0, 0] == 12
        np.testing.assert_array_equal(board[:, 8:], 12 - board[:, :-8])

    def test_lines_and_spaces_widen_by_a_pixel(self):
        sweep = line_space_sweep((5, 30), high=1)
        runs = np.diff(np.flatnonzero(np.diff(np.r_[-1, sweep[0].astype(int), -1])))
        assert runs[:8].tolist() == [1, 1, 2, 2, 3, 3, 4, 4]
        np.testing.assert_array_equal(line_space_sweep((30, 5), high=1, along="x"), sweep.T)

    def test_siemens_star_repeats_after_a_spoke(self):
        star = siemens_star((201, 201), spokes=4, high=1)
        # The star has four wedges, so a rotation by 90° maps it onto itself.
        np.testing.assert_array_equal(star, np.rot90(star))
        y, x = np.indices(star.shape) - 100
        inside = np.hypot(y, x) <= 96
        # The area is uncertain by about one pixel along the 8 edges, which are 96 pixels long.
        assert star[inside].mean() == pytest.approx(0.5, abs=8 * 96 / inside.sum())

    def test_pits_are_inverted_pillars(self):
        pillars = isolated_features((96, 96), widths_px=[1, 2, 4, 8], feature=12, ground=0)
        pits = isolated_features((96, 96), widths_px=[1, 2, 4, 8], feature=0, ground=12)
        np.testing.assert_array_equal(pillars, 12 - pits)
        assert (pillars > 0).sum() == 1 + 4 + 16 + 64

    def test_a_pattern_that_does_not_fit_its_field_is_an_error(self):
        with pytest.raises(InputError, match="step ladder"):
            step_ladder((4, 5), highest=12)
        with pytest.raises(InputError, match="isolated features"):
            isolated_features((32, 32), widths_px=[20], feature=1, ground=0)


class TestStatistics:
    def test_checkerboard_has_known_shares(self):
        board = checkerboard((64, 64), cell_px=8, high=12)
        found = layout_statistics([board], levels=13, pitch_um=0.1)
        assert (found.level_share[0], found.level_share[12]) == (0.5, 0.5)
        # Along each axis, 7 of the 63 pairs of neighbours have an edge between them.
        assert found.jump_share[12] == pytest.approx(7 / 63)

    def test_power_lies_at_the_frequency_of_a_wave(self):
        wave = np.rint(6 + 6 * np.sin(2 * np.pi * 0.625 * np.arange(128) * 0.1))[None].repeat(128, 0)
        found = layout_statistics([wave.astype(np.uint8)], levels=13, pitch_um=0.1)
        assert sum(found.power_share) == pytest.approx(1)
        near = [
            share
            for f, share in zip(found.frequency_per_um, found.power_share, strict=True)
            if abs(f - 0.625) < 0.15
        ]
        # Rounding to whole levels adds 1/12 to a variance of 18, which is 0.5 %.
        assert sum(near) > 0.985

    def test_statistics_written_to_a_file_are_read_back_unchanged(self, tmp_path):
        found = layout_statistics([random_layout((64, 64), seed=0)], levels=13, pitch_um=0.1)
        found.write(tmp_path)
        assert LayoutStatistics.read(tmp_path) == found

    def test_empty_and_foreign_layouts_are_errors(self):
        with pytest.raises(InputError, match="layouts"):
            layout_statistics([], levels=13, pitch_um=0.1)
        with pytest.raises(InputError, match="level in a layout"):
            layout_statistics([np.full((64, 64), 13, np.uint8)], levels=13, pitch_um=0.1)


class TestLayoutSets:
    @pytest.mark.parametrize("pattern", PATTERNS)
    def test_every_pattern_fits_its_levels(self, pattern):
        make, _ = PATTERNS[pattern]
        for layout in make(SetSettings(3, (96, 160), 13, 0.25, "square", 0.1, 0)):
            assert layout.level.shape == (96, 160)
            assert layout.level.dtype == np.uint8
            assert layout.level.max() <= 12

    @pytest.mark.parametrize("pattern", ["random", "line-space"])
    def test_a_set_has_a_valid_card(self, tmp_path, pattern):
        card_path = write_layout_set(tmp_path / "set", pattern=pattern, count=3, size_px=96)
        card = load_card(card_path)
        table = read_table(card_path.parent / card.ids.table)
        for scan_id in table:
            layout = read_layout(card_path.parent / card.layout.files.format(id=scan_id))
            assert layout.max() < card.layout.levels
        assert LayoutStatistics.read(card_path.parent).count == len(table)

    def test_dose_matrix_lists_its_doses(self, tmp_path):
        card_path = write_layout_set(tmp_path / "set", pattern="dose-matrix", count=5, size_px=150)
        table = read_table(card_path.parent / "scans.csv")
        assert [float(row["dose"]) for row in table.values()] == pytest.approx([0.7, 0.85, 1.0, 1.15, 1.3])

    def test_equal_levels_are_written_as_equal_bytes(self, tmp_path):
        first, second = (
            write_layout(tmp_path / name, "R1", random_layout((64, 64), seed=4)) for name in "ab"
        )
        assert first.read_bytes() == second.read_bytes()

    def test_unknown_pattern_is_an_error_and_writes_nothing(self, tmp_path):
        with pytest.raises(InputError, match="pattern"):
            write_layout_set(tmp_path / "set", pattern="spiral")
        assert not list(tmp_path.iterdir())


def test_doses_of_a_matrix_are_evenly_spaced_about_the_nominal_dose():
    np.testing.assert_allclose(relative_doses(7), [0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3])
