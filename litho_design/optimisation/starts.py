"""Starts of a search: each is a function that gives one level for every free cell.

To add a start, give it a name in ``StartName`` and a function in ``_STARTS``, and list it in ``starts`` of
the tasks that have what it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from litho_data.foundation.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from litho_design.optics import Optics
    from litho_design.optimisation.parameters import CellMap, Parametrisation

# The command line reads the names: what computes is imported when a start is made, torch with it.
StartName = Literal["random", "gs", "wgs", "fresnel", "inverse"]


@dataclass(frozen=True)
class Scene:
    """What a start can use.

    Attributes:
        cells: the free cells, on the device where the start is computed.
        pitch_um: pixel of the layout, µm.
        optics: wavelength, index step and distance.
        level_phase: phase, radian, that each level prints (levels,).
        iterations: of an iterative start.
        seed: of a start that draws numbers.
        target: wanted image (size, size) in [0, 1]; None for a lens.
        counted: pixels of the image where light is not free, bool (size, size); None for all.
        propagator: from the element to the image; None for a lens.
        total: sum over the pixels of the element, of which cells and target may be a part; None where they
            are all of it.
    """

    cells: CellMap
    pitch_um: float
    optics: Optics
    level_phase: Tensor
    iterations: int
    seed: int
    target: Tensor | None = None
    counted: Tensor | None = None
    propagator: Any = None
    total: Callable[[Tensor], Tensor] | None = None


def check_start(name: str, fit: Sequence[str], task: str) -> None:
    """Refuse a start that a task does not have.

    Raises:
        InputError: a start for images where a lens is designed, or the reverse.
    """
    if name not in fit:
        raise InputError("start", got=repr(name), wanted=f"{', '.join(map(repr, fit))} for {task}")


def start_search(
    parameters: Parametrisation, name: StartName, scene: Scene, *, jitter_levels: float = 0.0
) -> None:
    """Set ``parameters`` to the start ``name``; Gaussian ``jitter_levels`` are added unless it is random."""
    if name == "random":
        parameters.start_random(scene.seed)
    else:
        parameters.start_from(_STARTS[name](scene).float(), jitter_levels=jitter_levels, seed=scene.seed)


def _gerchberg_saxton(scene: Scene, *, weighted: bool = False) -> Tensor:
    from litho_design.optimisation.phases import gerchberg_saxton, nearest_levels

    assert scene.target is not None
    phase, _ = gerchberg_saxton(
        scene.propagator,
        scene.target,
        scene.cells,
        iterations=scene.iterations,
        weighted=weighted,
        seed=scene.seed,
        level_phase=scene.level_phase,
        counted=scene.counted,
        total=scene.total,
    )
    return nearest_levels(phase, scene.level_phase)


def _fresnel(scene: Scene) -> Tensor:
    from litho_design.optimisation.phases import focusing_levels, fresnel_lens_phase

    return focusing_levels(fresnel_lens_phase(scene.cells, scene.pitch_um, scene.optics), scene.level_phase)


_STARTS: dict[str, Callable[[Scene], Tensor]] = {
    "gs": _gerchberg_saxton,
    "wgs": partial(_gerchberg_saxton, weighted=True),
    "fresnel": _fresnel,
}
