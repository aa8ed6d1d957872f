"""Test the virtual fab: the physics of plain prints, the noise, the files, the truth, and reproducibility."""

from __future__ import annotations

import hashlib
import tracemalloc

import numpy as np
import pytest

from litho_data.cards.card import load_card
from litho_data.cards.listing import list_fields
from litho_data.foundation.errors import InputError
from litho_data.readers import read_layout, read_scan
from litho_data.readers.text_matrix import write_text_matrix
from litho_data.roughness import amplitude_parameters, autocorrelation, stair_steps
from litho_data.virtual_fab import (
    Fab,
    Job,
    KnobSetting,
    Microscope,
    Noise,
    Printer,
    Truth,
    jobs_of_card,
    scan_job,
    simulate,
)
from litho_data.virtual_fab.canvas import GUARD_PX, cut_layout
from litho_data.virtual_fab.exposure import accumulate_dose
from litho_data.virtual_fab.geometry import sample_surface
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.printer import print_clean
from litho_data.virtual_fab.random_curves import line_roughness, perlin_curve
from litho_data.virtual_fab.truth import noise_floor

NO_KNOBS = KnobBoard((), 0)


def fab(
    *knobs: KnobSetting, noise: Noise | None = None, microscope: Microscope | None = None, seed: int = 0
) -> Fab:
    return Fab(
        Printer(), microscope or Microscope.aligned(), noise or Noise.off(), KnobBoard(knobs, seed), seed
    )


def random_job(size_px: int = 96, seed: int = 0) -> Job:
    return next(random_jobs(Plan(count=1, size_px=(size_px, size_px)), Printer(), seed))


class TestPlainPrinting:
    def test_slices_and_hatch_lines_of_squared_spots_add_up(self):
        printer = Printer()
        level = np.zeros((24, 24), np.uint8)
        level[6:18, 4:15] = 9
        level[10:12, 8:20] = 12
        job = Job("a", level)
        dose = accumulate_dose(job.canvas(printer.pitch_um), printer, NO_KNOBS)
        y, x = np.indices(level.shape) * printer.pitch_um
        expected = np.zeros(level.shape)
        for slice_number in range(1, 13):
            for row, column in np.argwhere(level >= slice_number) * printer.pitch_um:
                squared_distance = (y - row) ** 2 + (x - column) ** 2
                intensity = np.exp(-squared_distance / (2 * printer.spot_sigma_um**2))
                expected += intensity**2
        # The integral of one squared spot is π s², where s is the sd of the intensity. The full dose is 12
        # slices.
        expected *= printer.pitch_um**2 / (np.pi * printer.spot_sigma_um**2) / 12
        # The sum of the sampled Gaussian (sd 2 px) equals its integral within 2 exp(−2π²·4). Light that wraps
        # around the periodic frame is 9 µm from its spot, so only rounding errors remain.
        np.testing.assert_allclose(cut_layout(dose), expected, rtol=0, atol=1e-10)

    def test_wide_blocks_print_from_base_to_full_height(self):
        printer = Printer()
        for level, height_um in ((0, printer.base_um), (12, printer.base_um + printer.full_height_um)):
            surface = print_clean(Job("a", np.full((32, 32), level, np.uint8)), printer, NO_KNOBS)
            np.testing.assert_allclose(surface, height_um, atol=1e-12)

    def test_more_dose_prints_higher(self):
        heights = [
            print_clean(Job("a", np.full((32, 32), 6, np.uint8), dose=dose), Printer(), NO_KNOBS).mean()
            for dose in (0.7, 0.85, 1.0, 1.15, 1.3)
        ]
        assert np.all(np.diff(heights) > 0.02)

    def test_gain_resembles_the_measured_prints(self):
        transfer = []
        for job in random_jobs(Plan(count=4, size_px=(256, 256), fields_per_print=2), Printer(), 7):
            clean = cut_layout(print_clean(job, Printer(), NO_KNOBS))
            window = np.outer(*[np.hanning(256)] * 2)
            nominal = 0.1 * job.level
            spectra = [np.fft.rfft2((z - z.mean()) * window) for z in (nominal, clean)]
            frequency = np.hypot(np.fft.fftfreq(256, 0.1)[:, None], np.fft.rfftfreq(256, 0.1)[None])
            transfer.append(
                [
                    np.sum((spectra[0].conj() * spectra[1]).real[band])
                    / np.sum(np.abs(spectra[0][band]) ** 2)
                    for low, high in ((0.1, 0.2), (0.2, 0.3), (0.5, 0.7))
                    for band in [(frequency >= low) & (frequency < high)]
                ]
            )
        gain = np.mean(transfer, axis=0)
        # In these bands, measured prints have gains of 0.69, 0.64 and 0.45, which spread by 0.085 between
        # fields. The plain fab may differ by one and a half times that.
        np.testing.assert_allclose(gain, [0.69, 0.64, 0.45], atol=0.13)

    def test_print_depends_on_the_neighbourhood_only(self):
        job = random_job(96)
        other = job.level.copy()
        other[:, 80:] = 0
        near, far = (
            cut_layout(print_clean(Job("a", level), Printer(), NO_KNOBS)) for level in (job.level, other)
        )
        # The distance is three sd of the widest kernel. Beyond that, 0.1 % of a height of 0.6 µm remains.
        assert np.abs(near - far)[:, :20].max() < 1e-3
        assert np.abs(near - far)[:, 85:].max() > 0.1


class TestDefaultNoise:
    def test_flat_print_and_substrate_have_the_papers_figures(self):
        flat, bare = (
            scan_job(
                fab(noise=Noise(), seed=3), Job("a", np.full((512, 512), 6, np.uint8), use=use)
            ).height_um
            for use in ("flat", "substrate")
        )
        # The paper states 15.96 nm and 1.25 nm. About 54²/(2 · 0.3 · 2.4) = 2000 independent pieces of line
        # give the sd to 1.6 %.
        assert amplitude_parameters(flat).sq_nm == pytest.approx(15.96, rel=0.04)
        assert amplitude_parameters(bare).sq_nm == pytest.approx(1.25, rel=0.04)

    def test_roughness_is_line_shaped(self):
        flat = scan_job(fab(noise=Noise(), seed=3), Job("a", np.full((512, 512), 6, np.uint8))).height_um
        correlation = autocorrelation(flat)
        along, across = correlation[0, correlation.shape[1] // 2 :], correlation[:, correlation.shape[1] // 2]
        # Along the lines, the correlation stays above 1/e over 0.8 µm. Across, it falls below 1/e within
        # 0.2 µm.
        assert along[:9].min() > np.exp(-1) > across[:3].min()

    def test_steps_of_one_level_stay_readable(self):
        plan = Plan(count=1, size_px=(512, 512), references=True)
        job = next(job for job in random_jobs(plan, Printer(), 0) if job.use == "steps")
        edges_px = np.flatnonzero(np.diff(job.level[0].astype(int))) + 1
        assert job.level[0, [0, *edges_px]].tolist() == [1, 2, 3, 4, 5]
        scan = scan_job(fab(noise=Noise()), job)
        margin = (scan.height_um.shape[0] - 512) // 2
        height = scan.height_um[margin:-margin, margin:-margin]
        for step in stair_steps(height, 0.1, edges_um=(edges_px * 0.1).tolist()):
            # The criterion of the paper is that a step exceeds twice the roughness. It is known to a tenth.
            assert step.height_nm > 2 * 15.96
            assert step.height_nm > 10 * step.uncertainty_nm

    def test_datum_is_the_only_offset(self):
        scans = [scan_job(fab(noise=Noise(), seed=seed), random_job(64)) for seed in range(40)]
        datums_nm = [1e3 * np.mean(scan.height_um - scan.noiseless_um) for scan in scans]
        # From 40 draws, the sd is known to 1/√80 = 11 %. Roughness adds 1 nm.
        assert np.std(datums_nm) == pytest.approx(30, rel=0.35)

    def test_noise_off_leaves_no_noise(self):
        scan = scan_job(fab(), random_job())
        assert np.array_equal(scan.height_um, scan.noiseless_um)

    def test_floor_of_known_noise(self):
        y, x = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 90), indexing="ij")
        bow = 0.02 * x - 0.01 * y + 0.03 * x**2 - 0.02 * x * y + 0.01 * y**2 + 0.4
        terms = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2]).reshape(6, -1).T
        white = 0.005 * np.random.default_rng(0).standard_normal(bow.shape)
        floor = noise_floor(bow + white)
        assert floor["floor_full_rmse_nm"] == pytest.approx(
            1e3 * (white.ravel() - terms @ np.linalg.lstsq(terms, white.ravel(), rcond=None)[0]).std(),
            rel=1e-9,
        )
        # The mean absolute value of a Gaussian is √(2/π) sd. There are 7200 pixels.
        assert floor["floor_full_mae_nm"] / floor["floor_full_rmse_nm"] == pytest.approx(
            (2 / np.pi) ** 0.5, rel=0.02
        )


class TestGeometry:
    def test_aligned_noise_free_scan_is_the_clean_print(self):
        job = random_job(128)
        scan = scan_job(fab(), job)
        margin = round(14 * 128 / 512)
        assert scan.height_um.shape == (128 + 2 * margin,) * 2
        seen = scan.height_um[margin:-margin, margin:-margin]
        # At integer positions, cubic interpolation is exact up to rounding.
        np.testing.assert_allclose(seen, scan.clean_um, rtol=0, atol=1e-12)
        np.testing.assert_allclose(scan.frame.scan_to_layout[:2, 2], -margin * 0.1, atol=1e-12)

    def test_stated_warp_is_the_one_applied(self):
        job = random_job(128)
        scan = scan_job(fab(microscope=Microscope(), seed=5), job)
        row, column = 40, 77
        x_um, y_um, _ = scan.frame.scan_to_layout @ [(column + 0.5) * 0.1, (row + 0.5) * 0.1, 1]
        surface = print_clean(job, Printer(), NO_KNOBS)
        # The surface is band-limited, so its Fourier series can be evaluated at the point.
        spectrum = np.fft.fft2(surface)
        size = surface.shape[0]
        phase = [np.fft.fftfreq(size) * (at / 0.1 - 0.5 + GUARD_PX) for at in (y_um, x_um)]
        exact = (np.exp(2j * np.pi * phase[0]) @ spectrum @ np.exp(2j * np.pi * phase[1])).real / size**2
        # At half a pixel, a cubic spline is wrong by (2πf·pitch)⁴/384 of a wave: 1e-5 µm at 1 cycle/µm.
        assert scan.height_um[row, column] == pytest.approx(exact, abs=5e-5)

    def test_warps_stay_within_the_microscopes_limits(self):
        for seed in range(20):
            frame = scan_job(fab(microscope=Microscope(), seed=seed), random_job(48)).frame
            scales = np.linalg.svd(frame.scan_to_layout[:2, :2], compute_uv=False)
            # A scale of 1.5 % and a shear of 0.5 % together change lengths by at most 2 %.
            assert np.abs(scales - 1).max() < 0.02

    def test_margin_shows_the_outermost_levels_continued(self):
        level = np.zeros((64, 64), np.uint8)
        level[:, 32:] = 10
        frame = scan_job(fab(), Job("a", level)).frame
        surface = print_clean(Job("a", level), Printer(), NO_KNOBS)
        sampled = sample_surface(surface, frame, NO_KNOBS, 0)
        np.testing.assert_allclose(sampled, sampled[:1].repeat(len(sampled), 0), atol=1e-9)


class TestFiles:
    def test_text_round_trip_to_five_digits(self, tmp_path):
        values = np.random.default_rng(0).standard_normal((20, 31)) * 10.0 ** np.arange(-26, 5)
        values[0, :3] = [0.0, 0.9999996, -9.99999]
        write_text_matrix(tmp_path / "a.txt", values)
        found = read_scan(tmp_path / "a.txt", unit="m", size_um=(2.0, 3.1)).height_um
        # The error is at most half a unit of the fifth digit.
        np.testing.assert_allclose(found, values, rtol=5.0001e-5)
        text = (tmp_path / "a.txt").read_bytes()
        assert text.startswith(b"0.0000e+000\t1.0000e-006\t-1.0000e-005\t")
        assert text.count(b"\r\n") == 20

    def test_nan_cannot_be_written(self, tmp_path):
        with pytest.raises(InputError, match="finite"):
            write_text_matrix(tmp_path / "a.txt", np.array([[np.nan, 1.0]]))

    def test_raw_is_an_ordinary_dataset_and_truth_lies_in_another_folder(self, tmp_path):
        card_path = simulate(
            tmp_path / "run", count=3, size_px=64, seed=2, knobs=["vignetting=0.2@9"], references=True
        )
        listing = list_fields(card_path)
        assert [field.id for field in listing.fields if field.use == "dataset"] == ["P1F1", "P1F2", "P1F3"]
        assert sorted(field.use for field in listing.fields if field.use != "dataset") == [
            "flat",
            "steps",
            "substrate",
        ]
        assert not any("truth" in str(path) for path in card_path.parent.rglob("*"))
        truth = Truth.read(tmp_path / "run" / "truth")
        assert [(knob.name, knob.effect, knob.strength, knob.seed) for knob in truth.knobs] == [
            ("vignetting", "vignetting", 0.2, 9)
        ]
        for scan in truth.scans:
            field = next(field for field in listing.fields if field.id == scan.id)
            card = load_card(card_path)
            height = read_scan(field.scan, unit="m", size_um=card.scan.size_um).height_um
            assert height.shape == scan.scan_shape
            clean = np.load(tmp_path / "run" / "truth" / "prints" / f"{scan.id}.npy")
            assert clean.shape == read_layout(field.layout).shape

    def test_layouts_of_a_card_can_be_printed(self, tmp_path):
        first = simulate(tmp_path / "a", count=3, size_px=64, seed=1)
        jobs = jobs_of_card(first)
        again = simulate(tmp_path / "b", jobs=jobs, seed=1)
        for field in list_fields(first).fields:
            other = again.parent / "scans" / field.scan.name
            assert other.read_bytes() == field.scan.read_bytes()
        assert load_card(again) == load_card(first)

    @pytest.mark.parametrize("shape", [(32, 48), (32, 32)])
    def test_the_pixels_of_a_scan_of_a_turned_print_are_square(self, tmp_path, shape):
        level = np.arange(shape[0] * shape[1]).reshape(shape).astype(np.uint8) % 13
        jobs = [Job("P1F1", level), Job("P1F2", level, index=1, print_index=0, turned_deg=90.0)]
        card = simulate(tmp_path / "run", jobs=jobs)
        for field in list_fields(card).fields:
            size_um = field.read.get("size_um", load_card(card).scan.size_um)
            assert read_scan(field.scan, unit="m", size_um=size_um).pitch_um == pytest.approx((0.1, 0.1))
        assert ("size_um" in (card.parent / "scans.csv").read_text()) == (shape[0] != shape[1])

    @pytest.mark.parametrize("files", ["text-matrix", "gsf"])
    def test_each_id_with_dots_has_a_scan_of_its_own(self, tmp_path, files):
        doses = {f"dose{dose:.2f}": dose for dose in (1.05, 1.10)}
        jobs = [Job(name, np.full((16, 16), 6, np.uint8), dose=dose) for name, dose in doses.items()]
        card = simulate(tmp_path / "run", jobs=jobs, microscope=Microscope(files=files))
        assert [field.id for field in list_fields(card).fields] == list(doses)
        assert {file.stem for file in (card.parent / "scans").iterdir()} == set(doses)

    def test_bad_runs_write_nothing(self, tmp_path):
        for settings in (
            {"knobs": ["nosuch=1"]},
            {"noise": "loud"},
            {"count": 0},
        ):
            with pytest.raises(InputError):
                simulate(tmp_path / "run", **{"count": 1, "size_px": 64, **settings})
        with pytest.raises(InputError, match="write field"):
            simulate(tmp_path / "run", count=1, size_px=64, write_field_um=5.0)
        assert not list(tmp_path.iterdir())


class TestDeterminism:
    def test_same_seed_same_files(self, tmp_path):
        digests = []
        for name in ("a", "b"):
            simulate(tmp_path / name, count=2, size_px=64, seed=8, knobs=["tilt-bow=20"])
            files = sorted(file for file in (tmp_path / name).rglob("*") if file.is_file())
            digests.append([hashlib.sha256(file.read_bytes()).hexdigest() for file in files])
        assert digests[0] == digests[1]

    def test_a_scan_does_not_depend_on_how_many_there_are(self, tmp_path):
        few = simulate(tmp_path / "few", count=2, size_px=64, seed=8)
        many = simulate(tmp_path / "many", count=4, size_px=64, seed=8)
        for name in ("P1F1.txt", "P1F2.txt"):
            assert (few.parent / "scans" / name).read_bytes() == (many.parent / "scans" / name).read_bytes()

    def test_memory_does_not_grow_with_the_number_of_scans(self, tmp_path):
        peaks = []
        for count in (2, 8):
            tracemalloc.start()
            simulate(tmp_path / str(count), count=count, size_px=64)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        # Six more scans as arrays would need 6 × 256² × 8 bytes = 3 MB. Their truth records need a few kB.
        assert peaks[1] - peaks[0] < 0.5e6


class OnePoint:
    """Generate a single point in place of white noise. The squares of the filtered point add up to the
    variance of filtered noise.
    """

    def standard_normal(self, shape):
        point = np.zeros(shape)
        point[shape[0] // 2, shape[1] // 3] = 1.0
        return point


@pytest.mark.parametrize("shape", [(24, 31), (25, 40)])
def test_rough_lines_have_unit_variance_on_average_and_lie_along_x(shape):
    spread = line_roughness(shape, 0.1, OnePoint())
    assert np.square(spread).sum() == pytest.approx(1, rel=1e-9)
    # Neighbours along a line are similar, but those across it are not.
    across, along = (float((spread * np.roll(spread, 1, axis)).sum()) for axis in (0, 1))
    assert along > 0.8 > across


def test_a_perlin_curve_is_zero_at_each_cell_and_never_beyond_one():
    curve = perlin_curve(np.arange(0, 60, 0.125), 2.0, np.random.default_rng(0))
    assert np.abs(curve[::16]).max() < 1e-12
    assert 0.2 < np.abs(curve).max() <= 1
