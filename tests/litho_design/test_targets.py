"""Test targets that are drawn by code or read from image files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.images.targets import draw_target, load_target, read_grey


@pytest.mark.parametrize("name", ["text", "ring", "chart", "spots"])
def test_drawings_look_the_same_at_every_size(name):
    fine, coarse = draw_target(name, 256), draw_target(name, 128)
    assert fine.min() >= 0
    assert fine.max() == 1
    assert 0.01 < fine.mean() < 0.3
    # Averaging 2 x 2 pixels must give the coarse drawing. Edges may differ by the oversampling of 4.
    assert np.abs(fine.reshape(128, 2, 128, 2).mean((1, 3)) - coarse).mean() < 0.02


def test_ring_area():
    # The ring covers pi (0.28^2 - 0.2^2) of the unit square. With 4-fold oversampling, this is exact to 1e-3.
    assert draw_target("ring", 256).mean() == pytest.approx(np.pi * (0.28**2 - 0.2**2), abs=1e-3)


def test_another_size_and_shape_are_adapted_and_reported(tmp_path):
    picture = np.zeros((60, 100), np.uint8)
    picture[10:30, 20:60] = 200
    cv2.imwrite(str(tmp_path / "wide.png"), picture)
    target = load_target(str(tmp_path / "wide.png"), 200)
    image, record = target.pixels, target.record
    assert image.shape == (200, 200)
    assert "60 x 100" in record.adaptation
    assert "from 100 to 200" in record.adaptation
    # After 20 more rows on top and doubling, the block's centre is at (79.5, 79.5), not (19.5, 39.5).
    rows, columns = np.indices(image.shape)
    assert (image * rows).sum() / image.sum() == pytest.approx(79.5, abs=0.01)
    assert (image * columns).sum() / image.sum() == pytest.approx(79.5, abs=0.01)
    assert image.max() == 1


def test_an_array_is_fitted_like_the_picture_with_the_same_pixels(tmp_path):
    grey = np.random.default_rng(0).integers(0, 256, (30, 50)).astype(np.uint8)
    grey[0, 0] = 255
    for size_px, image in ((64, grey), (20, grey), (30, grey[:, :30])):
        cv2.imwrite(str(tmp_path / "picture.png"), image)
        picture = load_target(tmp_path / "picture.png", size_px)
        for array in (image / 255, torch.from_numpy(image / 255).requires_grad_(), (image / 255).tolist()):
            target = load_target(array, size_px)
            assert target.record.adaptation == picture.record.adaptation
            # A picture is divided by its brightest value after it is resampled.
            expected = picture.pixels * target.pixels.max()
            np.testing.assert_allclose(target.pixels, expected, rtol=0, atol=1e-6)
    for bad in (np.zeros((2, 3, 4)), np.zeros((0, 4)), torch.zeros(5), [["a"]], object()):
        with pytest.raises(InputError, match="target, got"):
            load_target(bad, 64)


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_a_colour_is_its_luma_and_what_is_transparent_is_black(tmp_path, depth):
    white = np.iinfo(depth).max
    colour = np.zeros((4, 2, 4), depth)
    colour[:, :, :3], colour[:2, :, 3], colour[2:, :, 3] = [white // 4, white // 2, white], white, white // 2
    # This is the luma by ITU-R BT.601 of blue, green and red.
    luma = 0.114 * 0.25 + 0.587 * 0.5 + 0.299
    for channels, shares in ((4, [1, 0.5]), (3, [1, 1])):
        cv2.imwrite(str(tmp_path / "colour.png"), colour[..., :channels])
        grey, notes = read_grey(tmp_path / "colour.png", "target")
        assert grey[[0, 3], 0] / white == pytest.approx(luma * np.array(shares), abs=2 / 255)
        assert ("alpha channel composed on black" in notes) is (channels == 4)


def test_a_file_without_an_image_or_without_light_is_refused(tmp_path):
    (tmp_path / "note.txt").write_text("not an image")
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((8, 8), np.uint8))
    for name, message in (("note.txt", "an image"), ("black.png", "bright pixels")):
        with pytest.raises(InputError, match=message):
            load_target(str(tmp_path / name), 64)
    with pytest.raises(InputError, match="text, ring, chart, spots"):
        load_target("no such thing", 64)
