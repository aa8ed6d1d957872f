"""Where zero height lies: Gwyddion's Fix Zero, Zero Mean Value and Zero Maximum Value."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from litho_data.level.selection import Levelled, Masking, as_height, select, subtract


def fix_zero(height: np.ndarray, *, mask: np.ndarray | None = None, masking: Masking = "exclude") -> Levelled:
    """Move the lowest selected pixel to zero; an order statistic of one pixel, not a physical datum."""
    return _shift(height, np.min, mask, masking)


def zero_mean(
    height: np.ndarray, *, mask: np.ndarray | None = None, masking: Masking = "exclude"
) -> Levelled:
    """Move the mean of the selected pixels to zero."""
    return _shift(height, np.mean, mask, masking)


def zero_max(height: np.ndarray, *, mask: np.ndarray | None = None, masking: Masking = "exclude") -> Levelled:
    """Move the highest selected pixel to zero."""
    return _shift(height, np.max, mask, masking)


def _shift(
    height: np.ndarray, statistic: Callable[[np.ndarray], float], mask: np.ndarray | None, masking: Masking
) -> Levelled:
    z = as_height(height)
    chosen = select(z, mask, masking)
    return subtract(z, np.broadcast_to(np.float64(statistic(z if chosen is None else z[chosen])), z.shape))
