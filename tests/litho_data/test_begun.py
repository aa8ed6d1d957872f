"""Check that a command that is stopped after any of its writes and repeated gives the same result."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from litho_data.foundation.begun import BEGUN, growing_folder, whole_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file, atomic_folder
from tests.stops import stopped_after, writes_of

FACTS = {"dataset": {"name": "prints"}, "settings": {"seed": 0}}


def grow(out: Path, facts: dict[str, object] = FACTS) -> None:
    """Run a command that keeps finished parts when stopped. It writes a folder, a file and a record."""
    with growing_folder(out, "sums.json", facts) as begun:
        if not (begun.folder / "part").exists():
            with atomic_folder(begun.folder / "part") as part:
                (part / "a.txt").write_text("1")
        with atomic_file(begun.folder / "b.txt") as file:
            file.write_text("2" + (begun.folder / "part" / "a.txt").read_text())
        with atomic_file(begun.folder / "sums.json") as file:
            file.write_text(json.dumps({"schema": "test/sums/1", **facts}))


def replace(out: Path) -> None:
    """Run a command that replaces its result as a whole."""
    with whole_folder(out, "*.txt", "sums.json", record="sums.json", facts=FACTS) as folder:
        (folder / "a.txt").write_text("1")
        (folder / "sums.json").write_text(json.dumps(FACTS))


def tree(folder: Path) -> dict[str, str]:
    """Return the text of every file in a folder, including hidden files."""
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else ""
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("older", [False, True], ids=["new", "again"])
@pytest.mark.parametrize("command", [grow, replace])
def test_a_command_stopped_after_any_write_and_repeated_gives_the_same_result(
    command: Callable[[Path], None], older: bool, tmp_path: Path
) -> None:
    if older:
        command(tmp_path / "whole" / "out")
    count = writes_of(lambda: command(tmp_path / "whole" / "out"), tmp_path)
    assert count >= 5
    wanted = tree(tmp_path / "whole")
    for stop in range(count):
        place = tmp_path / f"{stop}"
        if older:
            command(place / "out")
        assert stopped_after(stop, lambda place=place: command(place / "out"), tmp_path)  # type: ignore[misc]
        command(place / "out")
        assert tree(place) == wanted, f"stopped after write {stop}"


def test_a_begun_folder_is_continued_by_the_same_command_only(tmp_path: Path) -> None:
    with growing_folder(tmp_path, "sums.json", FACTS) as begun:
        assert not begun.finished
    assert stopped_after(5, lambda: grow(tmp_path), tmp_path)
    held = tree(tmp_path)
    with pytest.raises(InputError, match="which holds"), growing_folder(tmp_path, "run.json"):
        pass
    other = {"dataset": {"name": "prints"}, "settings": {"seed": 1}}
    with (
        pytest.raises(InputError, match="seed = 0, but now 1"),
        growing_folder(tmp_path, "sums.json", other),
    ):
        pass
    assert tree(tmp_path) == held
    grow(tmp_path)
    assert BEGUN not in tree(tmp_path)
    with growing_folder(tmp_path, "sums.json", FACTS) as begun:
        assert begun.finished
        with (
            pytest.raises(InputError, match="written by another process"),
            growing_folder(tmp_path, "sums.json", FACTS),
        ):
            pass


def test_continuing_a_folder_does_not_rewrite_its_mark(tmp_path: Path) -> None:
    """Check this because a process that is stopped while it rewrites the mark would leave parts without a
    mark.
    """
    assert stopped_after(5, lambda: grow(tmp_path), tmp_path)
    os.utime(tmp_path / BEGUN, (0, 0))
    with growing_folder(tmp_path, "sums.json", FACTS) as begun:
        assert not begun.finished
        assert (tmp_path / BEGUN).stat().st_mtime == 0
        assert json.loads((tmp_path / BEGUN).read_text()) == {"record": "sums.json", **FACTS}


def test_a_command_that_fails_before_its_first_part_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name, stays in (("new", False), ("empty", True)):
        with pytest.raises(ZeroDivisionError), growing_folder(tmp_path / name, "sums.json"):
            raise ZeroDivisionError
        assert (tmp_path / name).exists() is stays
    # This is what a command leaves that is stopped after creating the mark and before writing to it.
    (tmp_path / "empty" / BEGUN).touch()
    grow(tmp_path / "empty")
    (tmp_path / "empty" / "sums.json").unlink()
    (tmp_path / "empty" / BEGUN).write_text("{")
    with pytest.raises(InputError, match=r"which holds b\.txt"):
        grow(tmp_path / "empty")


def test_a_folder_that_cannot_be_written_is_reported_before_the_work_begins(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    for begin in (
        growing_folder(tmp_path / "file" / "out", "a.json"),
        whole_folder(tmp_path / "file" / "out"),
    ):
        with pytest.raises(InputError, match="cannot write"), begin:
            pytest.fail("the work began")
