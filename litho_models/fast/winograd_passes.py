"""Compiled: what ``winograd`` does to fields before and after its products, patch by patch.

Fields are (y, x, channels), spectra (36, patches, channels), both contiguous float32; signs are int8
like a field. The channels are a multiple of ``LANES``. Nothing is checked here.

The loops over channels go by vectors that are a type of their own (at the end): what the compiler makes
of a plain loop depends on the number of channels and on what it can prove of the memories, and differs
by a factor of four. Processors with shorter vectors take several for one. All this is in one file
because Numba compiles anew what has changed in the file of a function, and in no other.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, models, overload, register_model
from numpy.typing import NDArray

# Side of a patch of results, and of the pixels and the frequencies that it depends on.
PATCH_PX, SPAN = 4, 6
# Zeros around the field of an adjoint.
FRAME_PX = 2
# Channels in a vector.
LANES = 16

_TWO, _FOUR, _FIVE, _EIGHT = (np.float32(number) for number in (2, 4, 5, 8))
_Floats = NDArray[np.float32]
_Signs = NDArray[np.int8]
_inlined = numba.njit(forceinline=True)
# For mypy an intrinsic still has the first argument, which Numba supplies.
_intrinsic: Any = intrinsic


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
    _results(spectrum, first, count, per_row, field, 0, signs, _activated, (bias, slope))


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
    _results(spectrum, first, count, per_row, framed, FRAME_PX, signs, _restrained, (slope,))


@_compiled
def lift(
    image: _Floats, taps: _Floats, bias: _Floats, slope: np.float32, field: _Floats, signs: _Signs
) -> None:
    """Convolution of an image (y, x) with (9, channels), bias and leaky ReLU, and the signs."""
    _lifted(image, taps, field, 0, signs, _activated, (bias, slope))


@_compiled
def lift_back(image: _Floats, taps: _Floats, slope: np.float32, signs: _Signs, framed: _Floats) -> None:
    """The same without bias, times the slope of the leaky ReLU whose signs these are, in a frame."""
    _lifted(image, taps, framed, FRAME_PX, signs, _restrained, (slope,))


@_inlined
def _results(
    spectrum: Any,
    first: int,
    count: int,
    per_row: int,
    field: Any,
    frame_px: int,
    signs: Any,
    finish: Any,
    settings: Any,
) -> None:
    """Results of patches, finished one by one into a field within a frame."""
    channels = field.shape[2]
    row, sign_row = field.shape[1] * channels, signs.shape[1] * channels
    source, target, kept = spectrum.reshape(-1), field.reshape(-1), signs.reshape(-1)
    half = np.empty(PATCH_PX * SPAN * LANES, np.float32)
    for patch in range(count):
        y, x = divmod(first + patch, per_row)
        for k in range(0, channels, LANES):
            _columns(source, patch * channels + k, spectrum.shape[1] * channels, half)
            for i in range(PATCH_PX):
                at = (PATCH_PX * y + i + frame_px) * row + (PATCH_PX * x + frame_px) * channels + k
                sign_at = (PATCH_PX * y + i) * sign_row + PATCH_PX * x * channels + k
                for result in _four(half, SPAN * i * LANES, LANES):
                    finish(result, k, settings, target, at, kept, sign_at)
                    at += channels
                    sign_at += channels


@_inlined
def _lifted(image: Any, taps: Any, field: Any, frame_px: int, signs: Any, finish: Any, settings: Any) -> None:
    """Convolution of an image, finished pixel by pixel into a field within a frame."""
    channels = field.shape[2]
    weights, target, kept = taps.reshape(-1), field.reshape(-1), signs.reshape(-1)
    for y in range(image.shape[0] - 2):
        for x in range(image.shape[1] - 2):
            at = ((y + frame_px) * field.shape[1] + x + frame_px) * channels
            sign_at = (y * signs.shape[1] + x) * channels
            for k in range(0, channels, LANES):
                value = _nine(image, y, x, weights, k, channels)
                finish(value, k, settings, target, at + k, kept, sign_at + k)


@_inlined
def _activated(value: Any, k: int, settings: Any, target: Any, at: int, kept: Any, sign_at: int) -> None:
    bias, slope = settings
    value = value + _load(bias, k)
    _store(target, at, _leaky(value, slope))
    _store_signs(kept, sign_at, value)


@_inlined
def _restrained(value: Any, k: int, settings: Any, target: Any, at: int, kept: Any, sign_at: int) -> None:
    (slope,) = settings
    _store(target, at, _leaky_by_signs(value, slope, kept, sign_at))


@_inlined
def _six(source: Any, at: int, step: int, target: Any, target_at: int, target_step: int) -> None:
    """B transposed of Lavin and Gray: six neighbours to six frequencies."""
    a, b, c = _load(source, at), _load(source, at + step), _load(source, at + 2 * step)
    d, e, f = _load(source, at + 3 * step), _load(source, at + 4 * step), _load(source, at + 5 * step)
    one, minus_one = d - _scaled(b, _FOUR), e - _scaled(c, _FOUR)
    two, minus_two = _scaled(d - b, _TWO), e - c
    _store(target, target_at, _scaled(a, _FOUR) - _scaled(c, _FIVE) + e)
    _store(target, target_at + target_step, minus_one + one)
    _store(target, target_at + 2 * target_step, minus_one - one)
    _store(target, target_at + 3 * target_step, minus_two + two)
    _store(target, target_at + 4 * target_step, minus_two - two)
    _store(target, target_at + 5 * target_step, _scaled(b, _FOUR) - _scaled(d, _FIVE) + f)


@_inlined
def _four(source: Any, at: int, step: int) -> Any:
    """A transposed of Lavin and Gray: six frequencies back to four results."""
    a, b, c = _load(source, at), _load(source, at + step), _load(source, at + 2 * step)
    d, e, f = _load(source, at + 3 * step), _load(source, at + 4 * step), _load(source, at + 5 * step)
    one, minus_one, two, minus_two = b + c, b - c, d + e, d - e
    return (
        a + one + two,
        minus_one + _scaled(minus_two, _TWO),
        one + _scaled(two, _FOUR),
        minus_one + _scaled(minus_two, _EIGHT) + f,
    )


@_inlined
def _columns(source: Any, at: int, step: int, half: Any) -> None:
    """The first of the two ways back, along y, for all six frequencies along x."""
    for j in range(SPAN):
        target = j * LANES
        for result in _four(source, at + j * step, SPAN * step):
            _store(half, target, result)
            target += SPAN * LANES


@_inlined
def _nine(image: Any, y: int, x: int, weights: Any, k: int, channels: int) -> Any:
    """3 x 3 neighbours of a pixel, weighted."""
    upper = _scaled(_load(weights, k), image[y, x])
    middle = _scaled(_load(weights, 3 * channels + k), image[y + 1, x])
    lower = _scaled(_load(weights, 6 * channels + k), image[y + 2, x])
    for j in range(1, 3):
        upper = upper + _scaled(_load(weights, j * channels + k), image[y, x + j])
        middle = middle + _scaled(_load(weights, (3 + j) * channels + k), image[y + 1, x + j])
        lower = lower + _scaled(_load(weights, (6 + j) * channels + k), image[y + 2, x + j])
    return upper + middle + lower


class _VectorType(types.Type):
    """A vector of floats as a value, for Numba."""


_vector = _VectorType(name="Vector16")
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_SIGNS = ir.VectorType(ir.IntType(8), LANES)
_ZEROS, _NO_SIGNS = ir.Constant(_FLOATS, [0.0] * LANES), ir.Constant(_SIGNS, [0] * LANES)
# A product and a sum may be rounded once; a NaN stays one.
_FUSED = ("contract",)


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any):
        super().__init__(manager, kind, _FLOATS)


@_intrinsic
def _load(typing: Any, memory: Any, at: Any) -> Any:
    """Floats of a flat array from position ``at`` on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        where = _pointer(context, builder, signature.args[0], given[0], given[1], _FLOATS)
        return builder.load(where, align=1, typ=_FLOATS)

    return (_vector(memory, at), generate) if _is_flat(memory, types.float32) else None


@_intrinsic
def _store(typing: Any, memory: Any, at: Any, vector: Any) -> Any:
    """Write a vector into a flat array from position ``at`` on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        where = _pointer(context, builder, signature.args[0], given[0], given[1], _FLOATS)
        builder.store(given[2], where, align=1)
        return context.get_dummy_value()

    return (types.void(memory, at, vector), generate) if _is_flat(memory, types.float32) else None


@_intrinsic
def _store_signs(typing: Any, memory: Any, at: Any, vector: Any) -> Any:
    """Write 1 for what is above zero and -1 for the rest."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        where = _pointer(context, builder, signature.args[0], given[0], given[1], _SIGNS)
        signs = (ir.Constant(_SIGNS, [sign] * LANES) for sign in (1, -1))
        builder.store(builder.select(builder.fcmp_ordered(">", given[2], _ZEROS), *signs), where, align=1)
        return context.get_dummy_value()

    return (types.void(memory, at, vector), generate) if _is_flat(memory, types.int8) else None


@_intrinsic
def _leaky(typing: Any, vector: Any, slope: Any) -> Any:
    """Values above zero, and the others times ``slope``."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        reduced = builder.fmul(given[0], _splat(builder, given[1]))
        return builder.select(builder.fcmp_ordered(">", given[0], _ZEROS), given[0], reduced)

    return _vector(vector, slope), generate


@_intrinsic
def _leaky_by_signs(typing: Any, vector: Any, slope: Any, memory: Any, at: Any) -> Any:
    """Values where ``_store_signs`` has written 1, and the others times ``slope``."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        where = _pointer(context, builder, signature.args[2], given[2], given[3], _SIGNS)
        positive = builder.icmp_signed(">", builder.load(where, align=1, typ=_SIGNS), _NO_SIGNS)
        return builder.select(positive, given[0], builder.fmul(given[0], _splat(builder, given[1])))

    return (_vector(vector, slope, memory, at), generate) if _is_flat(memory, types.int8) else None


@_intrinsic
def _scaled(typing: Any, vector: Any, factor: Any) -> Any:
    """A vector times a float32."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.fmul(given[0], _splat(builder, given[1]), flags=_FUSED)

    return _vector(vector, factor), generate


@_intrinsic
def _sum(typing: Any, a: Any, b: Any) -> Any:
    return _vector(a, b), lambda context, builder, signature, given: builder.fadd(*given, flags=_FUSED)


@_intrinsic
def _difference(typing: Any, a: Any, b: Any) -> Any:
    return _vector(a, b), lambda context, builder, signature, given: builder.fsub(*given, flags=_FUSED)


@overload(operator.add)
def _add(a, b):
    return (lambda a, b: _sum(a, b)) if a is _vector and b is _vector else None


@overload(operator.sub)
def _subtract(a, b):
    return (lambda a, b: _difference(a, b)) if a is _vector and b is _vector else None


def _is_flat(memory: Any, dtype: Any) -> bool:
    is_array = isinstance(memory, types.Array)
    return is_array and (memory.ndim, memory.layout, memory.dtype) == (1, "C", dtype)


def _pointer(context: Any, builder: Any, kind: Any, memory: Any, at: Any, vector: ir.Type) -> Any:
    array = context.make_array(kind)(context, builder, memory)
    return builder.bitcast(builder.gep(array.data, [at]), vector.as_pointer())


def _splat(builder: Any, number: Any) -> Any:
    nothing = ir.Constant(_FLOATS, ir.Undefined)
    one = builder.insert_element(nothing, number, ir.Constant(ir.IntType(32), 0))
    every = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, nothing, every)
