"""Compare levelling with results of Gwyddion 2.62, from which a few methods deviate on purpose."""

from __future__ import annotations

import json
import os
import re
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
from litho_data.readers import read_scan
from litho_data.scan import Scan

pytestmark = [pytest.mark.oracle, pytest.mark.filterwarnings("ignore::litho_data.level.LevellingWarning")]

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
    "facettilt": "facet-tilt",
}
# The methods and parameters of further results of Gwyddion 2.62, with every 27th pixel along both axes.
SAMPLED = {
    **{name: {} for name in ("facettilt", "modus", "match")},
    "tmean20": {"trim": 0.2},
    "tmeandiff20": {"trim": 0.2},
    "poly1_vert": {"degree": 1, "direction": "vertical"},
    "median_vert": {"direction": "vertical"},
}


def _vectors() -> list[dict[str, Any]]:
    """Return all entries of the index of reference fields, or none if these fields are not installed."""
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
    result_um = np.load(oracles / "gwyddion" / entry["file"])["result"] * 1e6
    return *_field(oracles, entry["input"]), result_um


def _field(oracles: Path, name: str) -> tuple[np.ndarray, np.ndarray, tuple]:
    """Return the heights in µm, the mask and the pitch (y, x) in µm of a reference field."""
    field = np.load(oracles / "gwyddion" / name)
    ny, nx = field["z"].shape
    pitch_um = (float(field["yreal"]) * 1e6 / ny, float(field["xreal"]) * 1e6 / nx)
    return field["z"] * 1e6, field["mask"] > 0, pitch_um


@pytest.mark.parametrize("entry", _vectors(), ids=lambda entry: Path(entry["file"]).stem)
def test_vector(oracles: Path, entry: dict[str, Any]) -> None:
    height_um, mask, pitch_um, expected_um = _inputs(oracles, entry)
    levelled = _level(entry, height_um, mask, pitch_um)
    # Sums in another order round differently. The normal equations of polynomials lose two more digits.
    polynomial = entry["method"].startswith(("polylevel", "rows_poly"))
    tolerance = (1e-10 if polynomial else 1e-12) * np.ptp(height_um)
    np.testing.assert_allclose(levelled.height + levelled.removed, height_um, rtol=0, atol=1e-15)
    if "note" not in entry:
        np.testing.assert_allclose(levelled.height, expected_um, rtol=0, atol=tolerance)
        return
    # Here Gwyddion's test of the mask selects no pixel, so Gwyddion returns its input. Our code uses the
    # pixels of the mask, so it moves rows, and excluding the inverted mask gives the same result.
    np.testing.assert_allclose(expected_um, height_um, rtol=0, atol=tolerance)
    mirrored = _level(entry | {"masking": "exclude"}, height_um, ~mask, pitch_um)
    np.testing.assert_array_equal(levelled.height, mirrored.height)
    assert np.abs(levelled.removed).max() > 0.01 * np.ptp(height_um)


@pytest.mark.parametrize("masking", ["ignore", "exclude", "include"])
@pytest.mark.parametrize("name", SAMPLED)
def test_sampled_rows_of_a_phantom(oracles: Path, name: str, masking: str) -> None:
    height_um, mask, pitch_um = _field(oracles, "synA__input.npz")
    if (name, masking) == ("tmeandiff20", "include"):
        pytest.skip("Gwyddion's difference methods use no pixel of an inclusion mask; see test_vector")
    _compare_samples(oracles, f"synA__rows_{name}_{masking}", name, height_um, pitch_um, mask, masking)


@pytest.fixture(scope="module", params=["e6", "e0"])
def scan(measured_prints: Path, tmp_path_factory: pytest.TempPathFactory, request: Any) -> Scan:
    """Return a measured scan read in metres, and the same digits read in micrometres."""
    path = measured_prints / "afm_ug" / "FOV11.txt"
    if request.param == "e6":
        return read_scan(path, unit="m", size_um=(54, 54))
    text = re.sub(r"e([-+]\d+)", lambda found: f"e{int(found[1]) + 6:+d}", path.read_text())
    changed = tmp_path_factory.mktemp("digits") / "scan.txt"
    changed.write_text(text)
    return read_scan(changed, unit="um", size_um=(54, 54))


@pytest.mark.measured
@pytest.mark.parametrize("name", SAMPLED)
def test_sampled_rows_of_a_measured_scan(oracles: Path, scan: Scan, name: str) -> None:
    key = f"FOV11__rows_{name}_ignore"
    _compare_samples(oracles, key, name, scan.height_um, scan.require_pitch(), None, "exclude")


def _compare_samples(
    oracles: Path, key: str, name: str, height_um: np.ndarray, pitch_um: tuple, mask: Any, masking: Any
) -> None:
    expected_um = np.load(oracles / "gwyddion" / "rows_samples.npz")[key] * 1e6
    method, params = ROW_METHODS[name.split("_")[0].replace("20", "05")], SAMPLED[name]
    got = align_rows(height_um, method=method, pitch_um=pitch_um, mask=mask, masking=masking, **params).height
    tolerance = (1e-10 if method == "polynomial" else 1e-12) * np.ptp(height_um)
    np.testing.assert_allclose(got[::27, ::27], expected_um, rtol=0, atol=tolerance)


def test_all_reference_fields_are_present(oracles: Path) -> None:
    entries = _vectors()
    assert len(entries) == 55
    assert sum("note" in entry for entry in entries) == 2
