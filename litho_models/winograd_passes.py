"""Compiled: what ``winograd`` does to fields before and after its products, patch by patch.

Fields are (y, x, channels), spectra (36, patches, channels), both contiguous float32; signs are int8
like a field. The channels are a multiple of ``vectors.LANES``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from litho_models.vectors import LANES, leaky, leaky_by_signs, load, scaled, store, store_signs

# Side of a patch of results, and of the frequencies and neighbours that it depends on.
PATCH_PX, SPAN = 4, 6
# Zeros around the field of an adjoint.
FRAME_PX = 2

_TWO, _FOUR, _FIVE, _EIGHT = (np.float32(number) for number in (2, 4, 5, 8))
_Floats = NDArray[np.float32]
_Signs = NDArray[np.int8]
_inlined = numba.njit(forceinline=True)


def _compiled(function: Callable[..., None]) -> Callable[..., None]:
    """Compiled at the first call, which takes seconds, and kept for later runs where there is a place."""
    try:
        return numba.njit(nogil=True, error_model="numpy", cache=True)(function)
    except RuntimeError:  # Neither the folder of the package nor that of the user's caches can be written.
        return numba.njit(nogil=True, error_model="numpy")(function)


@_compiled
def to_frequencies(field: _Floats, first: int, count: int, per_row: int, spectrum: _Floats) -> None:
    """Frequencies of ``count`` patches from number ``first`` on, with ``per_row`` patches in a row."""
    channels = field.shape[2]
    row, step = field.shape[1] * channels, spectrum.shape[1] * channels
    source, target = field.reshape(-1), spectrum.reshape(-1)
    half = np.empty(SPAN * SPAN * LANES, np.float32)
    for patch in range(count):
        y, x = divmod(first + patch, per_row)
        corner = PATCH_PX * (y * row + x * channels)
        for k in range(0, channels, LANES):
            for i in range(SPAN):
                _six(source, corner + i * row + k, channels, half, SPAN * i * LANES, LANES)
            for j in range(SPAN):
                _six(half, j * LANES, SPAN * LANES, target, j * step + patch * channels + k, SPAN * step)


@_compiled
def activate(
    spectrum: _Floats,
    first: int,
    count: int,
    per_row: int,
    bias: _Floats,
    slope: np.float32,
    field: _Floats,
    signs: _Signs,
) -> None:
    """Results of the same patches of a product, with bias and leaky ReLU, and their signs."""
    channels = field.shape[2]
    row, sign_row = field.shape[1] * channels, signs.shape[1] * channels
    source, target, kept = spectrum.reshape(-1), field.reshape(-1), signs.reshape(-1)
    half = np.empty(PATCH_PX * SPAN * LANES, np.float32)
    for patch in range(count):
        y, x = divmod(first + patch, per_row)
        for k in range(0, channels, LANES):
            _columns(source, patch * channels + k, spectrum.shape[1] * channels, half)
            for i in range(PATCH_PX):
                at = (PATCH_PX * y + i) * row + PATCH_PX * x * channels + k
                sign_at = (PATCH_PX * y + i) * sign_row + PATCH_PX * x * channels + k
                for result in _four(half, SPAN * i * LANES, LANES):
                    value = result + load(bias, k)
                    store(target, at, leaky(value, slope))
                    store_signs(kept, sign_at, value)
                    at += channels
                    sign_at += channels


@_compiled
def restrain(
    spectrum: _Floats,
    first: int,
    count: int,
    per_row: int,
    slope: np.float32,
    signs: _Signs,
    framed: _Floats,
) -> None:
    """Results of the same patches, times the slope of the leaky ReLU whose signs these are, in a frame."""
    channels = framed.shape[2]
    row, sign_row = framed.shape[1] * channels, signs.shape[1] * channels
    source, target, kept = spectrum.reshape(-1), framed.reshape(-1), signs.reshape(-1)
    half = np.empty(PATCH_PX * SPAN * LANES, np.float32)
    for patch in range(count):
        y, x = divmod(first + patch, per_row)
        for k in range(0, channels, LANES):
            _columns(source, patch * channels + k, spectrum.shape[1] * channels, half)
            for i in range(PATCH_PX):
                at = (PATCH_PX * y + i + FRAME_PX) * row + (PATCH_PX * x + FRAME_PX) * channels + k
                sign_at = (PATCH_PX * y + i) * sign_row + PATCH_PX * x * channels + k
                for result in _four(half, SPAN * i * LANES, LANES):
                    store(target, at, leaky_by_signs(result, slope, kept, sign_at))
                    at += channels
                    sign_at += channels


@_compiled
def lift(
    image: _Floats, taps: _Floats, bias: _Floats, slope: np.float32, field: _Floats, signs: _Signs
) -> None:
    """Convolution of an image (y, x) with (9, channels), bias and leaky ReLU, and the signs."""
    channels = field.shape[2]
    weights, target, kept = taps.reshape(-1), field.reshape(-1), signs.reshape(-1)
    for y in range(image.shape[0] - 2):
        for x in range(image.shape[1] - 2):
            at, sign_at = (y * field.shape[1] + x) * channels, (y * signs.shape[1] + x) * channels
            for k in range(0, channels, LANES):
                value = _nine(image, y, x, weights, k, channels) + load(bias, k)
                store(target, at + k, leaky(value, slope))
                store_signs(kept, sign_at + k, value)


@_compiled
def lift_back(image: _Floats, taps: _Floats, slope: np.float32, signs: _Signs, framed: _Floats) -> None:
    """The same without bias, times the slope of the leaky ReLU whose signs these are, in a frame."""
    channels = framed.shape[2]
    weights, target, kept = taps.reshape(-1), framed.reshape(-1), signs.reshape(-1)
    for y in range(image.shape[0] - 2):
        for x in range(image.shape[1] - 2):
            at = ((y + FRAME_PX) * framed.shape[1] + x + FRAME_PX) * channels
            sign_at = (y * signs.shape[1] + x) * channels
            for k in range(0, channels, LANES):
                value = _nine(image, y, x, weights, k, channels)
                store(target, at + k, leaky_by_signs(value, slope, kept, sign_at + k))


@_inlined
def _six(source: Any, at: int, step: int, target: Any, target_at: int, target_step: int) -> None:
    """Six neighbours as values of a polynomial at 0, 1, -1, 2, -2 and infinity."""
    a, b, c = load(source, at), load(source, at + step), load(source, at + 2 * step)
    d, e, f = load(source, at + 3 * step), load(source, at + 4 * step), load(source, at + 5 * step)
    one, minus_one = d - scaled(b, _FOUR), e - scaled(c, _FOUR)
    two, minus_two = scaled(d - b, _TWO), e - c
    store(target, target_at, scaled(a, _FOUR) - scaled(c, _FIVE) + e)
    store(target, target_at + target_step, minus_one + one)
    store(target, target_at + 2 * target_step, minus_one - one)
    store(target, target_at + 3 * target_step, minus_two + two)
    store(target, target_at + 4 * target_step, minus_two - two)
    store(target, target_at + 5 * target_step, scaled(b, _FOUR) - scaled(d, _FIVE) + f)


@_inlined
def _four(source: Any, at: int, step: int) -> Any:
    """Four results of six frequencies."""
    a, b, c = load(source, at), load(source, at + step), load(source, at + 2 * step)
    d, e, f = load(source, at + 3 * step), load(source, at + 4 * step), load(source, at + 5 * step)
    one, minus_one, two, minus_two = b + c, b - c, d + e, d - e
    return (
        a + one + two,
        minus_one + scaled(minus_two, _TWO),
        one + scaled(two, _FOUR),
        minus_one + scaled(minus_two, _EIGHT) + f,
    )


@_inlined
def _columns(source: Any, at: int, step: int, half: Any) -> None:
    """The first of the two ways back, along y, for all six frequencies along x."""
    for j in range(SPAN):
        target = j * LANES
        for result in _four(source, at + j * step, SPAN * step):
            store(half, target, result)
            target += SPAN * LANES


@_inlined
def _nine(image: Any, y: int, x: int, weights: Any, k: int, channels: int) -> Any:
    """3 x 3 neighbours of a pixel, weighted."""
    upper = scaled(load(weights, k), image[y, x])
    middle = scaled(load(weights, 3 * channels + k), image[y + 1, x])
    lower = scaled(load(weights, 6 * channels + k), image[y + 2, x])
    for j in range(1, 3):
        upper = upper + scaled(load(weights, j * channels + k), image[y, x + j])
        middle = middle + scaled(load(weights, (3 + j) * channels + k), image[y + 1, x + j])
        lower = lower + scaled(load(weights, (6 + j) * channels + k), image[y + 2, x + j])
    return upper + middle + lower
