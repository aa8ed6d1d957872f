"""Estimate the radius of the tip, or an upper bound on the radius, from scans, and find where the tip did not
touch the surface.
"""

import math
from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from litho_data.foundation import YX, Array, InputError
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts, run_facts
from litho_data.scan import Scan
from litho_data.tip.certainty import tip_certain
from litho_data.tip.curvature import noise_of
from litho_data.tip.radius import of_one_tip, peak_radius
from litho_data.tip.resolution import lateral_resolution_um

_SAME_PITCH = 1e-3


class ScanUnderTip(Record):
    """The effect of the tip on one scan.

    ``certain_fraction`` is the share of pixels that the tip certainly touched. ``resolution_um`` is the
    wavelength below which the scan may show the shape of the tip instead of the surface; it is None if the
    tip does not limit the resolution. Both values are None if the scans set no bound on the radius of the
    tip.
    """

    name: str
    certain_fraction: float | None
    resolution_um: float | None


class TipEstimate(RunFacts, Result):
    """The radius of a tip as estimated from scans made with it, and how the estimate was obtained.

    Args:
        kind: ``estimate`` if many places in the scans show the shape of the same tip end, otherwise ``upper
            bound``.
        radius_um: radius of the end of the tip, or its upper bound; None if the scans set no bound.
        radius_sd_um: standard uncertainty of the estimate; None if the radius is only a bound.
        reason: why the radius is only a bound; empty if it is an estimate.
        depth_um: range of heights in the scan from which the radius was determined, after its tilt and bow
            are removed.
        reach_px: radius, in pixels, that a spike with the height ``depth_um`` has in the image. For the tip
            radius R, it corresponds to √(2 R depth_um).
        pixel_noise_nm, line_noise_nm: standard deviations of the noise of single pixels and of whole lines,
            averaged over the scans as a root mean square.
        window_px: side length of the windows in which curvatures were measured; None if there is no bound.
        share: among the sharp peaks, the share of those that are about as sharp as the sharpest one. The
            share is high if the tip limits how sharp peaks appear.
        pitch_um: pixel pitch of the scans along y and x, µm.
        scans: results for each scan.
    """

    SCHEMA: ClassVar[str] = "litho-data/tip/1"
    FILE_NAME: ClassVar[str] = "tip.json"

    kind: Literal["estimate", "upper bound"]
    radius_um: float | None
    radius_sd_um: float | None
    reason: str
    depth_um: float
    reach_px: float | None
    pixel_noise_nm: float
    line_noise_nm: float
    window_px: int | None
    share: float | None
    pitch_um: YX
    scans: tuple[ScanUnderTip, ...]


def estimate_tip(scans: Sequence[Scan]) -> TipEstimate:
    """Estimate the radius of the tip that recorded one or more scans, such as all scans of one day.

    The radius is computed from the sharpest peaks, because no peak in an image is more sharply curved than
    the end of the tip. The result is an estimate if many peaks have the same maximum curvature and the
    valleys are more sharply curved than the peaks. Otherwise, the tip may be sharper than anything that it
    scanned, and the result is only an upper bound.

    Args:
        scans: scans that all have the same pitch. Levelling them changes the result little.

    Raises:
        InputError: there is no scan, a scan has no pitch, the pitches differ, or a scan has fewer than 64 ×
            64 pixels.
    """
    pitch_um = _common_pitch(scans)
    heights = [scan.height_um for scan in scans]
    found = of_one_tip([peak_radius(height, pitch_um) for height in heights])
    noises = [noise_of(height) for height in heights]
    reach_px = None
    if found.radius_um is not None:
        reach_px = math.sqrt(2 * found.radius_um * found.depth_um) / max(pitch_um)
    return TipEstimate(
        **run_facts(),
        kind="upper bound" if found.reason else "estimate",
        radius_um=found.radius_um,
        radius_sd_um=None if found.reason else found.sd_um,
        reason=found.reason,
        depth_um=found.depth_um,
        reach_px=reach_px,
        pixel_noise_nm=1e3 * _rms([one.pixel_um for one in noises]),
        line_noise_nm=1e3 * _rms([one.line_um for one in noises]),
        window_px=found.window_px,
        share=found.share,
        pitch_um=pitch_um,
        scans=tuple(
            _under_tip(scan.name, height, pitch_um, found.radius_um)
            for scan, height in zip(scans, heights, strict=True)
        ),
    )


def _under_tip(name: str, height: Array, pitch_um: YX, radius_um: float | None) -> ScanUnderTip:
    if radius_um is None:
        return ScanUnderTip(name=name, certain_fraction=None, resolution_um=None)
    certain = tip_certain(height, pitch_um, radius_um)
    return ScanUnderTip(
        name=name,
        certain_fraction=float(certain.sum() / np.isfinite(height).sum()),
        resolution_um=lateral_resolution_um(height, pitch_um, radius_um),
    )


def _common_pitch(scans: Sequence[Scan]) -> YX:
    if not scans:
        raise InputError("scans of a tip", got="none", wanted="at least one")
    pitches = [scan.require_pitch() for scan in scans]
    for scan, pitch in zip(scans, pitches, strict=True):
        if min(scan.shape) < 64:
            raise InputError(
                f"size of scan {scan.source or scan.name}", got=scan.shape, wanted="at least 64 x 64 pixels"
            )
        if not np.allclose(pitch, pitches[0], rtol=_SAME_PITCH):
            what = f"pitch of {scan.source or scan.name}"
            raise InputError(what, got=f"{pitch} µm", wanted=f"{pitches[0]} µm, as for the first scan")
    return pitches[0]


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values))
