"""The scoreboard: all draws with their outcomes, the few figures that count, and their text for the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from benchmarks.blind_trials.records import (
    COUNTS_FROM_RMS_NM,
    EMPTY,
    OTHER_FORM,
    Draws,
    Outcome,
    Planted,
    Scoreboard,
    Summary,
    Tally,
    Trial,
)
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file
from litho_data.foundation.run_facts import run_info

TOLERANCE_IN_FORM, TOLERANCE_OTHER = 1.05, 1.3
_FOUND = ("right", "set-contains-it")
_NOTICED = ("traced-to-covariate", "partial", "unexplained")
_UNNOTICED = ("missed", "failed")
_HEAD = (
    "| trial | planted | rms, nm | outcome | named by the loop | before → after, nm | floor, nm | ratio |\n"
    "|---|---|---|---|---|---|---|---|"
)
_END = "<!-- end of scoreboard -->"


def make_scoreboard(draws: Draws, trials: Sequence[Trial], command: str) -> Scoreboard:
    """The scoreboard of a campaign from its finished trials; ``command`` makes it again."""
    run = run_info([draws.seed], draws.n_scans)
    done = {trial.draw.number for trial in trials}
    return Scoreboard(
        command=command,
        commit=run.commit,
        versions=run.versions,
        seed=draws.seed,
        n_scans=draws.n_scans,
        size_px=draws.size_px,
        pending=[draw.number for draw in draws.trials if draw.number not in done],
        summary=summarise(trials),
        trials=list(trials),
    )


def summarise(trials: Sequence[Trial]) -> Summary:
    """The figures that count, over these trials; a failed trial counts as not found."""
    other = [trial for trial in trials if trial.draw.kind in OTHER_FORM]
    empty = [trial for trial in trials if trial.draw.kind in EMPTY]
    in_form = [trial for trial in trials if trial.draw.kind not in (*OTHER_FORM, *EMPTY)]
    named = [outcome for trial in in_form for outcome in _counted(trial)]
    found = _tally(named, _FOUND)
    beside = [outcome for trial in in_form if trial.also_named for outcome in _counted(trial)]
    unnamed = [outcome for trial in other for outcome in _counted(trial)]
    costs = [trial.cost.dataset_cpu_s or trial.cost.cpu_s for trial in trials if trial.cost]
    return Summary(
        counts_from_rms_nm=COUNTS_FROM_RMS_NM,
        tolerance_in_form=TOLERANCE_IN_FORM,
        tolerance_other=TOLERANCE_OTHER,
        in_form=found,
        false_beside=Tally(count=_tally(beside, _FOUND).count, total=found.count),
        in_form_with_false_name=Tally(count=sum(bool(t.also_named) for t in in_form), total=len(in_form)),
        named=_tally(unnamed, ("named-a-cause",)),
        noticed=_tally(unnamed, _NOTICED),
        unnoticed=_tally(unnamed, _UNNOTICED),
        clean=_tally([outcome for trial in empty for outcome in trial.outcomes], ("clean",)),
        at_floor_in_form=_at_floor([*in_form, *empty]),
        at_floor_other=_at_floor(other),
        failed=sum(bool(trial.failure) for trial in trials),
        mean_cpu_s=sum(costs) / len(costs) if costs else None,
        longest_cpu_s=max(costs, default=None),
    )


def tolerance(trial: Trial) -> float:
    """Largest error after that is accepted, as a multiple of that of the true models."""
    return TOLERANCE_OTHER if trial.draw.kind in OTHER_FORM else TOLERANCE_IN_FORM


def reaches_floor(trial: Trial) -> bool:
    """Whether the mean absolute error after is within the tolerance."""
    return trial.errors is not None and trial.errors.mae_to_floor <= tolerance(trial)


def trial_table(scoreboard: Scoreboard) -> pd.DataFrame:
    """One row per planted cause, at full precision; missing figures are NaN."""
    rows = []
    for trial in scoreboard.trials:
        errors = trial.errors
        for outcome, planted in _pairs(trial):
            rows.append(
                {
                    "trial": trial.draw.number,
                    "kind": trial.draw.kind,
                    "knob": planted.name if planted else "",
                    "effect": outcome.effect,
                    "strength": planted.strength if planted else float("nan"),
                    "unit": planted.unit if planted else "",
                    "at_limit": bool(planted and planted.at_limit),
                    "nuisance_span": bool(planted and planted.nuisance_span),
                    "wanted_rms_nm": planted.wanted_rms_nm if planted else float("nan"),
                    "rms_nm": outcome.rms_nm,
                    "judgement": outcome.judgement,
                    "named": "; ".join(" | ".join(n.names) for n in trial.named),
                    "also_named": "; ".join(trial.also_named),
                    "scan_terms": "; ".join(trial.scan_terms),
                    "verdict": trial.verdict,
                    "before_mae_nm": errors.before.mae_nm if errors else float("nan"),
                    "after_mae_nm": errors.after.mae_nm if errors else float("nan"),
                    "floor_mae_nm": errors.floor.mae_nm if errors else float("nan"),
                    "before_rmse_nm": errors.before.rmse_nm if errors else float("nan"),
                    "after_rmse_nm": errors.after.rmse_nm if errors else float("nan"),
                    "floor_rmse_nm": errors.floor.rmse_nm if errors else float("nan"),
                    "loop_s": trial.cost.loop_s if trial.cost else float("nan"),
                    "cpu_s": trial.cost.cpu_s if trial.cost else float("nan"),
                    "dataset_cpu_s": (trial.cost and trial.cost.dataset_cpu_s) or float("nan"),
                    "loop_says": outcome.loop_says,
                    "failure": trial.failure,
                }
            )
    return pd.DataFrame(rows)


class Figure(NamedTuple):
    """A figure that counts, in words, and what was aimed at before the board was run; empty if nothing."""

    what: str
    value: str
    wanted: str


def figures_of(scoreboard: Scoreboard) -> list[Figure]:
    """The figures that count; of an earlier board by today's rules."""
    s = scoreboard.summary or summarise(scoreboard.trials)
    size, within = f"above {s.counts_from_rms_nm:g} nm", "at most {:g} × that of the true models"
    in_form, other = s.at_floor_in_form, s.at_floor_other
    at_floor = Tally(count=in_form.count + other.count, total=in_form.total + other.total)
    figures = [
        Figure(f"in form, {size}: right name, or a set that contains it", str(s.in_form), "all but one"),
        Figure("… of these with a false name beside it", str(s.false_beside), "none"),
        Figure("in form, of any size: trials with a false name", str(s.in_form_with_false_name), ""),
        Figure(f"of another form, {size}: noticed, and no cause named", str(s.noticed), ""),
        Figure("… given a name", str(s.named), "at most 1"),
        Figure("… unnoticed", str(s.unnoticed), "at most 1"),
        Figure("nothing planted: nothing reported", str(s.clean), "all"),
        Figure(f"in form or empty: error after {within.format(s.tolerance_in_form)}", str(in_form), ""),
        Figure(f"of another form: error after {within.format(s.tolerance_other)}", str(other), ""),
        Figure("… both together", str(at_floor), "at least 90 %"),
        Figure("trials that failed", str(s.failed), "0"),
    ]
    if s.mean_cpu_s is not None and s.longest_cpu_s is not None:
        minutes = f"{s.mean_cpu_s / 60:.1f}, {s.longest_cpu_s / 60:.1f}"
        figures.append(Figure("processor minutes of a data set: mean, longest", minutes, "at most 4"))
    return figures


def publish(page: Path, scoreboard: Scoreboard) -> None:
    """Put the scoreboard into the page, in place of what stood between the marks of its seed.

    Raises:
        InputError: trials that have not been run, or a page without the marks.
    """
    if scoreboard.pending:
        raise InputError("scoreboard to publish", got=f"pending trials {scoreboard.pending}", wanted="none")
    before, _, after = _parts(page, scoreboard.seed)
    text = f"{before}{_start(scoreboard.seed)}\n{as_markdown(scoreboard)}\n{_END}{after}"
    with atomic_file(page) as temporary:
        temporary.write_text(text, encoding="utf-8")


def published(page: Path, seed: int) -> str:
    """What stands between the marks of a board.

    Raises:
        InputError: a page without the marks.
    """
    return _parts(page, seed)[1].strip("\n")


def as_markdown(scoreboard: Scoreboard) -> str:
    """Command, figures and one row per planted cause."""
    rows = [
        _row(trial, outcome, planted, first=i == 0)
        for trial in scoreboard.trials
        for i, (outcome, planted) in enumerate(_pairs(trial))
    ]
    figures = "\n".join(f"| {what} | {value} | {wanted} |" for what, value, wanted in figures_of(scoreboard))
    return (
        f"```\n{scoreboard.command}\n```\n\n"
        f"| | | wanted |\n|---|---|---|\n{figures}\n\n{_HEAD}\n" + "\n".join(rows) + _footnotes(scoreboard)
    )


def _row(trial: Trial, outcome: Outcome, planted: Planted | None, *, first: bool) -> str:
    size = f"{outcome.rms_nm:.1f}" if planted else "–"
    limit = " (limit)" if planted and planted.at_limit else ""
    name = planted.name if planted else outcome.effect
    mark = {"off-catalogue": " (outside the catalogue)", "other-form": " (other form)", "alias": " (alias)"}
    named = "; ".join(" or ".join(n.names) + _said(n.verdict) for n in trial.named) or "–"
    if not first:
        shared = ["", "", "", ""]
    elif trial.errors is None:
        shared = ["–", "–", "–", "–"]
    else:
        e = trial.errors
        change = f"{e.before.mae_nm:.2f} → {e.after.mae_nm:.2f}"
        shared = [named, change, f"{e.floor.mae_nm:.2f}", f"{e.mae_to_floor:.2f}"]
    number = str(trial.draw.number) if first else ""
    cells = [number, name + mark.get(trial.draw.kind, ""), size + limit, outcome.judgement, *shared]
    return "| " + " | ".join(cells) + " |"


def _said(verdict: str) -> str:
    return " (partial)" if verdict == "partial" else ""


def _footnotes(scoreboard: Scoreboard) -> str:
    notes = [f"Trial {t.draw.number} failed: {t.failure}" for t in scoreboard.trials if t.failure]
    if any(one.at_limit for trial in scoreboard.trials for one in trial.planted):
        notes.insert(0, "(limit): the knob's range ends before the drawn size; its largest value is used.")
    if any(o.rms_nm <= COUNTS_FROM_RMS_NM for trial in scoreboard.trials for o in trial.outcomes):
        notes.insert(0, f"Effects of at most {COUNTS_FROM_RMS_NM:g} nm are listed and not counted.")
    return "".join(f"\n\n{note}" for note in notes)


def _start(seed: int) -> str:
    return f"<!-- scoreboard of seed {seed}: written by the command -->"


def _parts(page: Path, seed: int) -> tuple[str, str, str]:
    before, start, rest = page.read_text(encoding="utf-8").partition(_start(seed))
    inside, end, after = rest.partition(_END)
    if not start or not end:
        raise InputError(f"marks in {page}", got="not both", wanted=f"{_start(seed)} … {_END}")
    return before, inside, after


def _pairs(trial: Trial) -> list[tuple[Outcome, Planted | None]]:
    planted: list[Planted | None] = [*trial.planted] or [None] * len(trial.outcomes)
    return list(zip(trial.outcomes, planted, strict=True))


def _counted(trial: Trial) -> list[Outcome]:
    return [outcome for outcome in trial.outcomes if outcome.rms_nm > COUNTS_FROM_RMS_NM]


def _at_floor(trials: Sequence[Trial]) -> Tally:
    return Tally(count=sum(map(reaches_floor, trials)), total=len(trials))


def _tally(outcomes: Sequence[Outcome], wanted: Sequence[str]) -> Tally:
    return Tally(count=sum(o.judgement in wanted for o in outcomes), total=len(outcomes))
