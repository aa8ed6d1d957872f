"""Find marks in single scans: rounded heights, scars, short lines and bends.

Marks are reported together with the evidence for them. They are not part of any model, because a model of
marks would not lower the errors on held-out scans.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import find_objects, label

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.judging import CONFIRM_P
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import ScanFinding
from litho_models.scan_terms import POLICIES, freed_um, row_index
from litho_models.scan_terms.lines import axis_along
from litho_models.scoring.statistics import one_sided_flip_p

# Range of distances between pixels over which the residuals of line-shaped roughness are correlated. These
# distances are longer than the resolution of tip and spot, and shorter than a line-shaped feature.
_LINE_LAGS_UM = (0.3, 0.8)
# Marks with an rms height below this value are not reported as seen, because they do not matter.
_SMALLEST_RMS_NM = 0.5


def marks(
    scans: Sequence[PreparedScan], maps_um: Sequence[np.ndarray], rounding_um: Mapping[str, float] | None
) -> list[ScanFinding]:
    """Return one finding for each kind of mark.

    Args:
        scans: the original scans.
        maps_um: maps that the scans are expected to show, one per scan, µm, of shape (ny, nx).
        rounding_um: step, µm, to which the heights in the raw file of each scan are rounded, keyed by scan
            id. None if there are no raw files.
    """
    residuals = [
        freed_um(scan.stored.height_um, own, scan.usable, POLICIES["full"])
        for scan, own in zip(scans, maps_um, strict=True)
    ]
    found = [_scars(scans, residuals), _short_lines(scans, maps_um, residuals), _bends(scans)]
    return found if rounding_um is None else [*found, _rounding([*rounding_um.values()])]


def with_marks(findings: Sequence[ScanFinding], seen: Sequence[ScanFinding]) -> list[ScanFinding]:
    """Merge the findings about per-scan terms (``findings``) with those about marks (``seen``). If both lists
    contain a finding of the same name, they are merged into one, which counts as seen if either of the two
    does.
    """
    found: dict[str, list[ScanFinding]] = {}
    for one in (*findings, *seen):
        found.setdefault(one.name, []).append(one)
    # Of two findings with the same name, the one that counts as seen is kept. It gets the evidence of both.
    ordered = [sorted(own, key=lambda one: not one.seen) for own in found.values()]
    return [
        first.model_copy(update={"evidence": "; ".join(one.evidence for one in (first, *others))})
        for first, *others in ordered
    ]


def rounding_step_um(raw_height_um: np.ndarray) -> float:
    """Return the step to which the heights of a raw scan are rounded, µm. Apart from a common offset, all
    heights are multiples of this step. Return 0 if there is no such step.
    """
    heights = np.unique(raw_height_um[np.isfinite(raw_height_um)].astype(np.float64))
    steps = np.diff(heights)
    # Smaller differences between heights arise only from storing the heights in single precision.
    steps = steps[steps > 1e-6 * np.ptp(heights)] if len(heights) > 2 else steps[:0]
    if not len(steps):
        return 0.0
    step = float(np.median(steps[steps < 1.5 * steps.min()]))
    places = (heights - heights[0]) / step
    return step if np.mean(np.abs(places - np.round(places)) < 0.05) >= 0.99 else 0.0


def _rounding(steps_um: Sequence[float]) -> ScanFinding:
    """Report the rounding of the heights in the raw files. Rounding adds uniformly distributed noise, whose
    rms is the step divided by √12.
    """
    steps_nm = NM_PER_UM * np.array(steps_um)
    noise_nm, rounded = float(np.sqrt(np.mean(steps_nm**2) / 12)), steps_nm[steps_nm > 0]
    if not len(rounded):
        evidence = "the heights in the raw files are not multiples of a common step"
    else:
        evidence = (
            f"the raw heights of {len(rounded)} of {len(steps_nm)} scans are multiples of "
            f"{np.median(rounded):.3g} nm; this rounding adds noise of {noise_nm:.2g} nm rms"
        )
    return ScanFinding.of("quantisation", evidence, seen=noise_nm >= _SMALLEST_RMS_NM)


def _scars(scans: Sequence[PreparedScan], residuals: Sequence[np.ndarray]) -> ScanFinding:
    """Test whether the scans contain scars (scratch-like errors along scan lines). If they do, more outliers
    are elongated along the scan lines than across them.
    """
    along, across = np.array([*map(_drawn_out, scans, residuals)]).T
    p = one_sided_flip_p((along - across).astype(float))
    text = (
        f"{along.sum()} outliers are elongated along the scan lines and {across.sum()} across them "
        f"(p = {p:.4f})"
    )
    return ScanFinding.of("scars-and-spikes", text, seen=p <= CONFIRM_P and along.sum() >= 10, p=p)


def _drawn_out(scan: PreparedScan, residual_um: np.ndarray) -> tuple[int, int]:
    """Return two numbers: that of the outliers that are elongated along the scan lines, and that of the
    outliers that are elongated across them. An outlier is a connected patch of pixels with large residuals.
    """
    seen = residual_um[scan.usable]
    spread = 1.4826 * float(np.median(np.abs(seen - np.median(seen))))
    numbered, _ = label(scan.usable & (np.abs(residual_um) > 5 * spread))
    sizes, along, across = np.bincount(numbered.ravel()), 0, 0
    for size, box in zip(sizes[1:], find_objects(numbered), strict=True):
        height, width = (part.stop - part.start for part in box)
        # Patches with fewer than nine pixels count as noise. A patch counts as elongated if it is at least
        # four times as long as wide.
        if size >= 9:
            along += width >= 4 * height
            across += height >= 4 * width
    return (across, along) if axis_along(scan.line) == 0 else (along, across)


def _short_lines(
    scans: Sequence[PreparedScan], maps_um: Sequence[np.ndarray], residuals: Sequence[np.ndarray]
) -> ScanFinding:
    """Test whether the surface has short line-shaped features along the scan lines. If so, the residuals of
    nearby pixels agree better along the scan lines than across them.

    Only flat areas are used, because the residuals on slopes contain errors of the model.
    """
    along, across = np.array([*map(_shared_nm2, scans, maps_um, residuals)]).T
    p = one_sided_flip_p(along - across)
    rms_nm = float(np.sqrt(max((along - across).mean(), 0.0)))
    first, last = _LINE_LAGS_UM
    text = (
        f"on flat areas, residuals {first:g} to {last:g} µm apart share {along.mean():.1f} nm² of variance "
        f"along the scan lines and {across.mean():.1f} nm² across them (p = {p:.4f}); the line-shaped "
        f"roughness is at least {rms_nm:.1f} nm rms and comes from the print or from the microscope"
    )
    return ScanFinding.of("line-roughness", text, seen=p <= CONFIRM_P and rms_nm >= _SMALLEST_RMS_NM, p=p)


def _shared_nm2(scan: PreparedScan, prediction: np.ndarray, residual_um: np.ndarray) -> tuple[float, float]:
    """Return the mean product, nm², of the residuals of two pixels at distances within ``_LINE_LAGS_UM``:
    first for pairs of pixels along the scan lines, then for pairs across them.
    """
    slope = np.hypot(*np.gradient(prediction))
    flat = scan.usable & (slope <= np.median(slope))
    values = np.where(flat, NM_PER_UM * residual_um, 0.0)
    for line in (scan.line, row_index(flat.shape)):
        # The mean of every line is subtracted, so that line offsets do not count. An error of this mean can
        # only lower the mean product along the lines.
        total, count = (
            np.bincount(line[flat], weights=w, minlength=line.max() + 1) for w in (values[flat], None)
        )
        values = np.where(flat, values - (total / np.maximum(count, 1))[line], 0.0)
    first, last = (max(1, round(lag / scan.context.pitch_um)) for lag in _LINE_LAGS_UM)

    def mean_product(turned: bool) -> float:
        shown = [one.T if turned else one for one in (values, flat.astype(float))]
        products, pairs = (
            sum(float((one[:, lag:] * one[:, :-lag]).sum()) for lag in range(first, last + 1))
            for one in shown
        )
        return products / max(pairs, 1.0)

    # In a scan rotated by 90 degrees, the scan lines run along y.
    turned = axis_along(scan.line) == 0
    return mean_product(turned), mean_product(not turned)


def _bends(scans: Sequence[PreparedScan]) -> ScanFinding:
    """Report how many bent scans the registration has straightened. All other steps of the loop use the
    straightened scans.
    """
    found_um = [scan.stored.bend_um.largest for scan in scans if scan.stored.bend_um is not None]
    text = f"the registration straightened {len(found_um)} of {len(scans)} scans"
    if found_um:
        text += f", which were bent by up to {max(found_um):.2f} µm (median {np.median(found_um):.2f} µm)"
    return ScanFinding.of("registration-residual", text, seen=bool(found_um))
