"""Effects that are seen directly, in the raw files or as marks in a scan: no model predicts them.

They lower no held-out error, so they are not added to a model; they have a verdict and its evidence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.defects import Defects
from litho_models.loop.selection.confirming import BINOMIAL_P, SMALLEST_RMSE_NM
from litho_models.loop.study import Study
from litho_models.scan_terms import Terms, line_terms, row_index
from litho_models.scan_terms.lines import axis_along
from litho_models.scoring.statistics import one_sided_flip_p

# Heights closer than this are one value of a file that rounds in single precision.
_SAME_VALUE = 1e-6
_OFF_COMB, _ON_COMB_SHARE = 0.05, 0.99
_FEWEST_SCARS = 10
# Beyond the sharpness of tip and spot, and within the length of a line-shaped feature.
_LINE_LAGS_UM = (0.3, 0.8)


@dataclass(frozen=True)
class Observed:
    """Whether an effect is seen, and the evidence in a sentence."""

    name: str
    seen: bool
    evidence: str


def rounding_step_um(raw_height_um: np.ndarray) -> float:
    """Step of which all heights of a raw scan are multiples, up to one offset; 0 where there is none."""
    heights = np.unique(raw_height_um[np.isfinite(raw_height_um)].astype(np.float64))
    if len(heights) < 3:
        return 0.0
    steps = np.diff(heights)
    steps = steps[steps > _SAME_VALUE * (heights[-1] - heights[0])]
    if not len(steps):
        return 0.0
    step = float(np.median(steps[steps < 1.5 * steps.min()]))
    places = (heights - heights[0]) / step
    off = np.abs(places - np.round(places))
    return step if np.mean(off < _OFF_COMB) >= _ON_COMB_SHARE else 0.0


def quantisation(rounding_um: Sequence[float]) -> Observed:
    """Rounding of the raw files, from ``rounding_step_um`` of every scan: uniform noise of step / √12."""
    steps_nm = np.array(rounding_um) * NM_PER_UM
    noise_nm = float(np.sqrt(np.mean(steps_nm**2) / 12))
    rounded = int((steps_nm > 0).sum())
    if not rounded:
        return Observed("quantisation", False, "the heights of the raw files share no common step")
    text = (
        f"the raw heights of {rounded} of {len(steps_nm)} scans are multiples of "
        f"{np.median(steps_nm[steps_nm > 0]):.3g} nm, which adds {noise_nm:.2g} nm rms"
    )
    return Observed("quantisation", noise_nm >= SMALLEST_RMSE_NM, text)


def scars(scans: Sequence[PreparedScan], defects: Defects) -> Observed:
    """Outliers drawn out along the scan lines, against those drawn out across them, scan by scan."""
    along, across = (
        np.array([sum(b.scan == f.id and getattr(b, kind) for b in defects.blobs) for f in scans])
        for kind in ("row_limited", "column_limited")
    )
    p = one_sided_flip_p((along - across).astype(float))
    text = (
        f"{along.sum()} outliers drawn out along the lines and {across.sum()} across them "
        f"(p = {p:.4f}); {100 * float(np.mean(defects.share_of_pixels)):.2f} % of the pixels in outliers"
    )
    seen = p <= BINOMIAL_P and along.sum() >= _FEWEST_SCARS
    return Observed("scars-and-spikes", bool(seen), text)


def line_roughness(study: Study, predictions: Sequence[np.ndarray], terms: Terms) -> Observed:
    """Residual that neighbours along a scan line share and neighbours across do not, in flat places.

    The mean of every line, of the scan and of the layout, is taken out first: offsets of whole lines are
    a term of single scans. Slopes are left out: what a model misses there is not noise.
    """
    lines = {term.name for term in line_terms(terms)}
    residuals = study.score(predictions, terms - lines).residual_um
    shared = np.array(
        [_shared_nm2(f, p, r) for f, p, r in zip(study.scans, predictions, residuals, strict=True)]
    )
    along, across = shared.T
    p = one_sided_flip_p(along - across)
    rms_nm = float(np.sqrt(max((along - across).mean(), 0.0)))
    text = (
        f"flat places {_LINE_LAGS_UM[0]:g} to {_LINE_LAGS_UM[1]:g} µm apart share {along.mean():.1f} nm² "
        f"along the lines and {across.mean():.1f} nm² across them (p = {p:.4f}): line-shaped roughness of "
        f"{rms_nm:.1f} nm rms or more, of the print or of the microscope"
    )
    return Observed("line-roughness", bool(p <= BINOMIAL_P and rms_nm >= SMALLEST_RMSE_NM), text)


def bends(scans: Sequence[PreparedScan]) -> Observed:
    """Scans that registration found bent, and straightened: the loop sees them without their bend."""
    found_um = [f.stored.bend_um.largest for f in scans if f.stored.bend_um is not None]
    text = f"registration straightened {len(found_um)} of {len(scans)} scans"
    if found_um:
        text += f", bent by up to {max(found_um):.2f} µm (median {np.median(found_um):.2f} µm)"
    return Observed("registration-residual", bool(found_um), text)


def _shared_nm2(scan: PreparedScan, prediction: np.ndarray, residual_um: np.ndarray) -> tuple[float, float]:
    """Mean product of residuals some lags apart, along the lines and across them, nm²."""
    slope = np.hypot(*np.gradient(prediction))
    flat = np.isfinite(residual_um) & (slope <= np.median(slope))
    values = np.where(flat, residual_um, 0.0) * NM_PER_UM
    for line in (scan.line, row_index(flat.shape)):
        # In the sample: what this takes off too much makes neighbours along a line share less, not more.
        total, count = (
            np.bincount(line[flat], weights=w, minlength=line.max() + 1) for w in (values[flat], None)
        )
        values = np.where(flat, values - (total / np.maximum(count, 1))[line], 0.0)
    first, last = (max(1, round(lag / scan.context.pitch_um)) for lag in _LINE_LAGS_UM)
    lags = range(first, last + 1)

    def mean_product(v: np.ndarray, w: np.ndarray) -> float:
        products = sum(float((v[:, lag:] * v[:, :-lag]).sum()) for lag in lags)
        pairs = sum(float((w[:, lag:] * w[:, :-lag]).sum()) for lag in lags)
        return products / max(pairs, 1.0)

    weight = flat.astype(float)
    by_axis = mean_product(values.T, weight.T), mean_product(values, weight)
    # A scan turned by 90 degrees has its lines along y.
    return (by_axis[1], by_axis[0]) if axis_along(scan.line) else by_axis


def observe(
    study: Study,
    predictions: Sequence[np.ndarray],
    terms: Terms,
    defects: Defects,
    rounding_um: Mapping[str, float] | None,
) -> dict[str, Observed]:
    """All effects that are seen directly; without the raw files nothing is said about their rounding.

    Args:
        predictions: held-out heights (y, x), µm, of the final model.
        terms: scan terms that were accepted.
        defects: outliers of the scans.
        rounding_um: step of the heights in each scan's raw file, by id, if known.
    """
    seen = [scars(study.scans, defects), line_roughness(study, predictions, terms), bends(study.scans)]
    if rounding_um is not None:
        seen.append(quantisation([rounding_um[f.id] for f in study.scans]))
    return {one.name: one for one in seen}
