"""Test a measured print and a photographed image as judges of a design."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.special import erf, j1

from benchmarks.coverage import Camera
from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.readers import read_scan
from litho_data.register.geometry import ORIENTATIONS, orient
from litho_design.images.camera_counts import saturated_share, without_outliers
from litho_design.images.camera_fit import CameraFit, fit_camera, fitted_dark_level
from litho_design.images.measurements import MeasuredSource, PhotoSource
from litho_design.images.noise import corrected_scores, covariance_by_tiles
from litho_design.images.photo_registration import photographed_image
from litho_design.images.photograph import CameraRecord, Photograph
from litho_design.images.similarity import si_psnr_db
from litho_design.images.targets import load_target
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.measured import _without_tip, measured_print
from litho_design.judging.photographs import score_hologram_photo
from litho_design.judging.score import ScoreResult
from litho_design.printers.printer import Printer
from litho_design.scans.background import (
    _LOW_ORDER_FACTOR,
    fitted_background,
    print_terms_sd_um,
    substrate_background,
)
from litho_design.scans.dust import foreign_pixels
from litho_design.scans.placing import Placed, warp_errors_px
from litho_design.scans.record import MeasuredRecord
from litho_design.scans.shapes import legendre_shapes
from litho_design.scans.variants import displaced, with_dust, with_other_prints
from litho_design.workflows.design import design_hologram
from litho_design.workflows.score import score as score_design
from tests.litho_design.conftest import unreported

DARK = 8000.0


@pytest.fixture(scope="module")
def printed_design(tmp_path_factory, small_settings, make_printer):
    folder = tmp_path_factory.mktemp("printed") / "design"
    printer, target = make_printer(small_settings.layout), load_target("ring", 128)
    with unreported():
        design_hologram(target, printer, folder, settings=small_settings, announce=False)
    return folder


@pytest.fixture(scope="module")
def text_design(tmp_path_factory, small_settings):
    folder = tmp_path_factory.mktemp("text") / "design"
    printer = Printer(None, small_settings.layout, source="none")
    with unreported():
        design_hologram("text", printer, folder, settings=small_settings, announce=False)
    return folder


def test_a_measured_print_scores_like_the_print_it_is(tmp_path, printed_design):
    loaded = LoadedDesign(printed_design)
    height = loaded.expected_um.numpy().astype(np.float64)
    noise = np.random.default_rng(0).normal(0, 0.002, height.shape)
    # The zero of an AFM is arbitrary, so an offset must not matter.
    np.savetxt(tmp_path / "scan.txt", (height + noise + 0.3) * 1e-6)
    source = MeasuredSource(tmp_path / "scan.txt", unit="m", size_um=(12.8, 12.8))
    score = score_design(printed_design, tmp_path / "score", judges=[], scan=source).scores[0]
    assert score.kind == "scan"
    assert score.judge.coverage > 0.9
    assert score.judge.height_offset_um == pytest.approx(0.3, abs=2e-3)
    # Noise of 2 nm is 0.002 wave, so only the registration error may be visible.
    assert score.figures["si_psnr_db"] == pytest.approx(loaded.record.predicted["si_psnr_db"], abs=0.5)


def test_the_noise_of_a_resampled_scan_is_estimated(tmp_path, printed_design):
    """Check a scan that is turned by 1.5° and shifted by a fraction of a pixel."""
    loaded = LoadedDesign(printed_design)
    expected = loaded.expected_um.numpy().astype(np.float64)
    turn = np.asarray(cv2.getRotationMatrix2D((63.5, 63.5), 1.5, 1.0))
    turn[:, 2] += (0.4, 0.3)
    noise = 0.01 * np.random.default_rng(4).standard_normal(expected.shape)
    scan = cv2.warpAffine(expected, turn, (128, 128), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    np.savetxt(tmp_path / "scan.txt", (scan + noise) * 1e-6)
    source = MeasuredSource(tmp_path / "scan.txt", "m", (12.8, 12.8), tip_um=0.0)
    back = cv2.warpAffine(noise, turn, (128, 128), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
    # Without the correction, the estimate is 28 % too low. Cubic convolution and a cubic spline weaken noise
    # by up to 5 % more or less than each other.
    record = measured_print(loaded, source)[1]
    assert record.noise_um == pytest.approx(back[16:-16, 16:-16].std(), rel=0.1)


def test_a_tilted_bowed_turned_and_noisy_scan_scores_like_its_print(tmp_path, printed_design):
    """Check that such a scan scores no worse than its print. A tilt of 0.05 µm/µm once cost 1.8 dB
    unnoticed.
    """
    loaded = LoadedDesign(printed_design)
    expected = loaded.expected_um.numpy().astype(np.float64)
    generator = np.random.default_rng(3)
    rough = cv2.GaussianBlur(0.02 * generator.standard_normal(expected.shape), (0, 0), 2.0)
    printed = 1.05 * expected + rough
    y, x = np.mgrid[0:128, 0:128] * 0.1 - 6.35
    tilt, bow = (0.05, -0.03), 0.002
    flat = printed + bow * (x * x + y * y) + 0.003 * generator.standard_normal(expected.shape)
    scan = flat + tilt[0] * x + tilt[1] * y
    # The reference is the print minus the part of its roughness that levelling removes.
    own = fitted_background(printed, expected, np.ones_like(printed, bool), 0.1, "bow").map_um
    truth = loaded.score(torch.from_numpy(printed - own).float())
    source = MeasuredSource(tmp_path / "scan.txt", "m", (12.8, 12.8))
    for orientation in ("identity", "rotate-90", "flip-y"):
        np.savetxt(source.path, orient(scan, orientation) * 1e-6)
        score = score_design(printed_design, tmp_path / orientation, scan=source).scores[0]
        # Noise of 3 nm is 0.003 wave, so it scatters (2 pi 0.003)^2 = 0.03 % of the light.
        assert score.figures["eff_signal"] == pytest.approx(truth.eff_signal, rel=0.01)
        assert score.figures["si_psnr_db"] == pytest.approx(truth.si_psnr_db, abs=0.15)
        assert score.judge.noise_um == pytest.approx(0.003, rel=0.2)
        assert (score.judge.orientation == "identity") == (orientation == "identity")
        # The height scale is known to 2 %, which adds more uncertainty than the noise.
        assert 0.01 < score.uncertainty["si_psnr_db"] < 1
    # Check the report of the first scan, which has the orientation of the layout.
    score = ScoreResult.read(tmp_path / "identity").scores[0]
    assert score.judge.tilt_um_per_um == pytest.approx(tilt, abs=0.002)
    # The bow is 2 bow 6.35^2 from the centre to the corners.
    assert score.judge.bow_um == pytest.approx(2 * bow * 6.35**2, rel=0.1)
    assert "a tilt of +0.0" in (tmp_path / "identity" / "report.html").read_text("utf-8")
    np.savetxt(source.path, (scan + 0.15 * x) * 1e-6)
    with pytest.raises(InputError, match=r"correlation .*--scan-levelling"):
        score_design(printed_design, tmp_path / "no", scan=replace(source, levelling="none"))


@dataclass(frozen=True)
class Widened:
    """Provide those attributes of a scan that tip correction needs."""

    height_um: np.ndarray

    def require_pitch(self) -> tuple[float, float]:
        return 0.1, 0.2


def test_a_pillar_is_narrower_without_its_tip_and_as_high():
    y, x = np.meshgrid(0.1 * np.arange(-20, 21), 0.2 * np.arange(-10, 11), indexing="ij")
    radius_um = 0.5
    # The scan of a needle 1 µm high is a paraboloid.
    scan = Widened(np.maximum(1 - (x**2 + y**2) / (2 * radius_um), 0))
    freed, found_um, change_um = _without_tip(scan, radius_um)
    assert (found_um, freed.height_um[20, 10]) == (radius_um, pytest.approx(1))
    for beside in ((21, 10), (19, 10), (20, 11), (20, 9)):
        off_um = np.hypot(y[beside], x[beside])
        # At a distance of √(2R), the tip rests on the foot of the needle.
        assert freed.height_um[beside] == pytest.approx((1 - off_um) ** 2, abs=1e-6)
    assert change_um == pytest.approx(np.std(freed.height_um - scan.height_um))
    assert _without_tip(scan, 0.0) == (scan, 0, 0)
    with pytest.raises(InputError, match="radius of the tip"):
        _without_tip(scan, -0.5)


def test_a_scan_of_something_else_is_refused(tmp_path, printed_design):
    other = np.random.default_rng(1).normal(0, 0.1, (128, 128))
    np.savetxt(tmp_path / "scan.txt", other * 1e-6)
    with pytest.raises(InputError, match="scan"):
        score_design(
            printed_design,
            tmp_path / "s",
            judges=[],
            scan=MeasuredSource(tmp_path / "scan.txt", "m", (12.8, 12.8)),
        )


def test_a_scan_without_unit_or_size_names_options_that_a_score_has(tmp_path):
    np.save(tmp_path / "scan.npy", np.eye(64))
    unit, size = (
        MeasuredSource.__pydantic_fields__[name].json_schema_extra["options"][0]
        for name in ("unit", "size_um")
    )
    with pytest.raises(InputError, match=f"unit = 'm', --unit m or {unit} m;"):
        read_scan(tmp_path / "scan.npy")
    with pytest.raises(InputError, match=f"--size-um 54 54 or {size} 54$"):
        read_scan(tmp_path / "scan.npy", unit="um").require_pitch()


@pytest.mark.pictures
def test_a_photograph_is_cleaned_registered_and_scored(tmp_path, printed_design):
    loaded = LoadedDesign(printed_design)
    image = loaded.image(loaded.expected_um)
    # The camera has pixels of 0.2 µm and a dark level of 300, and is rotated by 2° and shifted by
    # (1.3, -0.8) µm. It has two hot pixels, and a dead pixel in the light.
    turn = np.deg2rad(2.0)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    to_window = np.hstack([2 * matrix, (63.5 - 2 * matrix @ np.array([56.0, 45.5]))[:, None]])
    seen = cv2.warpAffine(
        cv2.GaussianBlur(image, (0, 0), 1.0),
        to_window,
        (100, 100),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    counts = seen / seen.max() * 40000 + 300
    bright = np.unravel_index(np.argmax(cv2.erode(counts, np.ones((3, 3)))), counts.shape)
    counts[5, 7] = counts[60, 90] = 65535
    counts[bright] = 0
    cv2.imwrite(str(tmp_path / "photo.png"), counts.astype(np.uint16))
    source = PhotoSource(tmp_path / "photo.png", 0.2)
    score = score_design(printed_design, tmp_path / "score", judges=[], camera=source).scores[0]
    # The dark level is found in the darkest gaps. How much light reaches them is known only to within 30 %.
    assert abs(score.judge.dark_level - 300) < 2 * score.judge.dark_level_sd < 300
    assert score.judge.replaced_pixels == 3
    assert score.judge.correlation > 0.97
    found = np.array(score.judge.photo_to_window)[:2, :2]
    assert found == pytest.approx(2 * matrix, abs=0.04)
    blurred = torch.from_numpy(cv2.GaussianBlur(image, (0, 0), 1.4)).double()
    wanted = si_psnr_db(blurred, loaded.target.double())
    assert score.figures["si_psnr_db"] == pytest.approx(wanted, abs=1.0)


@pytest.mark.parametrize(("target", "design"), [("text", "text_design"), ("ring", "printed_design")])
def test_a_mirrored_or_turned_photograph_is_never_scored_without_a_warning(tmp_path, request, target, design):
    loaded = LoadedDesign(request.getfixturevalue(design))
    image = cv2.GaussianBlur(loaded.image(loaded.expected_um), (0, 0), 1.5)
    # The camera has pixels of 0.15 µm, of which the brightest has 40,000 counts.
    to_window = np.array([[1.5, 0, -20.0], [0, 1.5, -15.0]])
    seen = cv2.warpAffine(image, to_window, (120, 110), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP).clip(0)
    counts = 40000 * seen / seen.max() + np.random.default_rng(0).normal(300, 60, seen.shape)
    # All orientations of a ring fit equally well, so a quarter turn and a mirror image stand for the others.
    for orientation in ORIENTATIONS if target == "text" else ("identity", "rotate-90", "flip-y"):
        cv2.imwrite(
            str(tmp_path / "p.png"), np.ascontiguousarray(orient(counts, orientation)).astype(np.uint16)
        )
        # A camera count is this share of the light, spread over 2.25 window pixels.
        power = 40000 / seen.max() / 2.25
        source = PhotoSource(tmp_path / "p.png", 0.15, 300.0, power_counts=power)
        try:
            score = score_design(loaded, tmp_path / "score", camera=source).scores[0]
        except InputError as error:
            refused = str(error)
            assert orientation != "identity" and "upright" in refused  # noqa: PT018
            continue
        assert orientation == "identity" or score.judge.ambiguous
        if orientation == "identity":
            assert score.figures["si_psnr_db"] == pytest.approx(
                si_psnr_db(torch.from_numpy(image).double(), loaded.target.double()), abs=0.3
            )
            assert score.figures["eff_signal"] == pytest.approx(image[loaded.target > 0.5].sum(), rel=0.01)
            assert 0 < score.uncertainty["si_psnr_db"] < 0.3
            assert bool(score.judge.ambiguous) == (target == "ring")


def test_a_photograph_is_within_a_third_of_a_decibel_of_its_light_or_refused(tmp_path, text_design):
    """Check photographs that are oblique, rotated, noisy, dark in the corners, or too bad for a score."""
    loaded = LoadedDesign(text_design)
    light = cv2.GaussianBlur(loaded.image(0.95 * loaded.expected_um), (0, 0), 1.0)
    truth = si_psnr_db(torch.from_numpy(light).double(), loaded.target.double())

    def scored(dark=DARK, **camera):
        counts = Camera(**camera).counts(light, 0.1, seed=0)
        cv2.imwrite(str(tmp_path / "p.png"), counts)
        pitch_sd = 0.05 if "scale" in camera else 0.0
        return score_hologram_photo(loaded, PhotoSource(tmp_path / "p.png", 0.15, dark, pitch_sd=pitch_sd))

    for camera in (
        {"tilt": (0.08, -0.08), "turn_deg": 6.0},
        {"tilt": (-0.05, 0.08), "vignetting": 0.3, "scale": 0.92, "shift_um": (0.8, -0.5)},
        {"noise": 0.04, "dark": None},
    ):
        assert scored(**camera).figures.si_psnr_db == pytest.approx(truth, abs=0.3)
    for camera, why in (
        ({"noise": 0.25}, "above the noise"),
        ({"gamma": 1 / 2.2}, "proportional"),
        ({"exposure": 4.0}, "at the lowest or highest value"),
    ):
        with pytest.raises(InputError, match=why):
            scored(**camera)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_saturation_is_found_from_the_pixels_and_not_from_the_file_type(bits):
    """Check cameras that have fewer bits than their files. Their pixels saturate below the limit of the file
    type.
    """
    light = np.random.default_rng(0).uniform(0, 1, (100, 100)) ** 2 * 2**bits
    assert saturated_share(np.minimum(light * 1.1, 2**bits - 1).astype(np.uint16)) == pytest.approx(
        0.046, abs=0.01
    )
    assert saturated_share((light * 0.8).astype(np.uint16)) == 0.0


def test_a_photograph_that_misses_a_part_of_the_image_has_the_dark_level_of_a_whole_one():
    """Check a ramp along y. All columns are equal, so missing columns do not change the result."""
    light = np.repeat(np.linspace(0.02, 1, 64, dtype=np.float32)[:, None], 64, axis=1)
    photo = (800 + 20000 * light).astype(np.float32)
    whole, cut = (
        fitted_dark_level(one, light, CameraFit(np.eye(3), 1.0, gain=20000.0))
        for one in (photo, photo[:, :60])
    )
    assert cut == pytest.approx(whole)
    # One row of the ramp is 310 counts, and blurs differ in the outermost row.
    assert whole[0] == pytest.approx(800, abs=310)


def test_dark_gaps_that_are_narrower_than_camera_pixels_do_not_raise_the_dark_level():
    """Check stripes of light without dark background, each as wide as 2.4 camera pixels."""
    x = np.arange(144) + 0.5
    # The mean of 1 - cos over camera pixels of four window pixels, in closed form.
    period, width = 19.2, 4.0
    light = np.repeat((1 - np.cos(2 * np.pi * x / period))[None].astype(np.float32) / 2, 144, axis=0)
    middles = np.arange(36) * width + width / 2
    averaged = (1 - np.sinc(width / period) * np.cos(2 * np.pi * middles / period)) / 2
    photo = np.repeat((800 + 20000 * averaged)[None].astype(np.float32), 36, axis=0)
    where = np.array([[1 / width, 0, (0.5 - width / 2) / width], [0, 1 / width, (0.5 - width / 2) / width]])
    fit = CameraFit(np.vstack([where, [0, 0, 1]]), 1.0, gain=20000.0, blur_px=width / np.sqrt(12))
    level, sd = fitted_dark_level(photo, light, fit)
    # Linear interpolation between camera pixels lowers the contrast to sinc(1 / 4.8)², that is by 14 %.
    assert abs(level - 800) < 0.14 * 20000 / 2
    assert abs(level - 800) < 3 * sd


def test_a_photograph_or_a_flat_with_values_that_are_not_numbers_is_refused(tmp_path):
    light = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    hole = light.copy()
    hole[3, 3] = np.nan
    for name, values in (("light.tif", light), ("hole.tif", hole)):
        cv2.imwrite(str(tmp_path / name), values)
    for photo, flat in (("hole.tif", None), ("light.tif", tmp_path / "hole.tif")):
        source = PhotoSource(tmp_path / photo, 0.1, 0.0, flat=flat)
        with pytest.raises(InputError, match=r"hole\.tif with values that are not numbers"):
            photographed_image(light, 0.1, source, 2.0)


@pytest.mark.parametrize(("darkest", "hint"), [(500, "shorter exposure"), (0, "black level")])
def test_dark_pixels_are_cut_off_only_at_zero(tmp_path, darkest, hint):
    """Check a photograph with 30 % of equally dark pixels and 3 % of overexposed pixels."""
    counts = np.random.default_rng(0).integers(600, 3500, (100, 100)).astype(np.uint16)
    counts[:, :30], counts[:3] = darkest, 4095
    cv2.imwrite(str(tmp_path / "photo.png"), counts)
    with pytest.raises(InputError, match=hint):
        photographed_image(counts, 0.1, PhotoSource(tmp_path / "photo.png", 0.1), 2.0)


@pytest.mark.parametrize("middle", [20.0, 20.5])
def test_the_finest_spot_of_the_light_is_not_replaced_as_a_hot_pixel(middle):
    """Check an Airy spot with 0.4 periods of its finest detail per pixel, in the middle of a pixel and
    between two pixels.
    """
    y, x = np.mgrid[:41, :41]
    v = np.pi * 0.4 * np.hypot(y - 20, x - middle) + 1e-9
    spot = (300 + 30000 * np.square(2 * j1(v) / v)).astype(np.float32)
    cleaned, replaced = without_outliers(spot, 0.4)
    assert replaced == 0
    assert np.array_equal(cleaned, spot)
    hot = spot.copy()
    hot[8, 30] = 65535
    assert without_outliers(hot, 0.4)[1] == 1
    # If the light has no such fine detail, two hot pixels beside each other are found too.
    wide = cv2.GaussianBlur(spot, (0, 0), 3.0)
    wide[8, 30:32] = 65535
    assert without_outliers(wide, 0.1)[1] == 2


class Power(Record):
    """Hold two scores: one is linear in the measured values, the other is not."""

    mean: float
    power: float


def test_the_mean_contribution_of_noise_is_subtracted_from_figures():
    """Check that the mean contribution of noise is subtracted. Noise of standard deviation s adds s^2 to a
    mean square, and nothing to a mean.
    """
    generator = np.random.default_rng(0)
    truth, sd = generator.uniform(0, 1, 4000), 0.3
    drawn, freed = [], []
    for _ in range(40):
        seen = truth + sd * generator.standard_normal(truth.shape)
        noise = sd * generator.standard_normal((4, *truth.shape))
        pairs = [seen + sign * one for one in noise for sign in (1, -1)]
        measured = Power(mean=seen.mean(), power=np.square(seen).mean())
        figures, spread = corrected_scores(
            lambda one: Power(mean=one.mean(), power=np.square(one).mean()), measured, pairs, []
        )
        assert figures["mean"] == pytest.approx(measured.mean, abs=1e-12)
        drawn.append(measured.power)
        freed.append(figures["power"])
    wanted = np.square(truth).mean()
    # The mean of 40 draws is known to sqrt((4 s^2 <x^2> + 2 s^4) / 4000 / 40) = 9e-4.
    assert np.mean(drawn) - wanted == pytest.approx(sd**2, abs=4e-3)
    assert np.mean(freed) == pytest.approx(wanted, abs=4e-3)
    assert spread["mean"] == pytest.approx(sd / np.sqrt(4000), rel=0.8)


@pytest.mark.parametrize("curved", [0.0, 1.0, 5.0, -5.0])
def test_sigma_covers_linear_and_curved_errors(curved):
    """Check a score that is a quadratic function of two errors with the standard deviations 0.3 and 0.4. An
    independent sample of errors lies within one and three σ as often as a normal distribution, or more often.
    """
    shifts, start = np.diag([0.3, 0.4]), np.zeros(2)

    def power(errors: np.ndarray) -> np.ndarray:
        return errors.sum(-1) + curved * np.square(errors).sum(-1)

    def score(errors: np.ndarray) -> Power:
        return Power(mean=errors.sum(), power=power(errors))

    pairs = [sign * shift for shift in shifts for sign in (1, -1)]
    figures, spread = corrected_scores(score, score(start), [start] * 2, pairs)
    assert figures["mean"] == pytest.approx(0, abs=1e-12)
    # 10,000 independent draws show σ to 1 %.
    assert spread["mean"] == pytest.approx(0.5, rel=0.03)
    drawn = power(np.random.default_rng(1).standard_normal((100_000, 2)) @ shifts)
    off = np.abs(drawn - figures["power"]) / spread["power"]
    # The shares are known to 0.3 and 0.1 %. Three σ of strongly curved errors require a wide σ.
    assert 0.67 < np.mean(off < 1) < 0.92
    assert np.mean(off < 3) > 0.993
    # The usual σ of strongly curved errors covers 98.2 %.
    usual = np.abs(drawn - drawn.mean()) / drawn.std()
    assert abs(curved) < 5 or np.mean(usual < 3) < 0.985


def test_two_possibilities_lie_one_sigma_from_their_mean():
    def score(one: np.ndarray) -> Power:
        return Power(mean=one[0], power=np.square(one).sum())

    start = np.zeros(1)
    figures, spread = corrected_scores(score, score(start), [start] * 2, [], [np.array([0.4]), start])
    assert figures == pytest.approx({"mean": 0.2, "power": 0.08})
    assert spread == pytest.approx({"mean": 0.2, "power": 0.08})


def test_dust_is_masked_and_what_the_printer_does_to_all_tall_places_is_not():
    generator = np.random.default_rng(0)
    expected_um = cv2.resize(generator.uniform(0, 0.8, (32, 32)), (128, 128), interpolation=cv2.INTER_AREA)
    noise_um = 0.002 * generator.standard_normal(expected_um.shape)
    y, x = np.mgrid[:128, :128]
    dust_um = 0.4 * np.exp(-((x - 40) ** 2 + (y - 70) ** 2) / 2 / 4**2)
    valid = np.ones(x.shape, bool)
    dusty = foreign_pixels(noise_um + dust_um, expected_um, valid)
    assert dusty[dust_um > 0.15].all()
    # The dust ends at 0.1 µm, 6.7 px from its middle. The blur and the widening move this edge by 2 px each.
    assert not dusty[np.hypot(x - 40, y - 70) > 6.7 + 4].any()
    tall_um = np.where(expected_um > 0.7, 0.4, 0.0)
    assert not foreign_pixels(noise_um + tall_um, expected_um, valid).any()
    # A height that occurs only once does not show whether the printer or dust is the cause.
    alone_um = np.where(np.hypot(x - 40, y - 70) < 5, 1.0, expected_um)
    assert foreign_pixels(noise_um + np.where(alone_um == 1, 0.4, 0), alone_um, valid)[70, 40]


def test_the_angle_of_few_spots_is_as_uncertain_as_fits_scatter():
    """Check fits of shift and rotation to five spots, each of which is displaced at random.

    The spots have the same gradients, so the fit is that of the displacements d of points p: the variance of
    the angle is s² / Σ|p - mean p|². Five points and three parameters leave seven degrees of freedom, and a
    fit without one point has five, so the jackknife may overestimate the variance by up to 10 / 5.
    """
    rng, y, x = np.random.default_rng(0), *np.mgrid[:64, :64]
    middles = np.array([(8, 24), (24, 56), (40, 8), (56, 40), (8, 56)]) - 0.5
    spots = [np.exp(-((y - row) ** 2 + (x - column) ** 2) / 2 / 2**2) for row, column in middles]
    gradients = np.array([np.gradient(spot) for spot in spots])
    along_y, along_x = gradients.sum(0)
    slopes = np.stack([along_x, along_y, (x - 31.5) * along_y - (y - 31.5) * along_x], axis=-1).reshape(-1, 3)
    angles, stated = [], []
    for _ in range(200):
        seen = np.einsum("pi,piyx->yx", 0.1 * rng.standard_normal((5, 2)), gradients).ravel()
        fitted, *_ = np.linalg.lstsq(slopes, seen, rcond=None)
        angles.append(fitted[2])
        stated.append(covariance_by_tiles(slopes, seen - slopes @ fitted, (64, 64))[2, 2])
    variance = 0.1**2 / np.square(middles - middles.mean(0)).sum()
    # The variance of 200 angles is known to 10 %, and neighbouring spots barely overlap.
    assert np.var(angles) == pytest.approx(variance, rel=0.3)
    assert 0.9 * variance < np.mean(stated) < 2 * variance


def test_each_parameter_of_the_registration_is_as_uncertain_as_fits_scatter():
    """Check rough scans of bars along y, which have only a few notches.

    The bars determine the shift along x much better than that along y. The scatter is that of fits of the
    same six parameters, gain and background to 60 scans, so each standard deviation is known to 9 %.
    """
    rng, (y, x) = np.random.default_rng(3), np.mgrid[:128, :128]
    bars = np.sign(np.sin(2 * np.pi * x / 32 + 1)) * np.where(rng.random((16, 1)) < 0.3, 0.4, 1).repeat(8, 0)
    topography = cv2.GaussianBlur(bars, (0, 0), 2.0)
    u, v = (x - 63.5) / 63.5, (y - 63.5) / 63.5
    slope_y, slope_x = np.gradient(topography)
    flows = [(1, 0), (0, 1), (-v, u), (u, v), (u, -v), (v, u)]
    moved = [along_x * slope_x + along_y * slope_y for along_x, along_y in flows]
    columns = np.stack(
        [*np.moveaxis(legendre_shapes((128, 128), (0, 1, 2)), -1, 0), topography, *moved], axis=-1
    )
    inside = (slice(8, -8), slice(8, -8))
    found, stated = [], []
    for _ in range(60):
        rough = cv2.GaussianBlur(rng.standard_normal((128, 128)), (0, 0), 2.0)
        height = topography + 0.1 * rough / rough.std()
        smooth = cv2.GaussianBlur(height, (0, 0), 1.0)
        fitted, *_ = np.linalg.lstsq(columns[inside].reshape(-1, 13), smooth[inside].ravel(), rcond=None)
        found.append(fitted[-6:] / fitted[-7])
        stated.append(np.square(warp_errors_px(height, topography)).sum(0))
    scatter, sd = np.std(found, axis=0), np.sqrt(np.mean(stated, axis=0))
    assert scatter[1] > 3 * scatter[0]
    # The scatter of 60 fits is known to 9 %, and three times this is allowed. On average, a jackknife does
    # not underestimate a variance, but it may overestimate it if tiles differ in what they determine.
    assert (sd / scatter > 1 - 3 * 0.09).all()
    assert (sd / scatter < 1.5).all()


def test_an_error_of_the_registration_displaces_a_print_by_its_coefficients():
    y, x = np.mgrid[:65, :81].astype(float)
    coefficients = np.array([0.5, -0.3, 0.2, 0.1, -0.4, 0.6])
    u, v = (60 - 40) / 40, (16 - 32) / 40
    shift_x, shift_y, turn, size, stretch, slant = coefficients
    motions = (
        shift_x - turn * v + (size + stretch) * u + slant * v,
        (shift_y + turn * u + (size - stretch) * v + slant * u),
    )
    for heights, wanted in zip((x, y), motions, strict=True):
        assert (displaced(heights, coefficients) - heights)[16, 60] == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize(("levelling", "terms"), [("none", 0), ("plane", 2), ("bow", 5)])
def test_prints_that_may_be_true_come_in_pairs(levelling, terms):
    height_um = torch.linspace(0, 0.8, 96).repeat(64, 1)
    facts = {"levelled_on": "print", "scale_sd": 0.02, "tip_um": 0.0, "warp_errors_um": 0.05 * np.eye(6)}
    removed_sd_um = [0.01, 0.02, 0.03, 0.04, 0.05][:terms]
    record = MeasuredRecord.model_construct(levelling=levelling, removed_sd_um=removed_sd_um, **facts)
    doubt_um = torch.zeros_like(height_um)
    doubt_um[10:14, 20:24] = 0.3
    # All or none of the doubtful height belongs to the print.
    whole, none = with_dust(height_um, doubt_um)
    assert torch.allclose(whole - height_um, doubt_um)
    assert torch.equal(none, height_um)
    assert not list(with_dust(height_um, torch.zeros_like(height_um)))
    more, less, *pairs = with_other_prints(height_um, record, 0.1)
    assert torch.allclose(more, 1.02 * height_um)
    assert torch.allclose(more + less, 2 * height_um)
    changes = torch.stack([one - height_um for one in pairs])
    plus, minus = changes.reshape(-1, 2, *height_um.shape).unbind(1)
    # The terms of tilt and bow, their common factor, and the six parameters of the registration.
    assert len(plus) == terms + bool(terms) + 6
    # Near the border, the spline does not follow the ramp.
    inside = (slice(None), slice(16, -16), slice(16, -16))
    assert torch.allclose(plus[inside], -minus[inside], atol=1e-6)
    rms_um = plus[:terms].square().mean((1, 2)).sqrt().tolist()
    # On pixels, the terms have an rms of up to 1.04.
    assert rms_um == pytest.approx(removed_sd_um, rel=0.04)
    # The first error of the registration moves the ramp along x, the second along y.
    slope, shift_px = 0.8 / 95, 0.05 / 0.1
    assert plus[-6][inside[1:]].numpy() == pytest.approx(slope * shift_px, rel=1e-3)
    assert plus[-5][inside[1:]].abs().max() == pytest.approx(0, abs=1e-6)


# Tilt, µm per pixel, and bow, µm per squared pixel.
TILT, BOW = 1e-3, 1e-5


def on_substrate(print_um: np.ndarray, rough_um: np.ndarray | float = 0.0) -> Placed:
    """Return a scan that shows a print of 64 × 96 px with 12 px of flat substrate around it. The scanner adds
    a tilt, a bow and noise of 2 nm.
    """
    y, x = np.mgrid[-44:44, -60:60] + 0.5
    bent = TILT * x + BOW * (x * x - 2 * y * y)
    noise = 0.002 * np.random.default_rng(2).standard_normal(bent.shape)
    height = np.pad(print_um, 12) + rough_um + bent + noise
    return Placed(height, np.isfinite(height), 12)


def test_a_bent_print_is_no_bent_scan_where_the_substrate_is_bare():
    """Check that the bow of a print, which levelling on the print removes, stays if the substrate shows the
    bow of the scanner.
    """
    y, x = np.mgrid[-32:32, -48:48] + 0.5
    for own in (0.0, 3e-5):
        found = substrate_background(on_substrate(0.4 - own * (x * x + y * y)), 0.1, "bow")
        assert found is not None
        # The coordinate x runs in pixels of 0.1 µm.
        assert found.tilt_um_per_um == pytest.approx((0.01, 0.0), abs=1e-4)
        wanted = TILT * x + BOW * (x * x - 2 * y * y)
        # The noise of 2 nm on about 1,900 pixels, carried over to the print by five terms.
        assert np.std(found.map_um - wanted) < 3e-4
        assert max(found.sd_um) < 2e-3


def test_the_standard_deviations_of_the_substrate_fit_hold():
    """Check the stated deviations for noise that is alike over ``_ALIKE_PX`` pixels."""
    rng, found, flat = np.random.default_rng(4), [], np.full((64, 96), 0.4)
    for _ in range(40):
        rough_um = 0.02 * cv2.blur(rng.standard_normal((88, 120)), (5, 5))
        found.append(substrate_background(on_substrate(flat, rough_um), 0.1, "bow"))
    seen_um = np.std([one.map_um for one in found], axis=0)
    sd_um = np.mean([one.sd_um for one in found], axis=0)
    stated_um = np.sqrt(legendre_shapes((64, 96), (1, 2)) ** 2 @ sd_um**2)
    # The terms are correlated a little, and 40 draws know a deviation to 11 %.
    assert 0.6 < np.sqrt(np.mean(seen_um**2) / np.mean(stated_um**2)) < 1.3


def test_a_substrate_without_noise_is_used():
    exact = Placed(np.pad(np.full((64, 96), 0.4), 12), np.ones((88, 120), bool), 12)
    found = substrate_background(exact, 0.1, "bow")
    assert found is not None
    assert not found.map_um.any()


def test_a_substrate_that_is_hidden_or_not_flat_is_not_used():
    flat = np.full((64, 96), 0.4)
    assert substrate_background(on_substrate(flat), 0.1, "none") is None
    dirty = on_substrate(flat)
    dirty.height_um[40:44, 2:5] += 1.0
    found = substrate_background(dirty, 0.1, "bow")
    assert found is not None
    # Twelve pixels of dust do not count.
    assert found.tilt_um_per_um == pytest.approx((0.01, 0.0), abs=1e-4)
    # A neighbouring print lies on the left.
    printed = on_substrate(flat)
    printed.height_um[:, :7] += 0.2 * np.random.default_rng(0).random((88, 7))
    printed.height_um[:7] += 0.2 * np.random.default_rng(1).random((7, 120))
    printed.height_um[-7:] += 0.2 * np.random.default_rng(1).random((7, 120))
    assert substrate_background(printed, 0.1, "bow") is None
    hidden = on_substrate(flat)
    hidden.valid[:, -10:] = False
    assert substrate_background(hidden, 0.1, "bow") is None


def test_hidden_tilt_and_bow_are_extrapolated_from_higher_orders():
    generator = np.random.default_rng(0)
    expected_um = generator.uniform(0, 0.8, (96, 128))
    shapes = legendre_shapes(expected_um.shape, range(1, 7))
    off_um = shapes @ (0.02 * generator.choice([-1, 1], shapes.shape[-1]))
    # On pixels, the terms have an rms of 1.01 to 1.07, not exactly 1.
    assert print_terms_sd_um(off_um, expected_um) == pytest.approx(_LOW_ORDER_FACTOR * 0.02, rel=0.1)
    # Levelling does not hide what depends on the expected height alone. A group of heights is 0.025 µm wide.
    assert print_terms_sd_um(0.2 * expected_um**2, expected_um) < 1e-4


@pytest.mark.parametrize(
    ("pitch_sd", "movements", "scale_sd"), [(0, 5, 0), (0.005, 6, 0.005), (0.1, 6, 0.015)]
)
def test_the_scale_of_a_photograph_is_as_uncertain_as_its_pitch_or_the_print(
    tmp_path, printed_design, pitch_sd, movements, scale_sd
):
    loaded = LoadedDesign(printed_design)
    light, pitch_um = loaded.image(loaded.expected_um), loaded.record.layout.pitch_um
    cv2.imwrite(str(tmp_path / "photo.png"), Camera(turn_deg=1.0, noise=1e-3).counts(light, pitch_um, 0))
    source = PhotoSource(tmp_path / "photo.png", 0.15, pitch_sd=pitch_sd, dark_level=DARK)
    photo = photographed_image(light, pitch_um, source, 2.0)
    assert len(photo.other_warps) == movements
    area = np.linalg.det(photo.window_to_photo)
    scales = [np.sqrt(np.linalg.det(one) / area) - 1 for one, _ in photo.other_warps]
    # A movement may turn the camera and scale its image, so the scales of all movements add up in square. The
    # pitch and the print limit the scale together: 1 / (1 / 0.005² + 1 / 0.015²) is 0.0047².
    assert np.linalg.norm(scales) == pytest.approx(scale_sd, rel=0.1, abs=1e-4)


def test_a_judge_whose_image_is_larger_makes_the_scale_less_certain(tmp_path, printed_design):
    loaded = LoadedDesign(printed_design)
    light, pitch_um = loaded.image(loaded.expected_um), loaded.record.layout.pitch_um
    cv2.imwrite(str(tmp_path / "photo.png"), Camera(noise=1e-3).counts(light, pitch_um, 0))
    source = PhotoSource(tmp_path / "photo.png", 0.15, pitch_sd=0.5, dark_level=DARK)
    middle = (len(light) - 1) / 2
    larger = cv2.getRotationMatrix2D((middle, middle), 0.0, 1.03)
    other = cv2.warpAffine(light, larger, light.shape, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    photo = photographed_image(light, pitch_um, source, 2.0, others=[other])
    # The mean square of the usual 1.5 % and the judge's 3 %. The blurred image shows its scale to 5 %.
    assert photo.record.scale_sd == pytest.approx(np.sqrt((0.015**2 + 0.03**2) / 2), rel=0.1)


def test_a_scale_that_the_stated_pitch_excludes_is_not_fitted():
    """Check the sum of the expected image and a stronger copy of it, reduced to 80 % of its size."""
    wanted = gaussian_filter(np.random.default_rng(0).random((128, 128)), 2.0).astype(np.float32)
    wanted = (wanted - wanted.min()) / np.ptp(wanted)
    smaller = cv2.getRotationMatrix2D((63.5, 63.5), 0.0, 0.8)
    copy = cv2.warpAffine(wanted, smaller, (128, 128), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    moves_px2 = np.zeros((6, 6))
    moves_px2[3, 3] = (0.015 * 64) ** 2
    warp = fit_camera(0.35 * wanted + 0.65 * copy, wanted, 1.0, 0.02, moves_px2).window_to_photo
    pixels = np.linalg.det(warp) / (warp[2] @ [63.5, 63.5, 1]) ** 3
    # The scale of the camera has a standard deviation of 0.02. Without this prior in the fit, the image would
    # be shrunk by 11 %, of which at least 0.02² / (0.02² + 0.015²), 7 %, would be the camera's.
    assert abs(np.log(pixels) / 2) < 2 * 0.02


def test_another_scale_of_the_camera_does_not_change_the_light():
    y, x = np.mgrid[:200, :200] - 99.5
    counts = np.exp(-(x**2 + y**2) / 2 / 12**2).astype(np.float32)
    where = np.array([[1.5, 0, 4], [0, 1.5, 4], [0, 0, 1]])
    larger = np.array([[1.6, 0, -2.5], [0, 1.6, -2.5], [0, 0, 1]])
    facts = {"pitch_um": 0.1, "dark_level_sd": 0.0, "vignetting_sd": 0.0, "blur_um": 0.0}
    record, warps = CameraRecord.model_construct(**facts), [[larger] * 2]
    photo = Photograph(counts, where, 128, 0.15, 1.0, 0.0, record, np.zeros((128, 128)), warps)
    images = photo.image(), *photo.with_other_cameras()
    light = [photo.power_share(image, 1.0).sum() for image in images]
    # Interpolation changes the light by less than 0.1 %, and the scale by 14 % if it is not corrected.
    assert light == pytest.approx([counts.sum()] * 5, rel=1e-3)


@pytest.mark.parametrize("averaged_um", [0.0, 0.2])
def test_an_image_is_averaged_over_its_pixels_and_not_over_those_of_the_camera(averaged_um):
    """Check a Gaussian spot whose mean over each camera pixel of 0.1 µm is given by error functions."""

    def spot(count: int, pitch_um: float, side_um: float) -> np.ndarray:
        place_um = pitch_um * (np.arange(count) - (count - 1) / 2)
        if not side_um:
            along = np.exp(-np.square(place_um) / 2 / sigma_um**2)
        else:
            low, high = (erf((place_um + half * side_um) / sigma_um / np.sqrt(2)) for half in (-0.5, 0.5))
            along = np.sqrt(np.pi / 2) * sigma_um / side_um * (high - low)
        return np.outer(along, along).astype(np.float32)

    sigma_um = 0.5
    counts, wanted = spot(149, 0.1, 0.1), spot(65, 0.2, averaged_um)
    where = np.array([[2.0, 0, 10], [0, 2.0, 10], [0, 0, 1]])
    record = CameraRecord.model_construct(pitch_um=0.1)
    photo = Photograph(counts, where, 65, 0.2, 2.0, averaged_um, record, np.zeros((65, 65)), [])
    # The averaging over 0.2 µm lowers the spot by 1.3 %, that over 0.1 µm by 0.3 %.
    assert photo.image() == pytest.approx(wanted, abs=1e-4)


def test_baselines_stand_beside_every_score(printed_design, tmp_path):
    design = LoadedDesign(printed_design).record
    black, limited, phase, weighted = design.baselines.values()
    target = LoadedDesign(printed_design).target.double()
    # For a black image, the error is the target itself.
    assert black["si_psnr_db"] == pytest.approx(float(-10 * torch.log10(target.square().mean())))
    assert black["ssim"] > design.predicted["ssim"]
    assert phase["loss"] < design.polished_loss
    assert limited["si_psnr_db"] > design.predicted["si_psnr_db"]
    assert weighted["speckle_contrast"] < phase["speckle_contrast"]
    assert design.predicted["eff_signal"] < design.reference_efficiency <= 1
    # For these scores, details that cannot be resolved do not count against an image.
    assert all(one["si_psnr_resolved_db"] > one["si_psnr_db"] for one in design.baselines.values())
    assert score_design(printed_design, tmp_path / "s", judges=["none"]).baselines == design.baselines


def test_a_photograph_of_something_else_is_refused(tmp_path, printed_design):
    cv2.imwrite(str(tmp_path / "flat.png"), np.random.default_rng(0).integers(0, 255, (90, 90), np.uint8))
    with pytest.raises(InputError, match="photograph"):
        score_design(
            printed_design, tmp_path / "s", judges=[], camera=PhotoSource(tmp_path / "flat.png", 0.2)
        )
    with pytest.raises(InputError, match="which does not exist"):
        score_design(
            printed_design, tmp_path / "s", judges=[], camera=PhotoSource(tmp_path / "none.png", 0.2)
        )
    named = PhotoSource(tmp_path / "flat.png", 0.2, imaged="text")
    with pytest.raises(InputError, match=r"hologram.*--camera-object"):
        score_design(printed_design, tmp_path / "s", judges=[], camera=named)
    # The light has 0.66 periods per µm, so pixels of 1 µm are too coarse for it.
    for pitch_um, complaint in ((0.0, "pitch"), (1.0, r"got 1 µm, .* at most 0\.\d+ µm")):
        with pytest.raises(InputError, match=complaint):
            score_design(
                printed_design, tmp_path / "s", judges=[], camera=PhotoSource(tmp_path / "flat.png", pitch_um)
            )
