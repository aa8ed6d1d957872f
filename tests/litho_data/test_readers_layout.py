"""Read layouts that are stored as levels or as greyscale images, or exported by the design package."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.readers import read_layout

LEVEL = (np.arange(60).reshape(6, 10) * 7 % 13).astype(np.uint8)


def with_sidecar(path: Path, **says: object) -> Path:
    content = {"schema": "litho-design/export/2", "file_sha256": file_sha256(path), "format": "png16"}
    content |= {"shape_px": LEVEL.shape, "pitch_um": 0.1, "level_height_um": 0.1, **says}
    path.with_name(f"{path.name}.json").write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(("white", "dtype"), [(255, np.uint8), (65535, np.uint16)])
@pytest.mark.parametrize("whole", [True, False])
def test_a_picture_whose_white_is_the_highest_level(
    tmp_path: Path, white: int, dtype: type, whole: bool
) -> None:
    path = tmp_path / "layout.png"
    step = white // 12 if whole else white / 12
    cv2.imwrite(str(path), np.rint(LEVEL.astype(float) * step).astype(dtype))
    np.testing.assert_array_equal(read_layout(path, levels=13), LEVEL)
    np.testing.assert_array_equal(read_layout(path, grey_per_level=step), LEVEL)


def test_levels_beyond_a_byte_need_a_number_of_levels(tmp_path: Path) -> None:
    path = tmp_path / "layout.tif"
    tifffile.imwrite(path, LEVEL.astype(np.uint16) * 5000)
    np.testing.assert_array_equal(read_layout(path, levels=65536), LEVEL.astype(int) * 5000)
    with pytest.raises(InputError, match="integer levels from 0 to 255"):
        read_layout(path)


def test_grey_values_that_are_no_steps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "layout.png"
    cv2.imwrite(str(path), np.full((4, 4), 30, np.uint8))
    with pytest.raises(InputError, match=r"steps of 21\.25 per level"):
        read_layout(path, grey_per_level=21.25)
    # Without a step, the values are kept as read, and the build compares them with the number of levels.
    assert read_layout(path, levels=13).max() == 30


def test_exported_files_are_read_by_their_sidecar(tmp_path: Path) -> None:
    picture = tmp_path / "layout.png"
    cv2.imwrite(str(picture), LEVEL.astype(np.uint16) * 5461)
    # The second version of the sidecar lists greys, as of a measured curve. The first states a constant step.
    greys = [5461 * level for level in range(13)]
    for says in ({"greys": greys}, {"levels": 13, "grey_per_level": 5461}):
        np.testing.assert_array_equal(read_layout(with_sidecar(picture, **says)), LEVEL)
    marks = {"element_px": [1, 5, 2, 9]}
    cropped = read_layout(with_sidecar(picture, greys=greys, marks=marks))
    np.testing.assert_array_equal(cropped, LEVEL[1:5, 2:9])
    pages = tmp_path / "layout.tif"
    with tifffile.TiffWriter(pages) as file:
        file.write(LEVEL.astype(np.uint16))
        file.write(LEVEL * np.float32(0.1))
    with pytest.raises(InputError, match="pages, got 2"):
        read_layout(pages)
    np.testing.assert_array_equal(read_layout(with_sidecar(pages, format="tiff")), LEVEL)
    with pytest.raises(InputError, match="greys"):
        read_layout(with_sidecar(picture, format="dxf"))
    cv2.imwrite(str(picture), LEVEL.astype(np.uint16) * 5000)
    with pytest.raises(InputError, match="a file that its sidecar does not describe"):
        read_layout(picture)


def test_transparent_pixels_have_no_level(tmp_path: Path) -> None:
    pixels = np.repeat(LEVEL[..., None], 4, axis=2)
    pixels[..., 3] = 255
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    np.testing.assert_array_equal(read_layout(tmp_path / "a.png"), LEVEL)
    pixels[0, 0, 3] = 0
    cv2.imwrite(str(tmp_path / "b.png"), pixels)
    with pytest.raises(InputError, match="transparent"):
        read_layout(tmp_path / "b.png")
