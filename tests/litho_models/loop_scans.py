"""Small printed scans made by a known model, for the tests of the loop."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from litho_data.store.read import PrintedScan
from litho_models.effects.chain import EffectChain
from litho_models.twin.prepared import prepare_scans
from litho_models.models import build_model

LEVELS, LEVEL_HEIGHT_UM, PITCH_UM = 13, 0.1, 0.1


def true_model(effects: Mapping[str, Mapping[str, float]]) -> EffectChain:
    """A Physics model away from its starting values, with effects."""
    base = build_model(
        "physics", sigma_diffusion_init_um=0.3, alpha_init=2.0, eta_init=0.4, bias_init_um=0.03
    )
    return EffectChain(base, effects, full_height_um=1.2, pitch_um=PITCH_UM)


def printed_scans(
    effects: Mapping[str, Mapping[str, float]] | None = None,
    *,
    count: int = 10,
    size_px: int | list[int] = 64,
    noise_um: float = 0.006,
    datum_um: float = 0.02,
    stripes_um: float = 0.0,
    order: bool = True,
    seed: int = 0,
) -> list[PrintedScan]:
    """Scans of random layouts: model with effects, roughness, a datum and a small tilt per scan."""
    rng = np.random.default_rng(seed)
    sizes = size_px if isinstance(size_px, list) else [size_px] * count
    blank = [_scan(i, _layout(rng, n), order) for i, n in enumerate(sizes)]
    chain = true_model(effects or {})
    scans = []
    for scan in prepare_scans(blank):
        with torch.no_grad():
            clean = chain(scan.layout, scan.context)[0, 0].numpy()
        ny, nx = clean.shape
        rough = gaussian_filter(rng.normal(size=clean.shape), 1.0)
        rough *= noise_um / rough.std()
        y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
        tilt = 0.003 * (rng.normal() * x + rng.normal() * y)
        lines = stripes_um * rng.normal(size=(ny, 1))
        height = clean + rough + datum_um * rng.normal() + tilt + lines
        scans.append(_with_height(scan.stored, height))
    return scans


def _layout(rng: np.random.Generator, size: int) -> np.ndarray:
    smooth = gaussian_filter(rng.normal(size=(size, size)), 4.0, mode="wrap")
    ranks = np.argsort(np.argsort(smooth.ravel())).reshape(smooth.shape) / smooth.size
    return np.floor(ranks * LEVELS).clip(0, LEVELS - 1).astype(np.uint8)


def _scan(number: int, level: np.ndarray, order: bool) -> PrintedScan:
    return PrintedScan(
        id=f"S{number:02d}",
        print_id=str(number // 4),
        order=number if order else 0,
        mask_level=level,
        height_um=np.zeros(level.shape, np.float32),
        valid=np.ones(level.shape, bool),
        pitch_um=PITCH_UM,
        level_height_um=LEVEL_HEIGHT_UM,
        levels=LEVELS,
        scan_to_layout=np.eye(3),
    )


def _with_height(scan: PrintedScan, height_um: np.ndarray) -> PrintedScan:
    from dataclasses import replace

    return replace(scan, height_um=height_um.astype(np.float32))
