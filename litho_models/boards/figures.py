"""Make the scoreboard of a board, which contains all trials with their outcomes, and compute the headline
results from it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from litho_data.foundation.run_facts import run_info
from litho_models.boards.other_forms import FORMS
from litho_models.boards.records import COUNTS_FROM_RMS_NM, Draws, Kind, Outcome, Scoreboard, Trial, Verdict

# Largest accepted error of the model that was corrected with the loop's findings, as a multiple of the error
# of the true models.
TOLERANCE: dict[Kind, float] = {"other-form": 1.3, "mixture": 1.15}
TOLERANCE_OF_THE_REST = 1.05
_NAMED: tuple[Verdict, ...] = ("right", "set-contains-it")
_LAWFUL: tuple[Verdict, ...] = (*_NAMED, "lawful")
_SEEN: tuple[Verdict, ...] = (*_LAWFUL, "noticed")


class Figure(NamedTuple):
    """A headline result in words. ``wanted`` is the target that was set before the board was run; it is empty
    if no target was set.
    """

    what: str
    value: str
    wanted: str = ""


def make_scoreboard(draws: Draws, trials: Sequence[Trial], command: str) -> Scoreboard:
    """Make the scoreboard of a board from its finished trials. ``command`` is the command line that
    reproduces the scoreboard.
    """
    run = run_info([draws.seed], draws.n_scans)
    done = {trial.draw.number for trial in trials}
    return Scoreboard(
        command=command,
        commit=run.commit,
        versions=run.versions,
        board=draws.board,
        seed=draws.seed,
        pending=[draw.number for draw in draws.trials if draw.number not in done],
        trials=list(trials),
    )


def share(hits: Iterable[bool]) -> str:
    """Count the True values. Return a text with this count, the number of all values, and the exact
    (Clopper-Pearson) 95 % confidence interval of the share of True values.
    """
    known = [*hits]
    if not known:
        return "none of 0"
    interval = binomtest(sum(known), len(known)).proportion_ci(0.95, method="exact")
    return f"{sum(known)} of {len(known)} ({100 * interval.low:.0f}–{100 * interval.high:.0f} %)"


def counted(trials: Iterable[Trial]) -> list[Outcome]:
    """Return the outcomes of the planted causes whose size (rms) is above ``COUNTS_FROM_RMS_NM``.

    If a trial failed before the sizes of its causes were measured, the drawn sizes are used.
    """
    found = []
    for trial in trials:
        sizes = {one.name: one.wanted_rms_nm for one in trial.draw.causes}
        sizes |= {one.draw.name: one.rms_nm for one in trial.planted}
        found += [one for one in trial.outcomes if sizes.get(one.name, 0.0) > COUNTS_FROM_RMS_NM]
    return found


def figures_of(scoreboard: Scoreboard) -> list[Figure]:
    """Compute the headline results. If a trial failed, its causes count as not found, and the error of its
    corrected model counts as too large.
    """
    trials = scoreboard.trials
    figures = (_of_singles if scoreboard.board == "singles" else _of_mixtures)(trials)
    empty = [
        one.verdict == "clean" for trial in trials if trial.draw.kind == "empty" for one in trial.outcomes
    ]
    figures += [
        Figure("nothing hidden: nothing reported", share(empty), "all"),
        Figure("trials that failed", str(sum(bool(trial.failure) for trial in trials)), "0"),
    ]
    bias = np.array([trial.bias for trial in trials if trial.bias and trial.draw.causes])
    if len(bias):
        without, with_found = np.median(bias, axis=0)
        ratio = np.median(bias[:, 1] / bias[:, 0])
        figures.append(
            Figure(
                "bias of the base model: without findings, with findings; median ratio of the two",
                f"{100 * without:.1f} %, {100 * with_found:.1f} %; {ratio:.2f}",
                "at most 1/3",
            )
        )
    minutes = [trial.dataset_cpu_s / 60 for trial in trials if trial.dataset_cpu_s is not None]
    if minutes:
        spent = f"{np.mean(minutes):.1f}, {max(minutes):.1f}"
        figures.append(Figure("CPU minutes per dataset: mean, longest", spent))
    return figures


def figure_lines(scoreboard: Scoreboard) -> list[str]:
    """Return the headline results as lines for a terminal."""
    return [
        f"{value:>24}  {what}" + (f" (target: {wanted})" if wanted else "")
        for what, value, wanted in figures_of(scoreboard)
    ]


def reaches_floor(trial: Trial) -> bool:
    """Return whether the error of the corrected model is close enough to the error of the true models. The
    limit depends on the kind of trial. If one of the errors is unknown, return False.
    """
    ratio = trial.errors.ratio if trial.errors else None
    return ratio is not None and ratio <= TOLERANCE.get(trial.draw.kind, TOLERANCE_OF_THE_REST)


def _of_singles(trials: Sequence[Trial]) -> list[Figure]:
    in_form, other = (_of_kind(trials, kind) for kind in ("in-form", "other-form"))
    rest = [trial for trial in trials if trial.draw.kind != "other-form"]
    return [
        _causes("known form: named, alone or in a set", counted(in_form), _NAMED, "all but one"),
        Figure("… trials with a false name", share(bool(one.false_names) for one in in_form), "none"),
        _causes("other form: correct name, or a law", counted(other), _LAWFUL),
        _causes("… noticed, with or without a name or law", counted(other), _SEEN, "all but one"),
        Figure("… trials with a false name", share(bool(one.false_names) for one in other), "at most 1"),
        Figure(
            f"all but other form: error of at most {TOLERANCE_OF_THE_REST:g} × that of the true models",
            share(map(reaches_floor, rest)),
            "at least 90 %",
        ),
        Figure(
            f"other form: error of at most {TOLERANCE['other-form']:g} ×",
            share(map(reaches_floor, other)),
            "at least 90 %",
        ),
    ]


def _of_mixtures(trials: Sequence[Trial]) -> list[Figure]:
    mixed, measured = (_of_kind(trials, kind) for kind in ("mixture", "measured"))
    causes = counted(mixed)
    linear, s_shaped = (
        [one for one in causes if one.name == name] for name in ("linear-slope-loss", "s-shaped-axis")
    )
    simulated = [trial for trial in trials if trial.draw.kind != "measured"]
    return [
        _causes(
            "causes of a known form: named, alone or in a set",
            [one for one in causes if one.name not in FORMS],
            _NAMED,
            "at least 80 %",
        ),
        _causes(
            "causes of another form: correct name, or a law",
            [one for one in causes if one.name in FORMS],
            _LAWFUL,
        ),
        _causes("all causes: named, or a law", causes, _LAWFUL),
        _causes("… or noticed", causes, _SEEN),
        _causes("linear loss on slopes by batch: named", linear, _NAMED, "all"),
        _causes("S-shaped axis in half of the scans: named or shared", s_shaped, _NAMED, "all"),
        Figure("trials with a false name", share(bool(one.false_names) for one in simulated), "at most 5 %"),
        Figure(
            f"error of at most {TOLERANCE['mixture']:g} × that of the true models",
            share(map(reaches_floor, mixed)),
            "at least 80 %",
        ),
        _causes("in measured prints: named, or a law", counted(measured), _LAWFUL),
    ]


def _of_kind(trials: Iterable[Trial], kind: str) -> list[Trial]:
    return [trial for trial in trials if trial.draw.kind == kind]


def _causes(what: str, causes: Iterable[Outcome], verdicts: Sequence[Verdict], wanted: str = "") -> Figure:
    return Figure(what, share(one.verdict in verdicts for one in causes), wanted)


def trial_table(scoreboard: Scoreboard) -> pd.DataFrame:
    """Return a table with one row per planted cause and one row per trial without causes. Sizes are in nm;
    unknown values are empty.
    """
    rows: list[dict[str, Any]] = []
    for trial in scoreboard.trials:
        set_as = {one.draw.name: one for one in trial.planted}
        shared = {
            "found": "; ".join(f"{' | '.join(one.names)} by {one.by}" for one in trial.found),
            "false_names": "; ".join(trial.false_names),
            **(trial.errors.model_dump() if trial.errors else {}),
            "bias_without": trial.bias and trial.bias[0],
            "bias_with": trial.bias and trial.bias[1],
            "failure": trial.failure,
        }
        for outcome in trial.outcomes:
            own = set_as.get(outcome.name)
            planted = own.model_dump(exclude={"draw", "names"}) | own.draw.model_dump() if own else {}
            kind = {"trial": trial.draw.number, "kind": trial.draw.kind}
            rows.append(kind | planted | outcome.model_dump() | shared)
    return pd.DataFrame(rows)
