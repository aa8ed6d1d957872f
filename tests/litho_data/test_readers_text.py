"""Read text matrices in all notations that occur, and check that damage is named with its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from litho_data.foundation.errors import InputError
from litho_data.readers import read_scan

ROWS = "1e-007\t2e-007\t3e-007\r\n4e-007\t5e-007\t6e-007\r\n"
EXPECTED_UM = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])


def read(folder: Path, content: str | bytes, **arguments: object):
    path = folder / "scan.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_scan(path, **({"unit": "m", "format": "text-matrix"} | arguments))


@pytest.mark.parametrize(
    "content",
    [
        ROWS,
        ROWS.replace("\r\n", "\n"),
        ROWS.replace("\t", " "),
        ROWS.replace("\t", ","),
        ROWS.replace("\t", ", "),
        ROWS.replace("\t", ";"),
        ROWS.replace("\r\n", "\t\r\n"),
        ROWS.replace("\t", ",").replace("\r\n", ",\r\n"),
        ROWS.rstrip(),
        "\ufeff" + ROWS,
        "# Channel: Topography\n# free text\n" + ROWS,
        "\n" + ROWS + "\n\n",
        ROWS.replace("e-007", "E-07"),
        ROWS.replace("1e", "1,0e").replace("4e", "4,0e"),
        ROWS.replace("\t", ";").replace("1e", "1,0e").replace("4e", "4,0e"),
        ROWS.encode("utf-16"),
        b"\xfe\xff" + ROWS.encode("utf-16-be"),
        "% measured on Monday\n; by us\n" + ROWS,
        "Height map of sample 7\n\nscan rate 1.5 Hz\n" + ROWS,
        ROWS.replace("e", "D"),
        ROWS.replace("1e", "1.0d").replace("e", "D"),
        ROWS.replace("1e", "1,0D"),
        ROWS.replace("\t", " , "),
    ],
)
def test_spellings(tmp_path: Path, content: str | bytes) -> None:
    scan = read(tmp_path, content, format="auto")
    # The conversion to binary and the factor 1e6 each round once.
    np.testing.assert_allclose(scan.height_um, EXPECTED_UM, rtol=4e-16)
    assert scan.pitch_um is None


def test_gwyddion_comments_state_size_and_unit(tmp_path: Path) -> None:
    comments = "# Channel: Topography\n# Width: 3.00 µm\n# Height: 1000 nm\n# Value units: nm\n"
    scan = read(tmp_path, comments + ROWS.replace("e-007", ""), unit=None)
    assert scan.channel == "Topography"
    assert scan.pitch_um == (0.5, 1.0)
    np.testing.assert_allclose(scan.height_um, EXPECTED_UM / 100, rtol=4e-16)
    assert scan.header["Width"] == "3.00 µm"


def test_the_hints_are_true(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"first row begins 1e-07, 2e-07.*unit 'm'"):
        read(tmp_path, ROWS, unit=None)


def test_headers_in_other_languages_state_size_and_unit(tmp_path: Path) -> None:
    lines = "# Kanal: Topographie\n# Breite: 3,00 µm\n# Höhe: 1000 nm\n# Value units: nm\n"
    scan = read(tmp_path, lines + ROWS.replace("e-007", ""), unit=None)
    assert (scan.channel, scan.pitch_um) == ("Topographie", (0.5, 1.0))
    lines = "h=2 w=3\npixel size=2e-006 m\ndata unit=rad\nheight conversion factor (-> m)=1e-007\n"
    scan = read(tmp_path, lines + "1 2 3\n4 5 6\n", unit=None)
    np.testing.assert_allclose(scan.height_um, EXPECTED_UM, rtol=4e-16)
    assert scan.pitch_um == pytest.approx((2, 2))


def test_isolated_nan_is_not_measured(tmp_path: Path) -> None:
    scan = read(tmp_path, ROWS.replace("5e-007", "nan").replace("2e-007", "-inf"))
    np.testing.assert_array_equal(np.isnan(scan.height_um), [[False, True, False], [False, True, False]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            ROWS + "7e-007\t8e-007\r\n",
            "line 3, got 2 values, wanted 3 values as in line 1; the file may be truncated",
        ),
        ("# one\n# two\n" + ROWS + "7e-007\r\n", "line 5, got 1 values"),
        (ROWS.replace("5e-007", "five"), "line 2, got 'five', wanted a number"),
        (ROWS.replace("5e-007", ""), "line 2, got an empty cell"),
        (ROWS.replace("\t", ",").replace("5e-007", ""), "line 2, got an empty cell"),
        (ROWS.rstrip()[:-3], "line 2 ends inside a number, got '6e-'|line 2, got '6e-'"),
        (ROWS.rstrip()[:-5], "line 2 ends inside a number, got '6'"),
        (ROWS.rstrip()[:-1], "line 2 ends inside a number, got '6e-00'"),
        (ROWS.encode() + b"\0\1\2", "line 3, got byte 0x00"),
        ("# only a comment\n", "holds no numbers"),
        (" \r\n\r\n", "holds no numbers"),
        ("nan nan\nnan nan\n", "no finite height"),
        ("1e-7\n2e-7\n", "size in pixels"),
        ("1e-7 2e-7\n", "size in pixels"),
        ("0x10 1\n2 3\n", "line 1, got '0x10'"),
        ("1_0 1\n2 3\n", "line 1, got '1_0'"),
        ("1,234.5;2,345.6\n1,234.5;2,345.6\n", r"line 1, got '1,234.5;2,345.6', wanted .*one separator"),
        ("1,234.5\t2,345.6\n1,234.5\t2,345.6\n", "line 1, got .*one separator"),
        ("1.5;2,5\n1.5;2.5\n", "line 1, got .*one separator"),
        ("1.5;2.5\n1,5;2.5\n", "line 2, got .*one separator"),
        ("1 2\n1e400 3\n", "line 2, got '1e400', wanted a number below"),
        ("1 2\nx y 3 4\n", "line 2.*first rows are '1 2' | 'x y 3 4'"),
    ],
)
def test_damage_is_named(tmp_path: Path, content: str | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, content)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("row", "kind"), [("0 1\n", "a profile"), ("0 1 2\n", "a point cloud")])
def test_a_list_of_points_is_not_read_as_a_matrix(tmp_path: Path, row: str, kind: str) -> None:
    with pytest.raises(InputError, match=f"holds {kind}.*wanted a height map"):
        read(tmp_path, row * 9, format="auto")


@pytest.mark.measured
def test_a_measured_scan_cut_at_any_byte(tmp_path: Path, measured_prints: Path) -> None:
    raw = (measured_prints / "afm_ug" / "FOV11.txt").read_bytes()
    rng = np.random.default_rng(0)
    for cut in rng.integers(len(raw) // 2, len(raw) - 16, size=12):
        # A cut between two lines leaves a smaller valid matrix, so no reader can detect it.
        if raw[cut - 1 : cut] not in (b"\n", b"\r"):
            with pytest.raises(InputError, match="line"):
                read(tmp_path, raw[:cut])


@settings(deadline=None, max_examples=50)
@given(
    values=arrays(
        np.float64,
        array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=7),
        elements=st.floats(-1e3, 1e3, allow_subnormal=False),
    ),
    separator=st.sampled_from(["\t", " ", ", ", ";"]),
)
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, separator: str) -> None:
    lines = [separator.join(repr(float(value)) for value in row) for row in values]
    scan = read(tmp_path_factory.mktemp("text"), "\n".join(lines) + "\n", unit="um", missing=[])
    # repr writes the shortest text that reads back to the same double.
    np.testing.assert_array_equal(scan.height_um, values)
