"""Test when a registration passes, and how wide a blur can be matched."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from litho_data.register.pyramid import BLURS_PX, match_blur
from litho_data.register.quality import judge

GOOD = {
    **{"ecc": 0.95, "second_orientation": 0.3, "layout_repeats": 0.2, "second_alignment": 0.3},
    **{
        "singular_min": 1.0,
        "singular_max": 1.0,
        "overlap": 1.0,
        "defect_share": 0.0,
        "tre_median_px": 0.3,
        "corner_sd_px": 0.2,
    },
    **{"dihedral": "identity", "polarity": 1, "method": "orb", "converged": True},
}


def test_a_good_fit_passes_without_a_warning():
    assert judge(GOOD, 2.0) == (True, "", "")


@pytest.mark.parametrize(
    ("figures", "blur_px", "passed", "warned"),
    [
        ({"tre_median_px": 1.0}, 2.0, True, False),
        ({"tre_median_px": 1.4}, 2.0, True, True),
        ({"tre_median_px": 1.6}, 2.0, False, True),
        # A blur of up to 8 px does not change the limits; a blur of 16 px doubles both.
        ({"tre_median_px": 1.6}, 8.0, False, True),
        ({"tre_median_px": 2.9}, 16.0, True, True),
        ({"tre_median_px": 3.1}, 16.0, False, True),
        ({"corner_sd_px": 1.6}, 8.0, False, False),
        ({"corner_sd_px": 2.9}, 16.0, True, False),
        ({"corner_sd_px": 3.1}, 16.0, False, False),
        ({"corner_sd_px": float("nan")}, 16.0, False, False),
        # A fit with a low correlation fails, however wide the blur.
        ({"ecc": 0.6}, 16.0, False, False),
    ],
)
def test_limits_warn_before_they_fail_and_grow_with_the_blur(figures, blur_px, passed, warned):
    found, reason, warning = judge(GOOD | figures, blur_px)
    assert found is passed
    assert bool(reason) is not passed
    assert ("target registration error" in warning) is warned


@pytest.mark.parametrize("blur_px", BLURS_PX[4:])
def test_the_blur_of_a_print_is_matched_however_wide(blur_px):
    level = np.random.default_rng(0).integers(0, 13, (12, 12)).repeat(16, 0).repeat(16, 1)
    blurred = gaussian_filter(level.astype(float), blur_px, mode="nearest")
    assert match_blur(blurred, level, np.eye(3)) == blur_px
