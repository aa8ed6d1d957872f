"""Check that files that an earlier version misread give the right map, or a message with the reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.readers import list_channels, read_layout, read_scan

SHAPE, PITCH_UM = (24, 32), 0.2


@pytest.fixture(scope="module")
def cases(oracles: Path) -> Path:
    folder = oracles.parent / "cases"
    if not folder.is_dir():
        pytest.skip(f"{folder} does not exist")
    return folder


# The arguments for the reader, the number of missing pixels, and whether the file states its size.
READ: dict[str, tuple[dict, int, bool]] = {
    "scan.nhf": ({"channel": "Position Z, Forward"}, 0, True),
    "gwy_concat_plain.txt": ({"unit": "m", "channel": "block 1"}, 0, False),
    "axes.csv": ({"unit": "um"}, 0, True),
    "pandas.csv": ({"unit": "um"}, 0, False),
    "matlab5_only.mat": ({"unit": "m"}, 0, False),
    "surfer.grd": ({"unit": "um"}, 0, True),
    "no_xreal.gwy": ({"unit": "um"}, 0, False),
    "compressed.sur": ({}, 0, True),
    "wyko.asc": ({}, 2, True),
    "grid.xyz": ({"unit": "um"}, 0, True),
    "nodata.txt": ({"unit": "um", "missing": [-9999]}, 1, False),
    "bad_word.txt": ({"unit": "um", "missing": ["Bad"]}, 1, False),
}


@pytest.mark.parametrize("name", READ)
def test_a_readable_case_gives_the_described_map(cases: Path, name: str) -> None:
    arguments, missing, has_size = READ[name]
    scan = read_scan(cases / name, **arguments)
    height = scan.height_um - np.nanmin(scan.height_um)
    assert scan.shape == SHAPE
    # The map has a raised upper left corner and steps of 0.01 µm from row to row. Wyko files state numbers in
    # nm.
    scale = 1e-3 if name == "wyko.asc" else 1.0
    assert height[:3, :3] == pytest.approx(0.9 * scale, rel=0.03)
    assert np.nanmedian(np.diff(height, axis=0)) == pytest.approx(0.01 * scale, rel=0.02)
    assert np.isnan(height).sum() == missing
    assert scan.pitch_um == (pytest.approx((PITCH_UM, PITCH_UM)) if has_size else None)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("scan.nhf", "several height channels, got 'Position Z, Forward'"),
        ("gwy_concat_plain.txt", "several height channels, got 'block 1'"),
        ("nodata.txt", r"missing = \[-9999\]"),
        ("bad_word.txt", r'missing = \["Bad"\]'),
        ("like_nms.nms", "unknown content"),
        ("over12_a.png", "a picture"),
    ],
)
def test_a_case_that_cannot_be_read_as_it_stands_is_refused_with_a_reason(
    cases: Path, name: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_scan(cases / name, **({} if name.endswith(("nhf", "nms", "png")) else {"unit": "um"}))
    assert "damaged" not in str(caught.value)


def test_park_states_unit_and_size(cases: Path) -> None:
    scan = read_scan(cases / "park.tiff")
    assert (scan.height_um.min(), scan.height_um.max()) == (0, pytest.approx(1))
    assert scan.pitch_um == pytest.approx((0.1, 0.1))
    scan = read_scan(cases / "card_park" / "scans" / "P1F1.tiff")
    # These heights equal those in the store before levelling.
    assert (scan.height_um.min(), scan.height_um.max()) == pytest.approx((0.126, 1.054), abs=5e-4)
    assert [one.is_height for one in list_channels(cases / "scan.nhf")] == [True, False, True, False]


def test_layouts_as_they_were_exported(cases: Path) -> None:
    picture, pages = (
        read_layout(cases / f"own_export_{kind}") for kind in ("png16/layout.png", "tiff/layout.tif")
    )
    np.testing.assert_array_equal(picture, pages)
    assert (picture.shape, picture.max()) == ((128, 128), 12)
    assert read_layout(cases / "layout_0_255.png", levels=13).max() == 12
