"""Jobs for the tests of workers. The processes that run these jobs import no other test module."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts

Job = tuple[int, list[int]]


def large(count: int) -> dict[str, list[int]]:
    """Return a large object, which all jobs may read."""
    return {"all": list(range(count))}


def told(job: Job) -> tuple[list[int], int, tuple[str, str, str | None]]:
    """Return the list that all jobs share, the entry of this list for this job, and facts about the run."""
    number, known = job
    return known, known[number], (run_facts()["command"], os.getcwd(), os.environ.get("OMP_NUM_THREADS"))


def refuse(number: int) -> None:
    raise InputError(f"job {number}", got="nothing", wanted="something")


def die_once(job: tuple[int, Path]) -> int:
    """Return the number of the job. On the first try of job 2, leave a mark and kill the process instead."""
    number, mark = job
    if number == 2 and not mark.exists():
        mark.touch()
        die(number)
    return number


def die_at_first(job: tuple[int, int, Path]) -> int:
    """On each of the first ``deaths`` tries, leave a mark and kill the process. Then return the number."""
    number, deaths, marks = job
    for death in range(deaths):
        if not (mark := marks / f"{number}.{death}").exists():
            mark.touch()
            die(number)
    return number


def die(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def new_pages(mib: int) -> int:
    """Count the new memory pages that the process gets while it makes and frees ``mib`` MiB 20 times."""
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        bytearray(mib << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
