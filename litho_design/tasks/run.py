"""Run any task: search for a layout, polish it (change levels by one to lower the loss), score it and write
the result. Interrupted runs resume.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from litho_data.commands.progress import say
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import record_sha256
from litho_design.optics.stroke import measure_stroke
from litho_design.optimisation.budget import measure_budget
from litho_design.optimisation.checkpoint import SearchState, finished_iterations, remove_checkpoint
from litho_design.optimisation.polish import polish_levels
from litho_design.optimisation.search import search_layout
from litho_design.printers.printer import Printer
from litho_design.tasks.design import Design, RunRecord
from litho_design.tasks.task import Task
from litho_design.tasks.width import SEARCHED, Width

# Two values for the estimate of the run time. The first is the number of layouts whose prints every model
# predicts after the search: the layout found by the search and an uncorrected layout. The second is the time,
# in seconds, in which a report is written.
_CANDIDATES, _PAGE_S = 2, 7.0
# A function that writes the report into the folder of a design. It takes the folder, the record, the task and
# the history of the search.
Report = Callable[[Path, Design, Task, list[dict[str, float]]], object]


def run_design(task: Task, out: str | Path, report: Report, *, announce: bool = True) -> Design:
    """Optimise, polish and score the layout of one task, and write the result into the folder ``out``.

    If the folder holds an interrupted run of the same task, the run resumes, and the result is the same as
    without the interruption. If the folder holds a finished design of the same task, this design is returned.
    The weights of every model that the search uses are hashed before and after the run. If they changed, no
    design is written.

    Args:
        report: function that writes the report. It is called after the arrays are saved and before the record
            is written.
        announce: print the expected time and memory to stderr before starting.

    Raises:
        InputError: ``out`` holds another design or result; a printer of the search is a virtual fab, which
            provides no gradients and can only judge; or the weights of a model changed during the run.
    """
    settings, folder = task.settings, Path(out)
    for printer in task.printers:
        if printer.only_judges:
            hint = "a fab can only judge; give it with --judge"
            raise InputError(f"model {printer.name}", got="a virtual fab", wanted="a frozen model", hint=hint)
    before = [printer.weights_sha256() for printer in task.printers]
    judged_by = [judge.weights_sha256() for judge in task.judges]
    facts = {
        "settings": settings.model_dump(mode="json"),
        "target": task.target_record.model_dump(mode="json") if task.target_record else None,
        "fingerprint": record_sha256([task.name, before, judged_by, task.inputs_sha256()]),
    }
    # If several processes share a design, the first of them creates the folder.
    with growing_folder(folder, Design.FILE_NAME, facts) if task.ranks.rank == 0 else nullcontext() as begun:
        if not task.ranks.any(begun is not None and begun.finished):
            _make(task, folder, facts, before, report, announce and task.ranks.rank == 0)
            task.ranks.wait()
            remove_checkpoint(folder, task.ranks.part)
    return Design.read(folder)


def _make(
    task: Task,
    folder: Path,
    facts: Mapping[str, Any],
    weights_sha256: Sequence[str],
    report: Report,
    announce: bool,
) -> None:
    """Search for a layout, choose between this layout and the uncorrected layouts, predict the print of the
    chosen layout, score it and write the result.
    """
    settings = task.settings
    layout, wave_um = settings.layout, settings.optics.wave_height_um
    heights = task.printer.level_heights_um()
    with ExitStack() as precisions:
        for printer in task.printers:
            precisions.enter_context(printer.at_precision(settings.search.precision))
        found = _searched(task, folder, record_sha256(facts), announce)
    level, width, loss = task.cells(found.levels), None, found.loss
    if task.in_one_piece:
        level, width = best_layout(task, level)
    if width is not None and width.returned != SEARCHED:
        what = f"the available models print the layout “{width.returned}” better than the layout found by"
        task.notes.append(f"{what} the search, so “{width.returned}” was chosen")
        with torch.no_grad():
            loss = float(task.objective(level[None, None].float())[0])
    height = task.printed_um(level)
    if [printer.weights_sha256() for printer in task.printers] != weights_sha256:
        raise InputError(
            f"model {', '.join(printer.name for printer in task.printers)}",
            got="weights or buffers that changed during the run",
            wanted="a model that printing does not change",
        )
    files = task.save(folder, level, height)
    if task.ranks.rank:
        return
    design = Design(
        **facts,
        task=task.name,
        variant=settings.variant,
        run=RunRecord.of(height.device, found.seconds, found.seconds_per_iteration),
        layout=layout,
        optics=settings.optics,
        printer=task.printer.record(),
        ensemble_sha256=list(weights_sha256[1:]),
        stroke=measure_stroke(heights, wave_um, level_height_um=layout.level_height_um),
        notes=task.notes,
        iterations=found.state.iteration,
        start_loss=found.start_loss,
        sample_loss=found.state.history[-1]["sample_loss"],
        argmax_loss=found.state.best_loss,
        polished_loss=loss,
        files=files,
        width=width,
        **dict(task.findings(folder, level, height)),
    )
    if task.in_one_piece:
        report(folder, design, task, found.state.history)
    design.write(folder)


@torch.no_grad()
def best_layout(task: Task, searched: Tensor) -> tuple[Tensor, Width | None]:
    """Return the layout with the smallest loss according to all available models (``Task.over_models``). The
    candidates are the layout found by the search and the uncorrected layouts (``Task.untouched``).

    Args:
        searched: levels that the search found, on the pixels of the layout, shape (size, size).

    Returns:
        The levels of the chosen layout, and the width of the design. The width states how much the
        predictions of the models differ. It is None if there is only one model and only one candidate.
    """
    candidates = {SEARCHED: searched, **task.untouched()}
    models = _by_name((*task.printers, *task.judges))
    if len(models) == 1 and len(candidates) == 1:
        return searched, None
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for name, level in candidates.items():
        seen = {model: task.bench(task.printed_um(level, one)) for model, one in models.items()}
        figures[name] = {
            model: {"loss": float(task.loss_by(models[model], one)[0]), **task.window_figures(one)}
            for model, one in seen.items()
        }

    def over_models(name: str) -> float:
        return float(task.over_models(torch.tensor([one["loss"] for one in figures[name].values()])))

    returned = min(figures, key=over_models)
    known = next(iter(figures[SEARCHED].values()))
    figure = next((name for name in (*task.headline, *known) if name in known), "loss")
    return candidates[returned], Width(
        searched_with=len(task.printers),
        figures=figures,
        returned=returned,
        figure=figure,
        less=figure in (*task.errors, "loss"),
        loss_unit=task.loss_unit,
        level_heights_um={model: list(one.level_heights_um()) for model, one in models.items()},
    )


def _by_name(printers: Sequence[Printer]) -> dict[str, Printer]:
    """Return the models by name. If two models with different weights have the same name, the source of the
    second model is added to the name of the second model.
    """
    named: dict[str, Printer] = {}
    for one in printers:
        name = one.name
        while name in named and named[name].weights_sha256() != one.weights_sha256():
            name = f"{name} ({one.source})"
        named.setdefault(name, one)
    return named


class _Searched(NamedTuple):
    """The result of the search and of the polish that follows it: the level of each cell, the loss, the state
    of the search, and its duration.
    """

    levels: Tensor
    loss: float
    start_loss: float
    state: SearchState
    seconds: float
    seconds_per_iteration: float


def _searched(task: Task, folder: Path, fingerprint: str, announce: bool) -> _Searched:
    search, started = task.settings.search, time.monotonic()
    done = finished_iterations(folder, task.ranks)
    parameters = task.free_parameters()
    first = parameters.cells(parameters.best_levels())
    with torch.no_grad():
        start_loss = float(task.objective(first[None, None].float())[0])
    budget = measure_budget(parameters, task.objective, search)
    if announce:
        after = _seconds_after(task, first) if task.in_one_piece else 0.0
        for line in (*task.notes, budget.sentence(search, done, after)):
            say(line)
    state = search_layout(
        parameters, task.objective, search, folder=folder, fingerprint=fingerprint, part=task.ranks.part
    )
    assert state.best_levels is not None
    levels, loss = state.best_levels, state.best_loss
    if search.polish_rounds and task.in_one_piece:
        levels, losses = polish_levels(
            levels, parameters.cells, task.objective,
            level_count=task.settings.layout.levels, rounds=search.polish_rounds,
        )  # fmt: skip
        loss = losses[-1]
    seconds = state.earlier_seconds + time.monotonic() - started
    return _Searched(levels, loss, start_loss, state, seconds, budget.seconds_per_iteration)


@torch.no_grad()
def _seconds_after(task: Task, level: Tensor) -> float:
    """Estimate the time, in seconds, that a run needs after the search to choose the layout and to compute
    the scores and the yield. For this estimate, one prediction by each model and the scores of one draw of
    the process window are timed.
    """
    models = (*task.printers, *task.judges)
    started = time.perf_counter()
    heights = [task.printed_um(level, one) for one in models]
    printed = time.perf_counter()
    task.window_scores(heights[0], 1)
    per_score = time.perf_counter() - printed
    scores = task.settings.window.yield_draws + _CANDIDATES * len(models)
    return _CANDIDATES * (printed - started) + scores * per_score + _PAGE_S
