"""The noise of prints that were not made to measure it, from the out-of-fold residuals of a model.

Two estimates, too high rather than too low: what differs between like surroundings (``estimated_floor``), and
the roughness where the layout is flat, so that a model has little to get wrong.
"""

from collections.abc import Sequence

import numpy as np

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness.texture import FEWEST_LINES
from litho_models.noise.residuals import Residuals
from litho_models.noise.texture import Texture, texture
from litho_models.noise.variance import layout_slope
from litho_models.scoring.noise_floor import NoiseFloor, floor_of_residuals, freed_by_policy
from litho_models.scoring.statistics import pixel_interval

FLAT_SHARE = 0.25
_FEWEST_PIXELS = 1000
_FARTHEST_PX = 40


class FlatLevel(Record):
    """Residual where the layout is flat, pixels of one level: rms and mean absolute value, nm.

    Each scan is freed of policy ``full+rows``. ``ci95_nm``: interval of σ over prints.
    """

    level: int
    pixels: int
    sigma_nm: float
    ci95_nm: tuple[float, float] | None
    mae_nm: float


class NoiseBudget(Record):
    """What the prints say about their own noise; both parts are upper estimates.

    ``flat_levels`` covers the pixels whose layout slope is at most ``flat_slope``, the flattest quarter.
    ``flat_texture`` is of the same pixels of all scans, freed of policy ``full``: lines are left in.
    ``flat_length_um`` (y, x): distance over which the correlation of these falls to 1/e; None in older files.
    """

    model: str
    floor: NoiseFloor
    flat_slope: float
    flat_levels: list[FlatLevel]
    flat_texture: Texture | None = None
    flat_length_um: tuple[float, float] | None = None


def noise_budget(found: Residuals, seed: int = 0) -> NoiseBudget:
    """Both estimates from the residuals of one model on scans that it had not seen."""
    freed = freed_by_policy(found.scans, found.maps_um, found.protocol.blocks)
    slopes = [layout_slope(scan) for scan in found.scans]
    limit = float(np.quantile(np.concatenate([slope.ravel() for slope in slopes]), FLAT_SHARE))
    level, left, number = [], [], []
    for at, (scan, fit, slope) in enumerate(zip(found.scans, freed["full+rows"], slopes, strict=True)):
        flat = np.isfinite(fit.residual_um) & (slope <= limit)
        level.append(scan.mask_level[flat])
        left.append(NM_PER_UM * fit.residual_um[flat])
        number.append(np.full(np.count_nonzero(flat), at))
    levels, residuals, owner = (np.concatenate(part) for part in (level, left, number))
    squares, sizes = residuals**2, np.abs(residuals)
    prints = [scan.print_id for scan in found.scans]
    rows = []
    for value in np.unique(levels).tolist():
        mine = levels == value
        if mine.sum() < _FEWEST_PIXELS:
            continue
        interval = pixel_interval(squares[mine], owner[mine], prints)
        rows.append(
            FlatLevel(
                level=value,
                pixels=int(mine.sum()),
                sigma_nm=float(np.sqrt(squares[mine].mean())),
                ci95_nm=None if interval is None else (interval[0] ** 0.5, interval[1] ** 0.5),
                mae_nm=float(sizes[mine].mean()),
            )
        )
    lines_in = zip(freed["full"], slopes, strict=True)
    flats = [np.where(slope <= limit, fit.residual_um, np.nan) for fit, slope in lines_in]
    pitch_um = found.scans[0].pitch_um
    small = min(min(flat.shape) for flat in flats) < FEWEST_LINES
    return NoiseBudget(
        model=found.model,
        flat_texture=None if small else texture(f"residuals of {found.model}", flats, pitch_um),
        flat_length_um=(_length_um(flats, pitch_um, 0), _length_um(flats, pitch_um, 1)),
        floor=floor_of_residuals(found.model, found.scans, freed, seed),
        flat_slope=limit,
        flat_levels=rows,
    )


def _length_um(maps_um: Sequence[np.ndarray], pitch_um: float, axis: int) -> float:
    """Distance along an axis over which the correlation of maps with gaps falls to 1/e, at most 40 px."""
    maps = [np.moveaxis(one, axis, 0) for one in maps_um]
    variances = sum(float(np.nanmean(one**2)) for one in maps_um)
    correlation = [1.0]
    while correlation[-1] > np.exp(-1) and len(correlation) <= _FARTHEST_PX:
        lag = len(correlation)
        products = sum(float(np.nanmean(one[lag:] * one[:-lag])) for one in maps)
        correlation.append(products / variances)
    before, after = correlation[-2:]
    if after > np.exp(-1):
        return pitch_um * _FARTHEST_PX
    return float(pitch_um * (len(correlation) - 2 + (before - np.exp(-1)) / (before - after)))
