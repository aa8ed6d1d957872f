"""Jobs for the tests of workers; processes that run them import nothing but this."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts

Job = tuple[int, list[int]]


def large(count: int) -> dict[str, list[int]]:
    """What jobs may know."""
    return {"all": list(range(count))}


def told(job: Job) -> tuple[list[int], int, tuple[str, str, str | None]]:
    """The known list, its entry of this number, and what a result would record."""
    number, known = job
    return known, known[number], (run_facts()["command"], os.getcwd(), os.environ.get("OMP_NUM_THREADS"))


def refuse(number: int) -> None:
    raise InputError(f"job {number}", got="nothing", wanted="something")


def die_once(job: tuple[int, Path]) -> int:
    """Job 2 kills its process the first time, and leaves a mark."""
    number, mark = job
    if number == 2 and not mark.exists():
        mark.touch()
        die(number)
    return number


def die_at_first(job: tuple[int, int, Path]) -> int:
    """Kills its process so many times, then answers; one mark for each time."""
    number, deaths, marks = job
    for death in range(deaths):
        if not (mark := marks / f"{number}.{death}").exists():
            mark.touch()
            die(number)
    return number


def die(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def new_pages(mib: int) -> int:
    """Pages that this process is given while it makes and frees an array of so many MiB twenty times."""
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        bytearray(mib << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
