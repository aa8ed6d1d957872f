"""Estimate the noise of ordinary prints from the residuals of a model on held-out scans.

There are two estimates of an upper limit of the noise. The first estimate compares residuals at pixels whose
surroundings in the layout are similar (``floor_of_residuals``). The second estimate is the roughness of the
residual in areas where the layout is flat. In such areas the errors of a model are small, so nearly all of
the residual is noise.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness.texture import FEWEST_LINES
from litho_data.store import PrintedScan
from litho_models.noise.residuals import Pool, Residuals
from litho_models.noise.texture import Texture, texture
from litho_models.noise.variance import layout_slope
from litho_models.scoring.noise_floor import NoiseFloor, floor_of_residuals, freed_by_policy
from litho_models.scoring.statistics import Interval, rms

FLAT_SHARE = 0.25
_FEWEST_PIXELS = 1000


class FlatLevel(Record):
    """The rms (``sigma_nm``) and the mean absolute value (``mae_nm``) of the residual at pixels of one level
    in areas where the layout is flat.

    From each scan, the per-scan terms of the policy ``full+rows`` are first removed, including line offsets.
    ``ci95_nm`` is the 95 % confidence interval of ``sigma_nm``, from resampling prints.
    """

    level: int
    pixels: int
    sigma_nm: float
    ci95_nm: Interval
    mae_nm: float


class NoiseBudget(Record):
    """Two estimates of an upper limit of the noise of prints.

    ``floor`` is computed from pixels with similar surroundings (see ``floor_of_residuals``). ``flat_levels``
    is computed from the pixels at which the slope of the layout is at most ``flat_slope``, which is the lower
    quartile of this slope. ``flat_texture`` is the texture of the residual at these pixels. Only the terms of
    the policy ``full`` are removed before the texture is computed, so the texture still contains line
    offsets.
    """

    model: str
    floor: NoiseFloor
    flat_slope: float
    flat_levels: list[FlatLevel]
    flat_texture: Texture | None = None


def noise_budget(found: Residuals, seed: int = 0) -> NoiseBudget:
    """Compute two estimates of an upper limit of the noise (see ``NoiseBudget``) from the residuals of one
    model on held-out scans.
    """
    freed = freed_by_policy(found.scans, found.maps_um, found.protocol.blocks)
    slopes = [layout_slope(scan) for scan in found.scans]
    limit = float(np.quantile(np.concatenate([slope.ravel() for slope in slopes]), FLAT_SHARE))
    without_lines, with_lines = (
        [np.where(slope <= limit, fit.residual_um, np.nan) for fit, slope in zip(fits, slopes, strict=True)]
        for fits in (freed["full+rows"], freed["full"])
    )
    small = min(min(flat.shape) for flat in with_lines) < FEWEST_LINES
    name = f"residuals of {found.model}"
    return NoiseBudget(
        model=found.model,
        flat_texture=None if small else texture(name, with_lines, found.scans[0].pitch_um),
        floor=floor_of_residuals(found.model, found.scans, freed, seed),
        flat_slope=limit,
        flat_levels=list(_by_level(found.scans, without_lines)),
    )


def _by_level(scans: Sequence[PrintedScan], flat_um: Sequence[np.ndarray]) -> Iterator[FlatLevel]:
    """Yield the ``FlatLevel`` of each level that has at least ``_FEWEST_PIXELS`` pixels in flat areas."""
    pool = Pool(scans, [np.isfinite(own) for own in flat_um])
    level, residual = pool.of([scan.mask_level for scan in scans]), NM_PER_UM * pool.of(flat_um)
    for value in np.unique(level).tolist():
        mine = level == value
        if mine.sum() < _FEWEST_PIXELS:
            continue
        interval = pool.interval(residual**2, mine)
        yield FlatLevel(
            level=value,
            pixels=int(mine.sum()),
            sigma_nm=rms(residual[mine]),
            ci95_nm=None if interval is None else (interval[0] ** 0.5, interval[1] ** 0.5),
            mae_nm=float(np.abs(residual[mine]).mean()),
        )
