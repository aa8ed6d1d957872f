"""Laws: short formulas that describe how the height departs from the model. Each law gives this departure as
a function of the height, the slopes, the surroundings, the position in the scan or the writing order.

A law is an effect with one strength (a law that adds a wave has two) and with fitted shapes, such as a power,
a length, a direction or a position. A law does not state the cause of the departure. The same code screens,
fits, judges and applies laws and all other effects. A table is an effect with many strengths. A table can
describe any dependence on one covariate, such as the level or the position, but does not explain this
dependence.

In formulas, h is the height and D the dose, both in µm. h̄ is the Gaussian mean of h over a length. x and y
run from -1 to 1 over the scan, r² = x² + y², and rim = e^(-distance to the edge / length). The order t runs
from -0.5 to 0.5. Slopes and sides are along axes rotated by the angle ``turn_deg``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from litho_models.effects.effect import ActsOn, Apply, Effect, FieldContext, Parameter, Values, of_development
from litho_models.effects.filters import add_filtered, gradient, local_mean, rounded_power, trailing_response
from litho_models.layers.pixelwise import interpolate

# Frequencies of waves that screening tries. These frequencies are so close together that a wave of any
# frequency between two neighbours stays nearly in phase with one of the two over a height of one micrometre.
_WAVES_PER_UM = tuple(0.5 * half for half in range(2, 21))
_FIELD: dict[ActsOn, str] = {"height": "height", "layout": "dose"}
_WORDS = ("x", "y", "r²")
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
_TURNED = "print and scan the same layouts rotated by 90 degrees"


@dataclass(frozen=True)
class Surface:
    """Compute the quantities that occur in the formula of a law, such as slopes and local means, from a
    field, its context and the parameters of the law.

    ``h`` is the height, µm, of shape (b, 1, ny, nx). For a law of the exposure, ``h`` is the dose, expressed
    as a nominal height.
    """

    h: Tensor
    context: FieldContext
    values: Values

    def along(self, axis: str, y: Tensor, x: Tensor) -> Tensor:
        """Return the component of the vector (y, x) along an axis. If the law has a parameter ``turn_deg``,
        the axis is rotated by this angle from x towards y.
        """
        angle = torch.deg2rad(self.values.get("turn_deg", self.h.new_zeros(())))
        sine, cosine = angle.sin(), angle.cos()
        return cosine * x + sine * y if axis == "x" else cosine * y - sine * x

    def slope(self, axis: str, of: Tensor | None = None) -> Tensor:
        """Return the slope of a map (by default the height) along an axis, by central differences."""
        return self.along(axis, *gradient(self.h if of is None else of, self.context.pitch_um))

    def size(self, *axes: str, power: float | Tensor = 1.0) -> Tensor:
        """Return a power of the absolute slope along one axis. If two axes are given, return a power of the
        steepness, i.e. of the magnitude of the gradient. The result is smoothed near zero.
        """
        squared = torch.stack([self.slope(one) for one in axes]).square().sum(dim=0)
        return rounded_power(squared, power)

    def place(self, word: str) -> Tensor:
        """Return a function of the position in the scan, as a tensor that can be broadcast to the shape of
        the field. ``word`` is the name of the function: ``x``, ``y``, ``r²`` or ``rim``. ``rim`` is
        e^(-d / length), where d is the distance of the pixel from the edge of the scan and ``length`` is a
        parameter of the law.
        """
        y, x = self.context.scan_position()
        if word == "rim":
            ny, nx = self.context.whole_shape()
            inside_px = torch.minimum((1 - y.abs()) * (ny - 1) / 2, (1 - x.abs()) * (nx - 1) / 2)
            return torch.exp(-self.context.pitch_um * inside_px / self.values["length_um"]).to(self.h)
        return {"x": x, "y": y, "r²": x**2 + y**2}[word].to(self.h)

    def beyond(self, axis: str) -> Tensor:
        """Return a step function along an axis of the scan. The parameter ``position`` of the law gives the
        position of the step. The function is 0 before the step and 1 beyond it, and rises linearly over one
        pixel.
        """
        number = "yx".index(axis)
        at, size = self.context.scan_position()[number], self.context.whole_shape()[number]
        return ((at - self.values["position"]) * (size - 1) / 2 + 0.5).clamp(0, 1).to(self.h)

    def mean(self) -> Tensor:
        """Return the Gaussian-weighted local mean of the height. The standard deviation of the Gaussian is
        the parameter ``length_um`` of the law.
        """
        return local_mean(self.h, self.values["length_um"], self.context.pitch_um, 4)

    def trailing(self, both_sides: bool) -> Tensor:
        """Return the weighted mean height on both sides of each pixel along the rotated x axis, or only on
        the side with smaller x. The weights decay exponentially with distance, with the decay length
        ``length_um`` of the law.
        """
        length, pitch = self.values["length_um"], self.context.pitch_um

        def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
            response = trailing_response(self.along("x", fy, fx), length, pitch)
            # The response of the other side is the complex conjugate.
            return (response.real if both_sides else response) - 1

        return add_filtered(self.h, transfer_minus_one, pitch, 6 * float(length.detach()))


def _law(
    name: str,
    formula: str,
    unit: str,
    column: Callable[[Surface], Tensor],
    shapes: Mapping[str, Parameter] = {},
    on: ActsOn = "height",
) -> Effect:
    """Make a law from its name, its formula (as text), and the function ``column``, which computes the map
    that is multiplied by the strength. The map has shape (b, 1, ny, nx). ``unit`` is the unit of the
    strength.
    """

    def apply(field: Tensor, values: Values, context: FieldContext) -> Tensor:
        return field + values["strength"] * column(Surface(field, context, values))

    strength = Parameter(unit, -4.0, 4.0, 0.05)
    return _nameless(name.replace("²", "2"), formula, {"strength": strength, **shapes}, apply, on)


def _wave(on: ActsOn, tried: tuple[float, ...]) -> Effect:
    """Make a law that adds a sine wave to a field (height or dose). The phase of the wave is proportional to
    the value of the field itself. If the field is a dose, the law describes the effect of slices. If the
    field is a height, the law describes standing waves of light. The added wave is zero where the field is
    zero.
    """

    def apply(field: Tensor, values: Values, context: FieldContext) -> Tensor:
        phase = 2 * math.pi * values["frequency_per_um"] * field
        return field + values["sine_um"] * phase.sin() + values["cosine_um"] * (phase.cos() - 1)

    amplitude = Parameter("µm", -0.2, 0.2, 0.02)
    frequency = Parameter("1/µm", tried[0], tried[-1], 5.0, "shape", tried=tried)
    parameters = {"sine_um": amplitude, "cosine_um": amplitude, "frequency_per_um": frequency}
    law = _nameless(
        f"{_FIELD[on]}-wave", f"a wave in the {_FIELD[on]} itself, sin(2π f h + phase)", parameters, apply, on
    )
    # Light makes the wave, so the development acts on a print that already has it.
    return replace(law, stage="resist") if on == "height" else law


def _nameless(
    name: str, formula: str, parameters: Mapping[str, Parameter], apply: Apply, on: ActsOn
) -> Effect:
    return Effect(
        name=name,
        title=f"{_FIELD[on]} changed by {formula}",
        stage="development" if on == "height" else "exposure",
        role="undetermined",
        acts_on=on,
        parameters=parameters,
        apply=apply,
        separating=_TURNED,
        knowledge="law",
    )


_POSITION = {
    "position": Parameter("1", -0.95, 0.95, 0.0, "shape", tried=(-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75))
}
_POWER = {"power": Parameter("1", 0.5, 4.0, 1.0, "shape", tried=(1.0, 1.5, 2.0, 3.0))}
_TURN = {"turn_deg": Parameter("deg", -90.0, 90.0, 0.0, "shape", tried=(0.0, 45.0))}
_REACH = {"length_um": Parameter("µm", 0.3, 8.0, 1.5, "shape", tried=(0.6, 1.5, 4.0))}
_TAIL = {
    "length_um": Parameter("µm", 0.3, 12.0, 2.0, "shape"),
    "turn_deg": Parameter("deg", -180.0, 180.0, 0.0, "shape"),
}
# Lengths of tails that screening tries, µm, and the angle between two directions that it tries, degrees. The
# longer the tail, the more exact its direction must be before a fit can find it.
_TAILS = {0.6: 45, 2.0: 45, 6.0: 20}
# For laws that depend on the position in the scan, screening tries only one value of the length. This value
# is close enough to the best one to start a fit.
_NEAR = {"length_um": Parameter("µm", 0.3, 8.0, 1.5, "shape")}


def _along_axis(a: str) -> Iterator[Effect]:
    yield _law(f"height-times-slope-{a}", f"h ∂h/∂{a}", "1", lambda s: s.h * s.slope(a))
    yield _law(f"height-times-slope-size-{a}", f"h |∂h/∂{a}|", "1", lambda s: s.h * s.size(a))
    yield _law(f"curvature-{a}", f"∂²h/∂{a}²", "µm²", lambda s: s.slope(a, s.slope(a)))
    yield _law(f"slope-size-{a}-times-order", f"|∂h/∂{a}| t", "µm", lambda s: s.size(a) * s.context.order)


def _height_at(word: str, shapes: Mapping[str, Parameter] = {}) -> Effect:
    return _law(f"height-times-{word}", f"h {word}", "1", lambda s: s.h * s.place(word), shapes)


def _blurred_at(word: str) -> Effect:
    name, formula = f"blur-times-{word}", f"(h̄ - h) {word}"
    return _law(name, formula, "1", lambda s: (s.mean() - s.h) * s.place(word), _NEAR)


def _power(a: str) -> Effect:
    name, formula = f"slope-{a}-power", f"|∂h/∂{a}|^power"
    return _law(name, formula, "µm", lambda s: s.size(a, power=s.values["power"]), _POWER | _TURN)


def _one_way(a: str) -> Iterator[Effect]:
    yield _law(f"rising-slope-{a}", f"max(∂h/∂{a}, 0)", "µm", lambda s: s.slope(a).relu(), _TURN)
    yield _law(f"falling-slope-{a}", f"max(-∂h/∂{a}, 0)", "µm", lambda s: (-s.slope(a)).relu(), _TURN)


def _jumps(a: str) -> Iterator[Effect]:
    name, formula = f"jump-along-{a}-in", f"({a} > position)"
    yield _law(f"{name}-height", formula, "µm", lambda s: s.beyond(a), _POSITION)
    yield _law(f"{name}-gain", f"h {formula}", "1", lambda s: s.h * s.beyond(a), _POSITION)
    yield _law(f"{name}-x", f"∂h/∂x {formula}", "µm", lambda s: s.slope("x") * s.beyond(a), _POSITION)
    yield _law(f"{name}-y", f"∂h/∂y {formula}", "µm", lambda s: s.slope("y") * s.beyond(a), _POSITION)


def _tail(name: str, sides: str, both_sides: bool) -> Effect:
    formula = f"(mean of D on {sides} along x over the length) - D"
    law = _law(name, formula, "1", lambda s: s.trailing(both_sides) - s.h, _TAIL, "layout")
    # A tail on both sides looks the same after half a turn.
    circle = 180 if both_sides else 360
    trials = tuple(
        {
            "strength": law.parameters["strength"].typical,
            "length_um": length_um,
            "turn_deg": float(turn_deg),
        }
        for length_um, step_deg in _TAILS.items()
        for turn_deg in range(-circle // 2, circle // 2, step_deg)
    )
    return replace(law, trials=trials)


_FOUND = [
    *_along_axis("x"),
    *_along_axis("y"),
    _law("height-power-2", "h²", "1/µm", lambda s: s.h**2),
    _law("height-power-3", "h³", "1/µm²", lambda s: s.h**3),
    _law("height-squared-times-order", "h² t", "1/µm", lambda s: s.h**2 * s.context.order),
    *map(_height_at, _WORDS),
    _law("steepness-power", "|∇h|^power", "µm", lambda s: s.size("x", "y", power=s.values["power"]), _POWER),
    *map(_power, "xy"),
    *_one_way("x"),
    *_one_way("y"),
    _law("surroundings", "h̄ - h", "1", lambda s: s.mean() - s.h, _REACH),
    _law("blur-height", "h (h̄ - h)", "1/µm", lambda s: s.h * (s.mean() - s.h), _REACH),
    _height_at("rim", _NEAR),
    *map(_blurred_at, _WORDS),
    *_jumps("x"),
    *_jumps("y"),
    _tail("dose-along", "both sides", both_sides=True),
    _tail("dose-from", "one side", both_sides=False),
    _law(
        "dose-times-density",
        "D (mean of D within the length / full height)^power",
        "1",
        lambda s: s.h * rounded_power((s.mean() / s.context.full_height_um) ** 2, s.values["power"]),
        _REACH | _POWER,
        "layout",
    ),
    _wave("height", _WAVES_PER_UM),
    _wave("layout", _WAVES_PER_UM[:9]),
]
LAWS = {law.name: law for law in _FOUND}


def _table(title: str, names: Iterable[str], unit: str) -> Callable[[Apply], Effect]:
    return of_development(
        title,
        {name: Parameter(unit, -1.0, 1.0, 0.02) for name in names},
        role="undetermined",
        separating=_TURNED,
        knowledge="description",
    )


@_table("a separate height for each level", _KNOTS, "µm")
def level_table(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Add to the height a correction that depends on the nominal height of the layout. At seventeen nominal
    heights, the correction is a fitted parameter. Between these heights, it is interpolated linearly.
    """
    knots = torch.stack([values[name] for name in _KNOTS])
    smooth = functional.avg_pool2d(context.layout_um, 3, 1, 1, count_include_pad=False)
    full = context.full_height_um
    return height + interpolate(smooth.clamp(0, full), knots, 0.0, full)


@_table("a response to the height nearby", _COPIES_UM, "1")
def linear_response(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Add a weighted sum of differences to the height of each pixel. Each difference is the height at a
    displaced position minus the height of the pixel. The field is padded with its edge values.
    """
    pitch, (ny, nx) = context.pitch_um, height.shape[-2:]
    edge = round(max(_STENCIL_UM) / pitch)
    padded = functional.pad(height, (edge,) * 4, mode="replicate")
    total = height
    for name, (dy, dx) in _COPIES_UM.items():
        there = padded[..., edge + round(dy / pitch) :, edge + round(dx / pitch) :][..., :ny, :nx]
        total = total + values[name] * (there - height)
    return total


@_table("a gain that depends on the position in the scan", _POWERS, "1")
def place_map(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Multiply the height by 1 + p, where p is a polynomial of the position in the scan."""
    y, x = context.scan_position()
    return height * (1 + sum(values[name] * y**i * x**j for name, (i, j) in _POWERS.items()))


TABLES = {one.name: one for one in (level_table, linear_response, place_map)}
