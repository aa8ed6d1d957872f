"""Is a change confirmed on scans it was not fitted on? Scans are the unit of every test."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from litho_models.scoring.statistics import bootstrap_interval, one_sided_flip_p

BINOMIAL_P = 0.005
# Every test of a confirmation, binomial or by sign flips, has p = 2**-n at best: seven gains out of seven
# have 0.0078, so that below eight scans nothing can be confirmed.
FEWEST_SCANS = math.ceil(-math.log2(BINOMIAL_P))
SMALLEST_SHARE = 0.01
SMALLEST_RMSE_NM = 0.5
LARGEST_SPREAD = 0.5


@dataclass(frozen=True)
class Confirmation:
    """Held-out judgement of one change.

    Attributes:
        passed: all rules hold; ``reason`` names those that do not.
        p: one-sided over scans; ``improved``: (better scans, all scans).
        gain_nm: mean error before minus after; ``gain_ci95_nm``: its bootstrap interval over scans.
    """

    passed: bool
    reason: str
    p: float
    improved: tuple[int, int]
    gain_nm: float
    gain_ci95_nm: tuple[float, float]


def confirm(
    before_mse_nm2: np.ndarray,
    after_mse_nm2: np.ndarray,
    before_mae_nm: np.ndarray,
    after_mae_nm: np.ndarray,
    *,
    floor_nm2: float = 0.0,
    amplitudes: Mapping[str, np.ndarray] | None = None,
    counted: bool = True,
    seed: int = 0,
) -> Confirmation:
    """Judge a change by its held-out errors per scan.

    Accepted when (a) enough scans improve for a one-sided p <= 0.005, binomial, or with ``counted`` False by
    sign flips of the scans' gains, (b) the bootstrap
    interval of the mean gain in squared error lies above 0, (c) the gain is at least 1 % of the
    squared error above the floor or 0.5 nm of RMSE, (d) the sign of the main amplitude is the same
    in every fold and its coefficient of variation is below 0.5.

    Args:
        before_mse_nm2, after_mse_nm2: (scans,) mean squared error, nm².
        before_mae_nm, after_mae_nm: (scans,) mean absolute error, nm.
        floor_nm2: squared noise floor or its lower bound.
        amplitudes: per amplitude, its distance from null in each fold, in units of its typical size.
        counted: False for what has no name that could be wrong: one scan in ten may then lose a little, as
            where a registration has taken up what the others show.
    """
    gain = before_mse_nm2 - after_mse_nm2
    count, better = len(gain), int((gain > 0).sum())
    p = binomial_p(better, count) if counted else one_sided_flip_p(gain)
    low, _ = bootstrap_interval(gain.tolist(), seed=seed)
    rmse_gain = math.sqrt(before_mse_nm2.mean()) - math.sqrt(max(after_mse_nm2.mean(), 0.0))
    share = gain.mean() / max(before_mse_nm2.mean() - floor_nm2, np.finfo(float).tiny)
    failures = []
    if count < FEWEST_SCANS:
        failures.append(f"{count} scans, at least {FEWEST_SCANS} are needed to confirm anything")
    elif p > BINOMIAL_P:
        failures.append(f"better in only {better} of {count} held-out scans (p = {p:.3f})")
    if low <= 0:
        failures.append("the interval of the held-out gain includes zero")
    if share < SMALLEST_SHARE and rmse_gain < SMALLEST_RMSE_NM:
        failures.append(f"gain of {100 * share:.2f} % and {rmse_gain:.2f} nm is too small to matter")
    if amplitudes:
        failures += _unstable(amplitudes)
    mae_gain = before_mae_nm - after_mae_nm
    low_nm, high_nm = bootstrap_interval(mae_gain.tolist(), seed=seed)
    return Confirmation(
        passed=not failures,
        reason="; ".join(failures),
        p=p,
        improved=(better, count),
        gain_nm=float(mae_gain.mean()),
        gain_ci95_nm=(low_nm, high_nm),
    )


def binomial_p(better: int, count: int) -> float:
    """Chance of at least ``better`` heads in ``count`` fair throws."""
    return sum(math.comb(count, k) for k in range(better, count + 1)) / 2**count


def confirm_variance(
    before_um: Sequence[np.ndarray],
    after_um: Sequence[np.ndarray],
    before: tuple[np.ndarray, np.ndarray],
    after: tuple[np.ndarray, np.ndarray],
    *,
    floor_nm2: float = 0.0,
    seed: int = 0,
) -> Confirmation:
    """Judge terms that differ from scan to scan, as a variance component.

    A scan whose own term happens to be near zero gains nothing by it, so scans are not counted.
    Instead the term estimated on one half of a scan's pixels must agree with what the other half
    needs: the product of the two, summed over scans, against flips of its sign per scan, replaces
    rule (a) of ``confirm``; (b) and (c) stay.

    Args:
        before_um, after_um: residual maps without and with the terms, NaN where not scored.
        before, after: (mean squared errors nm², mean absolute errors nm) of the scans.
    """
    plain = confirm(before[0], after[0], before[1], after[1], floor_nm2=floor_nm2, seed=seed)
    products = [np.nanmean(r * (r - left)) for r, left in zip(before_um, after_um, strict=True)]
    p = one_sided_flip_p(np.array(products))
    failures = [part for part in plain.reason.split("; ") if part and not part.startswith("better in only")]
    if len(products) >= FEWEST_SCANS and p > BINOMIAL_P:
        failures.append(f"the two halves of the scans do not agree on it (p = {p:.3f})")
    return replace(plain, passed=not failures, reason="; ".join(failures), p=p)


def _unstable(amplitudes: Mapping[str, np.ndarray]) -> list[str]:
    main = max(amplitudes, key=lambda name: abs(float(amplitudes[name].mean())))
    values = amplitudes[main]
    if (np.sign(values) != np.sign(values[0])).any() or values[0] == 0:
        return [f"{main} changes sign between folds"]
    spread = float(values.std() / abs(values.mean()))
    return [f"{main} varies by {100 * spread:.0f} % between folds"] if spread >= LARGEST_SPREAD else []
