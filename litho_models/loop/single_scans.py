"""Find out which of the following terms differ from scan to scan: datum, gain, bow, drift, registration
errors and line offsets.

Such terms cannot be predicted for the next print, so they are not part of any model. A term counts as present
if it agrees between two halves of a scan: the term that is fitted to one half of the pixels must agree with
the residual of the other half.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache, cached_property
from itertools import permutations

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import get_effect
from litho_models.loop.fits import Study
from litho_models.loop.judging import CONFIRM_P, GROUPED_P, Judgement, evidence_nm2, judge
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import ScanFinding, Strength
from litho_models.scan_terms import (
    SCAN_TERMS,
    Blocks,
    CrossFit,
    Terms,
    chosen_terms,
    cross_fit,
    freed_um,
    least_squares,
    line_terms,
    parameter_names,
    terms_of_effect,
)
from litho_models.scoring.statistics import by_print, one_sided_flip_p


class SingleScans:
    """Test which per-scan terms the scans contain. To test a term, fit it to pixels that are not scored, and
    subtract it from the pixels that are scored.

    Args:
        study: the original scans with their folds, and the seed.
        maps_um: map that each scan is expected to show, µm, of shape (ny, nx). It is predicted by a model of
            the printer and a measurement model, both of which were fitted without this scan.
    """

    def __init__(self, study: Study, maps_um: Sequence[np.ndarray]):
        self.study, self.scans, self.maps_um = study, study.scans, maps_um
        self.freed = cache(lambda terms: self._freed(maps_um, terms))

    def findings(self) -> list[ScanFinding]:
        """Test all per-scan effects, one after the other, and return the findings. In each test, the terms of
        all effects that were found in earlier tests are fitted, too. Line offsets are tested last.
        """
        accepted: Terms = frozenset({"offset"})
        found: list[ScanFinding] = []
        names = dict.fromkeys(term.effect for term in SCAN_TERMS.values() if term.effect)
        lines = [name for name in names if line_terms(terms_of_effect(name))]
        for name in names:
            if name not in lines:
                found.append(self._of_terms(name, accepted))
                if found[-1].seen:
                    accepted |= terms_of_effect(name)
        return found + self._of_lines(lines, accepted | {"bow"})

    def _freed(self, maps_um: Sequence[np.ndarray], terms: Terms) -> list[CrossFit]:
        blocks = Blocks(seed=self.study.seed)
        return [
            cross_fit(scan.stored.height_um, own, scan.usable, terms, blocks, scan_line=scan.line)
            for scan, own in zip(self.scans, maps_um, strict=True)
        ]

    def _of_terms(self, name: str, accepted: Terms) -> ScanFinding:
        effect, own = get_effect(name), terms_of_effect(name)
        before, after = self.freed(accepted - own), self.freed(accepted | own)
        judgement = _as_variance(before, after, self.study)
        values = coefficients(self.scans, self.maps_um, own, accepted | own)
        grouped = by_print(values, [scan.stored.print_id for scan in self.scans], self.study.seed)
        # If the term agrees between the scans of one print, the printer may be its cause instead of the
        # microscope.
        unclear = effect.role == "measurement" and grouped is not None and grouped.p <= GROUPED_P
        spreads = zip(effect.parameters.items(), values.std(axis=0, ddof=1).tolist(), strict=True)
        few, many = (np.mean([fit.degrees_of_freedom for fit in fits]) for fits in (before, after))
        was, now = np.sqrt([judgement.before_nm2, judgement.before_nm2 - judgement.gain_nm2])
        told = (
            f"if the number of terms per scan rises from {few:.0f} to {many:.0f}, the RMSE on "
            f"pixels outside the fit changes from {was:.2f} to {now:.2f} nm"
        )
        return ScanFinding.of(
            name,
            "; ".join(filter(None, (judgement.reason(), told))),
            role="undetermined" if unclear else effect.role,
            seen=not judgement.reason(),
            p=judgement.p,
            spread={
                parameter: Strength(value=value, unit=facts.unit) for (parameter, facts), value in spreads
            },
        )

    def _of_lines(self, names: Sequence[str], accepted: Terms) -> list[ScanFinding]:
        """Test whether the heights contain offsets of whole lines. The lines are scan lines or rows of the
        layout.

        The offsets of scan lines are compared with the offsets of rows. Both are also compared with offsets
        of the layout's columns, which serve as a control. Scans are slightly rotated relative to their
        layouts. Offsets that follow the layout's rows come from the printer, and offsets that follow the scan
        lines come from the microscope. If no scan were rotated, the two kinds of offsets could not be
        distinguished.
        """
        by_row, by_column = self._with_profile(axis=1), self._with_profile(axis=0)
        before = self._freed(by_row, accepted)
        judged = {
            name: _as_variance(before, self._freed(by_row, accepted | terms_of_effect(name)), self.study)
            for name in names
        }
        bare, freed = (self._freed(by_column, terms) for terms in (accepted, accepted | {"layout-columns"}))
        columns = _as_variance(bare, freed, self.study).gains_nm2
        found: list[ScanFinding] = []
        for name, other in permutations(names):
            gains = judged[name].gains_nm2
            behind = judged[other].gains_nm2 - gains
            beaten, better = (one_sided_flip_p(sign * behind) <= CONFIRM_P for sign in (1, -1))
            excess_p = one_sided_flip_p(gains - columns)
            reasons = [*filter(None, [judged[name].reason()])]
            if excess_p > CONFIRM_P:
                reasons.append(f"offsets of rows gain no more than offsets of columns (p = {excess_p:.3f})")
            if beaten:
                reasons.append(f"the offsets follow {_frame(other)} more closely, which indicates {other}")
            elif not better and found:
                reasons.append(
                    f"cannot be distinguished from {other}: no scan is rotated enough on its layout"
                )
            deviation = np.sqrt(np.maximum(gains, 0).mean()) / NM_PER_UM
            taken = f"{gains.mean():.1f} nm² along {_frame(name)} and {columns.mean():.1f} nm² along columns"
            found.append(
                ScanFinding.of(
                    name,
                    "; ".join([*reasons, f"offsets explain {taken}"]),
                    seen=not reasons,
                    p=excess_p,
                    spread={"sd_um": Strength(value=float(deviation), unit="µm")},
                    confusable_with=[] if beaten or better else [other],
                )
            )
        return found

    def _with_profile(self, axis: int) -> list[np.ndarray]:
        """Add to each expected map a profile that contains, for each line, the mean residual of this line
        over the scans of other folds. The lines are rows if ``axis`` is 1, and columns if ``axis`` is 0.

        If the scans differ in size, nothing is added, because the lines of different scans then do not
        correspond to each other.
        """
        if len({scan.usable.shape[1 - axis] for scan in self.scans}) > 1:
            return list(self.maps_um)
        totals = np.stack([one.sum(axis=axis) for one in self._smooth_um])
        seen = np.stack([scan.usable.sum(axis=axis) for scan in self.scans])
        found = list(self.maps_um)
        for others, own in self.study.folds:
            profile = totals[others].sum(axis=0) / np.maximum(seen[others].sum(axis=0), 1)
            for i in own:
                found[i] = found[i] + np.expand_dims(profile, axis)
        return found

    @cached_property
    def _smooth_um(self) -> list[np.ndarray]:
        """Return the residual map of each scan after its datum and bow have been fitted and subtracted, µm.
        Each map has shape (ny, nx).

        Pixels that were not measured have the value 0.
        """
        return [
            freed_um(scan.stored.height_um, own, scan.usable, frozenset({"offset", "bow"}))
            for scan, own in zip(self.scans, self.maps_um, strict=True)
        ]


def coefficients(
    scans: Sequence[PreparedScan], maps_um: Sequence[np.ndarray], own: Terms, terms: Terms
) -> np.ndarray:
    """Fit all ``terms`` to each scan. Return only the k coefficients of the terms in ``own``, as an array of
    shape (scans, k).

    Coefficients of displacements are in µm.
    """
    found = []
    lengths = _columns_of((term.name for term in chosen_terms(own) if term.unit == "px"), terms)
    for scan, expected in zip(scans, maps_um, strict=True):
        design = scan.terms_at_sample(expected, terms)
        fitted = least_squares(design, scan.height - scan.at_sample(expected))
        fitted[lengths] *= scan.context.pitch_um
        found.append(fitted[_columns_of(own, terms)])
    return np.stack(found)


def _as_variance(before: Sequence[CrossFit], after: Sequence[CrossFit], study: Study) -> Judgement:
    """Judge a per-scan term by whether the two halves of each scan agree on it.

    The number of scans with a smaller error would not be a suitable test: in a scan whose term is near zero,
    the error does not decrease even if the term differs from scan to scan.
    """
    residuals_um = [[fit.residual_um for fit in fits] for fits in (before, after)]
    was, now = (np.array([NM_PER_UM**2 * np.nanmean(one**2) for one in own]) for own in residuals_um)
    return judge(was, now, study, np.array([*map(evidence_nm2, *residuals_um)]))


def _frame(effect: str) -> str:
    return line_terms(terms_of_effect(effect))[0].frame


def _columns_of(names: Iterable[str], terms: Terms) -> list[int]:
    """Return the indices of the maps in ``term_maps(…, terms)`` that belong to the named terms."""
    wanted = parameter_names(names)
    return [at for at, name in enumerate(parameter_names(terms)) if name in wanted]
