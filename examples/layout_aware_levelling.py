"""Measure how much of the print's own slope and bow is removed from each scan by levelling that ignores the
layout.

    python examples/layout_aware_levelling.py STORE.zarr

The script fits two backgrounds to the raw heights of each scan in a store. One is fitted together with the
layout (layout-aware), the other is a plain polynomial. It prints a table that compares them, in nm.
"""

from __future__ import annotations

import argparse

import numpy as np
import pandas as pd

from litho_data.commands.progress import progress
from litho_data.level import layout_in_scan_frame, level_layout_aware, level_polynomial
from litho_data.store import Store, open_store


def main() -> None:
    """Compare the two backgrounds of every scan of the store, and print the table."""
    parser = argparse.ArgumentParser(
        description="Compare a layout-aware and a plain background of every scan of a store."
    )
    parser.add_argument("store", help="dataset store built from raw scans")
    store = open_store(parser.parse_args().store)
    rows = [compare(store, scan_id) for scan_id in progress(store.ids, "levelling")]
    table = pd.DataFrame(rows, index=list(store.ids))
    table.loc["median"] = table.median()
    table.loc["largest"] = table.iloc[:-1].max()
    print(table.to_string(float_format=lambda value: f"{value:.1f}"))


def compare(store: Store, scan_id: str) -> dict[str, float]:
    """Compare the two backgrounds of one scan. Return the range of both planes over the field, and the rms
    difference of both polynomials of degree 2, in nm.
    """
    print_ = store.scan(scan_id)
    height_um = store.scan_frame(scan_id, "raw_height_um").astype(np.float64)
    own = store.quality["scan"] == scan_id
    pitch_y_um, pitch_x_um = store.quality.loc[own, ["scan_pitch_y_um", "scan_pitch_x_um"]].to_numpy()[0]
    layout = layout_in_scan_frame(
        print_.mask_level, print_.scan_to_layout, height_um.shape, (pitch_y_um, pitch_x_um), print_.pitch_um
    )
    plane_aware = level_layout_aware(height_um, layout_level=layout)
    plane_plain = level_polynomial(height_um, total_degree=1)
    bow_aware = level_layout_aware(height_um, layout_level=layout, total_degree=2)
    bow_plain = level_polynomial(height_um, total_degree=2)
    return {
        "plane, plain": np.ptp(plane_plain.removed) * 1e3,
        "plane, layout-aware": np.ptp(plane_aware.removed) * 1e3,
        "difference of second degree, rms": np.std(bow_aware.removed - bow_plain.removed) * 1e3,
    }


if __name__ == "__main__":
    main()
