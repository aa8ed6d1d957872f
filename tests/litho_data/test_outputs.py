"""Check that a command overwrites nothing but an older result of the same kind."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from litho_data.exchange.pairs import export_pairs
from litho_data.exchange.release import export_ro_crate
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file, atomic_folder
from litho_data.foundation.outputs import (
    read_record,
    require_own_folder,
    require_replaceable_folder,
    require_same,
)
from litho_data.layouts import write_layout_set
from litho_data.virtual_fab import simulate

Writer = Callable[[Path, Path], object]
WRITERS: dict[str, Writer] = {
    "masks": lambda campaign, out: write_layout_set(out, count=1, size_px=64),
    "simulate": lambda campaign, out: simulate(out, count=1, size_px=64),
    "pairs": lambda campaign, out: export_pairs(campaign / "prints.zarr", out),
    "ro-crate": lambda campaign, out: export_ro_crate(campaign / "prints.zarr", out),
}


@pytest.mark.parametrize("name", WRITERS)
def test_only_an_older_result_is_replaced(name: str, campaign: Path, tmp_path: Path) -> None:
    write, out = WRITERS[name], tmp_path / "out"
    out.mkdir()
    write(campaign, out)
    names = {path.name for path in out.iterdir()}
    write(campaign, out)
    assert {path.name for path in out.iterdir()} == names

    # A folder that contains any foreign file, such as a measured scan or a note, is not replaced.
    (out / "scans").mkdir()
    (out / "scans" / "P11.txt").write_text("weeks of measuring")
    with pytest.raises(InputError, match="which holds scans"):
        write(campaign, out)
    assert (out / "scans" / "P11.txt").read_text() == "weeks of measuring"

    file = tmp_path / "thesis.pdf"
    file.write_text("years of work")
    with pytest.raises(InputError, match="which is a file"):
        write(campaign, file)
    assert file.read_text() == "years of work"


@pytest.mark.parametrize("name", ["masks", "simulate", "pairs"])
def test_a_file_of_the_user_in_a_subfolder_is_not_deleted(name: str, campaign: Path, tmp_path: Path) -> None:
    write, out = WRITERS[name], tmp_path / "out"
    write(campaign, out)
    folders = [path for path in out.iterdir() if path.is_dir()]
    assert folders
    for folder in folders:
        (folder / "notes").mkdir()
        (folder / "notes" / "monday.txt").write_text("a day of measuring")
        with pytest.raises(InputError, match=f"which holds {folder.name}/notes"):
            write(campaign, out)
        assert (folder / "notes" / "monday.txt").read_text() == "a day of measuring"
        (folder / "notes" / "monday.txt").unlink()
        (folder / "notes").rmdir()
    write(campaign, out)


@pytest.mark.parametrize(
    ("name", "holds", "is_own"),
    [
        ("a/b/c.tif", ("*.csv", "a/b/*.tif"), True),
        ("a/b/c.txt", ("a",), True),
        ("a/b/c.txt", ("a/b/*.tif", "*.txt"), False),
        ("a/c.tif", ("*.tif", "a/b/*.tif"), False),
    ],
)
def test_a_pattern_admits_files_of_its_own_folder_only(
    name: str, holds: tuple[str, ...], is_own: bool, tmp_path: Path
) -> None:
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).touch()
    if is_own:
        require_replaceable_folder(tmp_path, *holds)
        return
    with pytest.raises(InputError, match=f"which holds {name}"):
        require_replaceable_folder(tmp_path, *holds)


OTHERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "masks": (lambda out: write_layout_set(out, count=1, size_px=64, seed=1), "seed = 0, but now 1"),
    "simulate": (
        lambda out: simulate(out, count=1, size_px=64, knobs=["z-gain=0.1"]),
        r"settings \(knobs\)",
    ),
    "simulate twice": (lambda out: simulate(out, count=2, size_px=64), "count = 1, but now 2"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_result_of_other_settings_is_not_replaced(name: str, campaign: Path, tmp_path: Path) -> None:
    WRITERS[name.split()[0]](campaign, tmp_path / "out")
    held = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    again, differs = OTHERS[name]
    with pytest.raises(InputError, match=f"{differs}.*choose another --out"):
        again(tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == held


def test_settings_of_an_older_result_are_compared_one_by_one(tmp_path: Path) -> None:
    record = tmp_path / "plan.json"
    now = {"dataset": {"name": "a"}, "settings": {"prints": 4, "sizes": (1, 2), "cache": None}}
    require_same(tmp_path, read_record(tmp_path / "plan.json"), now)
    for settings, differs in (
        ({"prints": 4, "sizes": [1, 2], "cache": None}, ""),
        ({"prints": 4}, r"settings \(sizes\), wanted"),
        (None, r"settings \(prints\), wanted"),
        ({"prints": 3, "sizes": [1, 2]}, "prints = 3, but now 4 is requested"),
        ({"prints": 4, "sizes": [1, 3]}, r"\(sizes\), wanted"),
        ({"prints": 4, "sizes": [1, 2], "cache": 1}, "cache = 1, but now None"),
    ):
        record.write_text(json.dumps({"dataset": {"name": "a"}, "settings": settings}))
        if not differs:
            require_same(tmp_path, read_record(tmp_path / "plan.json"), now)
            continue
        with pytest.raises(InputError, match=differs):
            require_same(tmp_path, read_record(tmp_path / "plan.json"), now)
    record.write_text(json.dumps({"dataset": {"name": "b"}}))
    with pytest.raises(InputError, match=r"dataset\.name = 'b', but now 'a'"):
        require_same(tmp_path, read_record(tmp_path / "plan.json"), now)


@pytest.mark.parametrize("part", ["config", "settings"])
def test_a_value_that_is_no_longer_set_is_another_setting(part: str, tmp_path: Path) -> None:
    def facts(**values: float) -> dict[str, object]:
        return {"dataset": {"name": "a"}, part: {"seed": 0, "model": values}}

    # The record of a result holds more than its facts, at the top and in its parts.
    whole = {"name": "a", "sha256": "f"}
    for then, now in (({"x": 1, "sigma.um": 0.6}, {"x": 1}), ({"x": 1}, {}), ({"x": 1}, {"x": 2})):
        require_same(tmp_path, {**facts(**then), "dataset": whole, "scans": 3}, facts(**then))
        for before, after in ((then, now), (now, then)):
            with pytest.raises(InputError, match=r"settings \((config\.)?model\."):
                require_same(tmp_path, {**facts(**before), "dataset": whole}, facts(**after))


def test_the_current_folder_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="current folder"):
        write_layout_set(Path("."), count=1, size_px=64)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_bad_input(campaign: Path, tmp_path: Path) -> None:
    below_a_file = tmp_path / "file" / "out"
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(InputError, match="cannot write"), atomic_file(below_a_file):
        pass
    with pytest.raises(InputError, match="cannot write"), atomic_folder(below_a_file):
        pass
    with pytest.raises(InputError, match="cannot write"), atomic_file(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("name", "schema", "is_taken"),
    [
        ("gap.json", "litho-design/gap/1", True),  # an older result of the same kind
        ("design.json", "litho-design/design/1", False),
        ("close_loop.json", "litho-models/close-loop/1", False),
        ("notes.json", "somebody/else/1", False),
    ],
)
def test_a_result_is_not_written_over_one_of_another_kind(
    name: str, schema: str, is_taken: bool, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(json.dumps({"schema": schema, "dataset": {"name": "prints"}}))
    (tmp_path / "written_beside.json").write_text("{")
    if is_taken:
        require_own_folder(tmp_path, "gap.json")
        return
    with pytest.raises(InputError, match=f"which holds {name}"):
        require_own_folder(tmp_path, "gap.json")


def test_an_interrupted_run_finds_its_folder_and_a_dataset_is_no_folder(tmp_path: Path) -> None:
    require_own_folder(tmp_path, "run.json")
    (tmp_path / ".hidden").touch()
    require_own_folder(tmp_path, "run.json")
    (tmp_path / "checkpoint").mkdir()
    require_own_folder(tmp_path, "run.json", "checkpoint")
    with pytest.raises(InputError, match="which holds checkpoint"):
        require_own_folder(tmp_path, "run.json")
    (tmp_path / "zarr.json").touch()
    with pytest.raises(InputError, match="is a dataset store"):
        require_own_folder(tmp_path, "run.json")
