"""Determine the command line that results record, and show the progress of a command on stderr."""

import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from litho_data.foundation.run_facts import running_command

T = TypeVar("T")
# Shortest elapsed time from which the remaining time is estimated, and shortest remaining time that is
# reported, in seconds.
_TELLING_S, _MINUTE_S = 3.0, 60.0
# A command that has printed nothing for this time, in seconds, reports that it is at work. Users wait for
# five seconds, because the command also takes time to start.
_SILENT_S = 3.0
_silent = threading.Event()


def run_script(main: Callable[[], T]) -> T:
    """Run the main function of a script, so that its results record the script's command line."""
    with running_command(command_line()):
        return main()


def given_words() -> list[str]:
    """Return the words after the program's name on the command line."""
    return sys.argv[1:]


def command_line(program: str | None = None) -> str:
    """Return the command line that started this process. It begins with ``program``, or by default with the
    name of the script or module.
    """
    if program is None:
        module = sys.modules["__main__"].__spec__
        started = (
            ["python", "-m", module.name.removesuffix(".__main__")] if module else [Path(sys.argv[0]).name]
        )
    else:
        started = [program]
    return shlex.join([*started, *given_words()])


def progress(
    items: Iterable[T],
    what: str,
    total: int | None = None,
    *,
    estimate_of: int | None = None,
    at_once: int = 1,
) -> Iterator[T]:
    """Iterate over items, and show a progress bar on stderr if stderr is a terminal.

    If the remaining items will take more than a minute, one line states the remaining time as soon as it can
    be estimated. The first ``at_once`` items include start-up, so their time is left out of the estimate
    unless it exceeds a minute.

    Args:
        items: the items to iterate over. ``what`` is a text that says what is done with them.
        total: number of items, if ``len`` does not give it.
        estimate_of: number of items that the estimate covers; by default all. 0 means no estimate.
        at_once: number of items that are processed at the same time.
    """
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    count = total if total is not None else len(items) if isinstance(items, Sized) else 0
    wanted = count if estimate_of is None else estimate_of
    shown = track(items, description=what, total=total, console=console, disable=not console.is_terminal)
    before, since = 0, time.monotonic()
    for done, item in enumerate(shown, start=1):
        yield item
        now = time.monotonic()
        if done == at_once and now - since < _MINUTE_S:
            before, since = done, now
        elif wanted and done - before >= at_once and now - since > _TELLING_S:
            say_estimate(what, (now - since) / (done - before) * (wanted - done))
            wanted = 0


def say(what: str) -> None:
    """Print one line on stderr that names the work about to begin, so that users know what they are waiting
    for.
    """
    _silent.clear()
    print(what, file=sys.stderr, flush=True)


@contextmanager
def never_silent(name: str) -> Iterator[None]:
    """If a command prints nothing in its first seconds, print that it is at work."""

    def speak() -> None:
        if _silent.is_set():
            say(f"{name} is at work")

    _silent.set()
    waiting = threading.Timer(_SILENT_S, speak)
    waiting.daemon = True
    waiting.start()
    try:
        yield
    finally:
        waiting.cancel()


def say_estimate(what: str, seconds: float) -> None:
    """If some work will take more than a minute, print one line on stderr with the expected time."""
    if seconds > _MINUTE_S:
        span = f"{seconds / 3600:.1f} h" if seconds > 3600 else f"{seconds / _MINUTE_S:.0f} min"
        say(f"estimate: {what} will take about {span} more")
