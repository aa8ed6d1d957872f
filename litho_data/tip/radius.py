"""Estimate the radius of the end of a tip from the sharpest peaks in the images that it produced.

A paraboloid tip with the radius R produces images that become convex along every line if x²/2R is added. In
such an image, no peak has a curvature above 1/R, and every corner and spike that is sharper than the tip
appears with exactly the curvature 1/R. The distribution of the curvatures in an image therefore ends at an
upper edge. The edge is sharp if the tip limits the curvatures. If the surface limits them, the distribution
ends in a thin tail. Curvatures are measured along the scan lines, because a height offset of a line does not
change the curvature along it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from litho_data.foundation import YX, Array
from litho_data.register.topography import remove_bow
from litho_data.tip.curvature import QUIET, noise_of

# Half side lengths, in pixels, of the square windows in which curvatures are measured.
_HALVES_PX = (2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 20)
# Preferred and largest allowed half side length of a window, as shares of the reach. The reach is the radius
# of the image that the tip produces of a spike. A window of the preferred size is about the largest that
# still fits on the image of an edge.
_HALF_OF_REACH, _LARGEST_OF_REACH = 1 / 3, 0.45
# The upper edge of the distribution of curvatures is the 98 % quantile of the sharp curvatures, i.e. of those
# above half of the 50th highest. Noise raises this quantile by 1.4 standard deviations of the noise, which
# are subtracted.
_EDGE_QUANTILE, _EDGE_SIGMA = 0.98, 1.4
_FEWEST_TOPS = 50
# Share of a line that is excluded at each end, because the scan is unreliable near the turning points.
_TURN = 0.02
_SMALLEST_REACH_PX = 5.0
# Of the curvatures above 0.4 of the edge, at least this share must lie above 0.8 of the edge. If the surface
# and not the tip limits the sharpness of the peaks, the share is at most 0.16.
_TIP_SHARE = 0.25
# The tip limits the sharpness everywhere in a scan, but the sharpest peaks of a surface are in a few places.
# The scan is therefore divided into 5 x 5 parts, and the share of the parts whose own edge exceeds 0.9 of the
# whole scan's edge is computed. This share times the share that ``_TIP_SHARE`` limits must reach 0.13. Of the
# estimates that are more than 10 % too large, this limit rejects most of those from rounded bumps, but only
# one in twenty of those from steep walls and spikes.
_AGREEMENT, _EVERYWHERE, _PARTS = 0.9, 0.13, 5
# If the tip limits how sharp peaks appear, valleys are sharper than peaks by at least this factor. This is
# not so if the surface limits the sharpness of the peaks or, in most cases, if the peaks are noise.
_SHARPER_VALLEYS = 1.2
# The first value is the relative error of the method. It is the part of the scatter of estimates for known
# tips that the scatter among the parts of a scan does not explain. The second value is the number of standard
# uncertainties that are added to the radius to give an upper bound.
_METHOD_SD, _BOUND_SIGMA = 0.05, 2.0
_SPAN = (0.5, 99.5)


@dataclass(frozen=True)
class PeakRadius:
    """The radius of a tip, µm: an estimate or an upper bound, or None if there is no bound.

    ``reason`` says why the radius is only a bound, and is empty for an estimate. ``sd_um`` is the standard
    uncertainty of the measured radius; a bound is the measured radius plus twice this uncertainty.
    ``depth_um``, ``window_px`` and ``share`` are explained in ``TipEstimate``.
    """

    radius_um: float | None
    sd_um: float
    reason: str
    depth_um: float
    window_px: int | None
    share: float | None


def peak_radius(height_um: Array, pitch_um: YX) -> PeakRadius:
    """Estimate the radius of the tip from one scan, or return an upper bound and the reason why it is only a
    bound.

    Args:
        height_um: heights in µm, shape (ny, nx); NaN where not measured. Tilt and bow of the scan affect the
            result little.
        pitch_um: pixel pitch along y and x, µm.
    """
    depth_um = float(np.subtract(*np.nanpercentile(remove_bow(height_um), _SPAN[::-1])))
    noise = noise_of(height_um)
    lines, pitch = (height_um, pitch_um[1]) if noise.lines_are_rows else (height_um.T, pitch_um[0])
    turn = int(np.ceil(_TURN * lines.shape[1]))
    lines = lines[:, turn : lines.shape[1] - turn]
    chosen: _Tops | None = None
    for half in _HALVES_PX:
        if min(lines.shape) <= 4 * half:
            break
        tops = _tops(lines, pitch, half, noise.pixel_um)
        if tops.edge <= 0 or tops.noise > QUIET * tops.edge:
            continue
        chosen = tops
        if half >= _HALF_OF_REACH * tops.reach_px(depth_um, pitch_um):
            break
    if chosen is None:
        return PeakRadius(None, 0.0, "no peak rises clearly above the noise", depth_um, None, None)
    parts = [edge for edge in chosen.edges(2) if edge > 0]
    spread = float(np.std(parts, ddof=1) / np.mean(parts) / np.sqrt(len(parts))) if len(parts) > 1 else 0.0
    radius_um, doubt = 1 / chosen.edge, chosen.doubt(depth_um, pitch_um)
    sd_um = radius_um * float(np.hypot(spread, _METHOD_SD))
    if doubt:
        radius_um += _BOUND_SIGMA * sd_um
    return PeakRadius(radius_um, sd_um, doubt, depth_um, 2 * chosen.half_px + 1, chosen.share)


def of_one_tip(found: Sequence[PeakRadius]) -> PeakRadius:
    """Combine the results of several scans that were made with the same tip. Return the mean of the
    estimates, or the lowest bound if no scan gave an estimate.

    Estimates far above the lowest one are discarded, because they come from scans of rounded surfaces. If the
    lowest bound lies clearly below the mean of the estimates, this bound is returned instead of the mean.
    """
    known = sorted((one for one in found if one.radius_um is not None), key=lambda one: one.radius_um or 0.0)
    estimates, bounds = ([one for one in known if bool(one.reason) is bound] for bound in (False, True))
    if not known:
        return found[0]
    if not estimates:
        return bounds[0]
    radii = np.array([one.radius_um for one in estimates], dtype=float)
    radii = radii[radii <= radii[0] + 2 * _BOUND_SIGMA * estimates[0].sd_um]
    mean_um = float(radii.mean())
    sd_um = float(np.hypot(radii.std() / np.sqrt(len(radii)), estimates[0].sd_um))
    if bounds and (bounds[0].radius_um or 0.0) < mean_um - _BOUND_SIGMA * sd_um:
        return bounds[0]
    return replace(estimates[0], radius_um=mean_um, sd_um=sd_um)


@dataclass(frozen=True)
class _Tops:
    """Curvatures of a scan, measured in windows of one size, in 1/µm. They are positive at peaks, and NaN
    where a window contains an unmeasured pixel. ``edge`` is the upper edge of the distribution of the
    curvatures, and ``noise`` is the standard deviation that noise causes in them.
    """

    half_px: int
    noise: float
    curvature: Array
    edge: float

    @property
    def share(self) -> float:
        near, sharp = (int((self.curvature > part * self.edge).sum()) for part in (0.8, 0.4))
        return near / max(sharp, 1)

    def edges(self, count: int) -> list[float]:
        """Divide the scan into ``count`` x ``count`` parts, and return the upper edge of the distribution of
        the curvatures in each part.
        """
        return [
            _edge(part, self.noise)
            for rows in np.array_split(self.curvature, count, axis=0)
            for part in np.array_split(rows, count, axis=1)
        ]

    def reach_px(self, depth_um: float, pitch_um: YX) -> float:
        return float(np.sqrt(2 * depth_um / self.edge) / max(pitch_um))

    def doubt(self, depth_um: float, pitch_um: YX) -> str:
        """Return a reason to doubt that the tip determines the edge, or an empty string if there is no such
        reason.
        """
        reach = self.reach_px(depth_um, pitch_um)
        if reach < _SMALLEST_REACH_PX:
            return (
                f"with a tip of this radius, the image of a spike would reach only {reach:.1f} pixels, fewer "
                f"than {_SMALLEST_REACH_PX:.0f}"
            )
        if self.half_px > _LARGEST_OF_REACH * reach:
            size = 2 * self.half_px + 1
            return (
                f"the noise requires windows of {size} pixels, too wide for the image of a spike, which "
                f"reaches only {reach:.1f} pixels"
            )
        if self.share < _TIP_SHARE:
            return (
                f"only {self.share:.0%} of the sharp peaks are about as sharp as the sharpest, so the "
                "sharpness is limited by the surface, not by the tip"
            )
        agreeing = sum(edge > _AGREEMENT * self.edge for edge in self.edges(_PARTS))
        if self.share * agreeing < _EVERYWHERE * _PARTS**2:
            return (
                f"only {agreeing} of {_PARTS**2} parts of the scan contain a peak about as sharp as the "
                f"sharpest, and only {self.share:.0%} of the sharp peaks are about as sharp, so the "
                "surface may limit the sharpness"
            )
        valleys = _edge(-self.curvature, self.noise)
        if valleys < _SHARPER_VALLEYS * self.edge:
            return "valleys are no sharper than peaks, as on a surface that no tip limits"
        return ""


def _tops(lines: Array, pitch_um: float, half_px: int, pixel_um: float) -> _Tops:
    from scipy.signal import savgol_coeffs

    # The sum of the heights in a window, multiplied by these weights, is the second derivative of the
    # parabola that fits the heights best.
    weights = savgol_coeffs(2 * half_px + 1, 2, deriv=2, delta=pitch_um)
    noise = pixel_um * float(np.sqrt((weights**2).sum() / (2 * half_px + 1)))
    curvature = -_along_lines(lines, weights)
    return _Tops(half_px, noise, curvature, _edge(curvature, noise))


def _along_lines(lines: Array, weights: Array) -> Array:
    """Return the second derivative of the heights along the scan lines, averaged over the lines of a square
    window around each pixel. Pixels whose window would extend beyond the scan are left out.

    The result is NaN where the window contains an unmeasured pixel.
    """
    from scipy.ndimage import correlate1d, uniform_filter1d

    size, half = len(weights), len(weights) // 2
    measured = np.isfinite(lines)
    bent = correlate1d(np.where(measured, lines, 0.0), weights, axis=1)
    bent = uniform_filter1d(bent, size, axis=0)
    if not measured.all():
        from scipy.ndimage import minimum_filter

        bent[~minimum_filter(measured, size)] = np.nan
    return bent[half:-half, half:-half]


def _edge(curvatures: Array, noise: float) -> float:
    """Return the upper edge of a distribution of curvatures, minus the amount by which noise raises this
    edge.

    A result of 0 or less means that the curvatures are nothing but noise.
    """
    curvatures = curvatures[np.isfinite(curvatures)]
    if len(curvatures) <= _FEWEST_TOPS:
        return 0.0
    top = np.partition(curvatures, -_FEWEST_TOPS)[-_FEWEST_TOPS]
    sharp = curvatures[curvatures > 0.5 * top] if top > 0 else curvatures
    return float(np.quantile(sharp, _EDGE_QUANTILE) - _EDGE_SIGMA * noise)
