"""Check that calling the public functions one by one gives the result that ``build_dataset`` stores."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import litho_data


def test_public_functions_give_the_scan_of_the_dataset(campaign: Path) -> None:
    store = litho_data.open_store(campaign / "prints.zarr")
    stored = store.scan("P11")
    layout = litho_data.read_layout(campaign / "layouts" / "P11.tif")
    scan = litho_data.read_scan(campaign / "scans" / "P11.txt", unit="m", size_um=(12.8, 12.8))
    levelled, removed_um = litho_data.level_scan(scan, litho_data.Recipe())
    found = litho_data.register_scan(levelled, layout, layout_pitch_um=store.pitch_um)
    height_um, valid = litho_data.resample_to_layout(
        levelled.height_um,
        found.scan_to_layout,
        layout.shape,
        scan_pitch_um=levelled.require_pitch(),
        layout_pitch_um=store.pitch_um,
    )
    assert not removed_um.any()
    np.testing.assert_array_equal(valid, stored.valid)
    # The store keeps raw heights as float32, with rounding errors of 1e-7 µm.
    np.testing.assert_allclose(found.scan_to_layout, stored.scan_to_layout, atol=1e-4)
    np.testing.assert_allclose(height_um[valid], stored.height_um[valid], atol=1e-5)
