"""The interface of a task, which states what the light behind a printed element should do."""

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
    """The figures of your own task, by name."""

    model_config = ConfigDict(extra="allow")


class Task:
    """A goal for the light behind an element, which can be optimised and scored through printers.

    For your own task, define ``name``, ``loss``, ``figures`` and, if one image is not enough, ``views``. Then
    pass the class to ``register_task``. Search, checkpoints, polish, process window, comparison, report and
    export work without changes.

    Attributes:
        name: unique name of the task in results.
        starts: possible starts of the search; ``start_jitter_levels``: noise added to them.
        headline: figures that reports and commands show first; all figures if empty.
        errors: figures that are better when lower; ``loss_unit``: see ``Width``.
        in_one_piece: whether the element is designed as a whole. If so, single-level changes follow the
            search, and the run writes a report.
        ranks: the processes that share the task.
        score_type: record of the scores, whose field descriptions explain the figures in reports.
        settings, printer, printers, inputs: as given; ``notes``: notes for the record.
        bench: module that turns a height map into ``seen``, the input of ``loss`` and ``figures``.

    Args:
        settings: geometry, optics, search, process window.
        printer: frozen model, or nominal heights.
        inputs: arrays that the task needs, such as targets; they are saved as NAME.npy with the design.
        ensemble: further models; the loss is then the worst loss over all models plus a penalty on their
            disagreement.
        record: source of the inputs.

    Raises:
        InputError: the task does not support this start, or the spreads exceed the range of the propagator.
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
        # Models of the printer that the search does not use.
        self.judges: Sequence[Printer] = ()
        for one in self.printers:
            self.check_printer(one)
        self.cells = self.make_cells().to(printer.device)
        self.bench: Any = self.make_bench(settings.optics)
        for optics in self.views(settings.optics):
            check_draws(settings.window, optics, self.bench.grid, self.bench.window)

    # Methods that your own task defines.

    def views(self, optics: Optics) -> Sequence[Optics]:
        """Return the optics of every image; they may differ in colour (``optics.at_wavelength``), plane or
        angle.
        """
        return [optics]

    def loss(self, seen: Tensor) -> Tensor | tuple[Tensor, dict[str, float]]:
        """Return the loss of the light behind the print.

        By default, ``seen`` contains the shares of the incident power (views, size, size).

        Returns:
            A scalar, or a scalar and its named parts.
        """
        raise NotImplementedError

    def figures(self, seen: Tensor) -> Mapping[str, float]:
        """Return the scores of ``seen`` (see ``loss``), by name."""
        raise NotImplementedError

    # Methods that holograms and lenses override.

    def make_cells(self) -> CellMap:
        """Return the map from one value per free cell to the pixels of the search."""
        return CellMap(self.settings.layout)

    def make_bench(self, optics: Optics) -> Any:
        """Return the module that turns heights (size, size), µm, into ``seen``, the input of ``loss``."""
        return ViewsBench(self.settings.layout, self.views(optics)).to(self.printer.device)

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Return the levels (*cells) from which a search starts if it does not start at random.

        Args:
            level_phase: phase that each level prints, radian (levels,).
        """
        raise NotImplementedError

    def untouched(self) -> dict[str, Tensor]:
        """Return uncorrected layouts (size, size) by name; by default, only the start for nominal heights."""
        if set(self.starts) == {"random"}:
            return {}
        layout = self.settings.layout
        nominal = [level * layout.level_height_um for level in range(layout.levels)]
        phase = printed_phase(nominal, self.settings.optics).to(self.printer.device)
        return {"nominal heights": self.cells(self.start_levels(phase).to(self.printer.device))}

    def over_models(self, losses: Tensor) -> Tensor:
        """Combine the losses of several models (models,) into one loss, by default their maximum."""
        return losses.max()

    def check_printer(self, printer: Printer) -> None:
        """Refuse a printer that cannot print this task's layouts."""

    def search_bench(self, optics: Optics) -> Any:
        """Return the bench of the search, which turns ``search_print`` into what the loss sees."""
        return self.make_bench(optics)

    def search_print(self, level: Tensor, printer: Printer) -> Tensor:
        """Print levels (1, 1, size, size) for the search; return the height, µm."""
        return self.printed(level, printer)

    def search_area(self) -> Tensor | None:
        """Return the area that each height of ``search_print`` covers; None for pixels."""
        return None

    def printed(self, level: Tensor, printer: Printer) -> Tensor:
        """Print real levels (1, 1, size, size); return the height (size, size), µm, with gradients to the
        levels.
        """
        return printer(level)[0, 0]

    def score(self, height_um: Tensor, expected_um: Tensor | None = None) -> Record:
        """Score a print (size, size), µm.

        ``expected_um`` is the print that the design expected; by default, it is the scored print.
        """
        with torch.no_grad():
            return self.score_type(**self.figures(self.bench(height_um)))

    def thick_score(self, height_um: Tensor) -> Record | None:
        """Score a print as a thick element.

        Return None if the settings already specify a thick element, or if the task has no light.
        """
        if self.settings.optics.element == "thick":
            return None
        optics = self.settings.optics.model_copy(update={"element": "thick"})
        nominal = Printer(None, self.settings.layout, source="none").to(self.printer.device)
        settings = self.settings.model_copy(update={"optics": optics})
        return type(self)(settings, nominal, inputs=self.inputs).score(height_um)

    def window_figures(self, seen: Tensor) -> Mapping[str, float]:
        """Return the figures of one draw of the process window."""
        return self.figures(seen)

    def save(self, folder: Path, level: Tensor, height_um: Tensor) -> dict[str, str]:
        """Write levels, print and what is seen; return their SHA-256 by file name."""
        return write_arrays(folder, self.arrays(level, height_um))

    def findings(self, folder: Path, level: Tensor, height_um: Tensor) -> Findings:
        """Return findings about levels and their print, for the record; ``folder`` contains the arrays."""
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
        """Return the arrays of a design by file name: levels, heights, what is seen, and the inputs."""
        with torch.no_grad():
            seen = self.bench(height_um).cpu().numpy()
        levels = level.cpu().numpy().astype(np.uint8)
        made = {LEVELS_FILE: levels, HEIGHT_FILE: height_um.cpu().numpy(), IMAGE_FILE: seen}
        return made | {f"{name}.npy": array for name, array in self.inputs.items()}

    def reference_efficiency(self, height_um: Tensor) -> float | None:
        """Return the efficiency of an ideal element; None if it is undefined.

        The search for the ideal element starts from a print (size, size), µm.
        """
        return None

    def baselines(self) -> dict[str, dict[str, float]]:
        """Return baseline scores on the same grid, by default those of a flat plate."""
        flat = torch.zeros(self.bench.grid.shape, device=self.printer.device)
        return {"no element": self.score(flat).model_dump()}

    def display(self, seen: np.ndarray) -> np.ndarray:
        """Draw what is seen, for reports: images side by side in a square, each divided by its brightest
        value.
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
        """Return the draws of the process window that enter the loss, each with its bench.

        If there are no such draws, the only entry is None, which stands for the print as modelled, with its
        bench.
        """
        window, optics = self.settings.window, self.settings.optics
        drawn = draws(window, optics, window.samples)
        return [(draw, self.search_bench(draw.optics)) for draw in drawn] or [
            (None, self.search_bench(optics))
        ]

    def free_parameters(self) -> Parametrisation:
        """Return the free parameters of the search, at its start."""
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
        """Return the loss of levels on the pixels (1, 1, size, size), and its parts.

        For each sample of the process window, ``over_models`` combines the losses of the models; ``risk``
        then combines the samples. Penalties on the disagreement of the models and on rare levels and steps
        are added.
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
        """Print integer levels (size, size), by default with the first printer; return the height, µm."""
        return self.printed(level[None, None].float(), printer or self.printer)

    @torch.no_grad()
    def window_scores(self, height_um: Tensor, count: int) -> list[dict[str, float]]:
        """Score a print (size, size) over ``count`` unseen draws of the process window."""
        settings, scores = self.settings, []
        for draw in draws(settings.window, settings.optics, count, unseen=True):
            changed = draw.apply(height_um, settings.layout.pitch_um)
            scores.append(dict(self.window_figures(self.make_bench(draw.optics)(changed))))
        return scores

    def inputs_sha256(self) -> str:
        """Return the hash of the inputs and, for a task from outside this package, of its code."""
        digest = hashlib.sha256()
        for name, array in sorted(self.inputs.items()):
            digest.update(
                f"{name}:{array.dtype}:{array.shape};".encode() + np.ascontiguousarray(array).tobytes()
            )
        if not type(self).__module__.startswith("litho_design."):
            digest.update(_source(type(self)).encode())
        return digest.hexdigest()

    def loss_by(self, printer: Printer, seen: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of ``seen``, the light behind the print of ``printer``, and its named parts.

        By default, the result is that of ``loss``.
        """
        found = self.loss(seen)
        return found if isinstance(found, tuple) else (found, {})


_TASKS: dict[str, type[Task]] = {}


def register_task(task: type[Task]) -> type[Task]:
    """Register your own task, so that its designs can be opened; also works as a class decorator.

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
    """Return the task of that name.

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
        # If the class was typed into an interpreter, there is no source to compare.
        return ""
