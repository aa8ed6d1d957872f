"""Check that an object is recovered from its photograph through a lens. The photograph is simulated with a
known PSF.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_design.cli.app import main
from litho_design.images.measurements import MeasuredSource, PhotoSource
from litho_design.images.similarity import matched_scale, similarity
from litho_design.images.targets import TargetRecord
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.photographs import score_lens_photo
from litho_design.judging.score import ScoreResult
from litho_design.lenses.bench import sensor_psf
from litho_design.lenses.objects import object_stack, read_object
from litho_design.lenses.settings import lens_settings
from litho_design.optics import Optics
from litho_design.optics.imaging import Blur, richardson_lucy
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.workflows.design import design_lens
from litho_design.workflows.score import score as score_design
from tests.litho_design.conftest import unreported

SENSOR_UM, CAMERA_UM, DARK, WHITE, NOISE = 0.2, 0.15, 300.0, 30000.0, 100.0
OBJECT_PX, PHOTO_PX = 96, 160
# Dead camera pixels, given by the window pixels (x, y) on the L that they see, and hot pixels (y, x).
DEAD, HOT = ((23, 40), (23, 60), (40, 73)), ((10, 12), (80, 140), (61, 90))


@pytest.fixture(scope="module")
def lens(tmp_path_factory):
    """Design a lens of 20 µm with f = 40 µm. Its spot is 1.4 µm wide, or seven sensor pixels."""
    layout = LayoutSettings(size_px=200, cell_um=0.1, symmetry="radial")
    default = lens_settings("direct")
    settings = default.model_copy(
        update={
            "layout": layout,
            "optics": Optics(distance_um=40.0),
            "search": default.search.model_copy(update={"iterations": 3, "polish_rounds": 0}),
            "view": default.view.model_copy(update={"window_px": 128}),
            "imaging": default.imaging.model_copy(update={"object_px": OBJECT_PX}),
            "window": default.window.model_copy(update={"yield_draws": 2}),
        }
    )
    folder = tmp_path_factory.mktemp("lens") / "design"
    with unreported():
        design_lens(Printer(None, layout, source="none"), folder, settings=settings, announce=False)
    return folder


@pytest.fixture
def picture(tmp_path):
    """Draw an object without symmetry: an L, a grey bar and a bright dot."""
    drawn = np.zeros((72, 72), np.uint8)
    drawn[6:66, 6:16] = drawn[56:66, 16:50] = 220
    drawn[10:20, 40:60] = 120
    drawn[30:40, 30:40] = 255
    cv2.imwrite(str(tmp_path / "object.png"), drawn)
    return tmp_path / "object.png"


def photographed(path, loaded, height_um, wanted, *, turn_degrees=2.0, scale=1.03, shift_um=(1.1, -0.7)):
    """Write a photograph of an object ``wanted`` (n, n), taken through a printed lens.

    Return the PSF and the matrix from photograph to window.
    """
    psf = sensor_psf(loaded.bench(height_um), 2)
    seen = Blur(psf, (OBJECT_PX, OBJECT_PX)).forward(wanted).double().numpy()
    turn = np.deg2rad(turn_degrees)
    linear = scale * CAMERA_UM / SENSOR_UM * np.array(
        [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    )  # fmt: skip
    middle = np.full(2, (OBJECT_PX - 1) / 2) + np.array(shift_um) / SENSOR_UM
    offset = middle - linear @ np.full(2, (PHOTO_PX - 1) / 2)
    y, x = np.mgrid[0:PHOTO_PX, 0:PHOTO_PX]
    window_x, window_y = np.einsum("ij,jyx->iyx", linear, np.stack([x, y])) + offset[:, None, None]
    image = map_coordinates(seen, [window_y, window_x], order=5, mode="constant")
    noise = np.random.default_rng(0).normal(0, NOISE, image.shape)
    counts = WHITE * image / image.max() + DARK + noise
    dead_x, dead_y = np.linalg.solve(linear, np.transpose(DEAD) - offset[:, None]).round().astype(int)
    counts[dead_y, dead_x] = 0
    counts[tuple(np.transpose(HOT))] = 65535
    cv2.imwrite(str(path), counts.clip(0, 65535).round().astype(np.uint16))
    return psf, np.hstack([linear, offset[:, None]])


def estimate(loaded, recorded, psf, wanted):
    """Deconvolve a recorded image without registration. Return the result at the scale that minimises its
    error.
    """
    found = richardson_lucy(recorded, psf, loaded.task.settings.imaging.iterations)
    return found * matched_scale(found, wanted)


@torch.no_grad()
def test_a_photograph_is_deconvolved_with_the_designed_and_the_measured_psf(tmp_path, lens, picture):
    loaded = LoadedDesign(lens)
    wanted = torch.from_numpy(read_object(picture, OBJECT_PX)[0])
    # The print is too low near its rim, so its PSF is wider and lower than the designed one.
    radius = torch.from_numpy(np.hypot(*np.mgrid[-99.5:100, -99.5:100]) / 100).float()
    printed = loaded.expected_um * (1 - 0.5 * radius.square())
    np.savetxt(tmp_path / "scan.txt", (printed.double().numpy() + 0.2) * 1e-6)
    psf, to_window = photographed(tmp_path / "photo.png", loaded, printed, wanted)
    photo = PhotoSource(tmp_path / "photo.png", 1.03 * CAMERA_UM, DARK, str(picture))
    scan = MeasuredSource(tmp_path / "scan.txt", "m", (20.0, 20.0))
    measured, score = score_design(lens, tmp_path / "score", judges=[], scan=scan, camera=photo).scores
    assert (measured.kind, score.kind) == ("scan", "camera")
    assert ScoreResult.read(tmp_path / "score").scores[1] == score
    assert score.judge.imaged.sha256 == file_sha256(picture)
    # Dead pixels on the L differ most from their neighbours. Hot pixels differ everywhere.
    assert score.judge.replaced_pixels >= len(DEAD) + len(HOT)
    assert score.judge.dark_level == DARK
    assert score.judge.saturated_share == pytest.approx(len(HOT) / PHOTO_PX**2)

    # To check the registration, map corners of the lit part of the photograph to the window.
    # Registration compares images after a blur of 2 px. A quarter of a pixel is 0.05 µm, a 28th of the width
    # of the PSF.
    displaced_px = 0.25
    corners = np.array([[32, 128, 32, 128], [32, 32, 128, 128], [1, 1, 1, 1]])
    found = np.array(score.judge.photo_to_window) @ corners
    assert np.hypot(*(found[:2] / found[2] - to_window @ corners)).max() < displaced_px

    # A displacement d changes an image by at most d times its gradient. By the triangle inequality, the mean
    # absolute error and the rms error change by no more than that. The noise, 0.3 % of white, is added as it
    # is, because deconvolution amplifies it while averaging over camera pixels reduces it.
    seen = Blur(psf, (OBJECT_PX, OBJECT_PX)).forward(wanted)
    design_psf = sensor_psf(loaded.bench(loaded.expected_um), 2)
    for name, image in {
        "direct": seen * matched_scale(seen, wanted),
        "design": estimate(loaded, seen, design_psf, wanted),
        "calibrated": estimate(loaded, seen, psf, wanted),
    }.items():
        gradient = np.hypot(*np.gradient(image.numpy()))
        ideal = similarity(image, wanted, name)
        change = float(displaced_px * gradient.mean() + NOISE / WHITE)
        assert score.figures[f"mae_{name}"] == pytest.approx(ideal[f"mae_{name}"], abs=change)
        rms, rms_ideal = (10 ** (-one[f"psnr_{name}_db"] / 20) for one in (score.figures, ideal))
        change = float(displaced_px * np.sqrt(np.square(gradient).mean()) + NOISE / WHITE)
        assert rms == pytest.approx(rms_ideal, abs=change)
    # Only calibration gives the PSF of this photograph.
    assert score.figures["mae_calibrated"] < score.figures["mae_design"] < score.figures["mae_direct"]
    assert score.figures["ssim_calibrated"] > score.figures["ssim_design"] > score.figures["ssim_direct"]


@torch.no_grad()
def test_an_object_of_the_design_is_known_by_name(tmp_path, lens):
    loaded = LoadedDesign(lens)
    wanted = object_stack(["text"], OBJECT_PX)[0]
    photographed(tmp_path / "photo.png", loaded, loaded.expected_um, wanted)
    photo = PhotoSource(tmp_path / "photo.png", 1.03 * CAMERA_UM, imaged="text")
    verdict = score_lens_photo(loaded, photo)
    score, record = verdict.figures, verdict.record
    assert record.imaged == "text"
    # In noisy dark surroundings, the percentile is two or three standard deviations below the dark level.
    assert DARK - 3 * NOISE < record.dark_level < DARK + NOISE
    assert score.mae_calibrated is None
    assert list(verdict.pictures) == ["object text", "photograph", "deconvolved, design PSF"]
    assert score.mae_design < score.mae_direct
    # Another object than the photographed one does not match, or has a larger error.
    with pytest.raises(InputError, match=r"correlation|proportional to the light"):
        score_lens_photo(loaded, replace(photo, imaged="spots"))


def test_a_name_that_two_objects_have_is_refused(lens):
    loaded = LoadedDesign(lens)
    one, other = (TargetRecord(name="a.png", sha256=sha256, adaptation="") for sha256 in ("1" * 64, "2" * 64))
    settings = loaded.task.settings
    imaging = settings.imaging.model_copy(update={"objects": (one,), "test_objects": (other, "ring")})
    loaded.task.settings = settings.model_copy(update={"imaging": imaging})
    with pytest.raises(InputError, match="two objects"):
        score_lens_photo(loaded, PhotoSource("photo.png", 1.03 * CAMERA_UM, imaged="a.png"))


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--camera", "flat.png", "--camera-pitch-um", "0.15"), "no --camera-object"),
        (("--camera", "flat.png", "--camera-pitch-um", "0.15", "--camera-object", "face"), "'face'"),
        (("--camera", "flat.png", "--camera-pitch-um", "0.15", "--camera-object", "text"), "correlation"),
        (("--camera", "none.png", "--camera-pitch-um", "0.15", "--camera-object", "text"), "does not exist"),
        (("--camera", "flat.png", "--camera-object", "text"), "--camera-pitch-um"),
        (("--judge", "none", "--camera-object", "text"), "no --camera"),
    ],
)
def test_bad_photographs_are_one_line_and_exit_code_2(tmp_path, lens, monkeypatch, refused, words, complaint):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("flat.png", np.random.default_rng(0).integers(0, 255, (160, 160)).astype(np.uint8))
    assert complaint in refused("score", lens, *words, "--out", "out")
    assert not (tmp_path / "out").exists()


def test_the_command_tells_the_errors(tmp_path, lens, picture, monkeypatch, capsys):
    loaded = LoadedDesign(lens)
    wanted = torch.from_numpy(read_object(picture, OBJECT_PX)[0])
    with torch.no_grad():
        photographed(tmp_path / "photo.png", loaded, loaded.expected_um, wanted)
    words = ("--camera", tmp_path / "photo.png", "--camera-pitch-um", CAMERA_UM, "--camera-object", picture)
    arguments = map(str, ("score", lens, *words, "--out", tmp_path / "score"))
    monkeypatch.setattr(sys, "argv", ["litho-design", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    score = ScoreResult.read(tmp_path / "score").scores[0]
    told = ", ".join(
        f"MAE {score.figures[f'mae_{name}']:.4f} ± {score.uncertainty[f'mae_{name}']:.4f} {where}"
        for name, where in (("direct", "on the sensor"), ("design", "with the designed PSF"))
    )
    assert f"camera photo.png: {told}" in capsys.readouterr().out
    table = (tmp_path / "score" / "scores.csv").read_text()
    assert "psnr_direct_db" in table
