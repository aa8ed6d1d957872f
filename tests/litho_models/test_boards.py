"""Test blind boards for any loop: what they hide, how the judge rates answers, and a plain loop."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from examples.plain_loop import plain_loop
from litho_data.foundation.errors import InputError
from litho_data.store import open_store
from litho_models.boards import board as boards
from litho_models.boards.board import HIDDEN, STORES, command_loop, judge_board, new_board
from litho_models.boards.draws import names_of
from litho_models.boards.figures import figure_lines
from litho_models.boards.records import Answer, CauseDraw, Draw, Found, Hidden, Planted
from litho_models.cli.app import main

CAUSE = CauseDraw(name="vignetting", wanted_rms_nm=20.0)
DRAWS = [
    Draw(number=0, kind="in-form", seed=3, causes=[CAUSE]),
    Draw(number=1, kind="empty", seed=4, causes=[]),
]
EXAMPLE = f"{sys.executable} {Path(__file__).parents[2] / 'examples' / 'plain_loop.py'}"


def at_half_its_limit(draw: Draw, jobs: object, base: str) -> list[Planted]:
    """Plant every cause at half its largest strength, without a search for the strength."""
    return [
        Planted(draw=one, names=[*names_of(one.name)], strength=0.5, unit="1", at_limit=False, rms_nm=40.0)
        for one in draw.causes
    ]


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boards") / "board"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(boards, "draw_board", lambda board, seed: DRAWS)
        patch.setattr(boards, "plant", at_half_its_limit)
        new_board(folder, n_scans=6, size_px=128)
    return folder


def test_a_board_gives_stores_to_the_loop_and_hides_the_causes(board):
    assert sorted(path.name for path in (board / STORES).iterdir()) == ["00.zarr", "01.zarr"]
    planted = Hidden.read(board / HIDDEN / "00").planted
    assert [one.names for one in planted] == [["vignetting"]]
    assert Hidden.read(board / HIDDEN / "01").planted == []
    for store in (board / STORES).iterdir():
        # Registration may fail on such small fields.
        assert len(open_store(store).scans()) >= 4
        # No file of a store contains the name of a cause or its strength.
        texts = [file.read_bytes() for file in store.rglob("*.json")]
        assert texts
        assert not any(b"vignetting" in text or b"strength" in text for text in texts)


def test_a_board_of_other_settings_is_refused(board):
    with pytest.raises(InputError, match="seed"):
        new_board(board, seed=1, n_scans=6, size_px=128)


@pytest.mark.parametrize(
    ("answer", "wanted", "false"),
    [
        (Answer(found=[Found(names=["vignetting"], knowledge="cause")]), ["right", "false-positive"], [0, 1]),
        (Answer(left=True), ["noticed", "false-positive"], [0, 0]),
        (Answer(), ["missed", "clean"], [0, 0]),
        # A single error cannot be compared with anything.
        (Answer(after_nm=20), ["missed", "clean"], [0, 0]),
    ],
)
def test_the_judge_compares_names_with_what_is_hidden(board, tmp_path, answer, wanted, false):
    scoreboard = judge_board(board, tmp_path / "judged", lambda store, folder: answer)
    assert [one.verdict for trial in scoreboard.trials for one in trial.outcomes] == wanted
    assert [len(trial.false_names) for trial in scoreboard.trials] == false


def test_a_trial_has_the_errors_of_the_loop_and_of_the_true_models(board, tmp_path):
    """Check that a trial records two errors: the error that the loop states, and the error of the true
    models, which is the noise.
    """
    said = iter([Answer(before_nm=30, after_nm=20), Answer(before_nm=30, after_nm=10)])
    first, second = judge_board(board, tmp_path / "one", lambda store, folder: next(said)).trials
    assert first.errors is not None
    assert second.errors is not None
    assert (first.errors.after_nm, second.errors.after_nm) == (20, 10)
    # This is the fab's default noise in nm.
    assert 1 < second.errors.floor_nm < 15


def test_an_error_in_a_loop_is_its_result_and_a_judged_trial_is_kept(board, tmp_path, capfd):
    asked: list[str] = []

    def loop(store: Path, folder: Path) -> Answer:
        asked.append(store.name)
        if len(asked) == 1:
            raise ValueError("no idea")
        if len(asked) == 2:
            raise KeyboardInterrupt
        return Answer()

    with pytest.raises(KeyboardInterrupt):
        judge_board(board, tmp_path / "judged", loop)
    first, second = judge_board(board, tmp_path / "judged", loop).trials
    assert asked == ["00.zarr", "01.zarr", "01.zarr"]
    assert (first.failure, first.outcomes[0].verdict) == ("ValueError: no idea", "failed")
    assert second.outcomes[0].verdict == "clean"
    assert "no idea" in capfd.readouterr().err
    with pytest.raises(InputError, match="loop"):
        judge_board(board, tmp_path / "judged", plain_loop)


def test_a_plain_loop_names_a_strong_cause_by_its_command(board, tmp_path, monkeypatch, capsys):
    """Run the example as a user would, and check that the command prints the scoreboard."""
    words = ["litho-models", "board", "judge", str(board), "--out", str(tmp_path / "j"), "--loop", EXAMPLE]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit, match="0"):
        main()
    printed = capsys.readouterr().out
    scoreboard = judge_board(board, tmp_path / "j", name=EXAMPLE)
    assert printed.startswith("\n".join(figure_lines(scoreboard)))
    strong = scoreboard.trials[0]
    assert [one.verdict for one in strong.outcomes] == ["right"]
    # The cause is responsible for most of the error, and only the covariate "vignetting" has its form.
    assert strong.errors.after_nm < 0.5 * strong.errors.before_nm
    assert strong.found == plain_loop(board / STORES / "00.zarr", tmp_path).found


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("no-such-program here", "a program"),
        ("'", "got ', wanted a program"),
        (f"{sys.executable} '1", "a program"),
        (f"{sys.executable} -c 1/0", "exit code 1"),
    ],
)
def test_a_command_that_cannot_be_run_is_told(command, said, tmp_path):
    with pytest.raises(InputError, match=said):
        command_loop(command)(tmp_path, tmp_path)
