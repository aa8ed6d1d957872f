"""Measure the design-to-manufacturing gap. A design is made with every arm (a printer model, or none), and
every judge (a model) predicts the print of every design.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.commands.progress import progress
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts
from litho_data.sharing.sending import Known
from litho_data.sharing.workers import Workers, run_jobs
from litho_design.holograms.settings import HologramSettings
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import Target, load_target
from litho_design.judging.gap import (
    GapEntry,
    GapResult,
    design_folder,
    paired_differences,
    summarise,
)
from litho_design.judging.loaded import load_design
from litho_design.lenses.objects import with_objects
from litho_design.lenses.settings import LensSettings
from litho_design.lenses.task import lens_task
from litho_design.optimisation.settings import DesignSettings
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printers
from litho_design.reports.design import write_design_report
from litho_design.reports.gap import write_gap_report
from litho_design.reports.pictures import Panel
from litho_design.tasks.design import DESIGNS, Design
from litho_design.tasks.run import run_design
from litho_design.tasks.task import Task, registered_task

Models = Mapping[str, str | Path | Printer] | Iterable[str | Printer]


def compare(
    settings: DesignSettings,
    arms: Models,
    out: str | Path,
    *,
    judges: Models = (),
    target: str | Path | np.ndarray | Target = "text",
    task: type[Task] | None = None,
    inputs: Mapping[str, np.ndarray] | None = None,
    objects: Sequence[str | Path] = (),
    held_out_objects: Sequence[str | Path] = (),
    seeds: Iterable[int] = (0, 1, 2),
    device: Device = "cpu",
    extrapolate: bool = False,
    announce: bool = True,
    workers: int = 1,
    dask: str | None = None,
) -> GapResult:
    """Make one design per arm and seed with equal search settings, and predict the print of each layout with
    every judge.

    An arm is the printer model, or none, with which a design is made. A judge is a model that predicts the
    print of a finished layout. The settings of all designs are the same, except for the printer and the seed.
    Finished designs in ``out`` are reused, and interrupted designs resume. The printers of all arms are also
    judges.

    Args:
        settings: settings of a hologram or of a lens; their type decides which of the two is designed. If
            ``task`` is given, these are the settings of this task. Each of ``seeds`` replaces the seed of the
            search.
        arms: printers to design with, given as a mapping from names to models, or as a list whose items are
            NAME=MODEL, MODEL, ``none`` or loaded printers.
        out: folder of the comparison.
        judges: further printers, which only judge; given like ``arms``.
        target: target image, for holograms.
        task, inputs: a user-defined task and the arrays that it needs, as for ``design``.
        objects, held_out_objects: as for ``design_lens``.
        seeds: seeds of the search. One design is made for each arm and seed.
        device, extrapolate, announce: as for ``design_hologram``.
        workers: number of local processes that make the designs.
        dask: address of a Dask scheduler, whose workers then make the designs instead.

    Returns:
        The record written to ``out/gap.json``.

    Raises:
        InputError: there is no arm or no seed, a judge has the name of an arm, ``out`` holds another kind of
            result, or ``design_hologram`` or ``design_lens`` rejects an argument.
    """
    every_seed = list(seeds)
    fit: Any = {"device": device, "extrapolate": extrapolate}
    arms = dict(arms) if isinstance(arms, Mapping) else list(arms)
    designers = load_printers(arms, settings.layout, **fit)
    known = Known(partial(load_printers, arms, settings.layout, **fit), designers)
    others = load_printers(judges, settings.layout, **fit)
    _check(designers, others, every_seed)
    folder = Path(out)
    # The printers are checked before a target is drawn or a picture is read.
    make: Callable[[Any, Printer], Task]
    if task is not None:
        make = partial(registered_task(task.name), inputs=inputs)
    elif isinstance(settings, HologramSettings):
        if objects or held_out_objects:
            raise InputError(
                "objects", got="the hoe task, which has a target", wanted="the lens task", hint="use --target"
            )
        wanted = load_target(target, settings.layout.size_px)
        make = partial(HologramTask, inputs={"target": wanted.pixels}, record=wanted.record)
    else:
        assert isinstance(settings, LensSettings)
        settings, inputs = with_objects(settings, objects, held_out_objects)
        make = partial(lens_task, inputs=inputs)

    everyone = {**designers, **others}
    jobs: list[_Job] = []
    for (arm, printer), seed in itertools.product(designers.items(), every_seed):
        search = settings.search.model_copy(update={"seed": seed})
        own = settings.model_copy(update={"search": search})
        jobs.append((make, own, printer, design_folder(folder, arm, seed), announce))
    with growing_folder(folder, GapResult.FILE_NAME, holds=DESIGNS):
        done = run_jobs(_design, jobs, Workers(workers, dask, known), name=lambda job: str(job[3]))
        designs = [design for _, design in progress(done, "designs", len(jobs))]
        entries: list[GapEntry] = []
        pictures: list[list[Panel]] = []
        for arm, seed in itertools.product(designers, every_seed):
            found, panels = _judged(design_folder(folder, arm, seed), arm, seed, everyone)
            entries += found
            pictures += [panels] if seed == every_seed[0] else []
        shown = registered_task(designs[0].task).headline
        result = GapResult(
            task=designs[0].task,
            **run_facts(),
            settings=settings,
            target=designs[0].target.name if designs[0].target else "",
            seeds=every_seed,
            arms={name: printer.record() for name, printer in designers.items()},
            judges={name: printer.record() for name, printer in everyone.items()},
            entries=entries,
            summary=summarise(entries),
            paired=paired_differences(entries, shown or tuple(designs[0].predicted)),
        )
        write_gap_report(folder, result, pictures)
        result.write(folder)
    return result


_Job = tuple[Callable[[Any, Printer], Task], DesignSettings, Printer, Path, bool]


def _design(job: _Job) -> Design:
    make, settings, printer, place, announce = job
    return run_design(make(settings, printer), place, write_design_report, announce=announce)


def _judged(
    place: Path, arm: str, seed: int, printers: Mapping[str, Printer]
) -> tuple[list[GapEntry], list[Panel]]:
    """Predict the print of a finished design with every printer. Return one entry and one picture per
    printer. If the design has a target image, this image precedes the pictures.
    """
    loaded = load_design(place, device=printers[arm].device)
    expected = loaded.printed_um(printers[arm])
    entries, side_um = [], loaded.window_um
    panels = [] if loaded.target is None else [Panel("target", loaded.target.cpu().numpy(), side_um)]
    for name, printer in printers.items():
        printed = loaded.printed_um(printer)
        entries.append(
            GapEntry(
                arm=arm,
                seed=seed,
                judge=name,
                self_judged=name == arm,
                designed=loaded.record.predicted,
                judged=loaded.score(printed).model_dump(),
                rms_height_gap_um=float((printed - expected).square().mean().sqrt()),
            )
        )
        title = f"{arm}:\n{'in design' if name == arm else f'printed by {name}'}"
        panels.append(Panel(title, loaded.display(loaded.image(printed)), side_um))
    return entries, panels


def _check(arms: Mapping[str, Printer], judges: Mapping[str, Printer], seeds: Sequence[int]) -> None:
    if not arms or not seeds:
        raise InputError(
            "comparison", got=f"{len(arms)} arms, {len(seeds)} seeds", wanted="at least one arm and one seed"
        )
    both = sorted(set(arms) & set(judges))
    if both:
        raise InputError(
            "judges",
            got=f"{both[0]!r} twice",
            wanted="judges with names that no arm has",
            hint="the model of every arm is a judge already",
        )
