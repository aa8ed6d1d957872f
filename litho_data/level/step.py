"""What every step of a recipe shares: its fields are arguments, and a state passes through it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from litho_data.foundation.errors import InputError
from litho_data.level.selection import Masking


@dataclass(frozen=True, eq=False)
class State:
    """What passes from step to step: heights (µm), the current mask, pitch and layout."""

    height_um: np.ndarray
    mask: np.ndarray | None
    pitch_um: tuple[float, float] | None
    layout_level: np.ndarray | None

    def need(self, name: str) -> Any:
        """The pitch or the layout; raises InputError where it is unknown."""
        if (value := getattr(self, name)) is None:
            wanted = "the pixel pitch" if name == "pitch_um" else "the layout in the scan's frame"
            raise InputError(f"{wanted} is unknown", wanted=name)
        return value


class Step(BaseModel):
    """Base of all steps: its fields are the arguments of ``function``.

    ``masking`` says how the current mask is used: the mask of the scan at first, then that of the
    latest step that marks something.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    function: ClassVar[Callable[..., Any]]
    needs: ClassVar[tuple[str, ...]] = ()

    op: str
    masking: Masking = "exclude"

    def run(self, state: State) -> State:
        """The state with the levelled map."""
        return replace(state, height_um=self.call(state).height)

    def call(self, state: State) -> Any:
        """What ``function`` returns for the state."""
        arguments = {name: getattr(self, name) for name in type(self).model_fields if name != "op"}
        arguments |= {name: state.need(name) for name in self.needs}
        return type(self).function(state.height_um, mask=state.mask, **arguments)
