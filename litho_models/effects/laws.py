"""Laws without a name: short formulas of the height, its slopes and surroundings, the place and the order.

Each is an effect like any other, with one strength, so that it is screened, fitted, judged and applied by the
same code. It says by which formula the height departs from the model, not why. Descriptions are the same with
many strengths: they follow whatever their covariate carries, and explain nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from litho_models.effects.effect import Effect, FieldContext, Parameter, Values
from litho_models.effects.filters import add_blur, add_filtered, gradient, trailing_response

# (height, context) to the map that a strength multiplies, both (b, 1, y, x).
Column = Callable[[Tensor, FieldContext], Tensor]

_ROUNDED_SLOPE = 1e-3
_NEAR_UM, _REACHES_UM, _TAILS_UM = 0.3, (0.6, 1.5, 4.0), (0.6, 2.0, 6.0)
_STENCIL_UM = (-0.6, -0.3, 0.0, 0.3, 0.6)
_SIDES = {"left": (-1, -1), "right": (-1, 1), "above": (-2, -1), "below": (-2, 1)}


def _slope(height: Tensor, context: FieldContext, along: tuple[float, float]) -> Tensor:
    """Slope along a direction (y, x), smoothed by a pixel's own difference."""
    y, x = gradient(height, context.pitch_um)
    return along[0] * y + along[1] * x


def _size(slope: Tensor, power: float) -> Tensor:
    return (slope**2 + _ROUNDED_SLOPE**2) ** (power / 2) - _ROUNDED_SLOPE**power


def _blurred(height: Tensor, context: FieldContext, sigma_um: float) -> Tensor:
    variance = torch.as_tensor(sigma_um**2, dtype=height.dtype, device=height.device)
    return add_blur(height, variance, context.pitch_um, 4 * sigma_um)


def _side(height: Tensor, context: FieldContext, side: str, length_um: float) -> Tensor:
    """Mean height on one side, weighted by an exponential of that length, less the height here."""
    axis, sign = _SIDES[side]
    length = torch.as_tensor(length_um, dtype=height.dtype, device=height.device)

    def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
        along = fx if axis == -1 else fy
        return trailing_response(-sign * along, length, context.pitch_um) - 1

    return add_filtered(height, transfer_minus_one, context.pitch_um, 6 * length_um) - height


def _columns() -> dict[str, tuple[str, str, Column]]:
    """By name: formula, unit of the column, column."""
    found: dict[str, tuple[str, str, Column]] = {}
    half = 0.5**0.5
    directions = {
        "x": (0.0, 1.0), "y": (1.0, 0.0), "diagonal": (half, half), "antidiagonal": (half, -half),
    }  # fmt: skip
    for axis, along in directions.items():
        for power in (1.0, 1.5, 2.0, 3.0):
            found[_named(f"slope-{axis}-power-{power:g}")] = (
                f"|∂h/∂{axis}|^{power:g}", "1",
                lambda h, c, a=along, p=power: _size(_slope(h, c, a), p),
            )  # fmt: skip
    for axis, along in directions.items():
        for sign, word in ((1.0, "rising"), (-1.0, "falling")):
            found[f"{word}-slope-{axis}"] = (
                f"max({'' if sign > 0 else '-'}∂h/∂{axis}, 0)", "1",
                lambda h, c, a=along, s=sign: torch.relu(s * _slope(h, c, a)),
            )  # fmt: skip
    for axis in ("x", "y"):
        along = directions[axis]
        found[f"height-times-slope-{axis}"] = (
            f"h ∂h/∂{axis}", "µm", lambda h, c, a=along: h * _slope(h, c, a),
        )  # fmt: skip
        found[f"height-times-slope-size-{axis}"] = (
            f"h |∂h/∂{axis}|", "µm", lambda h, c, a=along: h * _size(_slope(h, c, a), 1.0),
        )  # fmt: skip
        found[f"curvature-{axis}"] = (
            f"∂²h/∂{axis}²", "1/µm", lambda h, c, a=along: _slope(_slope(h, c, a), c, a),
        )  # fmt: skip
    found["steepness-power-1"] = (
        "|∇h|", "1", lambda h, c: (sum(s**2 for s in gradient(h, c.pitch_um)) + _ROUNDED_SLOPE**2) ** 0.5,
    )  # fmt: skip
    found["steepness-power-2"] = ("|∇h|²", "1", lambda h, c: sum(s**2 for s in gradient(h, c.pitch_um)))
    for power in (2, 3):
        found[f"height-power-{power}"] = (f"h^{power}", f"µm^{power}", lambda h, c, p=power: h**p)
    for reach in _REACHES_UM:
        mean = partial(_blurred, sigma_um=reach)
        found[_named(f"surroundings-{reach:g}-um")] = (
            f"h̄({reach:g} µm)",
            "µm",
            lambda h, c, m=mean: m(h, c) - h,
        )
        found[_named(f"height-times-surroundings-{reach:g}-um")] = (
            f"h h̄({reach:g} µm)", "µm²", lambda h, c, m=mean: h * m(h, c),
        )  # fmt: skip
        found[_named(f"above-surroundings-{reach:g}-um")] = (
            f"(h - h̄({reach:g} µm))²", "µm²", lambda h, c, m=mean: (h - m(h, c)) ** 2,
        )  # fmt: skip
        found[_named(f"steps-within-{reach:g}-um")] = (
            f"mean of |∇h| within {reach:g} µm", "1",
            lambda h, c, r=reach: _blurred(found["steepness-power-1"][2](h, c), c, r),
        )  # fmt: skip
    for side in _SIDES:
        for length in _TAILS_UM:
            found[_named(f"{side}-{length:g}-um")] = (
                f"h {side}, over {length:g} µm, less h", "µm",
                lambda h, c, s=side, n=length: _side(h, c, s, n),
            )  # fmt: skip
    for word, place in (
        ("x", lambda c: c.scan_position()[1]),
        ("y", lambda c: c.scan_position()[0]),
        ("r2", lambda c: sum(one**2 for one in c.scan_position())),
    ):
        found[f"height-times-{word}"] = (f"h {word}", "µm", lambda h, c, p=place: h * p(c))
        for axis in ("x", "y"):
            found[f"slope-size-{axis}-times-{word}"] = (
                f"|∂h/∂{axis}| {word}", "1",
                lambda h, c, p=place, a=directions[axis]: _size(_slope(h, c, a), 1.0) * p(c),
            )  # fmt: skip
    found["height-squared-times-order"] = ("h² t", "µm²", lambda h, c: h**2 * c.order)
    found["slope-size-x-times-order"] = (
        "|∂h/∂x| t", "1", lambda h, c: _size(_slope(h, c, directions["x"]), 1.0) * c.order,
    )  # fmt: skip
    found["slope-size-y-times-order"] = (
        "|∂h/∂y| t", "1", lambda h, c: _size(_slope(h, c, directions["y"]), 1.0) * c.order,
    )  # fmt: skip
    return found


def _law(name: str, formula: str, unit: str, column: Column) -> Effect:
    unit_of_strength = {"1": "µm", "µm": "1", "µm²": "1/µm", "µm^2": "1/µm", "µm^3": "1/µm²", "1/µm": "µm²"}

    def apply(height: Tensor, values: Values, context: FieldContext) -> Tensor:
        return height + values["strength"] * column(height, context)

    return Effect(
        name=name,
        title=f"height changed by {formula}",
        stage="development",
        role="undetermined",
        acts_on="height",
        parameters={"strength": Parameter(unit_of_strength[unit], -2.0, 2.0, 0.05)},
        apply=apply,
        trials=({"strength": 0.05},),
        source="found in the residual; h, x, y, t: height, place from -1 to 1, order from -0.5 to 0.5",
        separating="print and scan the same layouts turned by 90 degrees",
        knowledge="law",
    )


def _level_table(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """One correction for each of nine heights of the layout, linear between them."""
    share = _blurred(context.layout_um, context, 0.15) / context.full_height_um * 8
    total = height
    for knot in range(9):
        total = total + values[f"at_{knot}_um"] * torch.relu(1 - (share - knot).abs())
    return total


def _linear_response(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """A weight for each displaced copy of the height."""
    total, pitch = height, context.pitch_um
    for dy in _STENCIL_UM:
        for dx in _STENCIL_UM:
            if dy or dx:
                moved = torch.roll(height, (round(dy / pitch), round(dx / pitch)), (-2, -1))
                total = total + values[_of_copy(dy, dx)] * (moved - height)
    return total


def _of_copy(dy_um: float, dx_um: float) -> str:
    return f"from_{1000 * dy_um:+.0f}_{1000 * dx_um:+.0f}_nm"


def _named(name: str) -> str:
    """A name that may be a part of the name of a parameter."""
    return name.replace(".", "-")


def _place_map(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """The height times a polynomial of the place in the scan."""
    y, x = context.scan_position()
    factor = sum(values[f"y{i}_x{j}"] * y**i * x**j for i in range(5) for j in range(5 - i) if i + j)
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


LAWS = {name: _law(name, *facts) for name, facts in _columns().items()}
DESCRIPTIONS = {
    one.name: one
    for one in (
        _description(
            "level-table", "a height of its own for each level", [f"at_{k}_um" for k in range(9)], "µm",
            _level_table,
        ),
        _description(
            "linear-response", "a response to the height nearby",
            [_of_copy(dy, dx) for dy in _STENCIL_UM for dx in _STENCIL_UM if dy or dx], "1",
            _linear_response,
        ),
        _description(
            "place-map", "a gain that follows the place in the scan",
            [f"y{i}_x{j}" for i in range(5) for j in range(5 - i) if i + j], "1", _place_map,
        ),
    )
}  # fmt: skip
