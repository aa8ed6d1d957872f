"""A vector of 16 floats as a value in functions that Numba compiles.

What a compiler makes of a plain loop over channels depends on their number and on what it can prove of
the memories, and differs by a factor of four; a loop over these vectors is what it says. Processors with
shorter vectors take several for one.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, models, overload, register_model

LANES = 16
# The types of Numba count the compiler's own argument among those of a call.
_intrinsic: Any = intrinsic
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_SIGNS = ir.VectorType(ir.IntType(8), LANES)
# A product and a sum may be rounded once; a NaN stays one.
_FUSED = ("contract",)


class _VectorType(types.Type):
    """Type of a vector, for Numba."""


_vector = _VectorType(name="Vector16")


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any):
        super().__init__(manager, kind, _FLOATS)


@_intrinsic
def load(typing: Any, memory: Any, at: Any) -> Any:
    """16 floats of a flat float32 array from position ``at`` on; nothing is checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_pointer(context, builder, signature, arguments, _FLOATS), align=1, typ=_FLOATS)

    return _vector(memory, at), generate


@_intrinsic
def store(typing: Any, memory: Any, at: Any, vector: Any) -> Any:
    """Write a vector into a flat float32 array from position ``at`` on; nothing is checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _pointer(context, builder, signature, arguments, _FLOATS), align=1)
        return context.get_dummy_value()

    return types.void(memory, at, vector), generate


@_intrinsic
def store_signs(typing: Any, memory: Any, at: Any, vector: Any) -> Any:
    """Write 1 for what is above zero, -1 for the rest, into a flat int8 array from ``at`` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        positive = builder.fcmp_ordered(">", arguments[2], _constant(0.0))
        signs = builder.select(positive, ir.Constant(_SIGNS, [1] * LANES), ir.Constant(_SIGNS, [-1] * LANES))
        builder.store(signs, _pointer(context, builder, signature, arguments, _SIGNS), align=1)
        return context.get_dummy_value()

    return types.void(memory, at, vector), generate


@_intrinsic
def leaky(typing: Any, vector: Any, slope: Any) -> Any:
    """Values above zero, and the others times ``slope``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values, slope = arguments[0], _splat(builder, arguments[1])
        positive = builder.fcmp_ordered(">", values, _constant(0.0))
        return builder.select(positive, values, builder.fmul(values, slope))

    return _vector(vector, slope), generate


@_intrinsic
def leaky_by_signs(typing: Any, vector: Any, slope: Any, memory: Any, at: Any) -> Any:
    """Values where ``store_signs`` has written 1, and the others times ``slope``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values, slope = arguments[0], _splat(builder, arguments[1])
        where = _pointer(context, builder, signature, arguments, _SIGNS, first=2)
        signs = builder.load(where, align=1, typ=_SIGNS)
        positive = builder.icmp_signed(">", signs, ir.Constant(_SIGNS, [0] * LANES))
        return builder.select(positive, values, builder.fmul(values, slope))

    return _vector(vector, slope, memory, at), generate


@_intrinsic
def scaled(typing: Any, vector: Any, factor: Any) -> Any:
    """A vector times a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fmul(arguments[0], _splat(builder, arguments[1]), flags=_FUSED)

    return _vector(vector, factor), generate


@_intrinsic
def _added(typing: Any, a: Any, b: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fadd(*arguments, flags=_FUSED)

    return _vector(a, b), generate


@_intrinsic
def _subtracted(typing: Any, a: Any, b: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fsub(*arguments, flags=_FUSED)

    return _vector(a, b), generate


@overload(operator.add)
def _add(a, b):
    return (lambda a, b: _added(a, b)) if a is _vector and b is _vector else None


@overload(operator.sub)
def _subtract(a, b):
    return (lambda a, b: _subtracted(a, b)) if a is _vector and b is _vector else None


def _pointer(
    context: Any, builder: Any, signature: Any, arguments: Any, kind: ir.Type, first: int = 0
) -> Any:
    """Where argument ``first``, an array, has the position that the next argument names."""
    array = context.make_array(signature.args[first])(context, builder, arguments[first])
    return builder.bitcast(builder.gep(array.data, [arguments[first + 1]]), kind.as_pointer())


def _splat(builder: Any, number: Any) -> Any:
    one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
    every = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(_FLOATS, ir.Undefined), every)


def _constant(number: float) -> Any:
    return ir.Constant(_FLOATS, [number] * LANES)
