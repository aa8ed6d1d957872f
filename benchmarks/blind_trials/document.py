"""The scoreboard as text for the documentation, written between two marks of a Markdown page."""

from __future__ import annotations

from pathlib import Path

from benchmarks.blind_trials.records import Outcome, Planted, Scoreboard, Trial
from benchmarks.blind_trials.scoreboard import COUNTS_FROM_RMS_NM
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file

START, END = "<!-- scoreboard: written by the command -->", "<!-- end of scoreboard -->"
_HEAD = (
    "| trial | planted | rms, nm | outcome | named by the loop | before → after, nm | floor, nm | ratio |\n"
    "|---|---|---|---|---|---|---|---|"
)


def publish(page: Path, scoreboard: Scoreboard) -> None:
    """Put the scoreboard into the page, in place of the one that was there.

    Raises:
        InputError: trials that have not been run, or a page without the two marks in this order.
    """
    if scoreboard.pending:
        raise InputError("scoreboard to publish", got=f"pending trials {scoreboard.pending}", wanted="none")
    text = page.read_text(encoding="utf-8")
    before, _, after = _parts(page, text)
    with atomic_file(page) as temporary:
        temporary.write_text(f"{before}{START}\n{as_markdown(scoreboard)}\n{END}{after}", encoding="utf-8")


def published(page: Path) -> str:
    """What stands between the marks.

    Raises:
        InputError: a page without the two marks in this order.
    """
    return _parts(page, page.read_text(encoding="utf-8"))[1].strip("\n")


def as_markdown(scoreboard: Scoreboard) -> str:
    """Command, figures and one row per planted effect."""
    rows = [row for trial in scoreboard.trials for row in _rows(trial)]
    figures = "\n".join(f"| {what} | {value} |" for what, value in figures_of(scoreboard))
    return (
        f"```\n{scoreboard.command}\n```\n\n"
        f"| | |\n|---|---|\n{figures}\n\n{_HEAD}\n" + "\n".join(rows) + _footnotes(scoreboard)
    )


def figures_of(scoreboard: Scoreboard) -> list[tuple[str, str]]:
    """The figures that count, in words."""
    s = scoreboard.summary
    size = f"above {s.counts_from_rms_nm:g} nm"
    return [
        (f"one effect {size}: right, or a set that contains it", str(s.single_found)),
        (f"… not found, and declared not testable by the loop ({size})", str(s.single_not_testable)),
        (f"all effects {size}, pairs included: right, or a set that contains it", str(s.effects_found)),
        ("… of these without a false name beside it", str(s.without_stranger)),
        ("no effect planted: none reported", str(s.clean)),
        ("outside the catalogue: no cause named, and something noticed", str(s.honest)),
        (f"error after at most {s.floor_tolerance:g} × that of the true models", str(s.at_floor)),
        ("trials that failed", str(s.failed)),
    ]


def _rows(trial: Trial) -> list[str]:
    planted: list[Planted | None] = [*trial.planted] or [None] * len(trial.outcomes)
    pairs = zip(trial.outcomes, planted, strict=True)
    return [_row(trial, outcome, one, first=i == 0) for i, (outcome, one) in enumerate(pairs)]


def _row(trial: Trial, outcome: Outcome, planted: Planted | None, *, first: bool) -> str:
    size = f"{outcome.rms_nm:.1f}" if planted else "–"
    limit = " (limit)" if planted and planted.at_limit else ""
    name = planted.name if planted else outcome.effect
    outside = " (outside the catalogue)" if trial.draw.kind == "off-catalogue" else ""
    named = "; ".join(" or ".join(n.names) for n in trial.named) or "–"
    if not first:
        shared = ["", "", "", ""]
    elif trial.errors is None:
        shared = ["–", "–", "–", "–"]
    else:
        e = trial.errors
        change = f"{e.before.mae_nm:.2f} → {e.after.mae_nm:.2f}"
        shared = [named, change, f"{e.floor.mae_nm:.2f}", f"{e.mae_to_floor:.2f}"]
    number = str(trial.draw.number) if first else ""
    cells = [number, name + outside, size + limit, outcome.judgement, *shared]
    return "| " + " | ".join(cells) + " |"


def _footnotes(scoreboard: Scoreboard) -> str:
    notes = [f"Trial {t.draw.number} failed: {t.failure}" for t in scoreboard.trials if t.failure]
    if any(one.at_limit for trial in scoreboard.trials for one in trial.planted):
        notes.insert(0, "(limit): the knob's range ends before the drawn size; its largest value is used.")
    if any(outcome.rms_nm <= COUNTS_FROM_RMS_NM for t in scoreboard.trials for outcome in t.outcomes):
        notes.insert(0, f"Effects of at most {COUNTS_FROM_RMS_NM:g} nm are listed and not counted.")
    return "".join(f"\n\n{note}" for note in notes)


def _parts(page: Path, text: str) -> tuple[str, str, str]:
    before, start, rest = text.partition(START)
    inside, end, after = rest.partition(END)
    if not start or not end:
        raise InputError(f"marks in {page}", got="not both", wanted=f"{START} … {END}")
    return before, inside, after
