"""Nested tests of what single scans add: datum, gain, bow, registration, line offsets.

A term is accepted for what *varies* between scans: the part common to all scans, estimated on the
other folds, is given to the comparison model too, because it may belong to the process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect, get_effect
from litho_models.loop.prepared import Field
from litho_models.loop.scoring import (
    LINE_TERMS,
    TERMS_OF,
    Score,
    Terms,
    scan_parameter_names,
    score,
    term_maps,
)
from litho_models.loop.selection.confirming import BINOMIAL_P, Confirmation, confirm_variance
from litho_models.scan_terms.nuisance import least_squares
from litho_models.scoring.statistics import bootstrap_interval, one_sided_flip_p, paired_difference

# Terms whose mean over scans could be a property of the process.
_SHARED: Terms = frozenset({"gain", "bow", "drift", "distortion"})
_LINES = ("scan-line-stripes", "line-roughness")
_FRAME = {"scan-line-stripes": "the scan lines", "line-roughness": "the layout's rows"}


@dataclass(frozen=True)
class MeasurementTest:
    """One nested step: per-scan terms without and with those of ``effect``.

    ``spread``: parameter name to (standard deviation over scans, unit); ``evidence`` is a sentence;
    ``confusable_with``: effects that these scans cannot tell from it.
    """

    effect: Effect
    before: Score
    after: Score
    confirmation: Confirmation
    p_screen: float
    spread: dict[str, tuple[float, tuple[float, float], str]]
    evidence: str
    confusable_with: tuple[str, ...] = ()


def measurement_tests(
    fields: Sequence[Field],
    predictions: Sequence[np.ndarray],
    fold_of: np.ndarray,
    *,
    floor_nm2: float,
    seed: int,
) -> list[MeasurementTest]:
    """Test each per-scan effect given those accepted before it; line offsets against the columns."""
    accepted: Terms = frozenset()
    tests = []
    for name, terms in TERMS_OF.items():
        if terms <= LINE_TERMS:
            continue
        test = _test_terms(name, fields, predictions, fold_of, accepted, floor_nm2, seed)
        tests.append(test)
        # The datum is free in every later comparison, whatever this test says.
        if test.confirmation.passed or name == "datum-offset":
            accepted |= terms
    return tests + _test_lines(fields, predictions, fold_of, accepted, floor_nm2, seed)


def scan_parameters(fields: Sequence[Field], predictions: Sequence[np.ndarray], terms: Terms) -> np.ndarray:
    """Smooth per-scan coefficients (scans, k) at the sampled pixels, in the order of ``term_maps``, µm."""
    return np.stack([_coefficients(f, p, terms) for f, p in zip(fields, predictions, strict=True)])


def _test_terms(
    name: str,
    fields: Sequence[Field],
    predictions: Sequence[np.ndarray],
    fold_of: np.ndarray,
    accepted: Terms,
    floor_nm2: float,
    seed: int,
) -> MeasurementTest:
    effect, terms = get_effect(name), accepted | TERMS_OF[name]
    coefficients = scan_parameters(fields, predictions, terms)
    own = _own_columns(terms, accepted)
    shared = _own_columns(terms, terms - (_SHARED - accepted))
    reference = list(predictions)
    if shared:
        for i, prediction in enumerate(predictions):
            mean = coefficients[fold_of != fold_of[i]].mean(axis=0)[shared]
            maps = term_maps(prediction, terms, fields[i].line)[shared]
            reference[i] = prediction + np.tensordot(mean, maps, axes=1)
    before = score(fields, reference, accepted, seed)
    after = score(fields, predictions, terms, seed)
    # The slopes are those from pixel to pixel, so that displacements come in pixels.
    displacements = _own_columns(terms, terms - {"warp", "distortion"})
    coefficients[:, displacements] *= [[field.context.pitch_um] for field in fields]
    spread = {}
    for parameter, column in zip(effect.parameters, own, strict=True):
        values = coefficients[:, column]
        interval = _spread_interval(values, seed)
        spread[parameter] = (
            float(values.std(ddof=min(1, len(values) - 1))),
            interval,
            effect.parameters[parameter].unit,
        )
    return MeasurementTest(
        effect=effect,
        before=before,
        after=after,
        confirmation=_confirm(before, after, floor_nm2, seed),
        p_screen=paired_difference(before.mse_nm2.tolist(), after.mse_nm2.tolist(), seed=seed).p,
        spread=spread,
        evidence=_sentence(before, after),
    )


def _test_lines(
    fields: Sequence[Field],
    predictions: Sequence[np.ndarray],
    fold_of: np.ndarray,
    accepted: Terms,
    floor_nm2: float,
    seed: int,
) -> list[MeasurementTest]:
    """Offsets of lines, along the scan and along the layout: against the columns, then against each other.

    Scans are turned a little against their layouts. Lines that follow the layout's rows better were
    written, lines that follow the scan's were measured; where no scan is turned nobody can tell.
    """
    # A tilt, a bow or a profile that all scans share is no term of single ones, nor of their lines.
    accepted |= {"offset", "bow"}
    turned = [_turned(field) for field in fields]
    turned_predictions = _with_shared_profile(turned, [p.T for p in predictions], fold_of)
    predictions = _with_shared_profile(fields, predictions, fold_of)
    before = score(fields, predictions, accepted, seed, stripes=True)
    control_before = score(turned, turned_predictions, accepted, seed, stripes=True)
    control_after = score(turned, turned_predictions, accepted | {"rows"}, seed)
    columns = control_before.mse_nm2 - control_after.mse_nm2
    after = {name: score(fields, predictions, accepted | TERMS_OF[name], seed) for name in _LINES}
    gains = {name: before.mse_nm2 - own.mse_nm2 for name, own in after.items()}
    tests = []
    for name, other in (_LINES, _LINES[::-1]):
        beaten_p = one_sided_flip_p(gains[other] - gains[name])
        better_p = one_sided_flip_p(gains[name] - gains[other])
        untold = beaten_p > BINOMIAL_P and better_p > BINOMIAL_P
        excess_p = one_sided_flip_p(gains[name] - columns)
        confirmation = _confirm(before, after[name], floor_nm2, seed)
        reasons = [confirmation.reason]
        if excess_p > BINOMIAL_P:
            reasons.append(f"rows gain no more than columns (p = {excess_p:.3f})")
        if beaten_p <= BINOMIAL_P:
            reasons.append(f"the lines follow {_FRAME[other]} more closely (p = {beaten_p:.4f}): {other}")
        elif untold and name == _LINES[1]:
            reasons.append(f"cannot be told from {other}: no scan is turned enough against its layout")
        reason = "; ".join(part for part in reasons if part)
        variance = np.maximum(gains[name], 0) / NM_PER_UM**2
        interval = bootstrap_interval(variance.tolist(), seed=seed)
        low, high = (float(np.sqrt(end)) for end in interval)
        tests.append(
            MeasurementTest(
                effect=get_effect(name),
                before=before,
                after=after[name],
                confirmation=replace(confirmation, passed=not reason, reason=reason),
                p_screen=excess_p,
                spread={"sd_um": (float(np.sqrt(variance.mean())), (low, high), "µm")},
                evidence=(
                    "line offsets, estimated on half of the columns, remove on the other half "
                    f"{gains[name].mean():.1f} nm² along {_FRAME[name]}, {gains[other].mean():.1f} nm² along "
                    f"{_FRAME[other]}; offsets of the columns, treated alike, {columns.mean():.1f} nm²"
                ),
                confusable_with=(other,) if untold else (),
            )
        )
    return tests


def _with_shared_profile(
    fields: Sequence[Field], predictions: Sequence[np.ndarray], fold_of: np.ndarray
) -> list[np.ndarray]:
    """Predictions with the mean residual of each row over the scans of the other folds added.

    Scans of different heights have no rows in common: then nothing is added.
    """
    if len({p.shape[0] for p in predictions}) > 1:
        return list(predictions)
    sums, counts = [], []
    for field, prediction in zip(fields, predictions, strict=True):
        maps, use = term_maps(prediction, frozenset({"offset", "bow"})), field.usable
        residual = np.where(use, field.scan.height_um - prediction, 0.0).astype(np.float64)
        own = np.tensordot(least_squares(maps[:, use], residual[use]), maps, axes=1)
        sums.append(np.where(use, residual - own, 0.0).sum(axis=1))
        counts.append(use.sum(axis=1))
    totals, seen = np.stack(sums), np.stack(counts)
    shared = []
    for fold, prediction in zip(fold_of, predictions, strict=True):
        others = fold_of != fold
        profile = totals[others].sum(axis=0) / np.maximum(seen[others].sum(axis=0), 1)
        shared.append(prediction + profile[:, None].astype(prediction.dtype))
    return shared


def _confirm(before: Score, after: Score, floor_nm2: float, seed: int) -> Confirmation:
    return confirm_variance(
        before.residual_um,
        after.residual_um,
        (before.mse_nm2, before.mae_nm),
        (after.mse_nm2, after.mae_nm),
        floor_nm2=floor_nm2,
        seed=seed,
    )


def _coefficients(field: Field, prediction: np.ndarray, terms: Terms) -> np.ndarray:
    maps = term_maps(prediction, terms, field.line)
    design = np.stack([field.at_sample(m) for m in maps])
    return least_squares(design, field.height - field.at_sample(prediction))


def _own_columns(terms: Terms, accepted: Terms) -> list[int]:
    """Columns of ``term_maps(…, terms)`` that ``accepted`` does not have."""
    known = scan_parameter_names(accepted)
    return [at for at, name in enumerate(scan_parameter_names(terms)) if name not in known]


def _spread_interval(values: np.ndarray, seed: int) -> tuple[float, float]:
    """Bootstrap interval over scans of the standard deviation between scans."""
    if len(values) < 2:
        return (0.0, 0.0)
    draws = np.random.default_rng(seed).integers(0, len(values), size=(2000, len(values)))
    low, high = np.quantile(values[draws].std(axis=1, ddof=1), [0.025, 0.975])
    return float(low), float(high)


def _sentence(before: Score, after: Score) -> str:
    return (
        f"RMSE on pixels not fitted {before.rmse_nm:.2f} -> {after.rmse_nm:.2f} nm "
        f"with {after.degrees_of_freedom:.0f} instead of {before.degrees_of_freedom:.0f} terms per scan"
    )


def _turned(field: Field) -> Field:
    """The scan with rows and columns exchanged, its columns taken as scan lines."""
    ny, nx = field.usable.shape
    scan = replace(field.scan, height_um=field.scan.height_um.T)
    line = np.broadcast_to(np.arange(nx)[:, None], (nx, ny))
    return replace(field, scan=scan, usable=field.usable.T, line=line)
