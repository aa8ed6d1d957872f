"""Agreement with fields that Gwyddion 2.62 levelled; deviations that we make on purpose are pinned too."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from litho_data.level import (
    Levelled,
    align_rows,
    fix_zero,
    level_facet,
    level_plane,
    level_polynomial,
    zero_max,
    zero_mean,
)

pytestmark = pytest.mark.oracle

ROW_METHODS = {
    "median": "median",
    "mediandiff": "median-of-differences",
    "tmean05": "trimmed-mean",
    "tmeandiff05": "trimmed-mean-of-differences",
    "poly0": "polynomial",
    "poly1": "polynomial",
    "poly2": "polynomial",
    "match": "matching",
    "modus": "modus",
}


def _vectors() -> list[dict[str, Any]]:
    """All entries of the index; none where the reference fields are absent."""
    index = Path(os.environ.get("LITHO_ORACLE_DIR", "")) / "gwyddion" / "index.json"
    return json.loads(index.read_text()) if index.is_file() else []


def _level(entry: dict[str, Any], height_um: np.ndarray, mask: np.ndarray, pitch_um: tuple) -> Levelled:
    method, params = entry["method"], entry["params"]
    common: dict[str, Any] = {"mask": mask, "masking": entry["masking"]}
    if method == "level":
        return level_plane(height_um, **common)
    if method == "facet_level":
        return level_facet(height_um, pitch_um=pitch_um, **common)
    if method.startswith("polylevel") and params["kind"] == "total":
        return level_polynomial(height_um, total_degree=params["max_degree"], **common)
    if method.startswith("polylevel"):
        degrees = {"x_degree": params["col_degree"], "y_degree": params["row_degree"]}
        return level_polynomial(height_um, **degrees, **common)
    if method.startswith("rows_"):
        return align_rows(height_um, method=ROW_METHODS[method.split("_")[1]], **params, **common)
    zeros = {"fix_zero": fix_zero, "zero_mean": zero_mean, "zero_max": zero_max}
    return zeros[method](height_um, **common)


def _inputs(oracles: Path, entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, tuple, np.ndarray]:
    field = np.load(oracles / "gwyddion" / entry["input"])
    ny, nx = field["z"].shape
    pitch_um = (float(field["yreal"]) * 1e6 / ny, float(field["xreal"]) * 1e6 / nx)
    result_um = np.load(oracles / "gwyddion" / entry["file"])["result"] * 1e6
    return field["z"] * 1e6, field["mask"] > 0, pitch_um, result_um


@pytest.mark.parametrize("entry", _vectors(), ids=lambda entry: Path(entry["file"]).stem)
def test_vector(oracles: Path, entry: dict[str, Any]) -> None:
    height_um, mask, pitch_um, expected_um = _inputs(oracles, entry)
    levelled = _level(entry, height_um, mask, pitch_um)
    # Rounding of another order of summation; normal equations of a polynomial lose two digits more.
    polynomial = entry["method"].startswith(("polylevel", "rows_poly"))
    tolerance = (1e-10 if polynomial else 1e-12) * np.ptp(height_um)
    np.testing.assert_allclose(levelled.height + levelled.removed, height_um, rtol=0, atol=1e-15)
    if "note" not in entry:
        np.testing.assert_allclose(levelled.height, expected_um, rtol=0, atol=tolerance)
        return
    # Gwyddion's mask test selects nothing here and it returns its input. Ours takes the mask at its
    # word, so the same mask inverted and excluded gives the same answer, and rows do move.
    np.testing.assert_allclose(expected_um, height_um, rtol=0, atol=tolerance)
    mirrored = _level(entry | {"masking": "exclude"}, height_um, ~mask, pitch_um)
    np.testing.assert_array_equal(levelled.height, mirrored.height)
    assert np.abs(levelled.removed).max() > 0.01 * np.ptp(height_um)


def test_all_vectors_are_there(oracles: Path) -> None:
    entries = _vectors()
    assert len(entries) == 55
    assert sum("note" in entry for entry in entries) == 2
