"""Nested tests of what single scans add: datum, gain, bow, registration, line offsets.

A term is accepted for what *varies* between scans: the part common to all scans, estimated on the
other folds, is given to the comparison model too, because it may belong to the process.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness import LinePeriod
from litho_models.effects import Effect, get_effect
from litho_models.effects.effect import Role
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.selection.confirming import BINOMIAL_P, Confirmation, confirm_variance
from litho_models.loop.single_scans.line_period import period_of_lines
from litho_models.loop.study import Score, Study
from litho_models.scan_terms import (
    SCAN_TERMS,
    LineIndex,
    ScanTerm,
    TermPixels,
    Terms,
    chosen_terms,
    freed_um,
    least_squares,
    line_terms,
    parameter_names,
    term_maps,
    terms_of_effect,
)
from litho_models.scoring.statistics import (
    ByPrint,
    bootstrap_interval,
    by_print,
    one_sided_flip_p,
    paired_difference,
)

# Of estimates that do not depend on the print, one set in twenty is called grouped.
GROUPED_P = 0.05


@dataclass(frozen=True)
class MeasurementTest:
    """One nested step: per-scan terms without and with those of ``effect``.

    ``by_print``: whether the estimates vary by print or from scan to scan; None where one cannot tell.
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
    by_print: ByPrint | None = None

    @property
    def role(self) -> Role:
        """That of the catalogue; where scans of one print are alike, the printer may have done it too."""
        grouped = self.by_print is not None and self.by_print.p <= GROUPED_P
        return "undetermined" if grouped and self.effect.role == "measurement" else self.effect.role


def measurement_tests(study: Study, predictions: Sequence[np.ndarray]) -> list[MeasurementTest]:
    """Test each effect of single scans given those accepted before it; line offsets against the columns."""
    accepted: Terms = frozenset()
    tests, lines = [], []
    for name in dict.fromkeys(term.effect for term in SCAN_TERMS.values() if term.effect is not None):
        terms = terms_of_effect(name)
        if line_terms(terms):
            lines.append(name)
            continue
        test = _test_terms(name, study, predictions, accepted)
        tests.append(test)
        # The datum is free in every later comparison, whatever this test says.
        if test.confirmation.passed or name == "datum-offset":
            accepted |= terms
    return tests + _test_lines(lines, study, predictions, accepted)


def scan_parameters(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], terms: Terms
) -> np.ndarray:
    """Smooth terms of each scan at the sampled pixels, (scans, k) in the order of ``parameter_names``, µm."""
    return np.stack([_coefficients(f, p, terms) for f, p in zip(scans, predictions, strict=True)])


def _test_terms(
    name: str, study: Study, predictions: Sequence[np.ndarray], accepted: Terms
) -> MeasurementTest:
    effect, own_terms = get_effect(name), terms_of_effect(name)
    terms = accepted | own_terms
    coefficients = scan_parameters(study.scans, predictions, terms)
    own = _columns_of(own_terms, terms)
    shared = _columns_of((term.name for term in chosen_terms(own_terms) if term.may_be_shared), terms)
    reference = list(predictions)
    if shared:
        for i, (scan, prediction) in enumerate(zip(study.scans, predictions, strict=True)):
            mean = coefficients[study.fold_of != study.fold_of[i]].mean(axis=0)[shared]
            maps = term_maps(TermPixels(prediction, scan.line), terms)[shared]
            reference[i] = prediction + (mean @ maps).reshape(prediction.shape)
    before = study.score(reference, accepted)
    after = study.score(predictions, terms)
    # Slopes are those from pixel to pixel, so that displacements come in pixels.
    displacements = _columns_of((term.name for term in chosen_terms(own_terms) if term.unit == "px"), terms)
    coefficients[:, displacements] *= [[scan.context.pitch_um] for scan in study.scans]
    spread = {}
    for parameter, column in zip(effect.parameters, own, strict=True):
        values = coefficients[:, column]
        interval = _spread_interval(values, study.seed)
        spread[parameter] = (
            float(values.std(ddof=min(1, len(values) - 1))),
            interval,
            effect.parameters[parameter].unit,
        )
    return MeasurementTest(
        effect=effect,
        before=before,
        after=after,
        confirmation=_confirm(before, after, study),
        p_screen=paired_difference(before.mse_nm2.tolist(), after.mse_nm2.tolist(), seed=study.seed).p,
        spread=spread,
        evidence=_sentence(before, after),
        by_print=by_print(coefficients[:, own], [s.stored.print_id for s in study.scans], study.seed),
    )


def _test_lines(
    names: Sequence[str], study: Study, predictions: Sequence[np.ndarray], accepted: Terms
) -> list[MeasurementTest]:
    """Offsets of lines, along the scan and along the layout: against the columns, then against each other.

    Scans are turned a little against their layouts. Lines that follow the layout's rows better were
    written, lines that follow the scan's were measured; where no scan is turned nobody can tell.
    """
    # A tilt, a bow or a profile that all scans share is no term of single ones, nor of their lines.
    accepted |= {"offset", "bow"}
    by_column = _with_shared_profile(study, predictions, axis=0)
    by_row = _with_shared_profile(study, predictions, axis=1)
    control = [study.score(by_column, terms).mse_nm2 for terms in (accepted, accepted | {"layout-columns"})]
    columns = control[0] - control[1]
    before = study.score(by_row, accepted)
    after = {name: study.score(by_row, accepted | terms_of_effect(name)) for name in names}
    gains = {name: before.mse_nm2 - own.mse_nm2 for name, own in after.items()}
    tests = []
    for at, name in enumerate(names):
        other = max((n for n in names if n != name), key=lambda n: float(gains[n].sum()))
        beaten_p = one_sided_flip_p(gains[other] - gains[name])
        better_p = one_sided_flip_p(gains[name] - gains[other])
        alike = beaten_p > BINOMIAL_P and better_p > BINOMIAL_P
        excess_p = one_sided_flip_p(gains[name] - columns)
        confirmation = _confirm(before, after[name], study)
        reasons = [confirmation.reason]
        if excess_p > BINOMIAL_P:
            reasons.append(f"rows gain no more than columns (p = {excess_p:.3f})")
        if beaten_p <= BINOMIAL_P:
            reasons.append(f"the lines follow {_frame(other)} more closely (p = {beaten_p:.4f}): {other}")
        elif alike and at:
            reasons.append(
                f"cannot be distinguished from {other}: no scan is turned enough against its layout"
            )
        reason = "; ".join(part for part in reasons if part)
        variance = np.maximum(gains[name], 0) / NM_PER_UM**2
        interval = bootstrap_interval(variance.tolist(), seed=study.seed)
        low, high = (float(np.sqrt(end)) for end in interval)
        term = line_terms(terms_of_effect(name))[0]
        period = period_of_lines(study.scans, predictions, [_lines(term, scan) for scan in study.scans])
        tests.append(
            MeasurementTest(
                effect=get_effect(name),
                before=before,
                after=after[name],
                confirmation=replace(confirmation, passed=not reason, reason=reason),
                p_screen=excess_p,
                spread={"sd_um": (float(np.sqrt(variance.mean())), (low, high), "µm")},
                evidence=(
                    "line offsets, estimated on the other side of each scan, remove on the scored side "
                    f"{gains[name].mean():.1f} nm² along {_frame(name)}, {gains[other].mean():.1f} nm² along "
                    f"{_frame(other)}; offsets of the columns, treated alike, {columns.mean():.1f} nm²"
                    f"{_period_text(period)}"
                ),
                confusable_with=(other,) if alike else (),
            )
        )
    return tests


def _lines(term: ScanTerm, scan: PreparedScan) -> LineIndex:
    assert term.lines is not None
    return term.lines(scan.usable.shape, scan.line)


def _period_text(period: LinePeriod | None) -> str:
    if period is None:
        return ""
    return (
        f"; they repeat every {period.period_um:.3g} µm, with {100 * period.share:.0f} % of the squared "
        f"line means (p = {period.p:.1g})"
    )


def _frame(effect: str) -> str:
    return line_terms(terms_of_effect(effect))[0].frame


def _with_shared_profile(study: Study, predictions: Sequence[np.ndarray], axis: int) -> list[np.ndarray]:
    """Predictions with the mean residual of each line along ``axis`` over the scans of the other folds added.

    Scans of different sizes have no lines in common: then nothing is added.
    """
    if len({p.shape[1 - axis] for p in predictions}) > 1:
        return list(predictions)
    sums, counts = [], []
    for scan, prediction in zip(study.scans, predictions, strict=True):
        residual = freed_um(scan.stored.height_um, prediction, scan.usable, frozenset({"offset", "bow"}))
        sums.append(residual.sum(axis=axis))
        counts.append(scan.usable.sum(axis=axis))
    totals, seen = np.stack(sums), np.stack(counts)
    shared = []
    for fold, prediction in zip(study.fold_of, predictions, strict=True):
        others = study.fold_of != fold
        profile = totals[others].sum(axis=0) / np.maximum(seen[others].sum(axis=0), 1)
        shared.append(prediction + np.expand_dims(profile, axis).astype(prediction.dtype))
    return shared


def _confirm(before: Score, after: Score, study: Study) -> Confirmation:
    return confirm_variance(
        before.residual_um,
        after.residual_um,
        (before.mse_nm2, before.mae_nm),
        (after.mse_nm2, after.mae_nm),
        floor_nm2=study.floor_nm2,
        seed=study.seed,
    )


def _coefficients(scan: PreparedScan, prediction: np.ndarray, terms: Terms) -> np.ndarray:
    design = scan.terms_at_sample(prediction, terms)
    return least_squares(design, scan.height - scan.at_sample(prediction))


def _columns_of(names: Iterable[str], terms: Terms) -> list[int]:
    """Columns of ``term_maps(…, terms)`` that belong to some of the terms."""
    wanted = parameter_names(names)
    return [at for at, name in enumerate(parameter_names(terms)) if name in wanted]


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
