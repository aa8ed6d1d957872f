"""Commands as processes: side by side, one thread each, skipped where their result exists."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from litho_data.foundation.errors import InputError

_BIN = Path(sys.executable).parent
# One thread per process: processes side by side use the cores better than threads within one.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Job:
    """One command, the file or folder that shows it is done, and what it is called in the log."""

    name: str
    command: tuple[str, ...]
    result: Path

    @property
    def done(self) -> bool:
        """Whether the result is there; commands write theirs last and as a whole."""
        return self.result.exists()


def run_jobs(jobs: Sequence[Job], logs: Path, workers: int) -> None:
    """Run the jobs that are not done, ``workers`` at a time; a line per job as it ends.

    Raises:
        InputError: a job failed; the others that had started come to their end first.
    """
    todo = [job for job in jobs if not job.done]
    if len(todo) < len(jobs):
        print(f"{len(jobs) - len(todo)} of {len(jobs)} done before", flush=True)
    failed: list[str] = []
    with ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(_run, job, logs, failed): job for job in todo}
        for place, future in enumerate(as_completed(running), 1):
            if seconds := future.result():
                print(f"[{place}/{len(todo)}] {running[future].name}: {seconds / 60:.1f} min", flush=True)
    if failed:
        raise InputError(
            f"step {failed[0]}", got="a failed command", hint=f"its output is in {_log(logs, failed[0])}"
        )


def command(program: str, *words: object) -> tuple[str, ...]:
    """A program of this environment as a command."""
    return (str(_BIN / program), *map(str, words))


def design_command(*words: object) -> tuple[str, ...]:
    """A command of ``litho-design``."""
    return command("litho-design", *words)


def module_command(*words: object) -> tuple[str, ...]:
    """This benchmark itself as a command."""
    return (sys.executable, "-m", "benchmarks.gap", *map(str, words))


def _run(job: Job, logs: Path, failed: list[str]) -> float:
    """Seconds that the command took; 0 where it was not run or failed."""
    if failed:
        return 0.0
    log, started = _log(logs, job.name), time.monotonic()
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as stream:
        print(f"$ {shlex.join(job.command)}", file=stream, flush=True)
        code = subprocess.run(
            job.command, stdout=stream, stderr=stream, env={**os.environ, **_ONE_THREAD}
        ).returncode
    if code or not job.done:
        failed.append(job.name)
        return 0.0
    return time.monotonic() - started


def _log(logs: Path, name: str) -> Path:
    return logs / f"{name.replace('/', '-')}.txt"
