"""Check that bad input or a limit of the machine ends a command with one helpful line and exit code 2."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from litho_data.cards.card import load_card
from litho_data.commands.app import new_app, run_app
from litho_data.commands.settings import read_settings
from litho_data.foundation.begun import growing_folder, whole_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_data.foundation.names import is_plain_name
from litho_data.foundation.quantities import DOSE, PITCH_UM
from litho_data.foundation.results import Result
from litho_data.level.recipe import Recipe


class CannotAllocate(RuntimeError):
    """Imitate the error that PyTorch raises when it cannot allocate memory."""


def os_error(code: int) -> OSError:
    return OSError(code, os.strerror(code), "/some/where")


OUTSIDE: dict[str, tuple[Exception, str]] = {
    "a full disk": (os_error(errno.ENOSPC), "cannot use /some/where, got no space .*make room"),
    "a place without rights": (os_error(errno.EACCES), "permission denied; choose another path"),
    "too many files": (os_error(errno.EMFILE), "too many open files; .*ulimit -n"),
    "a read-only place": (os_error(errno.EROFS), "choose another --out"),
    "a file that went": (os_error(errno.ENOENT), "no such file"),
    "an error without a number": (OSError("8 requested and 3 written"), "3 written; make room"),
    "no memory": (MemoryError(), "not enough memory, wanted"),
    "no memory for numpy": (MemoryError("Unable to allocate 8. EiB"), "not enough memory, got Unable"),
    "no memory for torch": (
        CannotAllocate("DefaultCPUAllocator: can't allocate memory"),
        "not enough memory",
    ),
    "no memory on a GPU": (CannotAllocate("CUDA out of memory. Tried"), "not enough memory"),
    "a link to itself": (RuntimeError("Symlink loop from '/a/b'"), "leads to itself, got /a/b"),
    "too deep": (RecursionError("maximum recursion depth"), "parts nested too deeply"),
    "nothing to fit to": (np.linalg.LinAlgError("Singular matrix"), "got Singular matrix, wanted data that"),
    "too large": (OverflowError("int too large to convert to float"), "int too large"),
    "bad input": (InputError("x", got=1, wanted=2), "x, got 1, wanted 2"),
}


@pytest.mark.parametrize("what", OUTSIDE)
def test_an_error_of_the_machine_is_one_line(
    what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error, words = OUTSIDE[what]
    app = new_app("test")

    @app.command()
    def fail() -> None:
        raise error

    @app.command()
    def other() -> None: ...

    monkeypatch.setattr("sys.argv", ["litho-test", "fail"])
    with pytest.raises(SystemExit) as stopped:
        run_app(app, "litho-test")
    (line,) = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 2
    with pytest.raises(InputError, match=words):
        raise InputError(line)


def test_a_defect_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    app = new_app("test")

    @app.command()
    def fail() -> None:
        raise KeyError("ours")

    @app.command()
    def other() -> None: ...

    monkeypatch.setattr("sys.argv", ["litho-test", "fail"])
    with pytest.raises(KeyError):
        run_app(app, "litho-test")


def run(words: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    code = f"from litho_data.commands.app import *\napp = new_app('t')\n{words}\nrun_app(app, 't')"
    command = [sys.executable, "-c", code, "say"]
    return subprocess.run(command, capture_output=True, env={**os.environ, **environment}, timeout=60)


SAY = "@app.command()\ndef say():\n    [print('0.1 µm') for _ in range({times})]\n"
SAY += "@app.command()\ndef other(): ..."


def test_a_terminal_without_the_micro_sign_gets_another_letter() -> None:
    done = run(SAY.format(times=1), PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stdout, done.stderr) == (0, b"0.1 ?m\n", b"")


def test_a_reader_that_closes_the_pipe_early_is_no_error() -> None:
    code = "from litho_data.commands.app import *\napp = new_app('t')\n"
    code += SAY.format(times=100_000) + "\nrun_app(app, 't')"
    with subprocess.Popen(
        [sys.executable, "-c", code, "say"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as writing:
        assert isinstance(writing.stdout, io.BufferedReader)
        writing.stdout.readline()
        writing.stdout.close()
        assert writing.stderr is not None
        assert writing.stderr.read() == b""
    assert writing.returncode == 1


class Kept(Result):
    SCHEMA = "test/kept/1"
    FILE_NAME = "kept.json"


READERS = {
    "a result": (Kept.read, "kept.json"),
    "settings": (read_settings, "settings.toml"),
    "a card": (load_card, "card.toml"),
    "a recipe": (Recipe.from_toml, "recipe.toml"),
}


@pytest.mark.parametrize("what", READERS)
def test_a_value_that_no_file_can_hold_is_one_line(what: str, tmp_path: Path) -> None:
    read, name = READERS[what]
    file = tmp_path / name
    toml = file.suffix == ".toml"
    os.mkfifo(file)
    with pytest.raises(InputError, match="a pipe or a device"):
        read(file)
    file.unlink()
    file.symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no such file"):
        read(file)
    file.unlink()
    deep, long = "[" * 100_000, "9" * 5_000
    for content in ("\x00", deep, long, '{"a": ' + deep, '{"a": ' + long + "}"):
        file.write_text(f"a = {content}" if toml else content)
        with pytest.raises(InputError) as said:
            read(file)
        assert "\n" not in str(said.value)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="bytes that are not text"):
        read(file)


def test_a_folder_under_a_pipe_cannot_be_written(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "nowhere").symlink_to(tmp_path / "there" / "not")
    (tmp_path / "itself").symlink_to(tmp_path / "itself")
    for name in ("pipe", "pipe/out", "nowhere", "itself"):
        words = "a file" if name == "pipe" else "cannot write"
        for place in (growing_folder(tmp_path / name, "a.json"), whole_folder(tmp_path / name)):
            with pytest.raises(InputError, match=words), place:
                pytest.fail("the work began")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 0.0, 1e300, 10**400, "0.1x", None, True])
def test_a_range_accepts_possible_numbers_only(value: object) -> None:
    assert DOSE.holds(1.0)
    assert DOSE.holds([0.5, 2])
    assert not DOSE.holds(value)
    with pytest.raises(InputError, match=r"^dose, got .*, wanted a number from 0.001 to 1000$"):
        DOSE.require("dose", [1.0, value])


@pytest.mark.parametrize("pitch", [PITCH_UM.low / 2, PITCH_UM.high * 2, float("nan"), 0.0])
def test_a_grid_refuses_an_impossible_pitch(pitch: float) -> None:
    for pitches in ((0.1, pitch), (pitch, 0.1)):
        with pytest.raises(InputError, match="grid pitch_um"):
            PixelGrid((4, 5), pitches)


def test_a_plain_name_is_never_a_path() -> None:
    for name in ("P11", "Probe 7", "Größe_µ", "007", "a.b-c+d", "x" * 200):
        assert is_plain_name(name), name
    wrong = [
        "",
        ".",
        "..",
        ".hidden",
        "-rf",
        "a/b",
        "..\\b",
        "C:x",
        "a\0b",
        "a\nb",
        " a",
        "a ",
        "a.",
        "x" * 201,
    ]
    for other in [*wrong, "~root", "a*", "\ud800", "a\u202eb", 7, None]:
        assert not is_plain_name(other), other
