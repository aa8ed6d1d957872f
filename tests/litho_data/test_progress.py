"""Check that the estimated remaining time is right within a factor of two, with any number of processes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from litho_data.commands import progress as module
from litho_data.commands.app import new_app, run_app
from litho_data.commands.progress import progress, say, say_estimate

# The number of items, the number processed at once, the seconds per item, and the start-up time of workers.
WORK = {
    "one by one": (40, 1, 4.0, 0.0),
    "short ones": (20_000, 1, 0.01, 0.0),
    "short ones after a long start": (20_000, 2, 0.02, 8.0),
    "by eight": (100, 8, 10.0, 3.0),
    "by eight, once and a half": (12, 8, 200.0, 3.0),
    "few long ones": (3, 1, 100.0, 0.0),
}


class Clock:
    """Provide a clock that only the simulated work advances."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


@pytest.mark.parametrize("work", WORK)
def test_an_estimate_is_within_a_factor_of_two(
    work: str, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    count, at_once, each_s, start_s = WORK[work]
    said: list[tuple[float, float]] = []
    monkeypatch.setattr(module, "say_estimate", lambda what, left_s: said.append((left_s, clock.now_s)))

    def results() -> Iterator[int]:
        began_s = clock.now_s + start_s
        for number in range(count):
            clock.now_s = began_s + (number // at_once + 1) * each_s
            yield number

    assert list(progress(results(), work, count, at_once=at_once)) == list(range(count))
    ((estimated_s, told_s),) = said
    assert 0.5 <= estimated_s / (clock.now_s - told_s) <= 2


def silent() -> None:
    """Work until a line is printed."""
    until_s = time.monotonic() + 20
    while module._silent.is_set() and time.monotonic() < until_s:
        time.sleep(0.01)


def spoken() -> None:
    """Report progress, then work silently for longer than a command is allowed to."""
    say("working")
    time.sleep(1)


@pytest.mark.parametrize(
    ("work", "within_s", "said"),
    [(silent, 0.01, "litho-test is at work\n"), (spoken, 0.5, "working\n"), (list, 60.0, "")],
)
def test_a_silent_command_is_reported_to_be_at_work(
    work: Callable[[], object],
    within_s: float,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert module._SILENT_S <= 3
    monkeypatch.setattr(module, "_SILENT_S", within_s)
    app = new_app("test")

    @app.command()
    def begin() -> None:
        work()

    @app.command()
    def other() -> None: ...

    monkeypatch.setattr("sys.argv", ["litho-test", "begin"])
    with pytest.raises(SystemExit):
        run_app(app, "litho-test")
    assert capsys.readouterr().err == said


def test_no_estimate_is_given_below_one_minute(capsys: pytest.CaptureFixture[str]) -> None:
    for seconds, words in ((59.0, ""), (150.0, "about 2 min"), (9000.0, "about 2.5 h")):
        say_estimate("it", seconds)
        assert words in (said := capsys.readouterr().err)
        assert bool(said) is bool(words)
