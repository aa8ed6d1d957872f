"""Noise without a model: how much do heights differ where the layout around them does not?

The gamma test (Stefánsson, Končar and Jones 1997, doi:10.1007/BF01413858): half the mean squared
difference between neighbours in feature space, extrapolated to distance zero, is the variance that
the features do not decide. A linear fit goes first, so that little is left to extrapolate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scoring.statistics import interval

_BLURS_UM = (0.1, 0.2, 0.4, 0.8, 1.6)
_SLOPE_BLUR_UM = 0.3
# Roughness is correlated over about 1 µm: a pair closer than this shares it.
APART_UM = 4.0
NEIGHBOURS = 12
_PIXELS_PER_SCAN = 3000


class NeighbourhoodNoise(NamedTuple):
    """σ at distance zero with its interval over scans, its MAE, σ of the nearest pairs, scans compared."""

    sigma_nm: float
    ci95_nm: tuple[float, float] | None
    mae_nm: float
    nearest_sigma_nm: float
    scans: int


class _Drawn(NamedTuple):
    """The pixels drawn from one scan: (n, k), (n,) nm, (n, 2) µm, and the number of the scan (n,)."""

    feature: np.ndarray
    height_nm: np.ndarray
    place_um: np.ndarray
    owner: np.ndarray


def neighbourhood_noise(
    scans: Sequence[PrintedScan], *, pixels_per_scan: int = _PIXELS_PER_SCAN, seed: int = 0
) -> NeighbourhoodNoise | None:
    """Spread of the height among pixels with like surroundings, nm; None where no two pixels can be compared.

    Scans of different doses differ where their layouts do not: only prints of one dose are fitted together
    and compared.
    """
    random = np.random.default_rng(seed)
    drawn: dict[float | None, list[_Drawn]] = {}
    for number, scan in enumerate(scans):
        inside = np.zeros(scan.shape, bool)
        border = round(2 * max(_BLURS_UM) / scan.pitch_um)
        inside[border:-border, border:-border] = True
        candidates = np.flatnonzero(inside & scan.valid & np.isfinite(scan.height_um))
        if candidates.size < 200:
            continue
        chosen = random.choice(candidates, min(pixels_per_scan, candidates.size), replace=False)
        found = _Drawn(
            feature=layout_features(scan)[:, chosen].T,
            height_nm=NM_PER_UM * scan.height_um.ravel()[chosen].astype(np.float64),
            place_um=np.stack(np.unravel_index(chosen, scan.shape), axis=1) * scan.pitch_um,
            owner=np.full(chosen.size, number),
        )
        drawn.setdefault(scan.dose, []).append(found)
    if not drawn:
        return None
    pairs = [_pairs_of_one_dose(group) for group in drawn.values()]
    distance2, half_square, absolute, mine = (np.concatenate(part) for part in zip(*pairs, strict=True))
    if not mine.size:
        return None
    mean_distance2, gamma = distance2.mean(axis=0), half_square.mean(axis=0)
    per_scan = [
        _intercept(mean_distance2, half_square[mine == number].mean(axis=0)) for number in np.unique(mine)
    ]
    sigma = float(np.sqrt(max(0.0, _intercept(mean_distance2, gamma))))
    nearest = float(np.sqrt(gamma[0]))
    shrink = sigma / nearest if nearest > 0 else 0.0
    roots = [float(np.sqrt(max(0.0, value))) for value in per_scan]
    return NeighbourhoodNoise(
        sigma_nm=sigma,
        ci95_nm=interval(roots),
        # E|n₁ − n₂| is √2 E|n| for a Gaussian; the extrapolation scales it as it scales σ.
        mae_nm=float(absolute[:, 0].mean() / np.sqrt(2)) * shrink,
        nearest_sigma_nm=nearest,
        scans=len(per_scan),
    )


def layout_features(scan: PrintedScan) -> np.ndarray:
    """What the surroundings of each pixel look like: blurred layouts and two slopes, (k, ny·nx), µm."""
    from scipy.ndimage import gaussian_filter

    layout = scan.layout_um.astype(np.float64)
    maps = [gaussian_filter(layout, sigma / scan.pitch_um, mode="nearest") for sigma in _BLURS_UM]
    slopes = np.gradient(gaussian_filter(layout, _SLOPE_BLUR_UM / scan.pitch_um, mode="nearest"))
    maps += [slope * (_SLOPE_BLUR_UM / scan.pitch_um) for slope in slopes]
    return np.stack([field.ravel() for field in maps])


def _pairs_of_one_dose(drawn: Sequence[_Drawn]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    feature, height_nm, place_um, owner = (np.concatenate(part) for part in zip(*drawn, strict=True))
    return _pairs(_whitened(feature), _linear_residual(feature, height_nm, owner), place_um, owner)


def _linear_residual(feature: np.ndarray, height: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Height minus its fit by the features, their squares and one offset per scan."""
    offsets = (owner[:, None] == np.unique(owner)[None, :]).astype(np.float64)
    centred = feature - feature.mean(axis=0)
    design = np.hstack([offsets, centred, centred**2])
    weights, *_ = np.linalg.lstsq(design, height, rcond=None)
    return height - design @ weights


def _whitened(feature: np.ndarray) -> np.ndarray:
    """Features of unit covariance, so that the distance does not depend on their scale."""
    centred = feature - feature.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(centred.T))
    kept = values > 1e-9 * values.max()
    return centred @ (vectors[:, kept] / np.sqrt(values[kept]))


def _pairs(
    feature: np.ndarray, residual: np.ndarray, place: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per pixel and rank of its neighbours: squared distance, half squared and absolute difference."""
    from scipy.spatial import cKDTree

    wanted = 4 * NEIGHBOURS
    distance, index = cKDTree(feature).query(feature, k=min(wanted + 1, len(feature)))
    distance, index = distance[:, 1:], index[:, 1:]
    same = owner[index] == owner[:, None]
    near = np.linalg.norm(place[index] - place[:, None, :], axis=2) < APART_UM
    allowed = ~(same & near)
    enough = allowed.sum(axis=1) >= NEIGHBOURS
    order = np.argsort(~allowed, axis=1, kind="stable")[enough, :NEIGHBOURS]
    chosen = np.take_along_axis(index[enough], order, axis=1)
    difference = residual[enough][:, None] - residual[chosen]
    distance2 = np.take_along_axis(distance[enough], order, axis=1) ** 2
    return distance2, 0.5 * difference**2, np.abs(difference), owner[enough]


def _intercept(distance2: np.ndarray, gamma: np.ndarray) -> float:
    slope, intercept = np.polyfit(distance2, gamma, 1)
    # A fall with distance is chance: the nearest pairs are then all there is.
    return float(intercept if slope > 0 else gamma.mean())
