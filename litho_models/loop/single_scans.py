"""Find out which of the following terms differ from scan to scan: datum, gain, bow, drift, registration
errors and line offsets.

Such terms cannot be predicted for the next print, so they are not part of any model. A term counts as present
if it agrees between two halves of a scan: the term that is fitted to one half of the pixels must agree with
the residual of the other half.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import permutations

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import get_effect
from litho_models.loop.fits import Study
from litho_models.loop.judging import CONFIRM_P, GROUPED_P, Judgement, evidence_nm2, judge
from litho_models.loop.marks import scars
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import ScanFinding, Strength
from litho_models.scan_terms import (
    SCAN_TERMS,
    Blocks,
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
    """Test which per-scan terms and marks the scans contain. To test a term, fit it to pixels that are not
    scored, and subtract it from the pixels that are scored.

    Args:
        study: the original scans with their folds, and the seed.
        maps_um: map that each scan is expected to show, µm, of shape (ny, nx). It is predicted by a model of
            the printer and a measurement model, both of which were fitted without this scan.
    """

    def __init__(self, study: Study, maps_um: Sequence[np.ndarray]):
        self.study, self.scans, self.maps_um = study, study.scans, maps_um
        # Each test needs two sets of residuals, and one of them is needed again by the next test.
        self._freed_um = lru_cache(maxsize=2)(self._without)

    def findings(self) -> list[ScanFinding]:
        """Test all per-scan effects, one after the other, and return the findings about them and about scars.
        In each test, the terms of all effects that were found in earlier tests are fitted, too. Line offsets
        are tested last.
        """
        accepted: Terms = frozenset({"offset"})
        found, lines = list[ScanFinding](), list[str]()
        for name in dict.fromkeys(term.effect for term in SCAN_TERMS.values() if term.effect):
            own = terms_of_effect(name)
            if line_terms(own):
                lines.append(name)
                continue
            one = self._of_terms(name, accepted - own, accepted | own)
            if one.seen:
                accepted |= own
            if name == "registration-residual":
                # All other steps of the loop use the scans that the registration has straightened.
                bent = sum(scan.bend_um is not None for scan in self.scans)
                text = f"{one.evidence}; the registration straightened {bent} of {len(self.scans)} scans"
                one = one.model_copy(update={"evidence": text, "seen": one.seen or bent > 0})
            found.append(one)
        return [*found, *self._of_lines(lines, accepted | {"bow"}), scars(self.scans, self.maps_um)]

    def _without(self, terms: Terms) -> list[np.ndarray]:
        """Fit terms to each scan and return the residuals, µm."""
        blocks = Blocks(seed=self.study.seed)
        return [
            cross_fit(scan.height_um, own, scan.usable, terms, blocks, scan_line=scan.line).residual_um
            for scan, own in zip(self.scans, self.maps_um, strict=True)
        ]

    def _judged(self, before: Terms, after: Terms) -> Judgement:
        """Judge per-scan terms by whether the two halves of each scan agree on them.

        The number of scans with a smaller error would not be a suitable test: in a scan whose term is near
        zero, the error does not decrease even if the term differs from scan to scan.

        Args:
            before, after: the terms that are fitted without and with those that are judged.
        """
        left_um = [self._freed_um(terms) for terms in (before, after)]
        was, now = (np.array([NM_PER_UM**2 * np.nanmean(one**2) for one in own]) for own in left_um)
        return judge(was, now, self.study, np.array([*map(evidence_nm2, *left_um)]))

    def _of_terms(self, name: str, before: Terms, after: Terms) -> ScanFinding:
        """Test an effect that consists of smooth maps. ``before`` contains the terms of the effects that were
        found in earlier tests, and ``after`` also contains the terms of this effect.
        """
        effect, judgement = get_effect(name), self._judged(before, after)
        reason = judgement.reason()
        values = coefficients(self.scans, self.maps_um, terms_of_effect(name), after)
        grouped = by_print(values, [scan.print_id for scan in self.scans], self.study.seed)
        # If the term agrees between the scans of one print, the printer may be its cause instead of the
        # microscope.
        unclear = effect.role == "measurement" and grouped is not None and grouped.p <= GROUPED_P
        spreads = zip(effect.parameters.items(), values.std(axis=0, ddof=1).tolist(), strict=True)
        few, many = (len(parameter_names(terms)) for terms in (before, after))
        was, now = np.sqrt([judgement.before_nm2, judgement.before_nm2 - judgement.gain_nm2])
        told = (
            f"if the number of terms per scan rises from {few} to {many}, the RMSE on "
            f"pixels outside the fit changes from {was:.2f} to {now:.2f} nm"
        )
        return ScanFinding(
            name=name,
            title=effect.title,
            role="undetermined" if unclear else effect.role,
            seen=not reason,
            evidence=f"{reason}; {told}" if reason else told,
            p=judgement.p,
            spread={key: Strength(value=value, unit=facts.unit) for (key, facts), value in spreads},
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
        # The profile that all scans share is subtracted, because it does not belong to a single scan.
        along_y, along_x = (SingleScans(self.study, self._with_profile(axis)) for axis in (0, 1))
        judged = {name: along_x._judged(accepted, accepted | terms_of_effect(name)) for name in names}
        columns = along_y._judged(accepted, accepted | {"layout-columns"}).gains_nm2
        frames = {name: line_terms(terms_of_effect(name))[0].frame for name in names}
        found: list[ScanFinding] = []
        for name, other in permutations(names):
            effect, gains = get_effect(name), judged[name].gains_nm2
            behind = judged[other].gains_nm2 - gains
            beaten, better = (one_sided_flip_p(sign * behind) <= CONFIRM_P for sign in (1, -1))
            excess_p = one_sided_flip_p(gains - columns)
            reasons = [*filter(None, [judged[name].reason()])]
            if excess_p > CONFIRM_P:
                reasons.append(f"offsets of rows gain no more than offsets of columns (p = {excess_p:.3f})")
            if beaten:
                reasons.append(f"the offsets follow {frames[other]} more closely, which indicates {other}")
            elif not better and found:
                reasons.append(
                    f"cannot be distinguished from {other}: no scan is rotated enough on its layout"
                )
            deviation = np.sqrt(np.maximum(gains, 0).mean()) / NM_PER_UM
            taken = f"{gains.mean():.1f} nm² along {frames[name]} and {columns.mean():.1f} nm² along columns"
            found.append(
                ScanFinding(
                    name=name,
                    title=effect.title,
                    role=effect.role,
                    seen=not reasons,
                    evidence="; ".join([*reasons, f"offsets explain {taken}"]),
                    p=excess_p,
                    spread=dict.fromkeys(effect.parameters, Strength(value=float(deviation), unit="µm")),
                    confusable_with=[] if beaten or better else [other],
                )
            )
        return found

    def _with_profile(self, axis: int) -> list[np.ndarray]:
        """Add to each expected map a profile that contains, for each line, the mean residual of this line
        over the scans of other folds. The lines are rows if ``axis`` is 1, and columns if ``axis`` is 0. The
        residual is computed after the datum and the bow of each scan have been fitted and subtracted.

        If the scans differ in size, nothing is added, because the lines of different scans then do not
        correspond to each other.
        """
        found = list(self.maps_um)
        if len({scan.usable.shape[1 - axis] for scan in self.scans}) > 1:
            return found
        smooth, pairs = frozenset({"offset", "bow"}), zip(self.scans, self.maps_um, strict=True)
        left_um = [freed_um(scan.height_um, own, scan.usable, smooth) for scan, own in pairs]
        usable = [scan.usable for scan in self.scans]
        for others, own in self.study.folds:
            total, seen = (sum(maps[i].sum(axis) for i in others) for maps in (left_um, usable))
            for i in own:
                found[i] = found[i] + np.expand_dims(total / np.maximum(seen, 1), axis)
        return found


def coefficients(
    scans: Sequence[PreparedScan], maps_um: Sequence[np.ndarray], own: Terms, terms: Terms
) -> np.ndarray:
    """Fit all ``terms`` to each scan. Return only the k coefficients of the terms in ``own``, as an array of
    shape (scans, k).

    Coefficients of displacements are in µm.
    """
    # The term to which each fitted map belongs.
    of_maps = [term for term in chosen_terms(terms) if term.maps for _ in term.labels]
    kept = [term.name in own for term in of_maps]
    lengths = [term.unit == "px" for term in of_maps]
    found = []
    for scan, expected in zip(scans, maps_um, strict=True):
        design = scan.terms_at_sample(expected, terms)
        fitted = least_squares(design, scan.residual(expected))
        fitted[lengths] *= scan.context.pitch_um
        found.append(fitted[kept])
    return np.stack(found)
