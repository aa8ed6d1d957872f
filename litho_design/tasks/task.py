"""The interface of a task. A task defines the goal for the light behind a printed element."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import ConfigDict
from torch import Tensor

from litho_data.foundation.errors import InputError, unknown_name
from litho_data.foundation.results import Record
from litho_design.images.targets import TargetRecord
from litho_design.optics import Optics
from litho_design.optimisation.parameters import CellMap, Parametrisation, make_parametrisation
from litho_design.optimisation.phases import printed_phase
from litho_design.optimisation.process_window import Draw, check_draws, disagreement_um, draws, risk
from litho_design.optimisation.ranks import ALONE
from litho_design.optimisation.settings import DesignSettings
from litho_design.printers.printer import Printer
from litho_design.printers.training import out_of_distribution, outside
from litho_design.tasks.bench import ViewsBench
from litho_design.tasks.design import (
    HEIGHT_FILE,
    IMAGE_FILE,
    LEVELS_FILE,
    Findings,
    write_arrays,
)


class Figures(Record):
    """The scores of a user-defined task; each field is one score."""

    model_config = ConfigDict(extra="allow")


class Task:
    """A goal for the light behind a printed element. Layouts can be optimised for it and scored against it.

    To define a task of your own, write a subclass that defines ``name``, ``loss``, ``figures`` and, if one
    image is not enough, ``views``. Then pass the class to ``register_task``. Search, checkpoints, polish,
    process window, comparison, report and export work without changes.

    Attributes:
        name: unique name of the task in results.
        starts: names of the starts from which the search can begin.
        start_jitter_levels: standard deviation, in levels, of the noise added to a start that is not random.
        headline: names of the scores that reports and commands show first. If it is empty, all scores are
            shown.
        errors: names of the scores that are better when lower.
        loss_unit: factor that converts the loss to the unit of the first headline score, or None (see
            ``Width``).
        in_one_piece: True if the element is designed as a whole, not in parts. In this case, the search is
            followed by the polish, which changes levels by one, and the run writes a report.
        ranks: the processes that share the task.
        score_type: class of the record of scores. Reports use the descriptions of its fields to explain the
            scores.
        settings, printer, inputs: the arguments of these names.
        printers: the printer, followed by the models of ``ensemble``.
        notes: sentences about the design that are written into the record and the report.
        bench: module that turns a height map into ``seen``, which is the input of ``loss`` and ``figures``.

    Args:
        settings: geometry, optics, search and process window.
        printer: printer that predicts prints with a frozen model, or that prints nominal heights.
        inputs: mapping from names to the arrays that the task needs, such as targets. Each array is saved as
            NAME.npy with the design.
        ensemble: further models of the printer. By default, the loss is then the worst loss over all models
            plus a penalty on the disagreement of the models.
        record: record that states where the target comes from.

    Raises:
        InputError: the task does not support the start in the settings, or the propagator is not valid for
            some draw of the process window.
    """

    name: ClassVar[str]
    starts: ClassVar[tuple[str, ...]] = ("random",)
    start_jitter_levels = 0.0
    headline: ClassVar[tuple[str, ...]] = ()
    errors: ClassVar[tuple[str, ...]] = ()
    loss_unit: ClassVar[float | None] = None
    score_type: ClassVar[type[Record]] = Figures
    settings_type: ClassVar[type[DesignSettings]] = DesignSettings
    in_one_piece = True
    ranks = ALONE

    def __init__(
        self,
        settings: Any,
        printer: Printer,
        *,
        inputs: Mapping[str, np.ndarray] | None = None,
        ensemble: Sequence[Printer] = (),
        record: TargetRecord | None = None,
    ):
        start = settings.search.start
        if start not in self.starts:
            wanted = f"one of {', '.join(map(repr, self.starts))} for {self.name}"
            raise InputError("start", got=repr(start), wanted=wanted)
        self.settings, self.printer, self.printers = settings, printer, [printer, *ensemble]
        self.inputs = dict(inputs or {})
        self.target_record = record
        self.notes: list[str] = []
        # Further models of the printer. They predict the print of the finished design, but the search does
        # not use them.
        self.judges: Sequence[Printer] = ()
        for one in self.printers:
            self.check_printer(one)
        self.cells = self.make_cells().to(printer.device)
        self.bench: Any = self.make_bench(settings.optics)
        for optics in self.views(settings.optics):
            check_draws(settings.window, optics, self.bench.grid, self.bench.window)

    # Methods that a user-defined task defines.

    def views(self, optics: Optics) -> Sequence[Optics]:
        """Return one set of optics for each image that the task needs. The sets may differ in wavelength (see
        ``optics.at_wavelength``), image plane or angle of incidence.
        """
        return [optics]

    def loss(self, seen: Tensor) -> Tensor | tuple[Tensor, dict[str, float]]:
        """Return the loss of ``seen``, which is the light behind a print.

        By default, ``seen`` is the share of the incident power on each pixel of each image, shape
        (views, size, size).

        Returns:
            The loss as a scalar, or a pair of this scalar and a dict of its named parts.
        """
        raise NotImplementedError

    def figures(self, seen: Tensor) -> Mapping[str, float]:
        """Return a dict from the name of each score to its value for ``seen`` (see ``loss``)."""
        raise NotImplementedError

    # Methods that holograms and lenses override.

    def make_cells(self) -> CellMap:
        """Return the map that spreads one value per cell over the pixels that the search uses."""
        return CellMap(self.settings.layout)

    def make_bench(self, optics: Optics) -> Any:
        """Return the module that turns a height map in µm, shape (size, size), into ``seen``, the input of
        ``loss``.
        """
        return ViewsBench(self.settings.layout, self.views(optics)).to(self.printer.device)

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Return the level of each cell from which a search starts, if the start is not random.

        Args:
            level_phase: phase delay of the print of each level, in radians, shape (levels,).
        """
        raise NotImplementedError

    def untouched(self) -> dict[str, Tensor]:
        """Return a dict from names to uncorrected layouts of shape (size, size). By default, there is one
        such layout: the layout from which a search starts if the printer prints nominal heights. If every
        start is random, the dict is empty.
        """
        if set(self.starts) == {"random"}:
            return {}
        layout = self.settings.layout
        nominal = [level * layout.level_height_um for level in range(layout.levels)]
        phase = printed_phase(nominal, self.settings.optics).to(self.printer.device)
        return {"nominal heights": self.cells(self.start_levels(phase).to(self.printer.device))}

    def over_models(self, losses: Tensor) -> Tensor:
        """Combine the losses of several models into one loss. ``losses`` has shape (models,). By default,
        return the maximum.
        """
        return losses.max()

    def check_printer(self, printer: Printer) -> None:
        """Raise InputError if a printer cannot print the layouts of this task."""

    def search_bench(self, optics: Optics) -> Any:
        """Return the bench that the search uses. It turns the heights from ``search_print`` into the input of
        ``loss``.
        """
        return self.make_bench(optics)

    def search_print(self, level: Tensor, printer: Printer) -> Tensor:
        """Return the printed height, µm, that the search uses, from levels of shape (1, 1, size, size)."""
        return self.printed(level, printer)

    def search_area(self) -> Tensor | None:
        """Return the area that each height from ``search_print`` covers, or None if the heights belong to
        pixels.
        """
        return None

    def printed(self, level: Tensor, printer: Printer) -> Tensor:
        """Return the printed height, µm, of shape (size, size) for real-valued levels of shape
        (1, 1, size, size).

        Gradients flow from the height to the levels.
        """
        return printer(level)[0, 0]

    def score(self, height_um: Tensor, expected_um: Tensor | None = None) -> Record:
        """Score a print, given as heights in µm of shape (size, size).

        ``expected_um`` contains the heights of the expected print, which was predicted when the layout was
        designed. If it is None, the scored print is used.
        """
        with torch.no_grad():
            return self.score_type(**self.figures(self.bench(height_um)))

    def thick_score(self, height_um: Tensor) -> Record | None:
        """Score a print that is treated as a thick element.

        Return None if the settings already specify a thick element, or if the task does not compute light.
        """
        if self.settings.optics.element == "thick":
            return None
        optics = self.settings.optics.model_copy(update={"element": "thick"})
        nominal = Printer(None, self.settings.layout, source="none").to(self.printer.device)
        settings = self.settings.model_copy(update={"optics": optics})
        return type(self)(settings, nominal, inputs=self.inputs).score(height_um)

    def window_figures(self, seen: Tensor) -> Mapping[str, float]:
        """Return the scores of ``seen``, the light behind a print, for one draw of the process window."""
        return self.figures(seen)

    def save(self, folder: Path, level: Tensor, height_um: Tensor) -> dict[str, str]:
        """Write the levels, the print and the light behind it. Return a dict from file name to SHA-256."""
        return write_arrays(folder, self.arrays(level, height_um))

    def findings(self, folder: Path, level: Tensor, height_um: Tensor) -> Findings:
        """Return what the record states about the levels and their print. The arrays are already in
        ``folder``.
        """
        layout, levels = self.settings.layout, level.cpu().numpy().astype(np.uint8)
        thick = self.thick_score(height_um)
        return Findings(
            tiling=self.printer.tiling_check(level[None, None].float()),
            out_of_distribution=out_of_distribution(levels, layout, self.printer.card),
            reference_efficiency=self.reference_efficiency(height_um),
            predicted=self.score(height_um).model_dump(),
            baselines=self.baselines(),
            thick=None if thick is None else thick.model_dump(),
        )

    def arrays(self, level: Tensor, height_um: Tensor) -> dict[str, np.ndarray]:
        """Return a dict from file name to array: the levels, the heights, the light behind the print, and the
        inputs.
        """
        with torch.no_grad():
            seen = self.bench(height_um).cpu().numpy()
        levels = level.cpu().numpy().astype(np.uint8)
        made = {LEVELS_FILE: levels, HEIGHT_FILE: height_um.cpu().numpy(), IMAGE_FILE: seen}
        return made | {f"{name}.npy": array for name, array in self.inputs.items()}

    def reference_efficiency(self, height_um: Tensor) -> float | None:
        """Return the efficiency of an ideal element, or None if the task defines no ideal element. The ideal
        element is found by a search that starts from the print. The print is given as heights in µm of shape
        (size, size).
        """
        return None

    def baselines(self) -> dict[str, dict[str, float]]:
        """Return the scores of the baselines on the grid of the element, keyed by the name of the baseline.
        By default, the only baseline is a flat plate.
        """
        flat = torch.zeros(self.bench.grid.shape, device=self.printer.device)
        return {"no element": self.score(flat).model_dump()}

    def display(self, seen: np.ndarray) -> np.ndarray:
        """Return a picture of ``seen`` for reports. Each image is divided by its brightest value, and the
        images are tiled in a square.
        """
        images = seen.reshape(-1, *seen.shape[-2:])
        side = int(np.ceil(np.sqrt(len(images))))
        tiles = np.zeros((side * side, *images.shape[1:]))
        tiles[: len(images)] = images / np.maximum(images.max((1, 2), keepdims=True), 1e-30)
        rows = [
            np.concatenate(list(tiles[first : first + side]), axis=1) for first in range(0, side**2, side)
        ]
        return np.concatenate(rows)

    # Methods that every task shares.

    @cached_property
    def scenes(self) -> list[tuple[Draw | None, Any]]:
        """Return one pair for each draw of the process window that enters the loss: the draw and its bench.

        If the loss uses no draws, the list contains one pair. This pair consists of None and the bench for
        the optics in the settings.
        """
        window, optics = self.settings.window, self.settings.optics
        drawn = draws(window, optics, window.samples)
        return [(draw, self.search_bench(draw.optics)) for draw in drawn] or [
            (None, self.search_bench(optics))
        ]

    def free_parameters(self) -> Parametrisation:
        """Return the free parameters of the search, set to the values from which the search starts."""
        search, optics = self.settings.search, self.settings.optics
        parameters = make_parametrisation(self.settings.layout, search, self.cells).to(self.printer.device)
        if search.start == "random":
            parameters.start_random(search.seed)
        else:
            phase = printed_phase(self.printer.level_heights_um(), optics).to(self.printer.device)
            levels = self.start_levels(phase).float()
            parameters.start_from(levels, jitter_levels=self.start_jitter_levels, seed=search.seed)
        return parameters

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of levels on the pixels, shape (1, 1, size, size), and a dict of the parts of this
        loss.

        For each draw of the process window, ``over_models`` combines the losses of all models. ``risk`` then
        combines the losses of all draws. Two penalties are added: one on the disagreement of the models, and
        one on levels and steps that are rare in the training layouts.
        """
        settings, prints = self.settings, [self.search_print(level, one) for one in self.printers]
        losses: list[Tensor] = []
        parts: dict[str, float] = {}
        for draw, bench in self.scenes:
            drawn = [one if draw is None else draw.apply(one, settings.layout.pitch_um) for one in prints]
            seen = [bench(height) for height in drawn]
            found = [self.loss_by(one, image) for one, image in zip(self.printers, seen, strict=True)]
            parts = parts or found[0][1]
            losses.append(self.over_models(torch.stack([loss for loss, _ in found])))
        loss = losses[0]
        if len(losses) > 1:
            together = torch.stack(losses)
            loss = risk(together, settings.window.tail)
            parts = {"mean": float(together.detach().mean()), "worst": float(together.detach().max())}
        if len(prints) > 1 and settings.ensemble.weight:
            apart_um = disagreement_um(torch.stack(prints), self.search_area())
            loss = loss + settings.ensemble.weight * apart_um / settings.optics.wave_height_um
        if weight := settings.fabrication.inside_weight:
            loss = loss + weight * outside(level, settings.layout.levels, self.printer.card)
        return loss, parts

    @torch.no_grad()
    def printed_um(self, level: Tensor, printer: Printer | None = None) -> Tensor:
        """Return the printed height, µm, of integer levels of shape (size, size). By default, the first
        printer predicts the print.
        """
        return self.printed(level[None, None].float(), printer or self.printer)

    @torch.no_grad()
    def window_scores(self, height_um: Tensor, count: int) -> list[dict[str, float]]:
        """Score a print of shape (size, size) after each of ``count`` random changes (draws of the process
        window) that no search has used.
        """
        settings, scores = self.settings, []
        for draw in draws(settings.window, settings.optics, count, unseen=True):
            changed = draw.apply(height_um, settings.layout.pitch_um)
            scores.append(dict(self.window_figures(self.make_bench(draw.optics)(changed))))
        return scores

    def inputs_sha256(self) -> str:
        """Return the SHA-256 of the inputs. For a task defined outside this package, its source code is
        hashed too.
        """
        digest = hashlib.sha256()
        for name, array in sorted(self.inputs.items()):
            digest.update(
                f"{name}:{array.dtype}:{array.shape};".encode() + np.ascontiguousarray(array).tobytes()
            )
        if not type(self).__module__.startswith("litho_design."):
            digest.update(_source(type(self)).encode())
        return digest.hexdigest()

    def loss_by(self, printer: Printer, seen: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of ``seen`` and a dict of the named parts of this loss. ``seen`` is the light
        behind the print that ``printer`` predicts. By default, the loss is the result of ``loss`` and does
        not depend on ``printer``.
        """
        found = self.loss(seen)
        return found if isinstance(found, tuple) else (found, {})


_TASKS: dict[str, type[Task]] = {}


def register_task(task: type[Task]) -> type[Task]:
    """Register a user-defined task, so that its designs can be opened. The function can also be used as a
    decorator.

    Raises:
        InputError: the task has no name, or another task has this name.
    """
    name = getattr(task, "name", "")
    known = _TASKS.get(name)
    if not name or (known is not None and known.__qualname__ != task.__qualname__):
        raise InputError("name of a task", got=repr(name), wanted="a name that no other task has")
    _TASKS[name] = task
    return task


def registered_task(name: str) -> type[Task]:
    """Return the class of the task that is registered under this name.

    Raises:
        InputError: no such task is registered.
    """
    if name not in _TASKS:
        raise unknown_name(
            "task",
            name,
            sorted(_TASKS),
            also="your own task, registered by register_task in a file that --plugin names",
        )
    return _TASKS[name]


def _source(task: type) -> str:
    try:
        return inspect.getsource(task)
    except (OSError, TypeError):
        # If the class was typed into an interpreter, its source code is not available and is not hashed.
        return ""
