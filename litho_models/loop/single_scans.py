"""Find what single scans contain besides the print: terms that differ from scan to scan (datum, gain, bow,
drift, registration errors and line offsets) and marks (scars, bends and rounded heights).

Terms of single scans cannot be predicted for the next print, and a model of marks would not lower the errors
on held-out scans. Neither is therefore part of any model. A term counts as present if it agrees between two
halves of a scan: the term that is fitted to one half of the pixels must agree with the residual of the other
half.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import permutations

import numpy as np
from scipy.ndimage import find_objects, label
from scipy.stats import median_abs_deviation

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan, Store
from litho_models.effects import get_effect
from litho_models.loop.fits import Study
from litho_models.loop.judging import CONFIRM_P, GROUPED_P, Judgement, evidence_nm2, judge
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import ScanFinding, Strength
from litho_models.scan_terms import (
    POLICIES,
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
from litho_models.scan_terms.lines import axis_along
from litho_models.scoring.statistics import by_print, one_sided_flip_p, rms

# Rounding that adds less noise than this is not reported as seen, because it does not matter.
_SMALLEST_RMS_NM = 0.5


class SingleScans:
    """Test which per-scan terms and marks the scans contain. To test a term, fit it to pixels that are not
    scored, and subtract it from the pixels that are scored.

    Args:
        study: the original scans with their folds, and the seed.
        maps_um: map that each scan is expected to show, µm, of shape (ny, nx). It is predicted by a model of
            the printer and a measurement model, both of which were fitted without this scan.
        steps_um: rounding step of the heights in the raw file of each scan, as ``rounding_um`` returns it. If
            it is empty, there is no finding about rounding.
    """

    def __init__(self, study: Study, maps_um: Sequence[np.ndarray], steps_um: Sequence[float] = ()):
        self.study, self.scans, self.maps_um, self.steps_um = study, study.scans, maps_um, steps_um
        # Each test needs two sets of residuals, and one of them is needed again by the next test.
        self._freed_um = lru_cache(maxsize=2)(self._without)

    def findings(self) -> list[ScanFinding]:
        """Test all per-scan effects, one after the other, and return the findings about them and about marks.
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
            found.append(self._of_terms(name, accepted - own, accepted | own))
            if found[-1].seen:
                accepted |= own
        found = [with_bends(one, self.scans) if one.name == "registration-residual" else one for one in found]
        found += [*self._of_lines(lines, accepted | {"bow"}), scars(self.scans, self.maps_um)]
        return [*found, rounding(self.steps_um)] if self.steps_um else found

    def _without(self, terms: Terms, axis: int | None) -> list[np.ndarray]:
        """Fit terms to each scan and return the residuals, µm. If ``axis`` is given, the mean profile of the
        scans of other folds is subtracted first; see ``_with_profile``.
        """
        maps = self.maps_um if axis is None else self._with_profile(axis)
        blocks = Blocks(seed=self.study.seed)
        return [
            cross_fit(scan.stored.height_um, own, scan.usable, terms, blocks, scan_line=scan.line).residual_um
            for scan, own in zip(self.scans, maps, strict=True)
        ]

    def _judged(self, before: Terms, after: Terms, axis: int | None = None) -> Judgement:
        """Judge per-scan terms by whether the two halves of each scan agree on them.

        The number of scans with a smaller error would not be a suitable test: in a scan whose term is near
        zero, the error does not decrease even if the term differs from scan to scan.

        Args:
            before, after: the terms that are fitted without and with those that are judged.
            axis: as for ``_without``.
        """
        left_um = [self._freed_um(terms, axis) for terms in (before, after)]
        was, now = (np.array([NM_PER_UM**2 * np.nanmean(one**2) for one in own]) for own in left_um)
        return judge(was, now, self.study, np.array([*map(evidence_nm2, *left_um)]))

    def _of_terms(self, name: str, before: Terms, after: Terms) -> ScanFinding:
        """Test an effect that consists of smooth maps. ``before`` contains the terms of the effects that were
        found in earlier tests, and ``after`` also contains the terms of this effect.
        """
        effect, judgement = get_effect(name), self._judged(before, after)
        reason, gain_nm2 = judgement.reason(), judgement.gain_nm2
        values = coefficients(self.scans, self.maps_um, terms_of_effect(name), after)
        grouped = by_print(values, [scan.stored.print_id for scan in self.scans], self.study.seed)
        # If the term agrees between the scans of one print, the printer may be its cause instead of the
        # microscope.
        unclear = effect.role == "measurement" and grouped is not None and grouped.p <= GROUPED_P
        spreads = zip(effect.parameters.items(), values.std(axis=0, ddof=1).tolist(), strict=True)
        few, many = (len(parameter_names(terms)) for terms in (before, after))
        was, now = np.sqrt([judgement.before_nm2, judgement.before_nm2 - gain_nm2])
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
        judged = {name: self._judged(accepted, accepted | terms_of_effect(name), axis=1) for name in names}
        columns = self._judged(accepted, accepted | {"layout-columns"}, axis=0).gains_nm2
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
                    spread={"sd_um": Strength(value=float(deviation), unit="µm")},
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
        left_um = [freed_um(scan.stored.height_um, own, scan.usable, smooth) for scan, own in pairs]
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
        fitted = least_squares(design, scan.height - scan.at_sample(expected))
        fitted[lengths] *= scan.context.pitch_um
        found.append(fitted[kept])
    return np.stack(found)


def rounding_um(store: Store, scans: Sequence[PrintedScan]) -> list[float]:
    """Return the rounding step of the heights in the raw file of each scan, µm. The list is empty if the
    store has no raw files.
    """
    try:
        return [rounding_step_um(store.scan_frame(scan.id, "raw_height_um")) for scan in scans]
    except InputError:
        return []


def rounding_step_um(raw_height_um: np.ndarray) -> float:
    """Return the rounding step of the heights of a raw scan, µm. Apart from a common offset, all heights are
    multiples of this step. Return 0 if there is no such step.
    """
    heights = np.unique(raw_height_um[np.isfinite(raw_height_um)].astype(np.float64))
    steps = np.diff(heights)
    # Smaller differences between heights arise only from storing the heights in single precision.
    steps = steps[steps > 1e-6 * steps.sum()]
    if len(heights) < 3 or not len(steps):
        return 0.0
    step = float(np.median(steps[steps < 1.5 * steps.min()]))
    places = (heights - heights[0]) / step
    return step if np.mean(np.abs(places - np.round(places)) < 0.05) >= 0.99 else 0.0


def rounding(steps_um: Sequence[float]) -> ScanFinding:
    """Report the rounding of the heights in the raw files. Rounding adds uniformly distributed noise, whose
    rms is the step divided by √12.
    """
    steps_nm = NM_PER_UM * np.array(steps_um)
    noise_nm, rounded = rms(steps_nm) / 12**0.5, steps_nm[steps_nm > 0]
    evidence = "the heights in the raw files are not multiples of a common step"
    if len(rounded):
        evidence = (
            f"the raw heights of {len(rounded)} of {len(steps_nm)} scans are multiples of "
            f"{np.median(rounded):.3g} nm; this rounding adds noise of {noise_nm:.2g} nm rms"
        )
    name, seen = "quantisation", noise_nm >= _SMALLEST_RMS_NM
    return ScanFinding(name=name, title=name, role="measurement", seen=seen, evidence=evidence)


def scars(scans: Sequence[PreparedScan], maps_um: Sequence[np.ndarray]) -> ScanFinding:
    """Test whether the scans contain scars (scratch-like errors along scan lines). If they do, more outliers
    are elongated along the scan lines than across them.
    """
    along, across = np.array([*map(_drawn_out, scans, maps_um)]).T
    p = one_sided_flip_p((along - across).astype(float))
    text = (
        f"{along.sum()} outliers are elongated along the scan lines and {across.sum()} across them "
        f"(p = {p:.4f})"
    )
    name, seen = "scars-and-spikes", p <= CONFIRM_P and bool(along.sum() >= 10)
    return ScanFinding(name=name, title=name, role="measurement", seen=seen, evidence=text, p=p)


def _drawn_out(scan: PreparedScan, map_um: np.ndarray) -> tuple[int, int]:
    """Return the number of outliers that are elongated along the scan lines, and the number of outliers that
    are elongated across the scan lines. An outlier is a connected patch of pixels with large residuals.
    """
    residual_um = freed_um(scan.stored.height_um, map_um, scan.usable, POLICIES["full"])
    spread = median_abs_deviation(residual_um[scan.usable], scale=1 / 1.4826)
    numbered, _ = label(scan.usable & (np.abs(residual_um) > 5 * spread))
    sizes = np.bincount(numbered.ravel())[1:]
    boxes = [[part.stop - part.start for part in box] for box in find_objects(numbered)]
    # Patches with fewer than nine pixels count as noise. A patch counts as elongated if it is at least four
    # times as long as wide.
    sides = np.reshape(boxes, (-1, 2))[sizes >= 9]
    # The numbers of patches that are elongated along y and along x.
    counts, axis = (sides >= 4 * sides[:, ::-1]).sum(axis=0), axis_along(scan.line)
    return int(counts[axis]), int(counts[1 - axis])


def with_bends(finding: ScanFinding, scans: Sequence[PreparedScan]) -> ScanFinding:
    """Add the number of bent scans to the finding about the registration. The registration has straightened
    these scans, and all other steps of the loop use the straightened scans.
    """
    found_um = [scan.stored.bend_um.largest for scan in scans if scan.stored.bend_um is not None]
    text = f"{finding.evidence}; the registration straightened {len(found_um)} of {len(scans)} scans"
    if found_um:
        text += f", which were bent by up to {max(found_um):.2f} µm (median {np.median(found_um):.2f} µm)"
    return finding.model_copy(update={"evidence": text, "seen": finding.seen or bool(found_um)})
