"""Test the laws that every knob of the virtual fab obeys, and the specific results of some knobs."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.virtual_fab import (
    KNOBS,
    Fab,
    Job,
    KnobSetting,
    Microscope,
    Noise,
    Printer,
    knob_rms_nm,
    scan_job,
    strength_for_rms,
)
from litho_data.virtual_fab.afm import scan_surface
from litho_data.virtual_fab.exposure import write_in_fields
from litho_data.virtual_fab.geometry import place_scan
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import KnobBoard

# The effects catalogue has 35 entries. These are the names that a truth file may use besides `off-catalogue`.
CATALOGUE = {
    "elliptical-psf",
    "long-range-proximity",
    "dose-exponent",
    "write-order-memory",
    "galvo-lag",
    "galvo-nonlinearity",
    "vignetting",
    "field-curvature",
    "laser-drift",
    "hatch-ripple",
    "layer-stacking",
    "interface-offset",
    "diffusion-blur",
    "threshold-softness",
    "height-saturation",
    "vertical-shrinkage",
    "dose-dependent-shrinkage",
    "lateral-shrinkage",
    "feature-collapse",
    "trench-residue",
    "slope-thinning",
    "datum-offset",
    "min-to-zero-datum",
    "z-gain",
    "tilt-bow",
    "scan-line-stripes",
    "slow-drift",
    "tip-dilation",
    "feedback-lag",
    "registration-residual",
    "piezo-nonlinearity",
    "resampling-blur",
    "quantisation",
    "line-roughness",
    "scars-and-spikes",
}


@pytest.fixture(scope="module")
def jobs() -> tuple[Job, ...]:
    return tuple(random_jobs(Plan(count=2, size_px=(96, 96), fields_per_print=1), Printer(), 1))


def scan(job: Job, *knobs: KnobSetting, noise: Noise | None = None):
    return scan_job(Fab(Printer(), Microscope.aligned(), noise or Noise.off(), KnobBoard(knobs, 4), 4), job)


@pytest.fixture(scope="module")
def plain(jobs):
    """Return the scans of the jobs without a knob and without noise."""
    return [scan(job) for job in jobs]


@pytest.fixture(scope="module")
def noisy(jobs):
    """Return the noisy scan of the first job without a knob."""
    return scan(jobs[0], noise=Noise())


def test_every_effect_of_the_catalogue_has_a_knob_and_no_other_name_is_used():
    assert {knob.effect for knob in KNOBS.values()} == CATALOGUE | {"off-catalogue"}


@pytest.mark.parametrize("name", KNOBS)
def test_strength_zero_changes_no_bit(name, jobs, noisy):
    off = scan(jobs[0], KnobSetting(name, 0.0, 3), noise=Noise())
    assert np.array_equal(noisy.height_um, off.height_um)
    assert np.array_equal(noisy.clean_um, off.clean_um)


@pytest.mark.parametrize("name", KNOBS)
def test_more_strength_changes_more(name, jobs, plain):
    knob = KNOBS[name]
    changes = []
    for share in (0.2, 0.5, 1.0):
        setting = KnobSetting(name, share * knob.limit, 5)
        scans = [scan(job, setting) for job in jobs]
        shifts = [one.height_um - other.height_um for one, other in zip(scans, plain, strict=True)]
        changes.append(np.sqrt(np.mean(np.square(shifts))))
    assert 0 < changes[0] < changes[1] < changes[2]
    assert np.isfinite(changes[2])


@pytest.mark.parametrize("name", [name for name, knob in KNOBS.items() if knob.stage == "measurement"])
def test_measurement_never_touches_the_print(name, jobs, plain):
    turned = scan(jobs[0], KnobSetting(name, KNOBS[name].limit, 5))
    assert np.array_equal(turned.clean_um, plain[0].clean_um)


def test_a_knob_does_not_change_the_random_draws_of_other_knobs(jobs):
    tilt, stripes = KnobSetting("tilt-bow", 20.0), KnobSetting("scan-line-stripes", 5.0)
    alone = [scan(jobs[0], one).height_um - scan(jobs[0]).height_um for one in (tilt, stripes)]
    for both in ((tilt, stripes), (stripes, tilt)):
        together = scan(jobs[0], *both).height_um - scan(jobs[0]).height_um
        # The results differ by rounding in double precision, at sums of a few µm.
        np.testing.assert_allclose(together, alone[0] + alone[1], atol=1e-14)


def test_noise_is_the_same_with_and_without_a_process_knob(jobs):
    plain = scan(jobs[0], noise=Noise())
    bent = scan(jobs[0], KnobSetting("vignetting", 0.3), noise=Noise())
    np.testing.assert_allclose(
        bent.height_um - bent.noiseless_um, plain.height_um - plain.noiseless_um, atol=1e-14
    )


def test_an_asymmetric_tip_leaves_the_noise_of_the_microscope_as_it_is(jobs):
    # The tip changes how roughness is scanned, so the surface has none here.
    smooth = Noise(roughness_nm=0.0)
    for job in jobs:
        plain, tipped = (scan(job, *one, noise=smooth) for one in ((), (KnobSetting("asymmetric-tip", 0.6),)))
        np.testing.assert_allclose(
            tipped.height_um - tipped.noiseless_um, plain.height_um - plain.noiseless_um, atol=1e-14
        )


def test_own_seed_redraws_that_knob_only(jobs):
    first, again, other = (
        scan(jobs[0], KnobSetting("ghost-spot", 0.3, seed)).height_um for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


class TestSettings:
    def test_text_form(self):
        assert KnobSetting.parse("vignetting=0.1") == KnobSetting("vignetting", 0.1)
        assert KnobSetting.parse("vignetting=0.1@7") == KnobSetting("vignetting", 0.1, 7)

    @pytest.mark.parametrize(
        "text",
        [
            "vignetting",
            "vignetting=",
            "vignetting=x",
            "vignetting=0.1@x",
            "vignetting=-1",
            "vignetting=nan",
            "nosuch=1",
        ],
    )
    def test_bad_text_is_an_error(self, text):
        with pytest.raises(InputError):
            KnobSetting.parse(text)

    def test_a_knob_counts_once(self):
        with pytest.raises(InputError, match="at most once"):
            KnobBoard([KnobSetting("vignetting", 0.1), KnobSetting("vignetting", 0.2)], 0)


class TestStrengthForRms:
    @pytest.mark.parametrize("name", ["vignetting", "slope-thinning", "elliptical-psf", "scan-line-stripes"])
    def test_the_strength_reaches_the_target_rms(self, name, jobs):
        found = strength_for_rms(name, 5.0, jobs=jobs)
        assert knob_rms_nm(found.setting, jobs) == pytest.approx(5.0, rel=0.0101)
        assert found.rms_nm == pytest.approx(5.0, rel=0.0101)

    def test_a_strength_stops_at_its_limit_and_reports_it(self, jobs):
        found = strength_for_rms("long-range-proximity", 500.0, jobs=jobs)
        assert found.setting.strength == KNOBS["long-range-proximity"].limit
        assert found.rms_nm < 500

    def test_the_strength_of_a_noise_knob_is_its_rms(self, jobs):
        assert strength_for_rms("line-roughness", 5.0, jobs=jobs).setting.strength == 5.0
        highest = KNOBS["line-roughness"].limit
        assert strength_for_rms("line-roughness", 2 * highest, jobs=jobs).rms_nm == highest

    def test_knobs_within_the_nuisance_span_are_refused(self, jobs):
        for name in ("tilt-bow", "z-gain", "vertical-shrinkage", "datum-offset"):
            with pytest.raises(InputError, match="no change beyond offset"):
                strength_for_rms(name, 5.0, jobs=jobs)

    def test_bad_targets_of_a_strength_are_errors(self, jobs):
        for name, rms_nm in (("nosuch", 5.0), ("vignetting", 0.0)):
            with pytest.raises(InputError):
                strength_for_rms(name, rms_nm, jobs=jobs)


class TestSignatures:
    def test_tip_widens_tops_and_only_adds(self, jobs):
        plain, dilated = scan(jobs[0]).height_um, scan(jobs[0], KnobSetting("tip-dilation", 0.5)).height_um
        assert (dilated - plain).min() > -1e-9
        # The apex touches the tops, so nothing changes at the maximum of the surface.
        top = np.unravel_index(plain[10:-10, 10:-10].argmax(), plain[10:-10, 10:-10].shape)
        # The true top lies between pixels, which changes the height by up to slope²·R/2 of one curvature
        # length. Here this is below 0.1 nm.
        assert (dilated - plain)[10:-10, 10:-10][top] < 1e-4

    def test_tip_on_a_slope_and_on_a_dome_have_closed_forms(self):
        frame = place_scan((96, 96), 0.1, Microscope.aligned(), np.random.default_rng(0))
        y_um, x_um = (np.indices(frame.shape) - 50) * 0.1
        radius_um = 0.4
        board = KnobBoard([KnobSetting("tip-dilation", radius_um)], 0)
        # The apex of a paraboloid on a slope s is R s²/2 above the slope. The image of a dome of radius A is
        # a dome of radius A + R.
        cases = (
            (0.1 * x_um - 0.2 * y_um, 0.1 * x_um - 0.2 * y_um + radius_um * (0.1**2 + 0.2**2) / 2),
            (-(x_um**2 + y_um**2) / 8, -(x_um**2 + y_um**2) / (2 * (4 + radius_um))),
        )
        for surface, expected in cases:
            job = Job("dome", np.zeros(frame.shape, np.uint8))
            found = scan_surface(surface, frame, Noise.off(), board, job, np.random.default_rng(0))
            # Contacts are searched on a grid of 0.01 µm, so heights are too low by at most (0.005 µm)²/2R for
            # each of the two axes.
            np.testing.assert_allclose(found[20:-20, 20:-20], expected[20:-20, 20:-20], atol=7e-5)

    def test_an_asymmetric_tip_has_another_radius_along_each_axis(self):
        frame = place_scan((96, 96), 0.1, Microscope.aligned(), np.random.default_rng(0))
        y_um, x_um = (np.indices(frame.shape) - 50) * 0.1
        job = Job("slope", np.zeros(frame.shape, np.uint8))
        blunt = set()
        for seed in range(8):
            board = KnobBoard([KnobSetting("asymmetric-tip", 0.6, seed)], 0)
            radii_um = []
            for slope in (0.2 * y_um, 0.2 * x_um):
                found = scan_surface(slope, frame, Noise.off(), board, job, np.random.default_rng(0))
                # On a slope s along one axis, the apex is R s²/2 above the slope, where R is the radius along
                # that axis.
                lifts = (found - slope)[30:-30, 30:-30]
                radii_um.append(2 * float(lifts.mean()) / 0.2**2)
            # Contacts are on a grid of 0.01 µm, so a lift is (0.005 µm)²/2R too small: 0.01 µm at R = 0.1 µm.
            assert max(radii_um) == pytest.approx(0.6, abs=0.01)
            assert 0.1 - 0.01 <= min(radii_um) <= 0.2 + 0.01
            blunt.add(int(np.argmax(radii_um)))
        assert blunt == {0, 1}

    def test_an_uneven_printer_moves_its_lines_by_the_closed_form(self):
        # Three bars, each four pixels wide, lie at a quarter, half and three quarters of a field of 19.2 µm.
        level = np.zeros((96, 192), np.uint8)
        for middle in (48, 96, 144):
            level[:, middle - 2 : middle + 2] = 8
        even, uneven = (
            scan(Job("a", level), *knobs).clean_um[48]
            for knobs in ((), (KnobSetting("galvo-nonlinearity", 0.05),))
        )
        for middle in (48, 96, 144):
            near = slice(middle - 16, middle + 16)
            x_um = (np.arange(192)[near] + 0.5) * 0.1
            was, now = (
                float(x_um @ h[near] / h[near].sum()) for h in (even - even.min(), uneven - uneven.min())
            )
            # The nonlinearity shortens a bar by 2 %. The window extends 1.6 µm from the centre of the bar.
            assert now - was == pytest.approx(0.05 * was * (1 - was / 19.2), abs=0.02)
        across = np.ascontiguousarray(level[:, :96].T)
        plain, bent = (
            scan(Job("a", across), *knobs).clean_um
            for knobs in ((), (KnobSetting("galvo-nonlinearity", 0.05),))
        )
        # Bars along the hatch lines are not displaced.
        np.testing.assert_allclose(bent, plain, atol=1e-9)

    def test_feedback_lag_trails_along_the_fast_axis_only(self):
        level = np.zeros((96, 96), np.uint8)
        level[:, 32:64] = 10
        step = KnobSetting("feedback-lag", 0.4)
        changed = scan(Job("a", level), step).height_um - scan(Job("a", level)).height_um
        assert changed[:, 68:75].min() > 0.02
        assert changed[:, 33:37].max() < -0.01
        across = scan(Job("a", level.T.copy()), step).height_um - scan(Job("a", level.T.copy())).height_um
        # The rows of this print are flat, so the feedback along the rows has no lag.
        assert np.abs(across).max() < 1e-9

    def test_write_order_memory_changes_what_is_written_later(self):
        level = np.full((96, 96), 2, np.uint8)
        level[40:50] = 12
        changed = scan(Job("a", level), KnobSetting("write-order-memory", 0.3, 1)).clean_um
        plain = scan(Job("a", level)).clean_um
        loss = (plain - changed).mean(axis=1)
        assert loss[60] > 1.5 * loss[30]

    def test_stripes_are_constant_along_the_fast_axis(self, jobs):
        change = scan(jobs[0], KnobSetting("scan-line-stripes", 9.0)).height_um - scan(jobs[0]).height_um
        assert np.ptp(change, axis=1).max() < 1e-12
        # From 100 draws, the sd is known to 7 %.
        assert 1e3 * change[:, 0].std() == pytest.approx(9.0, rel=0.25)

    def test_quantisation_truncates_to_its_step(self, jobs):
        height_nm = 1e3 * scan(jobs[0], KnobSetting("quantisation", 4.0)).height_um
        np.testing.assert_allclose(height_nm / 4, np.round(height_nm / 4), atol=1e-9)
        lost_nm = 1e3 * scan(jobs[0]).height_um - height_nm
        # Truncation lowers each pixel by up to one step, and all pixels by half a step on average.
        assert lost_nm.min() > -1e-9
        assert lost_nm.mean() == pytest.approx(2.0, rel=0.05)

    def test_a_displaced_write_field_shifts_its_grating_and_no_other(self):
        # The grating has a period of 16 px, in fields of 96 px. Each field is displaced by the drawn amount.
        level = np.tile((6 + 4 * np.cos(2 * np.pi * np.arange(192) / 16)).round().astype(np.uint8), (96, 1))
        fab = Fab(
            Printer(stitch_field_um=9.6), Microscope.aligned(), Noise.off(),
            KnobBoard([KnobSetting("stitching", 0.2)], 4), 4,
        )  # fmt: skip
        job = Job("a", level, index=3)
        moved, plain = scan_job(fab, job).clean_um, scan(job).clean_um
        offset_um = 0.2 * fab.knobs.scan_rng("stitching", 3).standard_normal((1, 2, 2))
        wave = np.exp(-2j * np.pi * np.arange(64) / 16)
        for number, left in enumerate((16, 112)):
            # Only middle rows and four periods are used. They are 1.6 µm from the seam, where the blur of
            # 2 µm has little effect.
            before, after = (one[40:56, left : left + 64].mean(0) @ wave for one in (plain, moved))
            expected = -2 * np.pi * offset_um[0, number, 1] / 1.6
            assert np.angle(after / before) == pytest.approx(expected, abs=0.03)
        # Without the knob the size of a field has no effect.
        off = Fab(Printer(stitch_field_um=9.6), Microscope.aligned(), Noise.off(), KnobBoard([], 4), 4)
        assert np.array_equal(scan_job(off, job).clean_um, plain)

    def test_seams_get_no_dose_or_twice_of_it(self):
        exposure = np.ones((4, 12))
        offset_px = np.array([[[0.0, -1.0], [0.0, 0.0], [0.0, -1.5]]])
        written = write_in_fields(exposure, [[0], [0, 4, 8]], offset_px)
        # There is a gap of one pixel and an overlap of 1.5 pixels. The last 1.5 pixels are empty.
        assert written[2].tolist() == [1, 1, 1, 0, 1, 1, 1.5, 2, 1, 1, 0.5, 0]
        # One row of four is displaced out of the frame and lost.
        assert write_in_fields(exposure, [[0], [0]], np.array([[[1.0, 0.0]]])).sum() == 36

    def test_vignetting_darkens_the_corners_of_the_write_field(self):
        level = np.full((96, 96), 6, np.uint8)
        centred = scan(Job("a", level), KnobSetting("vignetting", 0.4)).clean_um
        assert centred[48, 48] > centred[0, 48] > centred[0, 0]
        aside = Job("a", level, field_um=(0.0, 30.0), write_field_um=100.0)
        shaded = scan(aside, KnobSetting("vignetting", 0.4)).clean_um
        assert shaded[48, 0] > shaded[48, -1]

    def test_neighbouring_fields_affect_the_edge_only(self, jobs):
        change = np.abs(
            scan(jobs[0], KnobSetting("unseen-neighbours", 1.0)).clean_um - scan(jobs[0]).clean_um
        )
        assert change[:3].mean() > 10 * change[40:56, 40:56].mean()
