"""Run commands in parallel processes with one thread each. Commands whose result exists are skipped."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from litho_data.foundation.errors import InputError
from litho_data.sharing.workers import HERE, ONE_THREAD, Workers, run_jobs

_BIN = Path(sys.executable).parent


@dataclass(frozen=True)
class Job:
    """One command to run. It has a name, a command line, and a result, which is the file or folder that it
    writes last.
    """

    name: str
    command: tuple[str, ...]
    result: Path

    @property
    def done(self) -> bool:
        """Return whether the result exists. It is complete if it exists, because commands put it in place
        last.
        """
        return self.result.exists()


def run_commands(jobs: Sequence[Job], logs: Path, workers: Workers = HERE) -> None:
    """Run the unfinished jobs, and print a line when a job ends.

    Raises:
        InputError: a job failed. Before this error is raised, jobs that have already started are finished.
    """
    todo = [job for job in jobs if not job.done]
    if len(todo) < len(jobs):
        print(f"{len(jobs) - len(todo)} of {len(jobs)} jobs were already finished", flush=True)
    steps = [(job, _log(logs, job.name)) for job in todo]
    done = run_jobs(_run, steps, workers, name=lambda step: step[0].name, apart=True)
    for place, ((job, log), seconds) in enumerate(done, 1):
        if seconds is None:
            done.close()
            raise InputError(f"step {job.name}", got="a failed command", hint=f"its output is in {log}")
        print(f"[{place}/{len(todo)}] {job.name}: {seconds / 60:.1f} min", flush=True)


def command(program: str, *words: object) -> tuple[str, ...]:
    """Return the command line that runs a program of this Python environment."""
    return (str(_BIN / program), *map(str, words))


def design_command(*words: object) -> tuple[str, ...]:
    """Return the command line of a command of ``litho-design``."""
    return command("litho-design", *words)


def _run(step: tuple[Job, Path]) -> float | None:
    """Run one command, and return the time that it took in seconds, or None if it failed."""
    (job, log), started = step, time.monotonic()
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as stream:
        print(f"$ {shlex.join(job.command)}", file=stream, flush=True)
        # Parallel processes use the cores better than threads within one process.
        code = subprocess.run(
            job.command, stdout=stream, stderr=stream, env={**os.environ, **ONE_THREAD}
        ).returncode
    return None if code or not job.done else time.monotonic() - started


def _log(logs: Path, name: str) -> Path:
    return logs / f"{name.replace('/', '-')}.txt"
