"""Laws: short formulas of height, slopes, surroundings, position and order.

A law is an effect with one strength (and the position of a jump), so the same code screens, fits, judges and
applies laws. A law states how the height departs from the model, not why. Tables have many strengths. A table
follows any dependence on its covariate and explains nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from litho_models.effects.effect import Apply, Effect, FieldContext, Parameter, Values, of_development
from litho_models.effects.filters import add_blur, add_filtered, gradient, rounded_power, trailing_response

_REACHES_UM, _TAILS_UM = (0.6, 1.5, 4.0), (0.6, 2.0, 6.0)
_RIM_UM = 2.0
# Over one micrometre, a wave of any frequency between two of these stays nearly in step with one of them.
_FREQUENCIES_PER_UM = tuple(0.5 * half for half in range(4, 21))
_WORDS = ("x", "y", "r²", "rim")
_STENCIL_UM = (-0.6, -0.3, 0.0, 0.3, 0.6)
_COPIES_UM = {
    f"from_{1000 * dy:+.0f}_{1000 * dx:+.0f}_nm": (dy, dx)
    for dy in _STENCIL_UM
    for dx in _STENCIL_UM
    if dy or dx
}
_LAST_KNOT = 16
_KNOTS = [f"level_{knot}_of_{_LAST_KNOT}" for knot in range(_LAST_KNOT + 1)]
_POWERS = {f"y{i}_x{j}": (i, j) for i in range(5) for j in range(5 - i) if i + j}
_TURN = "print and scan the same layouts turned by 90 degrees"
_SIDES = {"left": (-1, -1), "right": (-1, 1), "above": (-2, -1), "below": (-2, 1)}
_DIAGONAL = 0.5**0.5
# Directions of slopes, as (y, x).
_DIRECTIONS = {
    "x": (0.0, 1.0),
    "y": (1.0, 0.0),
    "diagonal": (_DIAGONAL, _DIAGONAL),
    "antidiagonal": (_DIAGONAL, -_DIAGONAL),
}


@dataclass(frozen=True)
class Surface:
    """Compute the quantities in formulas from a height h (b, 1, y, x), µm, its field, and the law's
    parameters.
    """

    h: Tensor
    context: FieldContext
    values: Values

    def slope(self, direction: str, of: Tensor | None = None) -> Tensor:
        """Return the slope of a map (by default the height) along a direction, by central differences."""
        along_y, along_x = _DIRECTIONS[direction]
        y, x = gradient(self.h if of is None else of, self.context.pitch_um)
        return along_y * y + along_x * x

    def size(self, power: float, *directions: str) -> Tensor:
        """Return a power of the absolute slope along a direction, or of the steepness, smoothed near zero."""
        squared = torch.stack([self.slope(one) for one in directions]).square().sum(dim=0)
        return rounded_power(squared, power)

    def place(self, word: str) -> Tensor:
        """Return for each pixel x, y, r² or the closeness to the scan's edge, e^(-distance / 2 µm)."""
        y, x = self.context.scan_position()
        if word == "rim":
            sides_um = (self.context.pitch_um * (size - 1) / 2 for size in self.context.whole_shape())
            own_um = [side * (1 - one.abs()) for side, one in zip(sides_um, (y, x), strict=True)]
            return torch.exp(-torch.minimum(*own_um) / _RIM_UM).to(self.h)
        return {"x": x + 0 * y, "y": y + 0 * x, "r²": x**2 + y**2}[word].to(self.h)

    def beyond(self, axis: str) -> Tensor:
        """Return a step along an axis of the scan: 0 before the law's position, 1 beyond it, linear within a
        pixel.
        """
        number = "yx".index(axis)
        at, size = self.context.scan_position()[number], self.context.whole_shape()[number]
        return ((at - self.values["position"]) * (size - 1) / 2 + 0.5).clamp(0, 1).to(self.h)

    def mean(self, reach_um: float, of: Tensor | None = None) -> Tensor:
        """Return the Gaussian-weighted local mean of a map, by default the height."""
        field, variance_um2 = self.h if of is None else of, self.h.new_tensor(reach_um**2)
        return add_blur(field, variance_um2, self.context.pitch_um, 4 * reach_um)

    def beside(self, side: str, length_um: float) -> Tensor:
        """Return the exponentially weighted mean height on one side, with the given decay length."""
        axis, sign = _SIDES[side]
        length, pitch = self.h.new_tensor(length_um), self.context.pitch_um

        def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
            return trailing_response(-sign * (fx if axis == -1 else fy), length, pitch) - 1

        return add_filtered(self.h, transfer_minus_one, pitch, 6 * length_um)

    def along(self, direction: str, length_um: float) -> Tensor:
        """Return the exponentially weighted mean height along a direction, to both sides."""
        along_y, along_x = _DIRECTIONS[direction]
        length, pitch = self.h.new_tensor(length_um), self.context.pitch_um

        def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
            # The phases of both sides cancel.
            return trailing_response(along_y * fy + along_x * fx, length, pitch).real - 1

        return add_filtered(self.h, transfer_minus_one, pitch, 6 * length_um)


# A function that computes the map (b, 1, y, x) that a strength multiplies.
Column = Callable[[Surface], Tensor]


# The name, the formula, the unit of the column, and the column.
Facts = tuple[str, str, str, Column]


def _columns() -> Iterator[Facts]:
    for axis in _DIRECTIONS:
        yield from (_power(axis, power) for power in (1.0, 1.5, 2.0, 3.0))
        yield from _one_way(axis)
    for axis in ("x", "y"):
        yield from _along_axis(axis)
        yield from (_slope_at(axis, word) for word in _WORDS)
    yield "steepness-power-1", "|∇h|", "1", lambda s: s.size(1, "x", "y")
    yield "steepness-power-2", "|∇h|²", "1", lambda s: s.size(2, "x", "y")
    yield "height-power-2", "h²", "µm²", lambda s: s.h**2
    yield "height-power-3", "h³", "µm³", lambda s: s.h**3
    yield "height-squared-times-order", "h² t", "µm²", lambda s: s.h**2 * s.context.order
    yield from (_height_at(word) for word in _WORDS)
    yield from (_surroundings_at(word) for word in _WORDS)
    for reach_um in _REACHES_UM:
        yield from _nearby(reach_um)
    yield from (_to_both_sides(axis, length_um) for axis in _DIRECTIONS for length_um in _TAILS_UM[1:])
    yield from (_to_one_side(side, length_um) for side in _SIDES for length_um in _TAILS_UM)


def _power(axis: str, power: float) -> Facts:
    return f"slope-{axis}-power-{power:g}", f"|∂h/∂{axis}|^{power:g}", "1", lambda s: s.size(power, axis)


def _one_way(axis: str) -> Iterator[Facts]:
    yield f"rising-slope-{axis}", f"max(∂h/∂{axis}, 0)", "1", lambda s: s.slope(axis).relu()
    yield f"falling-slope-{axis}", f"max(-∂h/∂{axis}, 0)", "1", lambda s: (-s.slope(axis)).relu()


def _along_axis(axis: str) -> Iterator[Facts]:
    yield f"height-times-slope-{axis}", f"h ∂h/∂{axis}", "µm", lambda s: s.h * s.slope(axis)
    yield f"height-times-slope-size-{axis}", f"h |∂h/∂{axis}|", "µm", lambda s: s.h * s.size(1, axis)
    yield f"curvature-{axis}", f"∂²h/∂{axis}²", "1/µm", lambda s: s.slope(axis, s.slope(axis))
    name = f"slope-size-{axis}-times-order"
    yield name, f"|∂h/∂{axis}| t", "1", lambda s: s.size(1, axis) * s.context.order


def _slope_at(axis: str, word: str) -> Facts:
    name = f"slope-size-{axis}-times-{word.replace('²', '2')}"
    return name, f"|∂h/∂{axis}| {word}", "1", lambda s: s.size(1, axis) * s.place(word)


def _height_at(word: str) -> Facts:
    return f"height-times-{word.replace('²', '2')}", f"h {word}", "µm", lambda s: s.h * s.place(word)


def _surroundings_at(word: str) -> Facts:
    reach_um = _REACHES_UM[1]
    name, formula = f"blur-{word.replace('²', '2')}-{reach_um:g}-um", f"(h̄({reach_um:g} µm) - h) {word}"
    return name, formula, "µm", lambda s: (s.mean(reach_um) - s.h) * s.place(word)


def _jumps(axis: str) -> Iterator[Facts]:
    name, formula = f"jump-along-{axis}", f"({axis} > {axis}0)"
    yield f"{name}-in-height", formula, "1", lambda s: s.beyond(axis)
    yield f"{name}-in-gain", f"h {formula}", "µm", lambda s: s.h * s.beyond(axis)
    yield from (_displaced(name, formula, axis, way) for way in ("x", "y"))


def _displaced(name: str, formula: str, axis: str, way: str) -> Facts:
    return f"{name}-in-{way}", f"∂h/∂{way} {formula}", "1", lambda s: s.slope(way) * s.beyond(axis)


def _nearby(reach_um: float) -> Iterator[Facts]:
    mean, within = f"h̄({reach_um:g} µm)", f"{reach_um:g}-um"
    yield f"surroundings-{within}", f"{mean} - h", "µm", lambda s: s.mean(reach_um) - s.h
    blurred = f"h ({mean} - h)"
    yield f"blur-height-{within}", blurred, "µm²", lambda s: s.h * (s.mean(reach_um) - s.h)
    yield f"above-surroundings-{within}", f"(h - {mean})²", "µm²", lambda s: (s.h - s.mean(reach_um)) ** 2
    steps = f"mean of |∇h| within {reach_um:g} µm"
    yield f"steps-within-{within}", steps, "1", lambda s: s.mean(reach_um, s.size(1, "x", "y"))


def _to_both_sides(axis: str, length_um: float) -> Facts:
    name, formula = f"along-{axis}-{length_um:g}-um", f"h along {axis} over {length_um:g} µm - h"
    return name, formula, "µm", lambda s: s.along(axis, length_um) - s.h


def _to_one_side(side: str, length_um: float) -> Facts:
    name, formula = f"{side}-{length_um:g}-um", f"h {side} over {length_um:g} µm - h"
    return name, formula, "µm", lambda s: s.beside(side, length_um) - s.h


def _law(name: str, formula: str, unit: str, column: Column, **shapes: Parameter) -> Effect:
    unit_of_strength = {"1": "µm", "µm": "1", "µm²": "1/µm", "µm³": "1/µm²", "1/µm": "µm²"}

    def apply(height: Tensor, values: Values, context: FieldContext) -> Tensor:
        return height + values["strength"] * column(Surface(height, context, values))

    return Effect(
        # The name may become part of a parameter's name.
        name=name.replace(".", "-"),
        title=f"height changed by {formula}",
        stage="development",
        role="undetermined",
        acts_on="height",
        parameters={"strength": Parameter(unit_of_strength[unit], -2.0, 2.0, 0.05), **shapes},
        apply=apply,
        source="found in the residual; h in µm, h̄ its Gaussian mean, x and y from -1 to 1 over the scan, "
        "r² = x² + y², rim = e^(-distance to the edge / 2 µm), the order t from -0.5 to 0.5",
        separating=_TURN,
        knowledge="law",
    )


@of_development(
    "height changed by a wave of the height itself, sin(2π f h + phase)",
    {
        "sine_um": Parameter("µm", -0.2, 0.2, 0.02),
        "cosine_um": Parameter("µm", -0.2, 0.2, 0.02),
        "frequency_per_um": Parameter("1/µm", 2.0, 10.0, 5.0, "shape", tried=_FREQUENCIES_PER_UM),
    },
    role="undetermined",
    source="found in the residual; h in µm",
    separating="print a staircase of small steps",
    knowledge="law",
)
def height_wave(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Return a wave in the height, as slices or standing waves leave it."""
    phase = 2 * math.pi * values["frequency_per_um"] * height
    return height + values["sine_um"] * phase.sin() + values["cosine_um"] * phase.cos()


def _table(title: str, names: Iterable[str], unit: str) -> Callable[[Apply], Effect]:
    return of_development(
        title,
        {name: Parameter(unit, -1.0, 1.0, 0.02) for name in names},
        role="undetermined",
        source="a table along a covariate",
        separating=_TURN,
        knowledge="description",
    )


@_table("a separate height for each level", _KNOTS, "µm")
def level_table(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Return a correction for each of seventeen heights of the layout, linear between these heights."""
    knots = torch.stack([values[name] for name in _KNOTS])
    smooth = functional.avg_pool2d(context.layout_um, 3, 1, 1, count_include_pad=False)
    share = (smooth / context.full_height_um * _LAST_KNOT).clamp(0, _LAST_KNOT)
    below = share.floor().clamp(max=_LAST_KNOT - 1)
    at = below.long()
    return height + knots[at] + (share - below) * (knots[at + 1] - knots[at])


@_table("a response to the height nearby", _COPIES_UM, "1")
def linear_response(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Weight the height difference to each displaced position; the field is continued beyond its edge."""
    pitch, (ny, nx) = context.pitch_um, height.shape[-2:]
    edge = round(max(_STENCIL_UM) / pitch)
    padded = functional.pad(height, (edge,) * 4, mode="replicate")
    total = height * (1 - sum(values[name] for name in _COPIES_UM))
    for name, (dy, dx) in _COPIES_UM.items():
        top, left = edge + round(dy / pitch), edge + round(dx / pitch)
        total = total + values[name] * padded[..., top : top + ny, left : left + nx]
    return total


@_table("a gain that depends on the position in the scan", _POWERS, "1")
def place_map(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Return the height times a polynomial of the position in the scan."""
    y, x = context.scan_position()
    return height * (1 + sum(values[name] * y**i * x**j for name, (i, j) in _POWERS.items()))


_POSITION = Parameter("1", -0.95, 0.95, 0.0, "shape", tried=(-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75))
_OF_JUMPS = [_law(*facts, position=_POSITION) for axis in ("x", "y") for facts in _jumps(axis)]
LAWS = {law.name: law for law in (*(_law(*facts) for facts in _columns()), *_OF_JUMPS, height_wave)}
TABLES = {one.name: one for one in (level_table, linear_response, place_map)}
