"""Check that every reader answers random or damaged bytes with one clear error, without crash or hang."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from litho_data.foundation.errors import InputError
from litho_data.readers import formats, list_channels, read_layout, read_scan
from litho_data.readers.tiff import _ome_pitch_um as ome_pitch_um
from tests.litho_data import afm_files

LONGEST_S = 20
STARTS = (
    b"Gwyddion Simple Field 1.0\n", b"GWYPGwyContainer\0", b"\x93NUMPY\x01\x00", b"II*\0\x08\0\0\0", b"MM\0*",
    b"II+\0", b"\x89PNG\r\n\x1a\n", b"BM", b"\x05\x00", b"\x00\x05", b"DIGITAL SURF\0", b"\\*File list\r\n",
    b"PK\x03\x04", b"\x89HDF\r\n\x1a\n", b"CDF\x01", b"MATLAB 5.0 MAT-file", b"WSxM file copyright",
    b"1 2 3\n", b"# Width: 1 um\n",
    b"DSCOMPRESSED", b"DSAA\n3 3\n", b"DSBB\3\0\3\0",
    b"DSRB\1\0\0\0", b"Wyko ASCII Data File Format\t0\t1\t1\nX Size\t3\n", b"MATLAB 7.3 MAT-file",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _alarm() -> Iterator[None]:
    """Fail the test if a reader hangs, so that the other tests can run."""

    def stop(*_: object) -> None:
        raise AssertionError(f"a reader took longer than {LONGEST_S} s")

    previous = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LONGEST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("garbage")


def refused(path: Path, content: bytes, format: str) -> None:
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_scan(path, format=format, unit=None, size_um=(1.0, 1.0))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("format", ["auto", *formats()])
def test_random_bytes(folder: Path, format: str) -> None:
    @settings(deadline=None, max_examples=40)
    @given(content=st.binary(max_size=600))
    @example(b"")
    @example(bytes(4096))
    def check(content: bytes) -> None:
        refused(folder / "scan", content, format)

    check()


@pytest.mark.parametrize("signature", STARTS)
def test_random_bytes_behind_a_signature(folder: Path, signature: bytes) -> None:
    @settings(deadline=None, max_examples=15)
    @given(content=st.binary(max_size=600))
    def check(content: bytes) -> None:
        refused(folder / "scan", signature + content, "auto")

    check()


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=600), signature=st.sampled_from([b"", *STARTS]))
def test_random_layouts(folder: Path, content: bytes, signature: bytes) -> None:
    path = folder / "layout"
    path.write_bytes(signature + content)
    with pytest.raises(InputError):
        read_layout(path)


def whole_files(folder: Path) -> dict[str, bytes]:
    height_m = afm_files.HEIGHT_UM * 1e-6
    afm_files.write_gsf(folder / "gsf", height_m, {"ZUnits": "m"})
    afm_files.write_gwy(folder / "gwy", {"Topography": (height_m, "m")}, height_m > 0)
    afm_files.write_ibw(folder / "ibw", {"HeightTrace": height_m}, "ScanAngle: 0\r")
    afm_files.write_spm(folder / "spm", np.ones((5, 8), int), hard_v=1.0, sensitivity_nm_per_v=1.0)
    afm_files.write_jpk(folder / "jpk", np.ones((5, 8), int))
    afm_files.write_x3p(folder / "x3p", height_m)
    afm_files.write_sur(folder / "sur", np.ones((5, 8), int), height_per_count_um=1.0)
    tifffile.imwrite(folder / "tiff", height_m)
    with (folder / "npy").open("wb") as stream:
        np.save(stream, height_m)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_damaged_files_are_refused_or_read(tmp_path: Path) -> None:
    """Check that readers of changed or truncated files return a map or raise an InputError, nothing else."""
    rng = np.random.default_rng(0)
    (tmp_path / "whole").mkdir()
    for name, content in whole_files(tmp_path / "whole").items():
        for _ in range(60):
            damaged = bytearray(content[: rng.integers(4, len(content) + 1)])
            for position in rng.integers(0, len(damaged), size=rng.integers(0, 6)):
                damaged[position] = rng.integers(256)
            path = tmp_path / name
            path.write_bytes(damaged)
            with suppress(InputError):
                assert read_scan(path).height_um.ndim == 2


def test_no_header_claims_more_pixels_than_its_file_can_hold(tmp_path: Path) -> None:
    """Check a file with almost no pixels, in which small numbers after the signature are read as sizes."""
    path = tmp_path / "zeta"
    largest = []
    for seed in range(60):
        numbers = np.random.default_rng(seed).integers(0, 4, size=2000).astype(np.uint8)
        path.write_bytes(b"Zeta-Instruments" + numbers.tobytes())
        with suppress(InputError):
            largest += [channel.shape[0] * channel.shape[1] for channel in list_channels(path)]
    # Deflate compresses at most 1032 bytes into one byte.
    assert all(pixels <= 1032 * 2016 for pixels in largest)


@pytest.mark.parametrize("name", ["gsf", "gwy", "ibw", "spm", "jpk", "x3p", "sur", "tiff", "npy"])
def test_every_cut_is_noticed(tmp_path: Path, name: str) -> None:
    content = whole_files(tmp_path)[name]
    for cut in np.linspace(1, len(content) - 1, 25).astype(int):
        refused(tmp_path / "cut", content[:cut], "auto")


_LONG = 200_000


@pytest.mark.parametrize(
    "text",
    [
        "a" + " " * _LONG + "b\n1 2\n3 4\n",
        "# Width: " + "1" * _LONG + " x y\n1 2\n3 4\n",
        "# Width: " + " " * _LONG + "\n1 2\n3 4\n",
        "1" * _LONG + "x 2\n3 4\n",
        "1" + " " * _LONG + "2,5\n3 4\n",
        "1,5 2,5\n" + "\t" * _LONG + "x\n",
        "1,5" + " " * _LONG + ",\n1 2\n",
        "1 " + "e" * _LONG,
        "1 1" + "e1" * _LONG,
        "," * _LONG,
        "1;" * _LONG,
    ],
)
def test_no_line_makes_a_regular_expression_slow(tmp_path: Path, text: str) -> None:
    """Check long lines. They take hours if two adjacent repetitions in a pattern match the same
    characters.
    """
    path = tmp_path / "scan.txt"
    path.write_text(text)
    started = time.process_time()
    with suppress(InputError):
        read_scan(path, format="text-matrix", unit="m", size_um=(1.0, 1.0))
    # Splitting 200 kB into cells takes a few hundredths of a second. Quadratic time would be 40 s or more.
    assert time.process_time() - started < 2


@pytest.mark.parametrize(
    "text", ["<" * _LONG, "<a" * _LONG, "<Pixels PhysicalSizeX" + " " * _LONG, '="' * _LONG]
)
def test_no_metadata_makes_a_regular_expression_slow(text: str) -> None:
    started = time.process_time()
    assert ome_pitch_um(text) is None
    assert time.process_time() - started < 2
