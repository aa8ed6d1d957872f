"""Check that files and folders are replaced as a whole, and that the older one stays if writing stops."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from litho_data.foundation.files import atomic_file, atomic_folder, unfinished


@pytest.fixture
def older(tmp_path: Path) -> Path:
    """Return a folder with a finished result of two files."""
    folder = tmp_path / "result"
    (folder / "part").mkdir(parents=True)
    (folder / "part" / "a.txt").write_text("weeks of work")
    (folder / "b.txt").write_text("more of it")
    return folder


def contents(folder: Path) -> dict[str, str]:
    return {str(file.relative_to(folder)): file.read_text() for file in folder.rglob("*") if file.is_file()}


def stop_half_way(file: Path) -> None:
    file.write_text("half of it")
    raise ZeroDivisionError


OLDER = {"part/a.txt": "weeks of work", "b.txt": "more of it"}


def test_a_finished_folder_replaces_the_older_one_and_leaves_nothing_else(older: Path) -> None:
    with atomic_folder(older) as folder:
        (folder / "c.txt").write_text("new")
        assert contents(older) == OLDER
    assert contents(older) == {"c.txt": "new"}
    assert list(older.parent.iterdir()) == [older]


def test_an_error_on_the_way_leaves_the_older_folder_and_nothing_else(older: Path) -> None:
    with pytest.raises(ZeroDivisionError), atomic_folder(older) as folder:
        stop_half_way(folder / "c.txt")
    assert contents(older) == OLDER
    assert list(older.parent.iterdir()) == [older]


def test_a_rename_that_fails_puts_the_older_folder_back(older: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = Path.replace

    def refuse_the_new(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise OSError("no space left on device")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refuse_the_new)
    with pytest.raises(OSError, match="no space"), atomic_folder(older) as folder:
        (folder / "c.txt").write_text("new")
    assert contents(older) == OLDER
    assert list(older.parent.iterdir()) == [older]


KILL = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_process_killed_while_it_writes_leaves_the_older_folder(older: Path) -> None:
    code = (
        "from litho_data.foundation.files import atomic_folder\n"
        f"with atomic_folder({str(older)!r}) as folder:\n"
        f"    (folder / 'c.txt').write_text('half of it')\n    {KILL}"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode != 0
    assert contents(older) == OLDER


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_an_older_folder_that_a_killed_process_had_moved_away_is_restored(older: Path) -> None:
    code = (
        "from pathlib import Path\nfrom litho_data.foundation.files import atomic_folder\n"
        "replace = Path.replace\n"
        "def stop(self, target):\n"
        f"    if self.name == 'new':\n        {KILL}\n"
        "    return replace(self, target)\n"
        "Path.replace = stop\n"
        f"with atomic_folder({str(older)!r}) as folder:\n    (folder / 'c.txt').write_text('new')"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode != 0
    assert not older.exists()
    with unfinished(older):
        assert contents(older) == OLDER


def test_writers_of_one_folder_take_turns(tmp_path: Path) -> None:
    """Check that two commands that write the same fit to a shared cache do so one after the other."""

    def write(number: int) -> None:
        for turn in range(20):
            with atomic_folder(tmp_path / "fit") as folder:
                (folder / "a.txt").write_text(f"{number} {turn}")
                (folder / "b.txt").write_text(f"{number} {turn}")

    with ThreadPoolExecutor(4) as writers:
        list(writers.map(write, range(4)))
    kept = contents(tmp_path / "fit")
    assert kept["a.txt"] == kept["b.txt"]
    assert [path.name for path in tmp_path.iterdir()] == ["fit"]


def test_an_error_on_the_way_leaves_the_older_file(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("older")
    with pytest.raises(ZeroDivisionError), atomic_file(tmp_path / "a.txt") as file:
        stop_half_way(file)
    assert contents(tmp_path) == {"a.txt": "older"}


@pytest.mark.parametrize("mask", [0, 0o022, 0o077])
def test_the_permissions_of_a_file_follow_the_umask(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        with atomic_file(tmp_path / "a.txt") as file:
            file.write_text("a")
    finally:
        os.umask(before)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o666 & ~mask
