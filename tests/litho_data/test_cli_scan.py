"""Test what `level` and `inspect` write and print, and how they fail."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from litho_data.cli.scan import inspect, level
from litho_data.cli.scan_picture import write_picture
from litho_data.commands.app import new_app, run_app
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import array_sha256, file_sha256
from litho_data.level import Recipe
from litho_data.level.scan import LevelRecord, level_scan, write_heights, write_levelled
from litho_data.readers import formats, read_scan
from litho_data.scan import Scan
from tests.litho_data import afm_files
from tests.litho_data.afm_files import HEIGHT_UM, SIZE_UM

RECIPE = '[[step]]\nop = "plane"\n[[step]]\nop = "fix-zero"\n'


@pytest.fixture
def app():
    application = new_app("scans")
    application.command()(level)
    application.command()(inspect)
    return application


@pytest.fixture
def scan_file(tmp_path: Path) -> Path:
    path = tmp_path / "scan.txt"
    np.savetxt(path, HEIGHT_UM * 1e-6)
    (tmp_path / "recipe.toml").write_text(RECIPE)
    return path


def run(app, *arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("suffix", [".gsf", ".npy"])
def test_level_writes_heights_removed_surface_and_record(app, scan_file: Path, suffix: str) -> None:
    out = scan_file.with_name(f"levelled{suffix}")
    recipe_file = scan_file.with_name("recipe.toml")
    size = ("--size-um", *SIZE_UM)
    run(app, "level", scan_file, "--unit", "m", *size, "--recipe", recipe_file, "--out", out)
    expected = Recipe.from_toml(recipe_file).apply(read_scan(scan_file, unit="m", size_um=SIZE_UM))
    record = LevelRecord.read(f"{out}.json")
    arguments = {"unit": "µm", "size_um": SIZE_UM} if suffix == ".npy" else {}
    levelled = read_scan(out, **arguments)
    removed = read_scan(out.with_name(record.removed), **arguments)
    # GSF rounds to float32.
    rtol = 2**-23 if suffix == ".gsf" else 0.0
    np.testing.assert_allclose(levelled.height_um, expected.height, rtol=rtol, atol=1e-12 * bool(rtol))
    np.testing.assert_allclose(removed.height_um, expected.removed, rtol=rtol, atol=1e-12 * bool(rtol))
    assert levelled.pitch_um == pytest.approx((SIZE_UM[0] / 5, SIZE_UM[1] / 8), rel=1e-12)
    assert record.source_sha256 == file_sha256(scan_file)
    assert record.levelled_sha256 == array_sha256(expected.height, "µm", ("y", "x"))
    assert Recipe.from_dict(record.recipe).canonical() == Recipe.from_toml(recipe_file).canonical()


def test_a_levelling_step_warns_on_stderr_only(app, tmp_path: Path) -> None:
    """Check the warning about row alignment for a scan in which a block covers half of some lines."""
    height = 0.003 * np.random.default_rng(0).standard_normal((128, 128))
    height[30:90, 20:90] += 0.8
    np.savetxt(tmp_path / "scan.txt", height * 1e-6)
    (tmp_path / "recipe.toml").write_text('[[step]]\nop = "align-rows"\nmethod = "median"\n')
    words = ["level", tmp_path / "scan.txt", "--unit", "m", "--size-um", 12.8, 12.8]
    words += ["--recipe", tmp_path / "recipe.toml", "--out", tmp_path / "levelled.npy"]
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    assert done.stderr.startswith("warning: ")
    assert "warning" not in done.stdout


def test_a_scan_is_levelled_in_memory_by_a_recipe_or_its_file(scan_file: Path) -> None:
    scan = read_scan(scan_file, unit="m", size_um=SIZE_UM)
    recipe = scan_file.with_name("recipe.toml")
    levelled, removed_um = level_scan(scan, recipe)
    expected = Recipe.from_toml(recipe).apply(scan)
    np.testing.assert_array_equal(levelled.height_um, expected.height)
    np.testing.assert_allclose(levelled.height_um + removed_um, scan.height_um, atol=1e-12)
    assert (levelled.pitch_um, levelled.source) == (scan.pitch_um, scan.source)


def test_the_command_offers_what_the_reader_reads(app, scan_file: Path) -> None:
    said = CliRunner().invoke(app, ["inspect", str(scan_file), "--format", "nonsense"]).exception
    assert [name for name in formats() if name not in str(said)] == []


def test_gsf_keeps_missing_pixels(tmp_path: Path) -> None:
    holed = HEIGHT_UM.copy()
    holed[2, 3] = np.nan
    write_heights(tmp_path / "a.gsf", holed, pitch_um=None, title="two\nlines")
    scan = read_scan(tmp_path / "a.gsf")
    np.testing.assert_array_equal(np.isnan(scan.height_um), np.isnan(holed))
    assert (scan.pitch_um, scan.channel) == (None, "two lines")


def test_inspect_lists_channels_and_writes_a_picture(app, tmp_path: Path) -> None:
    path = tmp_path / "scan.gwy"
    channels = {"Topography": (HEIGHT_UM * 1e-6, "m"), "Phase": (HEIGHT_UM, "deg")}
    afm_files.write_gwy(path, channels, HEIGHT_UM > 0.03)
    output = run(app, "inspect", path, "--header", "--picture", tmp_path / "scan.png")
    for word in (
        "Topography",
        "Phase",
        "5 × 8",
        "deg",
        "0.5 × 0.2",
        "Scan rate = 1.5 Hz",
        "heights 0.001 to 0.5",
    ):
        assert word in output
    import cv2

    picture = cv2.imread(str(tmp_path / "scan.png"))
    assert picture is not None
    assert picture.std() > 10


def test_inspect_without_a_unit_lists_and_says_why_there_is_no_picture(app, scan_file: Path) -> None:
    output = run(app, "inspect", scan_file)
    assert "5 × 8" in output
    assert "does not state the unit" in output


def test_pictures_show_row_0_on_top(tmp_path: Path) -> None:
    height = np.zeros((40, 60))
    height[:20, :30] = 1.0
    scan = Scan(height_um=height, pitch_um=(0.1, 0.1), name="corner")
    import cv2

    picture = cv2.imread(str(write_picture(scan, tmp_path / "a.png")))
    rows, columns = picture.shape[:2]
    # Viridis ends in yellow, which is strong in red and weak in blue. The order is blue, green, red.
    top_left, bottom_right = picture[rows // 4, columns // 4], picture[3 * rows // 4, columns // 2]
    assert top_left[2] > 200 > 100 > top_left[0]
    assert bottom_right[2] < 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["level", "{scan}", "--recipe", "{recipe}", "--out", "o.gsf"], "does not state the unit"),
        (["level", "{scan}", "--unit", "m", "--recipe", "none.toml", "--out", "o.gsf"], "cannot read recipe"),
        (["level", "{scan}", "--unit", "m", "--recipe", "{recipe}", "--out", "o.xyz"], "file type"),
        (["inspect", "none.txt"], "no such file"),
        (["inspect", "{recipe}"], "unknown content"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    app, scan_file: Path, arguments: list[str], message: str, monkeypatch, capsys
) -> None:
    names = {"scan": scan_file, "recipe": scan_file.with_name("recipe.toml")}
    monkeypatch.chdir(scan_file.parent)
    before = sorted(scan_file.parent.iterdir())
    monkeypatch.setattr("sys.argv", ["litho-data", *(argument.format(**names) for argument in arguments)])
    with pytest.raises(SystemExit) as stopped:
        run_app(app, "litho-data")
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert sorted(scan_file.parent.iterdir()) == before


def test_a_full_disk_is_one_line_and_exit_code_2(app, scan_file: Path, monkeypatch, capsys) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "somewhere")

    monkeypatch.setattr("litho_data.level.scan.write_levelled", full)
    recipe = scan_file.with_name("recipe.toml")
    command = ["level", scan_file, "--unit", "m", "--recipe", recipe, "--out", "o.gsf"]
    monkeypatch.setattr("sys.argv", ["litho-data", *map(str, command)])
    with pytest.raises(SystemExit) as stopped:
        run_app(app, "litho-data")
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "cannot use somewhere, got no space left on device; make room" in line


@pytest.mark.parametrize("name", ["a.gsf", "a.removed.gsf"])
def test_the_levelled_scan_never_replaces_its_source(tmp_path: Path, name: str) -> None:
    source = write_heights(tmp_path / name, HEIGHT_UM, pitch_um=(0.1, 0.1))
    before = source.read_bytes()
    with pytest.raises(InputError, match="which is the scan itself"):
        write_levelled(read_scan(source), Recipe.from_dict({"step": [{"op": "plane"}]}), tmp_path / "a.gsf")
    assert source.read_bytes() == before
    assert [*tmp_path.iterdir()] == [source]


def test_a_step_that_fails_writes_nothing(tmp_path: Path) -> None:
    scan = Scan(height_um=HEIGHT_UM, pitch_um=None, source="scan")
    with pytest.raises(InputError, match="pixel pitch"):
        write_levelled(scan, Recipe.from_dict({"step": [{"op": "facet"}]}), tmp_path / "a.gsf")
    assert not list(tmp_path.iterdir())
