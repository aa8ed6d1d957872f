"""Legendre polynomials over a map, in which tilt, bow and finer terms are expressed."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.polynomial import Legendre


def legendre_shapes(shape: tuple[int, ...], orders: Iterable[int], margin_px: int = 0) -> np.ndarray:
    """Return all products of a Legendre polynomial in y and a Legendre polynomial in x whose two orders add
    up to a number in ``orders``. Each product has an rms of 1 over ``shape``, which is (ny, nx). The result
    has shape (ny + 2 margin, nx + 2 margin, number of products), because it continues beyond ``shape``.
    """
    reaches = (1 + 2 * margin_px / (size - 1) for size in shape)
    y, x = (
        np.linspace(-reach, reach, size + 2 * margin_px) for reach, size in zip(reaches, shape, strict=True)
    )
    products = [
        np.outer(_legendre(i, y), _legendre(order - i, x)) for order in orders for i in range(order + 1)
    ]
    return np.stack(products, axis=-1) if products else np.zeros((len(y), len(x), 0))


def _legendre(order: int, at: np.ndarray) -> np.ndarray:
    found: np.ndarray = math.sqrt(2 * order + 1) * Legendre.basis(order)(at)
    return found


def amounts(height_um: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Return the n coefficients of a map with respect to ``shapes``, which are orthogonal and have shape (ny,
    nx, n).
    """
    found: np.ndarray = np.tensordot(height_um, shapes, 2) / height_um.size
    return found
