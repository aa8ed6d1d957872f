"""Find marks in single scans: rounded heights, scars and bends.

Marks are reported together with the evidence for them. They are not part of any model, because a model of
marks would not lower the errors on held-out scans.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import label
from skimage.measure import regionprops

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness.noise import robust_sd
from litho_data.store import PrintedScan, Store
from litho_models.loop.judging import CONFIRM_P
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import ScanFinding
from litho_models.scan_terms import POLICIES, freed_um
from litho_models.scan_terms.lines import axis_along
from litho_models.scoring.statistics import one_sided_flip_p, rms

# Rounding that adds less noise than this is not reported as seen, because it does not matter.
_SMALLEST_RMS_NM = 0.5


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


def rounding(store: Store, scans: Sequence[PrintedScan]) -> list[ScanFinding]:
    """Report the rounding of the heights in the raw files. Rounding adds uniformly distributed noise, whose
    rms is the step divided by √12. If the store has no raw files, there is no finding.
    """
    try:
        steps_um = [rounding_step_um(store.scan_frame(scan.id, "raw_height_um")) for scan in scans]
    except InputError:
        return []
    steps_nm = NM_PER_UM * np.array(steps_um)
    noise_nm, rounded = rms(steps_nm) / 12**0.5, steps_nm[steps_nm > 0]
    evidence = "the heights in the raw files are not multiples of a common step"
    if len(rounded):
        evidence = (
            f"the raw heights of {len(rounded)} of {len(steps_nm)} scans are multiples of "
            f"{np.median(rounded):.3g} nm; this rounding adds noise of {noise_nm:.2g} nm rms"
        )
    name, seen = "quantisation", noise_nm >= _SMALLEST_RMS_NM
    return [ScanFinding(name=name, title=name, role="measurement", seen=seen, evidence=evidence)]


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


def _drawn_out(scan: PreparedScan, map_um: np.ndarray) -> np.ndarray:
    """Return the number of outliers that are elongated along the scan lines, and the number of outliers that
    are elongated across the scan lines, of shape (2,). An outlier is a connected patch of pixels with large
    residuals.
    """
    residual_um = freed_um(scan.height_um, map_um, scan.usable, POLICIES["full"])
    numbered, _ = label(scan.usable & (np.abs(residual_um) > 5 * robust_sd(residual_um[scan.usable])))
    # Patches with fewer than nine pixels count as noise. A patch counts as elongated if it is at least four
    # times as long as wide.
    sides = np.reshape([one.image.shape for one in regionprops(numbered) if one.area >= 9], (-1, 2))
    # The numbers of patches that are elongated along y and along x.
    counts, axis = (sides >= 4 * sides[:, ::-1]).sum(axis=0), axis_along(scan.line)
    return counts[[axis, 1 - axis]]
