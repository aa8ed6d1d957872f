"""Test the contract of `Scan` and the parser of units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import is_length, um_per
from litho_data.scan import Scan

HEIGHT_UM = np.arange(12.0).reshape(3, 4)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("m", 1e6),
        (" mm ", 1e3),
        ("µm", 1.0),
        ("μm", 1.0),
        ("um", 1.0),
        ("~m", 1.0),
        ("micron", 1.0),
        ("nm", 1e-3),
        ("Å", 1e-4),
        ("\u212b", 1e-4),
        ("pm", 1e-6),
    ],
)
def test_known_units(unit: str, factor: float) -> None:
    assert um_per(unit) == factor
    assert is_length(unit)


@pytest.mark.parametrize("unit", ["", "A", "Mm", "NM", "V", "deg", "m2", "µ", "inch", "1e-6 m"])
def test_other_units_are_refused(unit: str) -> None:
    assert not is_length(unit)
    with pytest.raises(InputError, match="unit of length"):
        um_per(unit)


@given(st.text(max_size=6))
def test_any_text_is_a_length_or_refused(unit: str) -> None:
    if is_length(unit):
        assert um_per(unit) > 0
    else:
        with pytest.raises(InputError):
            um_per(unit)


def test_heights_are_copied_and_locked() -> None:
    source = HEIGHT_UM.copy()
    scan = Scan(height_um=source, pitch_um=(0.1, 0.2))
    source[0, 0] = 99.0
    assert scan.height_um[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        scan.height_um[0, 0] = 1.0
    assert scan.grid.size_um == pytest.approx((0.3, 0.8))


def test_values_that_are_not_finite_count_as_missing() -> None:
    height = HEIGHT_UM.copy()
    height[1, 1:3] = np.inf, -np.inf
    assert np.isnan(Scan(height_um=height, pitch_um=None).height_um[1, 1:3]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"height_um": np.zeros(5)}, "at least 2 x 2"),
        ({"height_um": np.zeros((1, 5))}, "at least 2 x 2"),
        ({"height_um": np.full((3, 3), np.nan)}, "no finite height"),
        ({"mask": np.zeros((2, 2), bool)}, "shape of the mask"),
        ({"pitch_um": (0.0, 0.1)}, "pitch"),
        ({"pitch_um": (0.1, float("nan"))}, "pitch"),
    ],
)
def test_an_invalid_scan_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Scan(**({"height_um": HEIGHT_UM, "pitch_um": None} | arguments))


def test_a_missing_pitch_is_an_error_where_lengths_are_needed() -> None:
    scan = Scan(height_um=HEIGHT_UM, pitch_um=None, name="FOV11")
    for needs_lengths in (scan.require_pitch, lambda: scan.grid):
        with pytest.raises(InputError, match=r"FOV11 has no pixel pitch.*size_um"):
            needs_lengths()
