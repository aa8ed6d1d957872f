"""Separate noise from errors of a model by comparing residuals at pixels whose surroundings in the layout are
similar (gamma test).

In similar surroundings, the part that all residuals have in common is an error of the model, because another
model could predict it from the layout. The differences between these residuals are noise (Stefánsson, Končar
and Jones 1997, doi:10.1007/BF01413858). Each pixel is compared with pixels of other scans. The datum, the
gain and the bow of a single scan therefore count as noise.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from litho_data.foundation.kinds import Array
from litho_data.store import PrintedScan

_BLURS_UM = (0.1, 0.2, 0.4, 0.8, 1.6)
_SLOPE_BLUR_UM = 0.3
# Number of pixels (partners) with which each pixel is compared. With more partners, some partners would be
# less similar. With fewer partners, the estimate in ``noise_squared`` would be noisier.
PARTNERS = 4
_PIXELS, _PIXELS_PER_SCAN = 60_000, 3000


class LikePixels(NamedTuple):
    """A random sample of n pixels. For each of them, the sample also lists its partners, which are the m most
    similar pixels, each from another scan. m is at most ``PARTNERS``.

    Attributes:
        owner: number of the scan that contains the pixel; shape (n,).
        pixel: flat index of the pixel in its scan; shape (n,).
        partners: indices of the partners in the arrays ``owner`` and ``pixel``; shape (n, m). The partners in
            one row belong to different scans.
    """

    owner: Array
    pixel: Array
    partners: Array

    def noise_squared(self, residuals: Sequence[Array]) -> tuple[Array, Array]:
        """Return, for each pixel of the sample, an estimate of the noise variance, and the squared residual.
        Both arrays have shape (n,).

        Let r₀ be the residual of a pixel, and r₁ ... r_m the residuals of its partners. Each residual is the
        sum of its own noise and a misfit. The misfit is the same for all these residuals, because the
        surroundings are similar. The mean of (r₀ − r_j)(r₀ − r_k) over all j ≠ k therefore estimates the
        variance of the noise in r₀, however large the noise of the partners is. A simpler estimate would be
        half the squared difference of two residuals. It would be too small for pixels with rare surroundings,
        because the noise at such pixels is larger than at their partners.

        Args:
            residuals: one residual map per scan, of shape (ny, nx). Both results have the squared unit of
                these maps.
        """
        value = np.empty(len(self.owner))
        for number, residual in enumerate(residuals):
            mine = self.owner == number
            value[mine] = residual.reshape(-1)[self.pixel[mine]]
        difference = value[:, None] - value[self.partners]
        squares, count = (difference**2).sum(axis=1), self.partners.shape[1]
        return (difference.sum(axis=1) ** 2 - squares) / (count * (count - 1)), value**2


def like_pixels(scans: Sequence[PrintedScan], scored: Sequence[Array], seed: int = 0) -> LikePixels | None:
    """Draw a random sample of pixels. For each of these pixels, find the most similar pixels of other scans.

    Two pixels are similar if their surroundings in the layout are similar. Only scans at the same dose are
    compared, because the dose changes the height even if the layouts are equal.

    Args:
        scans: scans to compare. If no dose is common to at least three scans, or if the layouts are flat, the
            result is None.
        scored: for each scan, a mask of shape (ny, nx) that is True at the pixels that may be drawn.
        seed: determines which pixels are drawn.
    """
    from scipy.spatial import cKDTree

    random = np.random.default_rng(seed)
    by_dose: dict[float | None, list[int]] = {}
    for number, scan in enumerate(scans):
        if scored[number].any():
            by_dose.setdefault(scan.dose, []).append(number)
    groups = [group for group in by_dose.values() if len(group) > 2]
    if not groups:
        return None
    used = sorted(number for group in groups for number in group)
    most = max(1, min(_PIXELS_PER_SCAN, _PIXELS // len(used)))
    drawn = {}
    for number in used:
        candidates = np.flatnonzero(scored[number])
        drawn[number] = random.choice(candidates, min(most, candidates.size), replace=False)
    owner = np.concatenate([np.full(len(drawn[number]), number) for number in used])
    feature = _whitened(np.concatenate([_surroundings(scans[n])[:, drawn[n]].T for n in used]))
    if not feature.shape[1]:
        return None
    partners = np.empty((len(owner), min(PARTNERS, min(map(len, groups)) - 1)), np.intp)
    for group in groups:
        members = {number: np.flatnonzero(owner == number) for number in group}
        trees = {number: cKDTree(feature[at]) for number, at in members.items()}
        for number, at in members.items():
            others = [other for other in group if other != number]
            distance, nearest = zip(*(trees[other].query(feature[at]) for other in others), strict=True)
            found = np.stack([members[o][i] for o, i in zip(others, nearest, strict=True)], axis=1)
            closest = np.argsort(np.stack(distance, axis=1), axis=1)[:, : partners.shape[1]]
            partners[at] = np.take_along_axis(found, closest, axis=1)
    return LikePixels(owner, np.concatenate([drawn[number] for number in used]), partners)


def _surroundings(scan: PrintedScan) -> Array:
    """Return k features that describe the surroundings of each pixel: blurred layouts and two slopes, all in
    µm. The result has shape (k, ny·nx).
    """
    maps = [blurred_layout_um(scan, sigma_um) for sigma_um in _BLURS_UM]
    slopes = np.gradient(blurred_layout_um(scan, _SLOPE_BLUR_UM))
    maps += [slope * (_SLOPE_BLUR_UM / scan.pitch_um) for slope in slopes]
    return np.stack([field.ravel() for field in maps])


def blurred_layout_um(scan: PrintedScan, sigma_um: float) -> Array:
    """Return the layout of a scan, µm, blurred by a Gaussian of standard deviation ``sigma_um``. Before the
    blur, the layout is padded by repeating its outermost pixels. The result is float64 of shape (ny, nx).
    """
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(scan.layout_um.astype(np.float64), sigma_um / scan.pitch_um, mode="nearest")


def _whitened(feature: Array) -> Array:
    """Transform the features linearly so that their covariance is the unit matrix. Distances between pixels
    then do not depend on the units of the features.
    """
    centred = feature - feature.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(centred.T))
    kept = values > 1e-9 * values.max()
    return centred @ (vectors[:, kept] / np.sqrt(values[kept]))
