"""Make a blind board and judge a loop on it. A board consists of simulated dataset stores and a record of
their hidden causes of error. A loop is any program that reads such a store and names the causes that it
finds.
"""

from __future__ import annotations

import resource
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from litho_data.commands.progress import command_line, progress
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.making.build import build_dataset
from litho_data.store import open_store
from litho_data.virtual_fab.jobs import Plan
from litho_models.boards.draws import draw_board
from litho_models.boards.figures import make_scoreboard, trial_table
from litho_models.boards.judging import broken, judged
from litho_models.boards.own_loop import own_loop
from litho_models.boards.planting import plant, trial_jobs, write_raw
from litho_models.boards.records import Answer, Board, Draw, Draws, Hidden, Scoreboard, Trial

# Base model that the loop corrects. On the board ``singles``, the Physics model can represent every printer.
# The board ``mixtures`` also has printers that the Physics model cannot represent. On this board, the loop
# therefore chooses the best base model itself.
BASE: dict[Board, str] = {"singles": "physics", "mixtures": "auto"}
STORES, HIDDEN, TRIALS = "stores", "hidden", "trials"
# A function that maps a dataset store and an empty working folder to the loop's answer.
Loop = Callable[[Path, Path], Answer]


def make_draws(*, board: Board, seed: int, n_scans: int, size_px: int, base: str) -> Draws:
    """Choose at random which causes each trial of a board contains.

    Raises:
        InputError: no trials can be drawn with these settings, or the fields have a size that cannot be
            simulated.
    """
    # This call raises an error for impossible field sizes now, before a trial fails on them.
    Plan(n_scans, (size_px, size_px))
    trials = draw_board(board, seed)
    return Draws(board=board, seed=seed, n_scans=n_scans, size_px=size_px, base=base, trials=trials)


def new_board(
    out: str | Path,
    *,
    board: Board = "singles",
    seed: int = 0,
    trials: int | None = None,
    n_scans: int = 12,
    size_px: int = 256,
) -> Draws:
    """Make the dataset stores of a board in ``out/stores`` and write the hidden causes of each store to
    ``out/hidden``. If the call is interrupted, repeating it resumes the work.

    Args:
        out: folder of the board.
        board: ``singles`` (one cause per trial) or ``mixtures`` (two to four causes per trial). On each
            board, some trials have no cause.
        seed: determines all random draws.
        trials: number of trials to make, starting with the first drawn trial; None makes all trials.
        n_scans: number of scans in each store.
        size_px: side length of a layout, in pixels.

    Raises:
        InputError: no trials can be drawn with these settings, or ``out`` holds another board.
    """
    drawn = make_draws(board=board, seed=seed, n_scans=n_scans, size_px=size_px, base=BASE[board])
    # Trials that add causes to measured prints are left out, because they need a store of measured prints.
    kept = [draw for draw in drawn.trials if draw.kind != "measured"][:trials]
    draws = drawn.model_copy(update={"trials": kept})
    facts = draws.model_dump(mode="json", exclude={"schema_"})
    with growing_folder(out, Draws.FILE_NAME, facts) as begun:
        for draw in progress(kept, "printing and scanning"):
            hidden, store = begun.folder / HIDDEN / name_of(draw), store_of(begun.folder, draw)
            if not (hidden / Hidden.FILE_NAME).exists():
                jobs = trial_jobs(draw, n_scans, size_px)
                planted = plant(draw, jobs, draws.base)
                store.parent.mkdir(exist_ok=True)
                with tempfile.TemporaryDirectory() as place:
                    made = Path(place) / store.name
                    build_dataset(write_raw(draw, planted, jobs, Path(place) / "raw"), made)
                    shutil.rmtree(store, ignore_errors=True)
                    shutil.move(made, store)
                Hidden(planted=planted).write(hidden)
        draws.write(begun.folder)
    return draws


def judge_board(
    board: str | Path,
    out: str | Path,
    loop: Loop | None = None,
    *,
    name: str | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> Scoreboard:
    """Give every store of a board to a loop, judge the answers of the loop, and write ``scoreboard.json`` and
    ``scoreboard.csv``.

    If the loop raises an error, the current trial counts as failed, and the board continues with the next
    trial. If the call is interrupted, repeat it to resume the work.

    Args:
        board: folder written by ``new_board``.
        out: folder for the results; the files that the loop writes are kept in one folder per trial.
        loop: function that receives the path of a store and the path of an empty folder. It returns an
            answer. The default is the closed loop of this package.
        name: name of the loop. It is written to the scoreboard.
        report: function that receives the progress messages of the default loop.

    Raises:
        InputError: ``board`` holds no board, or ``out`` holds the trials of another board or of a loop with
            another name.
    """
    source = Path(board)
    draws = Draws.read(source)
    asked = loop or partial(own_loop, base=draws.base, report=report)
    usual = getattr(loop, "__name__", "a loop") if loop else "litho-models close-loop"
    facts = {"draws_sha256": file_sha256(source / Draws.FILE_NAME), "loop": name or usual}
    with growing_folder(out, Scoreboard.FILE_NAME, facts) as begun:
        for draw in progress(draws.trials, "judging"):
            folder = begun.folder / TRIALS / name_of(draw)
            if not (folder / Trial.FILE_NAME).exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                trial = _trial(draw, draws, source, folder, asked)
                trial.write(folder)
                report(trial_line(trial))
        done = [Trial.read(begun.folder / TRIALS / name_of(draw)) for draw in draws.trials]
        scoreboard = make_scoreboard(draws, done, command_line()).model_copy(update=facts)
        trial_table(scoreboard).to_csv(begun.folder / "scoreboard.csv", index=False)
        scoreboard.write(begun.folder)
    return scoreboard


def command_loop(command: str) -> Loop:
    """Make a loop function that runs a command. Two arguments are appended to the command: the path of a
    store, and the path of an empty folder. The command must write its answer to the file answer.json in this
    folder.

    Raises:
        InputError: the command cannot be run. The returned function raises the same error if the exit code of
            the command is not 0 or if the answer is missing.
    """
    try:
        words = shlex.split(command)
    except ValueError:  # a quotation mark without its partner
        words = []
    if not words or not shutil.which(words[0]):
        wanted = "a program that can be run, with its arguments"
        raise InputError("command that runs the loop", got=command or "nothing", wanted=wanted)

    def loop(store: Path, folder: Path) -> Answer:
        code = subprocess.run([*words, str(store), str(folder)], check=False).returncode
        if code:
            raise InputError(command, got=f"exit code {code}", wanted="exit code 0")
        return Answer.read(folder / Answer.FILE_NAME)

    return loop


def _trial(draw: Draw, draws: Draws, board: Path, folder: Path, loop: Loop) -> Trial:
    planted = Hidden.read(board / HIDDEN / name_of(draw)).planted
    store, started_s = store_of(board, draw), cpu_s()
    try:
        answer = loop(store, folder)
        used_s = cpu_s() - started_s
        jobs = trial_jobs(draw, draws.n_scans, draws.size_px)
        return judged(draw, planted, answer, jobs, open_store(store), used_s)
    except Exception as error:
        return broken(draw, error, planted, {folder: "OUT", board: "BOARD"})


def name_of(draw: Draw) -> str:
    """Return the name of the files and folders of a trial: its number, with two digits."""
    return f"{draw.number:02d}"


def store_of(board: Path, draw: Draw) -> Path:
    """Return the path of the store that the loop receives for this trial."""
    return board / STORES / f"{name_of(draw)}.zarr"


def cpu_s() -> float:
    """Return the CPU time, in seconds, that this process and its finished child processes have used."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def trial_line(trial: Trial) -> str:
    """Describe a judged trial in one line. The line states the outcome of each planted cause and the causes
    that the loop named wrongly. It also states the error of the corrected model divided by the error of the
    true models. For a failed trial, it also states the reason for the failure.
    """
    causes = [f"{one.name}: {one.verdict}" for one in trial.outcomes]
    false = [f"false name: {name}" for name in trial.false_names]
    ratio = trial.errors and trial.errors.ratio
    errors = [f"error {ratio:.2f} × that of the true models"] if ratio else []
    reason = [trial.failure] if trial.failure else []
    return f"trial {trial.draw.number}: {', '.join([*causes, *false, *errors, *reason])}"
