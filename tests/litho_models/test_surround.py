"""Check that an isolated field has no ring of errors if it has a rim of level 0, or if its border is left
out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, gaussian_filter

from litho_data.register.refine import BORDER_PX, interior_of
from litho_data.store import PrintedScan
from litho_models.fitting import TrainingConfig
from litho_models.fitting.fit import fit
from litho_models.loop.prepared import prepare_scans
from litho_models.prediction.tiles import predict_scan
from litho_models.scan_terms import POLICIES, cross_fit
from tests.litho_models.prints import BLUR_UM, PITCH_UM, make_scan

NOISE_UM, RIM_PX, AROUND_PX = 0.004, 2, 30


def alone(number: int, surround: str) -> PrintedScan:
    """Return a stored scan of an isolated field, whose blur extends onto the bare substrate."""
    scan = make_scan(number)
    rim = RIM_PX if surround == "substrate" else 0
    dose = gaussian_filter(np.pad(scan.layout_um.astype(float), AROUND_PX), BLUR_UM / PITCH_UM, truncate=6)
    height_um = 0.9 * dose - 0.25 * dose**2
    height_um += np.random.default_rng(number).normal(0, NOISE_UM, height_um.shape)
    field = (slice(AROUND_PX - rim, rim - AROUND_PX),) * 2
    shape = height_um[field].shape
    return replace(
        scan,
        mask_level=np.pad(scan.mask_level, rim),
        height_um=height_um[field].astype(np.float32),
        valid=interior_of(shape, BORDER_PX if surround == "unknown" else 0),
    )


@pytest.mark.parametrize("surround", ["substrate", "unknown"])
def test_a_lone_field_has_no_ring_of_errors(surround: str) -> None:
    scans = [alone(number, surround) for number in range(4)]
    model = fit("features", scans[1:], TrainingConfig()).model
    off = predict_scan(model, scans[0]) - scans[0].height_um
    valid = scans[0].valid
    ring = valid & ~binary_erosion(valid, iterations=RIM_PX)
    # The features contain the truth, so the residual is noise. From 700 pixels, its sd is known to 3 %.
    for part in (ring, valid & ~ring):
        assert np.std(off[part]) == pytest.approx(NOISE_UM, rel=0.12)


def test_heights_of_invalid_pixels_change_nothing() -> None:
    scan = alone(0, "unknown")
    other = replace(scan, height_um=np.where(scan.valid, scan.height_um, 1.0).astype(np.float32))
    expected = scan.layout_um
    freed = [cross_fit(one.height_um, expected, one.valid, POLICIES["offset"]) for one in (scan, other)]
    np.testing.assert_array_equal(*(one.residual_um for one in freed))
    fitted = [fit("features", [one], TrainingConfig()).model for one in (scan, other)]
    np.testing.assert_array_equal(*(predict_scan(model, scan) for model in fitted))
    for one in prepare_scans([scan, other]):
        np.testing.assert_array_equal(one.usable, scan.valid)
        assert scan.valid.flat[one.sample].all()
