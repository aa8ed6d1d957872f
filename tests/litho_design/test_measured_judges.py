"""A printed part and a photographed image as judges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.images.targets import load_target
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.score import MeasuredSource, PhotoSource
from litho_design.workflows.design import design_hologram
from litho_design.workflows.score import score as score_design


@pytest.fixture
def printed_design(tmp_path, small_settings, make_printer):
    folder = tmp_path / "design"
    design_hologram(
        load_target("ring", 128),
        make_printer(small_settings.layout),
        folder,
        settings=small_settings,
        announce=False,
    )
    return folder


def test_a_measured_print_scores_like_the_print_it_is(tmp_path, printed_design):
    loaded = LoadedDesign(printed_design)
    height = loaded.expected_um.numpy().astype(np.float64)
    noise = np.random.default_rng(0).normal(0, 0.002, height.shape)
    # The AFM's zero is arbitrary: an offset must not matter.
    np.savetxt(tmp_path / "scan.txt", (height + noise + 0.3) * 1e-6)
    source = MeasuredSource(tmp_path / "scan.txt", unit="m", size_um=(12.8, 12.8))
    score = score_design(printed_design, tmp_path / "score", judges=[], scan=source).scores[0]
    assert score.kind == "scan"
    assert score.judge.coverage > 0.9
    assert score.judge.height_offset_um == pytest.approx(0.3, abs=2e-3)
    # 2 nm of noise is 0.002 wave: nothing but the registration's own error may show.
    assert score.figures["si_psnr_db"] == pytest.approx(loaded.record.predicted["si_psnr_db"], abs=0.5)


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


def test_a_photograph_is_cleaned_registered_and_scored(tmp_path, printed_design):
    loaded = LoadedDesign(printed_design)
    image = loaded.image(loaded.expected_um)
    # Camera of 0.2 µm pixels, turned by 2 degrees, moved by (1.3, -0.8) µm, dark level 300, two hot pixels
    # and a dead one in the light.
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
    assert score.judge.dark_level == pytest.approx(300, abs=30)
    assert score.judge.replaced_pixels == 3
    assert score.judge.correlation > 0.97
    # photograph = matrix^-1 window / 2: the linear part found must undo what was done.
    found = np.array(score.judge.photo_to_window)[:, :2]
    assert found == pytest.approx(np.linalg.inv(2 * matrix), abs=0.01)
    blurred = torch.from_numpy(cv2.GaussianBlur(image, (0, 0), 1.4)).double()
    from litho_design.images.similarity import si_psnr_db

    wanted = si_psnr_db(blurred, loaded.target.double())
    assert score.figures["si_psnr_db"] == pytest.approx(wanted, abs=1.0)


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
    with pytest.raises(InputError, match="pitch"):
        score_design(
            printed_design, tmp_path / "s", judges=[], camera=PhotoSource(tmp_path / "flat.png", 0.0)
        )
