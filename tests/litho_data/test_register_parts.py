"""Parts of the registration that are fast ways to something with a plain definition."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from litho_data.register.features import match_bits
from litho_data.register.geometry import ORIENTATIONS, orient
from litho_data.register.orientation import masked_correlations
from litho_data.register.resample import Resampler, resample_to_layout


@pytest.mark.parametrize(("count", "other_count", "values"), [(300, 250, 256), (70, 90, 2), (1, 40, 256)])
def test_matched_bits_are_those_of_opencv_ties_included(count, other_count, values):
    rng = np.random.default_rng(count)
    # Bytes of 0 and 1 only leave 32 bits that differ, so that many distances are equal.
    first, second = (rng.integers(0, values, (n, 32), dtype=np.uint8) for n in (count, other_count))
    second[: min(count, other_count) // 2] = first[: min(count, other_count) // 2]
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
    expected = [(match.queryIdx, match.trainIdx) for match in matches]
    assert np.transpose(match_bits(first, second)).tolist() == [list(pair) for pair in expected]


@pytest.mark.parametrize("gaps", [False, True])
def test_masked_correlation_is_pearson_over_the_overlap(gaps):
    rng = np.random.default_rng(3)
    fixed, moving = rng.random((14, 18)), rng.random((16, 15))
    if gaps:
        fixed[3:5, 2:9], moving[:4, :4] = np.nan, np.nan
    turned = [orient(moving, orientation) for orientation in ORIENTATIONS]
    for image, (correlation, overlap) in zip(turned, masked_correlations(fixed, turned), strict=True):
        for shift_y, shift_x in ((0, 0), (2, -3), (-1, 4)):
            y, x = np.indices(fixed.shape)
            rows, columns = y + shift_y, x + shift_x
            inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
            pairs = np.stack([fixed[inside], image[rows[inside], columns[inside]]])
            pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
            assert overlap[shift_y, shift_x] == pairs.shape[1]
            # Transforms of a thousand numbers of order one lose three digits of double precision.
            assert correlation[shift_y, shift_x] == pytest.approx(np.corrcoef(pairs)[0, 1], abs=1e-12)


def test_one_spline_serves_several_places():
    height = np.random.default_rng(5).random((40, 50))
    height[10:12, 20:23] = np.nan
    pitches = {"scan_pitch_um": (0.05, 0.1), "layout_pitch_um": 0.1}
    resampler = Resampler(height, **pitches)
    for shift_um in (0.0, 0.33):
        matrix = np.eye(3)
        matrix[0, 2] = shift_um
        for found, expected in zip(
            resampler.at(matrix, (20, 50)),
            resample_to_layout(height, matrix, (20, 50), **pitches),
            strict=True,
        ):
            np.testing.assert_array_equal(found, expected)
