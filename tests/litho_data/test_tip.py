"""Test tips of the microscope: laws of morphology, known tips, and places that a tip does not touch."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
from typer.testing import CliRunner

from litho_data.cli.app import app
from litho_data.foundation.errors import InputError
from litho_data.level.scan import write_heights
from litho_data.making.build import build_dataset
from litho_data.provenance.history import replay
from litho_data.provenance.verify import verify
from litho_data.scan import Scan
from litho_data.store import open_store
from litho_data.tip import (
    estimate_tip,
    lateral_resolution_um,
    paraboloid_erosion,
    reconstructed,
    tip_certain,
)
from litho_data.tip.curvature import highest_curvature
from litho_data.tip.radius import PeakRadius, of_one_tip, peak_radius
from tests.litho_data.campaigns import write_campaign
from tests.litho_data.known_tips import OVER, PITCH_UM, fine_surface, noise_of_snr, print_under_tip

PITCH = PITCH_UM
_image = cache(lambda kind, radius_um: print_under_tip(kind, radius_um, 1.0))


def _scan(kind: str, radius_um: float, snr: float) -> Scan:
    image, _ = _image(kind, radius_um)
    return Scan(image + noise_of_snr(image.shape, 1.0, snr, seed=11), PITCH, name=kind)


# Morphology


def _dilated(surface: np.ndarray, pitch_um: tuple[float, float], radius_um: float) -> np.ndarray:
    return -paraboloid_erosion(-surface, pitch_um, radius_um).surface


def test_a_paraboloid_applied_axis_by_axis_equals_the_whole_paraboloid() -> None:
    rng, pitch = np.random.default_rng(1), (0.1, 0.07)
    field = rng.standard_normal((20, 26)) * 0.1
    field[3, 4] = np.nan
    radius = 0.2
    half = int(np.sqrt(2 * radius * np.ptp(field[np.isfinite(field)])) / min(pitch)) + 2
    step = np.arange(-half, half + 1)
    tip = -((step[:, None] * pitch[0]) ** 2 + (step * pitch[1]) ** 2) / (2 * radius)
    measured = np.isfinite(field)
    found = paraboloid_erosion(field, pitch, radius)
    known = np.where(measured, field, np.inf)
    eroded = scipy.ndimage.grey_erosion(known, structure=tip, mode="constant", cval=np.inf)
    assert np.allclose(found.surface[measured], eroded[measured], atol=1e-14)
    # (found.row, found.column) is the place of the image that determines the height of a pixel.
    rows, columns = np.indices(field.shape)
    away = ((found.row - rows) * pitch[0]) ** 2 + ((found.column - columns) * pitch[1]) ** 2
    explained = field[found.row, found.column] + away / (2 * radius)
    assert np.allclose(explained[measured], found.surface[measured], atol=1e-14)
    assert np.isnan(found.surface[3, 4])


def test_a_surface_that_the_tip_follows_comes_back_and_an_image_stays_an_image() -> None:
    rows, columns = np.indices((60, 60)) * 0.1
    surface = 0.05 * np.sin(1.3 * rows) * np.cos(0.9 * columns)  # its curvature is below 0.13 / µm
    image = _dilated(surface, PITCH, 2.0)
    found = reconstructed(image, PITCH, 2.0)
    # Contacts lie between pixels, so two operations each change heights by at most (pitch/2)²/2R per axis.
    assert np.abs(found - surface)[10:-10, 10:-10].max() < 2 * 0.05**2 / (2 * 2.0) * 2
    assert np.allclose(_dilated(found, PITCH, 2.0), image, atol=1e-14)


# Known tips


@pytest.mark.parametrize("snr", [20, 100])
@pytest.mark.parametrize(("kind", "radius_um"), [("pillars", 0.5), ("spikes", 0.5), ("bumps", 1.0)])
def test_the_radius_of_a_known_tip_is_found(kind: str, radius_um: float, snr: float) -> None:
    found = estimate_tip([_scan(kind, radius_um, snr)])
    assert found.kind == "estimate", found.reason
    assert found.radius_um == pytest.approx(radius_um, rel=0.1)
    assert found.radius_sd_um is not None
    assert abs(found.radius_um - radius_um) < 3 * found.radius_sd_um
    assert peak_radius(_scan(kind, radius_um, snr).height_um, PITCH).radius_um == found.radius_um


@pytest.mark.parametrize("seed", [5002, 5004, 5010, 5011])
def test_a_few_tops_that_are_sharper_than_the_others_are_not_taken_for_the_tip(seed: int) -> None:
    """Check rounded bumps of many radii r. A tip of radius R images their tops with radii R + r."""
    image, _ = print_under_tip("bumps", 0.15, 1.0, seed=seed)
    found = peak_radius(image + noise_of_snr(image.shape, 1.0, 50, seed), PITCH)
    # If they were given as estimates, these radii would be 15 to 52 % too large.
    assert "parts of the scan" in found.reason
    assert found.radius_um is not None
    assert found.radius_um > 0.15


@pytest.mark.parametrize("snr", [20, 100])
@pytest.mark.parametrize("kind", ["pillars", "spikes", "bumps"])
def test_a_tip_of_few_pixels_gets_an_upper_bound(kind: str, snr: float) -> None:
    found = estimate_tip([_scan(kind, 0.06, snr)])  # √(2 R h) = 3.5 pixels
    assert found.kind == "upper bound"
    assert found.radius_um is not None
    assert found.radius_um > 0.06


def test_the_radius_of_a_spherical_tip_is_found() -> None:
    radius_um, fine_um = 2.0, PITCH[0] / OVER
    surface = fine_surface("pillars", 0.3, seed=11, size_px=64)
    reach = int(np.sqrt(2 * radius_um * 0.35) / fine_um)
    step = np.arange(-reach, reach + 1) * fine_um
    inside = radius_um**2 - step[:, None] ** 2 - step**2
    sphere = np.where(inside > (radius_um - 0.35) ** 2, np.sqrt(np.maximum(inside, 0)) - radius_um, -np.inf)
    image = scipy.ndimage.grey_dilation(
        surface, footprint=np.isfinite(sphere), structure=sphere, mode="constant", cval=-np.inf
    )[OVER // 2 :: OVER, OVER // 2 :: OVER]
    found = estimate_tip([Scan(image, PITCH)])
    # The curvature of a sphere along a line up its flank is 1/R (1 + slope²)^1.5. The flanks end at 0.3 µm,
    # where the slope is 0.62 and the curvature 1.63 times as high. On the way, it is 1.23 times as high.
    assert found.radius_um is not None
    assert radius_um / 1.63 < found.radius_um < 1.1 * radius_um


def test_a_flat_scan_gives_no_bound_and_a_rounded_surface_only_a_bound() -> None:
    rng = np.random.default_rng(3)
    flat = estimate_tip([Scan(0.003 * rng.standard_normal((128, 128)), PITCH)])
    assert (flat.kind, flat.radius_um, flat.radius_sd_um) == ("upper bound", None, None)
    assert flat.scans[0].certain_fraction is None
    rough = scipy.ndimage.gaussian_filter(rng.standard_normal((200, 200)), 5)
    rounded = estimate_tip([Scan(0.3 * rough / rough.std(), PITCH)])
    assert rounded.kind == "upper bound"
    assert "surface" in rounded.reason
    ridges = np.broadcast_to(0.3 * np.sin(np.arange(200) / 4), (200, 200))
    assert estimate_tip([Scan(ridges, PITCH)]).kind == "upper bound"


def test_scans_of_one_day_bound_one_tip_by_the_sharpest_of_them() -> None:
    rough = scipy.ndimage.gaussian_filter(np.random.default_rng(4).standard_normal((160, 160)), 9)
    dull, sharp = Scan(0.2 * rough / rough.std(), PITCH), _scan("pillars", 0.5, 100)
    alone, both = estimate_tip([dull]), estimate_tip([dull, sharp])
    assert alone.radius_um is not None
    assert both.radius_um is not None
    assert alone.radius_um > 1.5 * both.radius_um
    with pytest.raises(InputError, match="pitch of"):
        estimate_tip([sharp, Scan(rough, (0.2, 0.2))])


def test_an_estimate_is_refuted_by_a_sharper_scan() -> None:
    def said(radius_um: float | None, reason: str = "") -> PeakRadius:
        return PeakRadius(radius_um, 0.05 * (radius_um or 0.0), reason, 1.0, 5, 0.5)

    none, wide, tight = said(None, "flat"), said(2.0, "rounded"), said(0.2, "rounded")
    assert of_one_tip([none, none]).radius_um is None
    assert of_one_tip([none, wide, tight]) == tight
    both = of_one_tip([said(0.5), wide, said(0.52)])
    assert both.radius_um == pytest.approx(0.51)
    assert not both.reason
    # The third scan is blunter by 8 standard deviations, so it shows its surface and not this tip.
    assert of_one_tip([said(0.5), said(0.52), said(0.7)]).radius_um == pytest.approx(0.51)
    assert of_one_tip([said(0.5), tight]) == tight


def test_offsets_of_lines_and_turning_points_do_not_sharpen_the_bound() -> None:
    scan = _scan("pillars", 0.5, 100)
    rng = np.random.default_rng(6)
    worse = scan.height_um + 0.03 * rng.standard_normal((scan.shape[0], 1))
    worse[:, :2] += 0.3
    found = estimate_tip([Scan(worse, PITCH)])
    assert found.radius_um == pytest.approx(0.5, rel=0.1)
    turned = estimate_tip([Scan(worse.T, PITCH)])
    assert turned.radius_um == pytest.approx(found.radius_um, rel=1e-9)


def test_gaps_do_not_affect_the_tip() -> None:
    scan = _scan("pillars", 0.5, 100)
    gaps = scan.height_um.copy()
    gaps[40:60, 70:100] = np.nan
    found = estimate_tip([Scan(gaps, PITCH)])
    assert found.radius_um == pytest.approx(0.5, rel=0.1)
    assert not tip_certain(gaps, PITCH, 0.5)[np.isnan(gaps)].any()


# Where the tip did not touch


@pytest.mark.parametrize("snr", [np.inf, 20])
@pytest.mark.parametrize(
    ("kind", "radius_um"), [("pillars", 0.15), ("pillars", 0.5), ("spikes", 0.5), ("bumps", 1.0)]
)
def test_untouched_pixels_are_uncertain_and_most_of_the_touched_certain(
    kind: str, radius_um: float, snr: float
) -> None:
    inner = (slice(15, -15),) * 2
    certain = tip_certain(_scan(kind, radius_um, snr).height_um, PITCH, radius_um)[inner]
    untouched = _image(kind, radius_um)[1][inner] < 0.5
    assert untouched.sum() > 100
    assert (~certain[untouched]).mean() >= 0.95
    assert certain[~untouched].mean() >= 0.8


@pytest.mark.parametrize("kind", ["pillars", "spikes", "bumps"])
def test_valleys_as_narrow_as_the_disc_are_uncertain_too(kind: str) -> None:
    """Check a sharp tip with much noise, for which curvatures are fitted over more than half of its reach."""
    inner = (slice(15, -15),) * 2
    for seed in (5000, 5001, 5002):
        image, touched = print_under_tip(kind, 0.15, 1.0, seed=seed)
        certain = tip_certain(image + noise_of_snr(image.shape, 1.0, 20, seed), PITCH, 0.15)[inner]
        untouched = touched[inner] < 0.5
        assert (~certain[untouched]).mean() >= 0.95
        assert certain[~untouched].mean() >= 0.8


def test_a_blunter_tip_leaves_fewer_pixels_certain_and_a_flat_scan_all() -> None:
    image, _ = _image("pillars", 0.5)
    shares = [tip_certain(image, PITCH, radius).mean() for radius in (0.1, 0.25, 0.5)]
    assert shares[0] > shares[1] > shares[2]
    noise = 0.003 * np.random.default_rng(7).standard_normal((80, 80))
    assert tip_certain(noise, PITCH, 0.05).all()
    with pytest.raises(InputError, match="radius of the tip"):
        tip_certain(noise, PITCH, float("nan"))


@pytest.mark.parametrize("shape", [(9, 9), (10, 9), (9, 30), (8, 8), (8, 9), (30, 8), (1, 30)])
def test_curvatures_are_known_only_where_the_disc_fits_into_the_scan(shape: tuple[int, int]) -> None:
    y, x = 0.1 * np.indices(shape)
    found = highest_curvature(x**2 / 2 + y**2, (0.1, 0.1), 4.0)
    inside = np.zeros(shape, bool)
    inside[4 : max(4, shape[0] - 4), 4 : max(4, shape[1] - 4)] = True
    assert np.array_equal(np.isfinite(found), inside)
    assert found[inside] == pytest.approx(2.0, rel=1e-9)


def test_a_noisy_scan_smaller_than_the_disc_has_no_valley() -> None:
    height = np.random.default_rng(0).normal(0, 0.2, (10, 32))
    assert tip_certain(height, (0.1, 0.1), 1.0).all()


def test_the_lateral_resolution_follows_its_closed_form_and_surface_topography() -> None:
    from SurfaceTopography import Topography

    rows, columns = np.indices((80, 120)) * 0.1
    base_um, bump_um, radius_um = 1.0, 0.5, 1.0
    away = (rows - 4.0) ** 2 + (columns - 5.0) ** 2
    image = np.maximum(base_um**2 - away, 0) / (2 * bump_um)
    # Measured over a distance d beyond its base, this cap of height h = b²/2ρ has the curvature 2h/d². This
    # is half of 1/R at d = b √(2R/ρ), and λ is 2d. Between pixels, the curvature is interpolated linearly.
    found = lateral_resolution_um(image, PITCH, radius_um)
    assert found == pytest.approx(2 * base_um * np.sqrt(2 * radius_um / bump_um), rel=0.01)
    theirs = Topography(image, (8.0, 12.0), unit="um", periodic=False)
    assert found == pytest.approx(theirs.scanning_probe_reliability_cutoff(radius_um), rel=0.01)
    assert lateral_resolution_um(0.001 * image, PITCH, 0.01) is None


# The command


def test_the_command_prints_the_tip_and_writes_its_maps(tmp_path) -> None:
    scan = _scan("pillars", 0.5, 100)
    file = write_heights(tmp_path / "print.gsf", scan.height_um, pitch_um=PITCH)
    done = CliRunner().invoke(app, ["tip", str(file), "--maps", str(tmp_path / "maps")])
    assert done.exit_code == 0, done.output
    assert "radius 0.5" in done.output or "radius 0.4" in done.output
    certain = np.load(tmp_path / "maps" / "print.certain.npy")
    assert certain.dtype == bool
    assert certain.shape == scan.shape
    assert (tmp_path / "maps" / "print.surface.gsf").exists()
    twice = CliRunner().invoke(app, ["tip", str(file), str(file), "--maps", str(tmp_path / "maps")])
    assert isinstance(twice.exception, InputError)
    assert "different names" in str(twice.exception)
    said = json.loads(CliRunner().invoke(app, ["tip", str(file), "--json"]).stdout)
    assert said["kind"] == "estimate"
    assert said["scans"][0]["certain_fraction"] == pytest.approx(certain.mean(), abs=0.01)


# In a build


def test_a_build_with_a_tip_leaves_out_what_it_may_not_have_touched(tmp_path, without_report) -> None:
    card = write_campaign(tmp_path / "raw", count=1)
    plain = open_store(_built(card, tmp_path / "plain.zarr"))
    store = open_store(_built(card, tmp_path / "blunt.zarr", tip=0.1))
    scan, before = store.scan("P11"), plain.scan("P11")
    certain = store.scan_frame("P11", "tip_certain")
    assert certain.dtype == bool
    assert 0.3 < certain.mean() < 0.97
    row = store.quality.iloc[0]
    assert row["tip_radius_um"] == scan.tip_radius_um == 0.1
    assert before.tip_radius_um is None
    assert row["tip_certain_fraction"] == pytest.approx(certain.mean())
    # The scan extends 8 pixels beyond its layout on all sides, almost without rotation or change of scale.
    on_layout = certain[8:-8, 8:-8]
    inner = (slice(3, -3),) * 2
    clear = scipy.ndimage.uniform_filter(on_layout.astype(float), 3)
    assert not scan.valid[inner][clear[inner] < 0.01].any()
    assert scan.valid[inner][clear[inner] > 0.99].all()
    assert np.isnan(scan.height_um[~scan.valid]).all()
    assert np.array_equal(scan.height_um[scan.valid], before.height_um[scan.valid])
    assert verify(tmp_path / "blunt.zarr").findings == ()
    assert replay(tmp_path / "blunt.zarr")["same_hash"].all()
    assert store.sha256 != plain.sha256
    assert store.computed_sha256() == store.sha256


def test_a_blind_tip_is_the_same_for_all_scans(tmp_path, capsys, without_report) -> None:
    card = write_campaign(tmp_path / "raw", count=2, more='[process]\ntip = "blind"')
    store = open_store(_built(card, tmp_path / "prints.zarr"))
    assert "tip: radius at most" in capsys.readouterr().err
    assert store.quality["tip_radius_um"].nunique() == 1
    assert store.manifest["card"]["process"]["tip"] == "blind"
    assert 0.3 < store.quality["valid_fraction"].min() < 1


@pytest.mark.parametrize("tip", ["-1", "0", "sharp", "nan"])
def test_an_invalid_tip_radius_is_one_line(tmp_path, tip) -> None:
    card = write_campaign(tmp_path / "raw", count=1)
    with pytest.raises(InputError, match="wanted a radius in µm, or blind"):
        build_dataset(card, tmp_path / "out.zarr", tip=tip)
    card.write_text(card.read_text() + '[process]\ntip = "sharp"\n')
    with pytest.raises(InputError, match=r"process\.tip"):
        build_dataset(card, tmp_path / "out.zarr")


def _built(card: Path, out: Path, **options) -> Path:
    build_dataset(card, out, **options)
    return out
