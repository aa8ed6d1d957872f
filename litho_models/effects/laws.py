"""Laws without a name: short formulas of the height, its slopes and surroundings, the place and the order.

Each is an effect like any other, with one strength, so that it is screened, fitted, judged and applied by the
same code. It says by which formula the height departs from the model, not why. Descriptions are the same with
many strengths: they follow whatever their covariate carries, and explain nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.nn import functional

from litho_models.effects.effect import Effect, FieldContext, Parameter, Values
from litho_models.effects.filters import add_blur, add_filtered, gradient, trailing_response

# (height, context) to the map that a strength multiplies, both (b, 1, y, x).
Column = Callable[[Tensor, FieldContext], Tensor]

_ROUNDED_SLOPE = 1e-3
_REACHES_UM, _TAILS_UM = (0.6, 1.5, 4.0), (0.6, 2.0, 6.0)
_STENCIL_UM = (-0.6, -0.3, 0.0, 0.3, 0.6)
_LAST_KNOT = 16
_COPIES_UM = tuple((dy, dx) for dy in _STENCIL_UM for dx in _STENCIL_UM if dy or dx)
_SIDES = {"left": (-1, -1), "right": (-1, 1), "above": (-2, -1), "below": (-2, 1)}
_DIAGONAL = 0.5**0.5
# (y, x) of the directions along which a slope is taken.
_DIRECTIONS = {
    "x": (0.0, 1.0),
    "y": (1.0, 0.0),
    "diagonal": (_DIAGONAL, _DIAGONAL),
    "antidiagonal": (_DIAGONAL, -_DIAGONAL),
}


def _height(height: Tensor, context: FieldContext) -> Tensor:
    return height


def _order(height: Tensor, context: FieldContext) -> Tensor:
    return torch.full_like(height, context.order)


def _place(word: str) -> Column:
    """x, y, or r² of the pixel in its scan."""

    def column(height: Tensor, context: FieldContext) -> Tensor:
        y, x = context.scan_position()
        return {"x": x + 0 * y, "y": y + 0 * x, "r²": x**2 + y**2}[word].to(height)

    return column


def _times(first: Column, second: Column) -> Column:
    return lambda height, context: first(height, context) * second(height, context)


def _minus(first: Column, second: Column) -> Column:
    return lambda height, context: first(height, context) - second(height, context)


def _twice(column: Column) -> Column:
    return lambda height, context: column(column(height, context), context)


def _slope(direction: str, sign: float = 1.0) -> Column:
    """Slope along a direction by central differences."""
    along_y, along_x = _DIRECTIONS[direction]

    def column(height: Tensor, context: FieldContext) -> Tensor:
        y, x = gradient(height, context.pitch_um)
        return sign * (along_y * y + along_x * x)

    return column


def _size(power: float, *slopes: Column) -> Column:
    """A power of the size of a slope, or of the steepness, rounded off near zero so that it is smooth."""

    def column(height: Tensor, context: FieldContext) -> Tensor:
        squared = torch.stack([slope(height, context) for slope in slopes]).square().sum(dim=0)
        return (squared + _ROUNDED_SLOPE**2) ** (power / 2) - _ROUNDED_SLOPE**power

    return column


def _uphill(slope: Column) -> Column:
    return lambda height, context: torch.relu(slope(height, context))


def _mean(reach_um: float, of: Column = _height) -> Column:
    """Mean nearby, weighted by a Gaussian."""
    return lambda height, context: _blurred(of(height, context), context, reach_um)


def _beside(side: str, length_um: float) -> Column:
    """Mean height on one side, weighted by an exponential of that length."""
    axis, sign = _SIDES[side]

    def column(height: Tensor, context: FieldContext) -> Tensor:
        length = torch.as_tensor(length_um, dtype=height.dtype, device=height.device)

        def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
            along = fx if axis == -1 else fy
            return trailing_response(-sign * along, length, context.pitch_um) - 1

        return add_filtered(height, transfer_minus_one, context.pitch_um, 6 * length_um)

    return column


def _along(direction: str, length_um: float) -> Column:
    """Mean height along a direction, to both sides, weighted by an exponential of that length."""
    along_y, along_x = _DIRECTIONS[direction]

    def column(height: Tensor, context: FieldContext) -> Tensor:
        length = torch.as_tensor(length_um, dtype=height.dtype, device=height.device)

        def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
            # Both sides together: their phases cancel.
            return trailing_response(along_y * fy + along_x * fx, length, context.pitch_um).real - 1

        return add_filtered(height, transfer_minus_one, context.pitch_um, 6 * length_um)

    return column


def _blurred(height: Tensor, context: FieldContext, sigma_um: float) -> Tensor:
    variance = torch.as_tensor(sigma_um**2, dtype=height.dtype, device=height.device)
    return add_blur(height, variance, context.pitch_um, 4 * sigma_um)


def _columns() -> Iterator[tuple[str, str, str, Column]]:
    """Name, formula, unit of the column, column."""
    steepness = _slope("x"), _slope("y")
    for axis in _DIRECTIONS:
        slope = _slope(axis)
        for power in (1.0, 1.5, 2.0, 3.0):
            yield f"slope-{axis}-power-{power:g}", f"|∂h/∂{axis}|^{power:g}", "1", _size(power, slope)
        yield f"rising-slope-{axis}", f"max(∂h/∂{axis}, 0)", "1", _uphill(slope)
        yield f"falling-slope-{axis}", f"max(-∂h/∂{axis}, 0)", "1", _uphill(_slope(axis, -1.0))
    for axis in ("x", "y"):
        slope, size = _slope(axis), _size(1, _slope(axis))
        yield f"height-times-slope-{axis}", f"h ∂h/∂{axis}", "µm", _times(_height, slope)
        yield f"height-times-slope-size-{axis}", f"h |∂h/∂{axis}|", "µm", _times(_height, size)
        yield f"curvature-{axis}", f"∂²h/∂{axis}²", "1/µm", _twice(slope)
        yield f"slope-size-{axis}-times-order", f"|∂h/∂{axis}| t", "1", _times(size, _order)
        for word in ("x", "y", "r²"):
            name = f"slope-size-{axis}-times-{word.replace('²', '2')}"
            yield name, f"|∂h/∂{axis}| {word}", "1", _times(size, _place(word))
    yield "steepness-power-1", "|∇h|", "1", _size(1, *steepness)
    yield "steepness-power-2", "|∇h|²", "1", _size(2, *steepness)
    square = _times(_height, _height)
    yield "height-power-2", "h²", "µm²", square
    yield "height-power-3", "h³", "µm³", _times(square, _height)
    yield "height-squared-times-order", "h² t", "µm²", _times(square, _order)
    for word in ("x", "y", "r²"):
        name = f"height-times-{word.replace('²', '2')}"
        yield name, f"h {word}", "µm", _times(_height, _place(word))
    for reach in _REACHES_UM:
        mean, within = f"h̄({reach:g} µm)", f"{reach:g}-um"
        above = _minus(_height, _mean(reach))
        yield f"surroundings-{within}", f"{mean} - h", "µm", _minus(_mean(reach), _height)
        yield f"height-times-surroundings-{within}", f"h {mean}", "µm²", _times(_height, _mean(reach))
        yield f"above-surroundings-{within}", f"(h - {mean})²", "µm²", _times(above, above)
        steps = _mean(reach, _size(1, *steepness))
        yield f"steps-within-{within}", f"mean of |∇h| within {reach:g} µm", "1", steps
    for axis in _DIRECTIONS:
        for length in _TAILS_UM[1:]:
            column = _minus(_along(axis, length), _height)
            yield f"along-{axis}-{length:g}-um", f"h along {axis} over {length:g} µm - h", "µm", column
    for side in _SIDES:
        for length in _TAILS_UM:
            column = _minus(_beside(side, length), _height)
            yield f"{side}-{length:g}-um", f"h {side} over {length:g} µm - h", "µm", column


def _law(name: str, formula: str, unit: str, column: Column) -> Effect:
    unit_of_strength = {"1": "µm", "µm": "1", "µm²": "1/µm", "µm³": "1/µm²", "1/µm": "µm²"}

    def apply(height: Tensor, values: Values, context: FieldContext) -> Tensor:
        return height + values["strength"] * column(height, context)

    return Effect(
        name=_named(name),
        title=f"height changed by {formula}",
        stage="development",
        role="undetermined",
        acts_on="height",
        parameters={"strength": Parameter(unit_of_strength[unit], -2.0, 2.0, 0.05)},
        apply=apply,
        trials=({"strength": 0.05},),
        source="found in the residual; h in µm, h̄ its Gaussian mean, x and y from -1 to 1 over the scan, "
        "r² = x² + y², the order t from -0.5 to 0.5",
        separating="print and scan the same layouts turned by 90 degrees",
        knowledge="law",
    )


def _level_table(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """One correction for each of seventeen heights of the layout, linear between them."""
    knots = torch.stack([values[_of_knot(knot)] for knot in range(_LAST_KNOT + 1)])
    smooth = functional.avg_pool2d(context.layout_um, 3, 1, 1, count_include_pad=False)
    share = (smooth / context.full_height_um * _LAST_KNOT).clamp(0, _LAST_KNOT)
    below = share.floor().clamp(max=_LAST_KNOT - 1)
    at = below.long()
    return height + knots[at] + (share - below) * (knots[at + 1] - knots[at])


def _linear_response(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """A weight for what the height differs by at each displaced place; the field goes on beyond its edge."""
    pitch, (ny, nx) = context.pitch_um, height.shape[-2:]
    edge = round(max(_STENCIL_UM) / pitch)
    padded = functional.pad(height, (edge,) * 4, mode="replicate")
    weights = [values[_of_copy(*one)] for one in _COPIES_UM]
    total = height * (1 - sum(weights))
    for (dy, dx), weight in zip(_COPIES_UM, weights, strict=True):
        top, left = edge + round(dy / pitch), edge + round(dx / pitch)
        total = total + weight * padded[..., top : top + ny, left : left + nx]
    return total


def _of_knot(knot: int) -> str:
    return f"level_{knot}_of_{_LAST_KNOT}"


def _of_copy(dy_um: float, dx_um: float) -> str:
    return f"from_{1000 * dy_um:+.0f}_{1000 * dx_um:+.0f}_nm"


def _named(name: str) -> str:
    """A name that may be a part of the name of a parameter."""
    return name.replace(".", "-")


def _place_map(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """The height times a polynomial of the place in the scan."""
    y, x = context.scan_position()
    # By columns: a polynomial of y times a power of x.
    factor = sum(sum(values[f"y{i}_x{j}"] * y**i for i in range(5 - j) if i + j) * x**j for j in range(5))
    return height * (1 + factor)


def _description(name: str, title: str, names: list[str], unit: str, apply: Callable[..., Tensor]) -> Effect:
    return Effect(
        name=name,
        title=title,
        stage="development",
        role="undetermined",
        acts_on="height",
        parameters={one: Parameter(unit, -1.0, 1.0, 0.02) for one in names},
        apply=apply,
        trials=tuple({one: 0.02} for one in names),
        source="a table along a covariate",
        separating="print and scan the same layouts turned by 90 degrees",
        knowledge="description",
    )


LAWS = {law.name: law for law in (_law(*facts) for facts in _columns())}
TABLES = {
    one.name: one
    for one in (
        _description(
            "level-table", "a height of its own for each level",
            [_of_knot(k) for k in range(_LAST_KNOT + 1)], "µm", _level_table,
        ),
        _description(
            "linear-response", "a response to the height nearby",
            [_of_copy(*one) for one in _COPIES_UM], "1", _linear_response,
        ),
        _description(
            "place-map", "a gain that follows the place in the scan",
            [f"y{i}_x{j}" for i in range(5) for j in range(5 - i) if i + j], "1", _place_map,
        ),
    )
}  # fmt: skip
