"""Define an effect: a differentiable change of the layout or of the height. An effect changes nothing if each
of its amplitudes has its null value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any, Literal

import torch
from torch import Tensor

from litho_data.foundation.errors import InputError, require_known
from litho_models.effects.filters import add_blur, local_mean, pixel_numbers

Stage = Literal["exposure", "resist", "development", "measurement"]
Role = Literal["process", "measurement", "nuisance", "undetermined"]
ActsOn = Literal["layout", "height"]
Kind = Literal["amplitude", "shape", "choice"]
# How much is known about an effect that was found: its physical cause (``cause``), only its formula
# (``law``), or only the variable on which it depends (``description``).
Knowledge = Literal["cause", "law", "description"]

Values = Mapping[str, Tensor]

# Tolerance for values that lie on a bound, as a fraction of the range. The tolerance is needed because a
# value is rounded when it is stored in float32.
_ROUNDING = 1e-6

# Variance of the spot that exposes single slices, and the distance from its centre at which it is cut off.
_SLICED_VARIANCE_UM2, _SLICED_REACH_UM = 0.02, 0.8


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Args:
        unit: unit of the value; ``1`` for a dimensionless parameter.
        lower, upper: bounds of the physical range. A best-fitting value outside this range is evidence
            against the effect.
        typical: a usual value, used for screening and as the starting value of fits.
        kind: kind of parameter: ``amplitude``, ``shape`` or ``choice``. The effect is off if every amplitude
            equals its ``null`` value. A shape (such as a length or a position) has no meaning while the
            effect is off. A choice is a shape with few possible values (such as a direction) and is never
            fitted.
        null: value of an amplitude at which the effect changes nothing.
        tried: values that screening (the fast test of all effects) tries. If this tuple is empty, screening
            tries ``typical``.
    """

    unit: str
    lower: float
    upper: float
    typical: float
    kind: Kind = "amplitude"
    null: float = 0.0
    tried: tuple[float, ...] = ()

    @property
    def off(self) -> float:
        """Return the value that this parameter has while its effect is switched off."""
        return self.null if self.kind == "amplitude" else self.typical


@dataclass(frozen=True)
class FieldContext:
    """Information about a printed field, passed to an effect along with the array to be changed.

    Args:
        layout_um: exposure of the field, which is the nominal height times the relative dose, µm, as a tensor
            of shape (1, 1, ny, nx).
        pitch_um: lateral sampling, µm.
        full_height_um: nominal height of the highest level, µm. Effects that change each pixel independently
            of its neighbours use it as their unit of height.
        slice_um: height of one printed slice, which is the height of one level, µm.
        field_centre_um: position (y, x) of the centre of the whole scan in the write field, µm.
        field_radius_um: distance from the centre of the write field to its edge, µm.
        slow_axis: axis perpendicular to the written lines.
        order: position of this field in the writing order, scaled so that the positions in the dataset run
            from -0.5 to 0.5.
        scan_shape: numbers of rows and columns of the whole scan, if this field is only a part of a scan.
        origin_px: row and column of this field's first pixel in the whole scan.
        quarter_turns: number of quarter turns by which the print was rotated under the microscope, in the
            direction of ``torch.rot90``.
        backward: whether the scan consists of retrace lines.
        new_tip: whether the scan was made with a new, sharp tip instead of the usual one.
        pixel_size: ratio of the pixel size of this scan to the pixel size of the other scans. The time per
            pixel is the same in all scans, so the lag length of the probe is proportional to the pixel size.
        dose: dose relative to the recipe. This dose is already contained in ``layout_um``.
    """

    layout_um: Tensor
    pitch_um: float
    full_height_um: float
    slice_um: float = 0.1
    field_centre_um: tuple[float, float] = (0.0, 0.0)
    field_radius_um: float | None = None
    slow_axis: Literal["y", "x"] = "y"
    order: float = 0.0
    scan_shape: tuple[int, int] | None = None
    origin_px: tuple[int, int] = (0, 0)
    quarter_turns: int = 0
    backward: bool = False
    new_tip: bool = False
    pixel_size: float = 1.0
    dose: float = 1.0

    @cached_property
    def exposed_slices(self) -> Tensor:
        """Return the exposure of each slice, blurred by the spot, where 1 means fully exposed. The result has
        shape (slices, 1, ny, nx). It is used by the effect ``layer-stacking``, once per scan.
        """
        count = max(1, round(self.full_height_um / self.slice_um))
        # The dose changes the exposure, not the number of slices.
        number = self.layout_um / (self.dose * self.slice_um)
        lower = torch.arange(count).to(number)[:, None, None, None]
        slices = self.dose * torch.clamp(number - lower, 0, 1)
        return add_blur(slices, _SLICED_VARIANCE_UM2, self.pitch_um, _SLICED_REACH_UM)

    def left_by_shrinkage(self, fraction: Tensor, length_um: Tensor) -> Tensor:
        """Return the share of the height that is left if a print shrinks more where its surroundings are
        thin: 1 - k (1 - u). Here k is ``fraction``, and u is the mean nominal height nearby as a fraction of
        the full height. The mean has Gaussian weights with standard deviation ``length_um``. The result has
        shape (1, 1, ny, nx).
        """
        nearby = local_mean(self.layout_um / self.full_height_um, length_um, self.pitch_um)
        return 1 - fraction * (1 - nearby)

    def in_scan_frame(self) -> FieldContext:
        """Return this context rotated into the frame of the scan, in which the fast axis runs along x."""
        turns = self.quarter_turns % 4
        if not turns:
            return self
        (ny, nx), (top, left) = self.whole_shape(), self.origin_px
        turned = replace(
            self,
            layout_um=torch.rot90(self.layout_um, 1, (-2, -1)),
            scan_shape=(nx, ny),
            origin_px=(nx - left - self.layout_um.shape[-1], top),
            quarter_turns=turns - 1,
        )
        return turned.in_scan_frame()

    def centred_um(self) -> tuple[Tensor, Tensor]:
        """Return the y and x positions of the pixels relative to the centre of the write field, µm. The two
        tensors have shapes (ny, 1) and (1, nx).
        """
        axes = zip(self.scan_position(), self.whole_shape(), self.field_centre_um, strict=True)
        y, x = (place * (size - 1) / 2 * self.pitch_um + centre for place, size, centre in axes)
        return y, x

    def whole_shape(self) -> tuple[int, int]:
        """Return the numbers of rows and columns of the whole scan."""
        ny, nx = self.layout_um.shape[-2:]
        return self.scan_shape or (ny, nx)

    def scan_position(self) -> tuple[Tensor, Tensor]:
        """Return the y and x positions of the pixels relative to the whole scan. Each coordinate runs from -1
        to 1 over the whole scan. The two tensors have shapes (ny, 1) and (1, nx).
        """
        axes = zip(pixel_numbers(self.layout_um), self.whole_shape(), self.origin_px, strict=True)
        y, x = (2 * (number + first) / max(size - 1, 1) - 1 for number, size, first in axes)
        return y, x

    def radius_um(self) -> float:
        """Return half the width of the write field, µm. If the dataset card (the TOML file that describes a
        campaign) states no write field, return half the longer side of the whole scan.
        """
        return self.field_radius_um or max(self.whole_shape()) * self.pitch_um / 2


Apply = Callable[[Tensor, Values, FieldContext], Tensor]


def of_single_scans(array: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Raise InputError. A per-scan effect has this function instead of a formula, because its terms are
    fitted to each scan separately and do not become part of a model.
    """
    raise InputError(
        "an effect in a model",
        got="a per-scan effect",
        wanted="an effect with the same parameters in all scans",
    )


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    Args:
        name: the identifier used in code, JSON and on the command line.
        title: short description for a process engineer.
        stage: stage of printing or measurement at which the effect acts.
        role: ``process`` if the printer causes the effect; ``measurement`` if the microscope causes it;
            ``undetermined`` if it is not known whether the printer or the microscope causes it; ``nuisance``
            if designs should not depend on the effect, whatever causes it. Only ``process`` effects become
            part of the exported process model.
        acts_on: what the effect changes: ``layout``, the input of the base model, or ``height``, the output
            of the base model. Both are in µm.
        parameters: the parameters, keyed by name. At least one of them must be an amplitude.
        apply: the formula, a pure function ``apply(field, values, context)`` that returns the changed field.
            The field given and the field returned have shape (b, 1, ny, nx) and are in µm. For per-scan
            effects, ``apply`` is ``of_single_scans``.
        trials: parameter sets that screening tries. By default, each set switches on only one amplitude, and
            the sets contain all combinations of the ``tried`` values of this amplitude with the ``tried``
            values of the shapes.
        separating: experiment that distinguishes this effect from similar effects.
        needs: what must be given before the effect can be tested. ``order``: the writing order of the scans
            must be known. ``probe``: the microscope must have a probe.
        reverses: names of the parameters whose sign changes between trace and retrace lines.
        of_tip: whether the effect is absent from scans made with a new tip.
        of_films: True if this effect moves the edges of a film seen from above, and False if it changes
            heights.
        knowledge: what is known about the effect: the physical cause (``cause``), only a formula (``law``),
            or only the variable on which the effect depends (``description``).
    """

    name: str
    title: str
    stage: Stage
    role: Role
    acts_on: ActsOn
    parameters: Mapping[str, Parameter]
    apply: Apply
    separating: str = ""
    trials: tuple[Mapping[str, float], ...] = ()
    needs: tuple[Literal["order", "probe"], ...] = ()
    reverses: tuple[str, ...] = ()
    of_tip: bool = False
    of_films: bool = False
    knowledge: Knowledge = "cause"

    def __post_init__(self) -> None:
        if not self.amplitudes:
            raise InputError(f"effect {self.name}", got="no amplitude", wanted="at least one")
        if not (self.trials or self.per_scan):
            object.__setattr__(self, "trials", tuple(self._trials()))

    @cached_property
    def amplitudes(self) -> tuple[str, ...]:
        """Return the names of the parameters that are amplitudes."""
        return tuple(name for name, p in self.parameters.items() if p.kind == "amplitude")

    @property
    def per_scan(self) -> bool:
        """Return whether this effect has separate parameters for every scan."""
        return self.apply is of_single_scans

    def _trials(self) -> Iterator[dict[str, float]]:
        shapes = {n: p.tried for n, p in self.parameters.items() if n not in self.amplitudes and p.tried}
        for shape in product(*shapes.values()):
            for name in self.amplitudes:
                facts = self.parameters[name]
                for value in facts.tried or (facts.typical,):
                    yield {name: value, **dict(zip(shapes, shape, strict=True))}

    def with_values(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the values of all parameters. A parameter that is not in ``values`` is set to its value
        ``Parameter.off``.

        Raises:
            InputError: ``values`` contains a name that is not a parameter of this effect.
        """
        for name in values:
            require_known(f"parameter of {self.name}", name, self.parameters)
        return {name: values.get(name, parameter.off) for name, parameter in self.parameters.items()}

    def require_in_range(self, values: Mapping[str, float]) -> None:
        """Check that all values are within their physical ranges.

        Raises:
            InputError: ``values`` contains a name that is not a parameter of this effect, or a value outside
                the physical range of its parameter.
        """
        for name, value in self.with_values(values).items():
            limits = self.parameters[name]
            slack = _ROUNDING * (limits.upper - limits.lower)
            if not limits.lower - slack <= value <= limits.upper + slack:
                raise InputError(
                    f"{name} of {self.name}", got=value, wanted=f"{limits.lower:g} to {limits.upper:g}"
                )

    def __call__(
        self,
        array: Tensor,
        values: Mapping[str, float | Tensor],
        context: FieldContext,
        scanned: bool = False,
    ) -> Tensor:
        """Apply the effect to a layout or height. Numbers in ``values`` are converted to tensors on the
        device of the array. A parameter that is not in ``values`` is set to its value ``Parameter.off``.

        Args:
            scanned: whether to treat the effect as caused by the microscope. The result then depends on the
                orientation of the scan, on whether it consists of retrace lines, and on whether its tip was
                new.
        """
        tensors = {
            name: torch.as_tensor(value, dtype=array.dtype, device=array.device)
            for name, value in {**self.with_values({}), **values}.items()
        }
        if not scanned:
            return self.apply(array, tensors, context)
        if self.of_tip and context.new_tip:
            return array
        if context.backward:
            tensors |= {name: -tensors[name] for name in self.reverses}
        turn = context.quarter_turns
        seen = self.apply(torch.rot90(array, turn, (-2, -1)), tensors, context.in_scan_frame())
        return torch.rot90(seen, -turn, (-2, -1))


def entry(
    title: str,
    parameters: Mapping[str, Parameter],
    *,
    stage: Stage,
    role: Role,
    acts_on: ActsOn,
    **facts: Any,
) -> Callable[[Apply], Effect]:
    """Make a decorator that turns a formula (a function of the type ``Apply``) into an effect. The effect
    gets the name of the function, with hyphens instead of underscores. ``facts`` sets the other fields of
    ``Effect``.
    """

    def of_formula(apply: Apply) -> Effect:
        name = apply.__name__.replace("_", "-")
        return Effect(name, title, stage, role, acts_on, parameters, apply, **facts)

    return of_formula


# Parameter sets that screening tries for an effect with one amplitude along each axis.
ALONG_AXES = ({"along_x_um": 0.1}, {"along_y_um": 0.1}, {"along_x_um": 0.1, "along_y_um": 0.1})
# The direction of writing or scanning along an axis: 1 forwards, -1 backwards.
DIRECTION = Parameter("1", -1.0, 1.0, 1.0, "choice", tried=(1.0, -1.0))

# Decorators for the usual stages and roles of effects.
of_exposure = partial(entry, stage="exposure", role="process", acts_on="layout")
of_resist = partial(entry, stage="resist", role="process", acts_on="height")
of_development = partial(entry, stage="development", role="process", acts_on="height")
of_microscope = partial(entry, stage="measurement", role="measurement", acts_on="height")
