"""Whether a name holds: does its formula leave what another formula of the same change would take?

A cause that is missing beside a named one leaves a residual that has nothing to do with the named change. A
name that only resembles the cause leaves one that is the named change in another shape: scaled with the
height or the place, blurred, displaced, squared.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.fits import State, Study, held_out_maps, without_terms
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, Block, Products


def reshaped_gain(without: State, state: State, study: Study) -> float:
    """Gain (nm²) on held-out scans of a cause's change in other shapes, beside the change itself.

    Args:
        without, state: the model without and with the cause.
    """
    grams = []
    before, after = (held_out_maps(one.per_fold, study, study.windows) for one in (without, state))
    for window, left, own, other in zip(study.windows, state.held_out_um, after, before, strict=True):
        maps = _shapes(own - other, own, window)
        freed = without_terms(np.column_stack([left, *map(window.at_sample, maps)]), window, own)
        grams.append(freed.T @ freed / len(freed))
    # Evidence for no reshaping, in scans: as many numbers would else fit the noise of a few scans.
    products = Products.ungrouped(np.stack(grams))
    count = products.grams.shape[1]
    left = products.held_out([], study.fold_of)
    taken = left - products.held_out([Block(tuple(range(1, count)), ALL, 0.02)], study.fold_of)
    return float(taken.mean()) * NM_PER_UM**2


def _shapes(change: np.ndarray, prediction: np.ndarray, window: PreparedScan) -> list[np.ndarray]:
    """A change of the prediction (y, x), µm, and the same in other shapes."""
    pitch = window.context.pitch_um
    blurred = [gaussian_filter(change, sigma / pitch) for sigma in (0.2, 0.6, 1.6)]
    layout = np.asarray(window.stored.layout_um, np.float64)
    near, far = (gaussian_filter(layout, sigma / pitch) for sigma in (0.6, 2.0))
    relative = prediction - prediction.mean()
    slopes = np.gradient(change, pitch)
    ny, nx = change.shape
    y, x = np.linspace(-1, 1, ny)[:, None], np.linspace(-1, 1, nx)[None, :]
    return [
        change,
        change * relative,
        change * relative**2,
        change * np.abs(change),
        change * near,
        change * far,
        change * (near - layout),
        *blurred,
        *(one * relative for one in blurred),
        *slopes,
        np.abs(slopes[0]),
        np.abs(slopes[1]),
        change * x,
        change * y,
        change * (x * x + y * y),
    ]
