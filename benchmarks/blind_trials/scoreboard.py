"""The scoreboard: all draws with their outcomes, and the few figures that count."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from benchmarks.blind_trials.records import Draws, Outcome, Planted, Scoreboard, Summary, Tally, Trial
from litho_data.foundation.run_facts import run_info

# Effects of a smaller rms are in the table but not in the goal.
COUNTS_FROM_RMS_NM = 8.0
FLOOR_TOLERANCE = 1.15
_FOUND = ("right", "set-contains-it")
_HONEST = ("traced-to-covariate", "unexplained")


def make_scoreboard(draws: Draws, trials: Sequence[Trial]) -> Scoreboard:
    """The scoreboard of a campaign from its finished trials."""
    run = run_info([draws.seed], draws.n_scans)
    done = {trial.draw.number for trial in trials}
    return Scoreboard(
        schema=Scoreboard.SCHEMA,
        command=(
            f"python -m benchmarks.blind_trials --count {len(draws.trials)} --seed {draws.seed} "
            f"--scans {draws.n_scans} --size-px {draws.size_px}"
        ),
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
    singles = [o for trial in trials if trial.draw.kind == "single" for o in _large(trial)]
    effects = [o for trial in trials if trial.draw.kind in ("single", "two") for o in _large(trial)]
    plain = [
        o
        for trial in trials
        if trial.draw.kind in ("single", "two") and not trial.also_named
        for o in _large(trial)
    ]
    nothing = [trial for trial in trials if trial.draw.kind == "none"]
    outside = [trial for trial in trials if trial.draw.kind == "off-catalogue"]
    costs = [trial.cost for trial in trials if trial.cost]
    return Summary(
        counts_from_rms_nm=COUNTS_FROM_RMS_NM,
        floor_tolerance=FLOOR_TOLERANCE,
        single_found=_tally(singles, _FOUND),
        single_not_testable=sum(
            o.judgement not in _FOUND and o.loop_says.startswith("not-testable") for o in singles
        ),
        effects_found=_tally(effects, _FOUND),
        without_stranger=Tally(count=_tally(plain, _FOUND).count, total=_tally(effects, _FOUND).count),
        clean=_tally([o for trial in nothing for o in trial.outcomes], ("clean",)),
        honest=_tally([o for trial in outside for o in trial.outcomes], _HONEST),
        at_floor=Tally(count=sum(map(reaches_floor, trials)), total=len(trials)),
        failed=sum(bool(trial.failure) for trial in trials),
        mean_cpu_s=sum(cost.cpu_s for cost in costs) / len(costs) if costs else None,
        longest_loop_s=max((cost.loop_s for cost in costs), default=None),
    )


def reaches_floor(trial: Trial) -> bool:
    """Whether the mean absolute error after is at most the tolerated multiple of the true models'."""
    return trial.errors is not None and trial.errors.mae_to_floor <= FLOOR_TOLERANCE


def trial_table(scoreboard: Scoreboard) -> pd.DataFrame:
    """One row per planted effect, at full precision; missing figures are NaN."""
    rows = []
    for trial in scoreboard.trials:
        errors = trial.errors
        knobs: list[Planted | None] = [*trial.planted] or [None] * len(trial.outcomes)
        for outcome, planted in zip(trial.outcomes, knobs, strict=True):
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
                    "loop_says": outcome.loop_says,
                    "failure": trial.failure,
                }
            )
    return pd.DataFrame(rows)


def _large(trial: Trial) -> list[Outcome]:
    return [outcome for outcome in trial.outcomes if outcome.rms_nm > COUNTS_FROM_RMS_NM]


def _tally(outcomes: Sequence[Outcome], wanted: Sequence[str]) -> Tally:
    return Tally(count=sum(o.judgement in wanted for o in outcomes), total=len(outcomes))
