"""Check the scales found from gratings and steps, their uncertainties, and their use in a build."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from typer.testing import CliRunner

from litho_data import build_dataset, open_store, verify
from litho_data.cards.listing import list_fields
from litho_data.cli.app import app
from litho_data.foundation.errors import InputError
from litho_data.making.calibration import calibrate
from litho_data.making.day_tip import tip_of
from litho_data.making.jobs import field_jobs
from litho_data.making.operations import no_recipe
from litho_data.provenance.history import history, replay
from litho_data.readers.gsf import gsf_bytes
from litho_data.roughness import axis_scales, find_step, find_wave
from litho_data.tip.radius import peak_radius
from tests.litho_data.campaigns import MARGIN_PX, NOISE_UM, height_of, layout_of, write_campaign, write_scan

PITCH_UM, PERIOD_UM, STEP_UM = 0.1, 1.5, 0.2
SCALE = {"x": 1.03, "y": 0.98, "z": 1.05}


def _grating(
    rng: np.random.Generator, axis: str, scale_x: float, scale_y: float, degrees: float, size: int = 192
) -> np.ndarray:
    """Return a scan of ridges 0.1 µm high, with pixel noise and line noise.

    The scales of the scanner are wrong by the given factors.
    """
    y, x = (np.arange(size) * PITCH_UM * scale for scale in (scale_y, scale_x))
    turn = np.radians(degrees)
    along, across = (x[None, :], y[:, None]) if axis == "x" else (y[:, None], x[None, :])
    phase = (along * np.cos(turn) + across * np.sin(turn)) / PERIOD_UM + rng.uniform()
    ridges = 0.05 * np.tanh(4 * np.sin(2 * np.pi * phase))
    return ridges + 0.02 * rng.standard_normal((size, size)) + 0.01 * rng.standard_normal((size, 1))


def _step(rng: np.random.Generator, height_um: float, shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    """Return a scan of a step across x on a tilted field, with pixel noise and line noise."""
    profile = height_um * gaussian_filter((np.arange(shape[1]) >= 70).astype(float), 2.0)
    tilt = np.linspace(0, 0.1, shape[1])[None, :] + np.linspace(0, 0.3, shape[0])[:, None]
    return profile + tilt + 0.01 * rng.standard_normal(shape) + 0.05 * rng.standard_normal((shape[0], 1))


def test_a_stretched_grating_gives_both_factors_within_their_uncertainty():
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(40):
        scales = 1 + 0.03 * rng.standard_normal(2)
        waves = [
            find_wave(_grating(rng, axis, *scales, rng.uniform(-3, 3)), (PITCH_UM,) * 2, PERIOD_UM, axis)
            for axis in ("x", "y")
        ]
        found = axis_scales([(wave, PERIOD_UM, 0.0) for wave in waves], ["x", "y"])
        ratios.append(
            [(found[a].factor - s) / found[a].uncertainty for a, s in zip("xy", scales, strict=True)]
        )
        # The factors are known to one part in a thousand, and the stretch of 3 % is thirty times as large.
        assert max(found[a].uncertainty for a in "xy") < 2e-3
    inside = [float((np.abs(ratios) < limit).mean()) for limit in (1, 2)]
    # For 80 draws, 0.68 ± 0.05 and 0.95 ± 0.024 are expected. The limits allow three times these deviations.
    assert 0.53 < inside[0] < 0.83
    assert inside[1] > 0.88


@pytest.mark.parametrize("periods", [8.5, 20.3])
def test_the_bow_of_a_scan_does_not_change_the_period_of_its_grating(periods: float) -> None:
    """Check a grating of 50 nm in raw scans with tilt and bow, whatever the phase of the grating."""
    x = np.arange(512) * PITCH_UM
    period_um, along = 51.2 / periods, np.linspace(-1, 1, 512)
    ratios = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        wave_um = 0.05 * np.cos(2 * np.pi * (x / period_um + rng.uniform())) + 0.15 * along
        raw = wave_um + 0.1 * along**2 + 0.001 * rng.standard_normal((64, 512))
        wave = find_wave(raw, (PITCH_UM,) * 2, period_um, "x")
        assert wave.x_per_um * period_um == pytest.approx(1, abs=1e-4)
        ratios.append((wave.x_per_um - 1 / period_um) / wave.uncertainty_per_um)
    # For 30 draws, the rms of 1 has an error of 0.13.
    assert np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_the_scale_of_a_turned_grating_depends_on_the_other_axis_only_to_second_order():
    """Check a grating that is rotated by 3°, while the scale of the other axis is wrong by 2 %."""
    rng = np.random.default_rng(3)
    wave = find_wave(_grating(rng, "x", 1.03, 1.02, 3.0), (PITCH_UM,) * 2, PERIOD_UM, "x")
    found = axis_scales([(wave, PERIOD_UM, 0.0)], ["x"])["x"]
    # The error of the axis that is not calibrated is multiplied by (sin 3°)².
    assert found.factor == pytest.approx(1.03, abs=3 * found.uncertainty + 0.02 * np.sin(np.radians(3)) ** 2)


def test_the_uncertainty_of_the_period_of_a_standard_is_added():
    wave = find_wave(_grating(np.random.default_rng(1), "x", 1.0, 1.0, 0.0), (PITCH_UM,) * 2, PERIOD_UM, "x")
    own = axis_scales([(wave, PERIOD_UM, 0.0)], ["x"])["x"].uncertainty
    both = axis_scales([(wave, PERIOD_UM, 0.015)], ["x"])["x"]
    assert both.uncertainty == pytest.approx(np.hypot(own, 0.01 * both.factor), rel=1e-6)


def test_a_step_is_found_and_measured_within_its_uncertainty():
    rng = np.random.default_rng(0)
    found = [find_step(_step(rng, STEP_UM), PITCH_UM) for _ in range(60)]
    ratios = np.array([(step.height_nm - 1e3 * STEP_UM) / step.uncertainty_nm for step in found])
    # For 60 draws, a share of 0.68 ± 0.06 is expected. The limits allow three times this deviation.
    assert 0.5 < (np.abs(ratios) < 1).mean() < 0.86
    assert find_step(_step(rng, STEP_UM).T, PITCH_UM, axis="y").height_nm == pytest.approx(200, abs=5)
    grooves = np.tile(np.repeat([0.0, -0.3], 16), 4)[None, :] + np.zeros((20, 1))
    assert find_step(grooves, PITCH_UM).height_nm == pytest.approx(300, abs=1e-6)


@pytest.mark.parametrize("until", [90, 200])
def test_the_bow_of_a_scan_is_not_taken_for_the_height_of_its_step(until: int) -> None:
    """Check a ridge and a step off the middle of the field, in a raw scan with tilt and bow."""
    along = np.linspace(-1, 1, 200)
    step = np.zeros(200)
    step[60:until] = STEP_UM
    # A background of second degree is fitted exactly, however large it is.
    for bow_um in (0.1, -0.3):
        raw = np.tile(step + 0.2 * along + bow_um * along**2, (20, 1))
        assert find_step(raw, PITCH_UM).height_nm == pytest.approx(1e3 * STEP_UM, abs=1e-6)
        assert find_step(raw.T, PITCH_UM, axis="y").height_nm == pytest.approx(1e3 * STEP_UM, abs=1e-6)
    ratios = []
    for seed in range(60):
        noise = np.random.default_rng(seed).standard_normal((40, 200))
        found = find_step(step + 0.1 * along**2 + 0.002 * noise, PITCH_UM)
        ratios.append((found.height_nm - 1e3 * STEP_UM) / found.uncertainty_nm)
    # The mean of the two steps of a ridge is more certain than the single step that the uncertainty states.
    # For 60 draws, the rms of 1 has an error of 0.09.
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.3


@pytest.mark.parametrize("missing", [slice(0, 12), slice(-30, None), slice(70, 80), slice(95, 105)])
def test_unmeasured_columns_are_not_taken_for_a_step(missing: slice) -> None:
    along = np.linspace(-1, 1, 200)
    raw = np.tile(0.5 + STEP_UM * (along > 0) + 3.0 * along, (20, 1))
    raw[:, missing] = np.nan
    assert find_step(raw, PITCH_UM).height_nm == pytest.approx(1e3 * STEP_UM, abs=1e-6)
    assert find_step(raw.T, PITCH_UM, axis="y").height_nm == pytest.approx(1e3 * STEP_UM, abs=1e-6)


@pytest.mark.parametrize("columns", [0, 1, 5])
def test_a_scan_of_a_few_columns_shows_no_step(columns: int) -> None:
    raw = np.full((20, 40), np.nan)
    raw[:, 10 : 10 + columns] = 0.1
    with pytest.raises(InputError, match=f"got {columns} measured positions, wanted at least 6"):
        find_step(raw, PITCH_UM)


def test_lines_that_vary_together_count_as_fewer() -> None:
    """Check the number of independent lines. Here only neighbouring lines have a positive correlation."""
    wave = np.cos(np.pi * np.arange(60) / 3)
    height = np.zeros((60, 80))
    height[:, 40:] = 0.2 + 0.01 * wave[:, None]
    found = find_step(height, PITCH_UM)
    next_line = (wave[1:] * wave[:-1]).sum() / (wave**2).sum()
    assert (found.line_sd_nm / found.uncertainty_nm) ** 2 == pytest.approx(60 / (1 + 2 * next_line), rel=1e-6)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a campaign whose microscope has three wrong scales, with scans of gratings and a step."""
    folder = tmp_path_factory.mktemp("calibrated")
    write_campaign(folder)
    rng = np.random.default_rng(5)
    for index, name in enumerate(("P11", "P12", "P21")):
        write_scan(folder / "scans" / f"{name}.txt", height_of(layout_of(index), index) / SCALE["z"])
    size = 192
    for axis in "xy":
        write_scan(folder / "standards" / f"{axis}.txt", _grating(rng, axis, SCALE["x"], SCALE["y"], 1.0))
    write_scan(folder / "standards" / "step.txt", _step(rng, STEP_UM / SCALE["z"], (size, size)))
    card = (folder / "card.toml").read_text()
    stated = [12.8 / SCALE["y"], 12.8 / SCALE["x"]]
    card = card.replace("size_um = [12.8, 12.8]", f"size_um = {stated}")
    grating = f"size_um = [19.2, 19.2]\nperiod_um = {PERIOD_UM}\nuncertainty_um = 0.0015\n"
    card += f'[calibration.x]\nfile = "standards/x.txt"\n{grating}'
    card += f'[calibration.y]\nfile = "standards/y.txt"\n{grating}'
    card += '[calibration.z]\nfile = "standards/step.txt"\nsize_um = [19.2, 19.2]\n'
    card += f"height_um = {STEP_UM}\nuncertainty_um = 0.002\n"
    (folder / "card.toml").write_text(card)
    build_dataset(folder / "card.toml", folder / "prints.zarr")
    return folder


def test_a_standard_is_read_as_the_scans_are(tmp_path: Path) -> None:
    card = write_campaign(tmp_path, count=1, unit='"nm"')
    plain = card.read_text()
    grating = _grating(np.random.default_rng(6), "x", SCALE["x"], SCALE["y"], 1.0)
    marked = grating.copy()
    marked[3, 5] = marked[90, 100] = -9999.0
    write_scan(tmp_path / "x.txt", grating)
    np.savetxt(tmp_path / "marked.txt", marked, delimiter="\t")
    (tmp_path / "x.gsf").write_bytes(gsf_bytes(grating, (PITCH_UM, PITCH_UM)))

    def scale(name: str, of_scans: str = "", own: str = "") -> float:
        known = f'file = "{name}"\nperiod_um = {PERIOD_UM}\nuncertainty_um = 0.0015\n'
        scans = plain.replace("levelled = true", f"levelled = true\n{of_scans}")
        card.write_text(f"{scans}[calibration.x]\n{known}{own}")
        return calibrate(card)["x"].factor

    own = 'size_um = [19.2, 19.2]\nunit = "m"\n'
    true = scale("x.txt", own=own)
    assert true == pytest.approx(SCALE["x"], rel=0.01)
    # The file states another unit and size than the card does for the scans.
    for stated in ("", 'unit = "m"\n'):
        assert scale("x.gsf", own=f'format = "gsf"\n{stated}') == pytest.approx(true, rel=1e-4)
    # It must agree with what the card states for this standard.
    with pytest.raises(InputError, match="size_um"):
        scale("x.gsf", own='format = "gsf"\nunit = "m"\nsize_um = [12.8, 12.8]\n')
    marks, own = "missing = [-9999]\n", own.replace('"m"', '"um"')
    assert scale("marked.txt", marks, own) == pytest.approx(true, rel=1e-3)
    assert scale("marked.txt", "missing = []\n", own + marks) == scale("marked.txt", marks, own)


def test_a_build_applies_the_scales_and_carries_their_uncertainty(calibrated: Path) -> None:
    store = open_store(calibrated / "prints.zarr")
    quality = store.quality
    for axis, true in SCALE.items():
        error = np.abs(quality[f"scale_{axis}"] - true) / quality[f"scale_{axis}_uncertainty"]
        assert error.max() < 3
    # With corrected lengths, scan and layout have the same scale, up to 0.02 px of 112 due to noise.
    assert quality["singular_max"].max() < 1.004
    assert quality["singular_min"].min() > 0.996
    pitches = quality[["scan_pitch_y_um", "scan_pitch_x_um"]].to_numpy()
    assert [store.scan_frame_pitch_um(scan_id) for scan_id in store.ids] == [*map(tuple, pitches)]
    for index, scan in enumerate(store.scans()):
        truth = height_of(layout_of(index), index)[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        difference = (scan.height_um - truth)[scan.valid]
        # The z scale is known to 1 %, so heights with an sd of 0.35 µm are known to 3.5 nm, plus noise.
        assert difference.std() < np.hypot(2 * NOISE_UM, 3 * 0.0035)
        spread = scan.height_um[scan.valid].std()
        known = 1e3 * spread * quality["scale_z_uncertainty"][index] / quality["scale_z"][index]
        assert quality["sigma_calibration_nm"][index] == pytest.approx(known, rel=1e-4)


def test_a_blind_tip_is_found_in_calibrated_lengths(calibrated: Path) -> None:
    (job, *_) = field_jobs(list_fields(calibrated / "card.toml"), no_recipe())
    found, true = tip_of(job), peak_radius(height_of(layout_of(0), 0), (PITCH_UM, PITCH_UM))
    assert found is not None
    assert found.radius_um is not None
    # The scales are known to 1 %. The radius is proportional to a squared length over a height, so without
    # one of the corrections it would be wrong by 5 or 6 %. Without both, the depth would be wrong by 5 %.
    assert found.radius_um == pytest.approx(true.radius_um, rel=0.03)
    assert found.depth_um == pytest.approx(true.depth_um, rel=0.02)


def test_the_standards_are_in_the_provenance(calibrated: Path) -> None:
    path = calibrated / "prints.zarr"
    assert not verify(path).findings
    assert "standards/step.txt" in history(path, "P11")
    assert replay(path, ["P12"])["same_hash"].all()
    said = CliRunner().invoke(app, ["calibrate", str(calibrated / "card.toml")])
    assert said.exit_code == 0
    assert [line[0] for line in said.output.splitlines()] == ["y", "x", "z"]
    step = calibrated / "standards" / "step.txt"
    kept = step.read_text()
    step.write_text(kept.replace("e-", "e-0", 1))
    assert [str(one).split(":")[0] for one in verify(path).findings] == ["raw file standards/step.txt"]
    step.write_text(kept)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("standards/x.txt", "standards/step.txt", "nothing that repeats every 1.5 µm"),
        (
            f"period_um = {PERIOD_UM}",
            "period_um = 3.0",
            r"6.4 periods of 30.0 pixels, wanted at least 8 periods",
        ),
        ("standards/step.txt", "standards/flat.txt", "no edge that stands out"),
        ("standards/step.txt", "standards/none.txt", "no file standards/none.txt"),
        (f"height_um = {STEP_UM}\nuncertainty", "height_um = 200.0\nuncertainty", "check the unit"),
        ("uncertainty_um = 0.002", "uncertainty_um = -1", "uncertainty_um"),
    ],
)
def test_a_standard_that_shows_something_else_stops_the_build_in_one_line(calibrated, old, new, said):
    flat = 0.01 * np.random.default_rng(9).standard_normal((192, 192))
    write_scan(calibrated / "standards" / "flat.txt", gaussian_filter(flat, 2.0))
    card = calibrated / "bad.toml"
    text = (calibrated / "card.toml").read_text()
    assert old in text
    card.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=said) as caught:
        build_dataset(card, calibrated / "bad.zarr")
    assert "\n" not in str(caught.value)
    assert not (calibrated / "bad.zarr").exists()
    with pytest.raises(InputError, match=said):
        calibrate(card)
