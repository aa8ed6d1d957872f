"""The run that every task shares: start, search, polish, score, write; interrupted runs resume."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import record_sha256
from litho_design.optimisation.budget import Budget, measure_budget
from litho_design.optimisation.checkpoint import SearchState, finished_iterations, remove_checkpoint
from litho_design.optimisation.fabrication import outside
from litho_design.optimisation.parameters import Parametrisation
from litho_design.optimisation.polish import polish_levels
from litho_design.optimisation.robust import measure_disagreement
from litho_design.optimisation.search import make_parametrisation, search_layout
from litho_design.printers.layout import printability
from litho_design.printers.printer import Printer
from litho_design.printers.source import load_printer
from litho_design.printers.training import OutOfDistribution, out_of_distribution
from litho_design.tasks.design import (
    HEIGHT_FILE,
    LEVELS_FILE,
    Design,
    RunRecord,
    finished_design,
    write_arrays,
    write_level_image,
)
from litho_design.tasks.task import Task

# Writes the report into the folder of a design, from the record and the history of the search.
Report = Callable[[Path, Design, Task, list[dict[str, float]]], object]

# Brings a hologram from 0.67 to 0.2 of the level distance in twenty iterations.
_INSIDE_WEIGHT = 0.5


@dataclass(frozen=True)
class _Outcome:
    levels: Tensor
    state: SearchState
    start_loss: float
    polished_loss: float
    budget: Budget
    seconds: float


def run_design(task: Task, out: str | Path, report: Report, *, announce: bool = True) -> Design:
    """Optimise, polish and score one layout, and write the folder ``out``.

    If the folder holds an interrupted run of the same task, the run resumes, with the same result as an
    uninterrupted one; a finished design of the same task is returned. The weights of every model are hashed
    before and after the run; if they changed, no design is written.

    Args:
        report: called with the folder when the arrays are in it; the record is written afterwards.
        announce: print the expected time and memory to stderr before starting.

    Raises:
        InputError: ``out`` holds another design or result, a printer can only judge, or the weights
            of a model changed during the run.
    """
    settings = task.settings
    _check_printers(task.printers)
    folder = Path(out)
    hashes_before = [printer.weights_sha256() for printer in task.printers]
    draft = _draft_of(task)
    drafted_with = [draft.printer.weights_sha256()] if draft else []
    target = task.target_record.model_dump(mode="json") if task.target_record else None
    fingerprint = record_sha256(
        [task.name, settings.model_dump(mode="json"), hashes_before + drafted_with, target,
         task.inputs_sha256()]
    )  # fmt: skip
    finished = finished_design(folder, fingerprint, settings)
    if finished is not None:
        return finished
    heights = task.printer.level_heights_um()
    with ExitStack() as precisions:
        for printer in [*task.printers, *([draft.printer] if draft else [])]:
            precisions.enter_context(printer.at_precision(settings.search.precision))
        outcome = _optimise(task, draft, folder, fingerprint, heights, announce)
    cells = make_parametrisation(settings.layout, settings.search).to(outcome.levels.device).cells
    layout_level = cells(outcome.levels)
    level = layout_level[None, None].float()
    with torch.no_grad():
        height = task.printer(level)[0, 0]
    hashes_after = [printer.weights_sha256() for printer in task.printers]
    for printer, before, after in zip(task.printers, hashes_before, hashes_after, strict=True):
        if after != before:
            raise InputError(
                f"model {printer.name}",
                got="weights or buffers that changed during the run",
                wanted="a model that printing does not change",
            )
    layout_array = layout_level.cpu().numpy().astype(np.uint8)
    arrays = {LEVELS_FILE: layout_array, HEIGHT_FILE: height.cpu().numpy(), **task.arrays(height)}
    files = write_arrays(folder, arrays) | write_level_image(folder, layout_array)
    thick = task.thick_score(height)
    design = Design.searched(
        settings,
        task.printer,
        heights,
        outcome.state,
        task=task.name,
        fingerprint=fingerprint,
        run=RunRecord.of(height.device, outcome.seconds, outcome.budget.seconds_per_iteration),
        target=task.target_record,
        printer_unchanged=hashes_after == hashes_before,
        tiling=task.printer.tiling_check(level),
        ensemble=measure_disagreement(task.printers, level, settings.optics.wave_height_um),
        printability=printability(layout_array, settings.layout),
        out_of_distribution=_gauge(task, outcome.levels, layout_array),
        notes=list(task.notes),
        start_loss=outcome.start_loss,
        polished_loss=outcome.polished_loss,
        reference_efficiency=task.reference_efficiency(height),
        predicted=task.score(height).model_dump(),
        baselines=task.baselines(),
        thick=None if thick is None else thick.model_dump(),
        files=files,
    )
    report(folder, design, task, outcome.state.history)
    design.write(folder)
    remove_checkpoint(folder)
    return design


def _gauge(task: Task, levels: Tensor, layout_array: np.ndarray) -> OutOfDistribution | None:
    """Distance from the training layouts; where that is large, also what a layout closer to them scores."""
    settings = task.settings
    gauge = out_of_distribution(layout_array, settings.layout, task.printer.card)
    trial = settings.fabrication.trial_iterations
    if gauge is None or not gauge.flagged or not trial:
        return gauge
    search = settings.search.model_copy(
        update={"parametrisation": "direct", "optimiser": "adam", "learning_rate": 1.0, "iterations": trial,
                "rate_schedule": "constant", "hard_from": 0.0, "evaluate_every": 5, "keep": "best"}
    )  # fmt: skip
    parameters = make_parametrisation(settings.layout, search).to(levels.device)
    parameters.start_from(levels.float())

    def inside(level: Tensor) -> tuple[Tensor, dict[str, float]]:
        loss, parts = task.objective(level)
        return loss + _INSIDE_WEIGHT * outside(level, settings.layout.levels, task.printer.card), parts

    state = search_layout(parameters, inside, search, what="staying inside")
    assert state.best_levels is not None
    layout_level = parameters.cells(state.best_levels)
    with torch.no_grad():
        score = task.score(task.printer(layout_level[None, None].float())[0, 0]).model_dump()
    kept = out_of_distribution(layout_level.cpu().numpy(), settings.layout, task.printer.card)
    assert kept is not None
    return gauge.model_copy(
        update={
            "inside": score,
            "inside_distance": kept.level_distance,
            "inside_step_distance": kept.step_distance,
        }
    )


def _check_printers(printers: Sequence[Printer]) -> None:
    for printer in printers:
        if printer.only_judges:
            raise InputError(
                f"model {printer.name}",
                got="a virtual fab",
                wanted="a frozen model, or none",
                hint="a fab can only judge: --judge",
            )


def _draft_of(task: Task) -> Task | None:
    """The task through the model of the first stage of its search; None where there is no such stage."""
    settings = task.settings
    if not settings.search.draft:
        return None
    printer = load_printer(settings.search.draft, settings.layout, device=task.printer.device)
    _check_printers([printer])
    return task.reopened(settings.model_dump(), task.inputs, printer)


def _draft(draft: Task, parameters: Parametrisation) -> None:
    """Start ``parameters`` where a short search through the model of ``draft`` ends."""
    search = draft.settings.search
    draft.start(parameters, draft.printer.level_heights_um())
    short = search.model_copy(update={"iterations": search.draft_iterations})
    levels = search_layout(parameters, draft.objective, short, what="drafting").best_levels
    assert levels is not None
    parameters.start_from(levels.float())


def _optimise(
    task: Task,
    draft: Task | None,
    folder: Path,
    fingerprint: str,
    heights: list[float],
    announce: bool,
) -> _Outcome:
    started = time.monotonic()
    layout, search = task.settings.layout, task.settings.search
    parameters = make_parametrisation(layout, search).to(task.printer.device)
    if draft is None:
        task.start(parameters, heights)
    else:
        _draft(draft, parameters)
    with torch.no_grad():
        start_loss = float(task.objective(parameters.cells(parameters.best_levels())[None, None].float())[0])
    budget = measure_budget(parameters, task.objective, search)
    if announce:
        for note in task.notes:
            print(note, file=sys.stderr)
        print(budget.sentence(search, finished_iterations(folder)), file=sys.stderr)
    state = search_layout(parameters, task.objective, search, folder=folder, fingerprint=fingerprint)
    levels, polished = state.best_levels, state.best_loss
    assert levels is not None
    if search.polish_rounds:
        levels, losses = polish_levels(
            levels,
            parameters.cells,
            task.objective,
            level_count=layout.levels,
            rounds=search.polish_rounds,
        )
        polished = losses[-1]
    seconds = state.earlier_seconds + time.monotonic() - started
    return _Outcome(levels, state, start_loss, polished, budget, seconds)
