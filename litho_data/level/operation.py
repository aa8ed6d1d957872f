"""Make functions usable as steps of levelling recipes. The signature of such a function states the parameters
of the step, their defaults and their limits.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, ClassVar, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from litho_data.foundation import YX, Array, InputError
from litho_data.foundation.results import first_error
from litho_data.level.selection import MaskedLevelling, Masking, as_height, select

R = TypeVar("R")
STEPS: "dict[str, type[Step]]" = {}
"""The classes of the steps that a recipe can contain, keyed by the name of the operation."""
# Arguments of operations that are not settings of a step, because their values come with the scan. Each is
# mapped to the phrase that names it in messages.
_OF_SCAN = {
    "pitch_um": "the pixel pitch",
    "layout_level": "the layout in the scan's frame, which only a build finds,",
}


@dataclass(frozen=True, eq=False)
class State:
    """What one step of a recipe passes to the next: the heights (µm), the current mask, and, if known, the
    pitch and the layout.
    """

    height_um: Array
    mask: Array | None
    pitch_um: YX | None
    layout_level: Array | None


class Step(BaseModel):
    """Base class of the steps of a recipe. The fields of a step are the arguments of its operation.

    ``masking`` says how the step uses the current mask. The current mask comes from the last step that marked
    pixels. If no earlier step marked pixels, it is the scan's own mask.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    function: ClassVar[Callable[..., Any]]
    # The names of the arguments whose values come with the scan. Each is mapped to True if the argument is
    # optional.
    of_scan: ClassVar[dict[str, bool]]

    op: str
    masking: Masking = "exclude"

    def run(self, state: State) -> State:
        """Return the state after the step, in which the heights, the mask, or both have changed."""
        arguments = {name: getattr(self, name) for name in type(self).model_fields if name != "op"}
        for name, optional in self.of_scan.items():
            arguments[name] = getattr(state, name)
            if arguments[name] is None and not optional:
                raise InputError(f"{_OF_SCAN[name]} is unknown", wanted=name)
        made = type(self).function(state.height_um, state.mask, **arguments)
        if isinstance(made, Array):
            return replace(state, mask=made)
        levelled, mask = made if isinstance(made, MaskedLevelling) else (made, state.mask)
        return replace(state, height_um=levelled.height, mask=mask)


def operation(op: str) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Return a decorator that registers a function as the operation named ``op`` of levelling recipes.

    The function receives two arrays of shape (ny, nx): the heights (float64), and a bool array that is True
    at the usable pixels. The decorated function, in contrast, is called with a height map of any numeric
    type, a ``mask`` and a ``masking``. From these, ``select`` determines the usable pixels. The keyword
    arguments of the function, except those whose values come with the scan, become fields of the step and are
    checked at every call. The function returns a ``Levelled``, a ``MaskedLevelling``, or a bool array of
    pixels to mark.
    """

    def made(function: Callable[..., R]) -> Callable[..., R]:
        _, _, *parameters = inspect.signature(function, eval_str=True).parameters.values()
        fields: dict[str, Any] = {"op": (Literal[op], op)} | {
            one.name: (one.annotation, ... if one.default is one.empty else one.default) for one in parameters
        }
        of_scan = {name: fields.pop(name)[1] is None for name in _OF_SCAN if name in fields}
        knows_masking = fields.pop("masking", None) is not None

        def run(height: Array, mask: Array | None, masking: Masking, **arguments: Any) -> R:
            z = as_height(height)
            arguments |= {"masking": masking} if knows_masking else {}
            return function(z, select(z, mask, masking), **arguments)

        step = create_model(op, __base__=Step, **fields)
        step.function, step.of_scan = staticmethod(run), of_scan
        STEPS[op] = step

        @wraps(function)
        def checked(
            height: Array, *, mask: Array | None = None, masking: Masking = "exclude", **arguments: Any
        ) -> R:
            stated = {name: value for name, value in arguments.items() if name not in of_scan}
            try:
                step(op=op, masking=masking, **stated)
            except ValidationError as error:
                raise InputError(op, got=first_error(error)) from error
            return run(height, mask, masking, **arguments)

        return checked

    return made
