"""Run the trials of a board in parallel processes.

An interrupted run can be continued. A failed trial does not stop the other trials.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.blind_trials.trial import run_trial, trial_folder
from litho_data.foundation.errors import InputError
from litho_data.sharing.workers import ONE_THREAD, Workers, run_jobs
from litho_models.boards.board import name_of, trial_line
from litho_models.boards.judging import failed
from litho_models.boards.records import Draw, Draws, Trial

_ROOT = Path(__file__).parents[2]


def open_campaign(out: Path, draws: Draws) -> None:
    """Write the draws to ``out/draws.json`` before any trial is run.

    Raises:
        InputError: ``out`` contains trials with other settings.
    """
    if not (out / Draws.FILE_NAME).exists():
        draws.write(out)
    elif Draws.read(out) != draws:
        raise InputError(
            f"campaign in {out}",
            got="trials with other settings",
            wanted="trials with the same settings",
            hint="choose another --out",
        )


def finished(out: Path, draws: Draws) -> list[Trial]:
    """Return the finished trials, including failed ones, in the order in which they were drawn."""
    folders = (trial_folder(out, draw) for draw in draws.trials)
    return [Trial.read(folder) for folder in folders if (folder / Trial.FILE_NAME).exists()]


def run_campaign(
    out: Path,
    draws: Draws,
    *,
    numbers: Sequence[int],
    workers: Workers,
    timeout_s: float,
    options: Sequence[str] = (),
) -> None:
    """Run the unfinished trials among ``numbers``, and print a line when a trial ends.

    A trial is recorded as failed if its process dies or runs longer than ``timeout_s``. The words in
    ``options`` are appended to the command that runs a trial.

    Raises:
        InputError: there is no trial with one of the numbers, or the workers are not available.
    """
    unknown = set(numbers) - {draw.number for draw in draws.trials}
    if unknown:
        raise InputError("trials", got=sorted(unknown), wanted=f"numbers below {len(draws.trials)}")
    done = {trial.draw.number for trial in finished(out, draws)}
    todo = [draw for draw in draws.trials if draw.number in set(numbers) - done]
    if len(todo) < len(set(numbers)):
        print(f"{len(set(numbers)) - len(todo)} trials were already finished", flush=True)
    jobs = [_Job(out, draw, timeout_s, options) for draw in todo]
    results = run_jobs(_run_apart, jobs, workers, name=lambda job: f"trial {job.draw.number}", apart=True)
    for place, (_, (trial, seconds)) in enumerate(results, 1):
        print(f"[{place}/{len(todo)}] {trial_line(trial)} ({seconds:.0f} s)", flush=True)


def run_one(out: Path, number: int, *, measured: Path | None, keep_data: bool) -> None:
    """Run one trial in this process. The draws must have been written by ``open_campaign``."""
    draws = Draws.read(out)
    draw = next(draw for draw in draws.trials if draw.number == number)
    run_trial(draw, draws, out, measured=measured, keep_data=keep_data, report=_print)


def _print(message: str) -> None:
    print(message, flush=True)


class _Job(NamedTuple):
    out: Path
    draw: Draw
    timeout_s: float
    options: Sequence[str]


def _run_apart(job: _Job) -> tuple[Trial, float]:
    """Run a trial in a separate process, whose output is written to a log file. Return the trial and the time
    that it took in seconds.
    """
    out, draw, timeout_s, options = job
    folder, clock = trial_folder(out, draw), time.monotonic()
    command = [sys.executable, "-m", "benchmarks.blind_trials", "--out", str(out.resolve())]
    command += ["--run-one", str(draw.number), *options]
    log = out / "logs" / f"{name_of(draw)}.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w", encoding="utf-8") as stream:
        try:
            code = subprocess.run(
                command,
                cwd=_ROOT,
                # Several trials at once use the cores better than several threads in one trial.
                env=os.environ | ONE_THREAD,
                stdout=stream,
                stderr=subprocess.STDOUT,
                timeout=timeout_s,
            ).returncode
            reason = f"the process ended with exit code {code}"
        except subprocess.TimeoutExpired:
            reason = f"not finished after {timeout_s:g} s"
    if not (folder / Trial.FILE_NAME).exists():
        failed(draw, reason).write(folder)
    return Trial.read(folder), time.monotonic() - clock
