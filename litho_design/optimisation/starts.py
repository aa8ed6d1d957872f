"""Starts of a search: each is a function that gives one level for every free cell.

To add a start, give it a name in ``StartName`` of the settings and a function in ``_STARTS``, and list it in
``starts`` of the tasks that have what it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from litho_data.foundation.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from litho_design.optics import Optics
    from litho_design.optimisation.parameters import CellMap, Parametrisation
    from litho_design.optimisation.settings import SearchSettings


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


def start_search(parameters: Parametrisation, search: SearchSettings, levels: Callable[[], Tensor]) -> None:
    """Set ``parameters`` to random levels, or to those given (*cells) with the jitter of the settings."""
    if search.start == "random":
        parameters.start_random(search.seed)
    else:
        jitter_levels = search.start_jitter_levels
        parameters.start_from(levels().float(), jitter_levels=jitter_levels, seed=search.seed)


def start_levels(name: str, scene: Scene) -> Tensor:
    """The levels (*cells) of a start that needs no more than the scene, such as ``gs``."""
    return _STARTS[name](scene)


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
