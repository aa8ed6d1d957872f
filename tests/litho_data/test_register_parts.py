"""Compare the fast masked correlation of the registration with a computation by its definition."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data.register.geometry import ORIENTATIONS, orient
from litho_data.register.orientation import masked_correlation


@pytest.mark.parametrize("gaps", [False, True])
def test_masked_correlation_is_pearson_over_the_overlap(gaps):
    rng = np.random.default_rng(3)
    fixed, moving = rng.random((14, 18)), rng.random((16, 15))
    if gaps:
        fixed[3:5, 2:9], moving[:4, :4] = np.nan, np.nan
    for image in (orient(moving, orientation) for orientation in ORIENTATIONS):
        correlation, overlap = masked_correlation(fixed, image)
        for shift_y, shift_x in ((0, 0), (2, -3), (-1, 4)):
            y, x = np.indices(fixed.shape)
            rows, columns = y + shift_y, x + shift_x
            inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
            pairs = np.stack([fixed[inside], image[rows[inside], columns[inside]]])
            pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
            assert overlap[shift_y, shift_x] == pairs.shape[1]
            # Transforms of a thousand numbers of order one lose three digits of double precision.
            assert correlation[shift_y, shift_x] == pytest.approx(np.corrcoef(pairs)[0, 1], abs=1e-12)
