"""The front of efficiency against likeness: a hologram designed with several weights of missing light."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from litho_data.commands.progress import progress
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts
from litho_data.sharing.sending import Known
from litho_data.sharing.workers import Workers, run_jobs
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.images.targets import Target
from litho_design.judging.front import FrontPoint, FrontResult
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printer, load_printers
from litho_design.reports.front import write_front_report
from litho_design.tasks.design import DESIGNS, Design
from litho_design.workflows.design import design_hologram

WEIGHTS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)


def efficiency_front(
    target: str | Path | np.ndarray | Target,
    model: str | Path | Printer,
    out: str | Path,
    *,
    weights: Sequence[float] = WEIGHTS,
    settings: HologramSettings | None = None,
    ensemble: Iterable[str | Printer] = (),
    device: Device = "cpu",
    extrapolate: bool = False,
    announce: bool = True,
    workers: int = 1,
    dask: str | None = None,
) -> FrontResult:
    """Design a hologram once per weight of the light that misses the target; an interrupted run resumes.

    Args:
        weights: values of ``loss.efficiency_weight``.
        target, model, out, settings, ensemble, device, extrapolate, announce: as for ``design_hologram``; the
            designs lie in ``out/designs``.
        workers: local processes; ``dask``: address of a Dask scheduler instead. They design.

    Returns:
        The record written to ``out/front.json``, with the figures of the prints that the model expects.

    Raises:
        InputError: fewer than two weights, one below zero or twice, or what ``design_hologram`` refuses.
    """
    if len(weights) < 2 or min(weights) < 0 or len(set(weights)) < len(weights):
        raise InputError(
            "weights of the front", got=", ".join(f"{one:g}" for one in weights), wanted="two or more, from 0"
        )
    folder, made = Path(out), settings or hologram_settings()
    load = partial(_printers, model, list(ensemble), made.layout, device, extrapolate)
    printers = load()
    name = "si_psnr_window_db" if made.loss.signal_window_um else "si_psnr_db"
    places = {weight: Path(DESIGNS) / f"weight_{weight:g}" for weight in sorted(weights)}
    jobs: list[_Job] = []
    for weight, place in places.items():
        loss = made.loss.model_copy(update={"efficiency_weight": weight})
        own = made.model_copy(update={"loss": loss})
        jobs.append((weight, target, [*printers.values()], folder / place, own, announce))
    where = Workers(workers, dask, Known(load, printers))
    with growing_folder(folder, FrontResult.FILE_NAME):
        done = run_jobs(_design, jobs, where, name=lambda job: f"weight {job[0]:g}")
        designs = {weight: design for (weight, *_), design in progress(done, "designs", len(jobs))}
        found = [
            (weight, str(place), designs[weight].predicted[name], designs[weight].predicted["eff_signal"])
            for weight, place in places.items()
        ]
        points = [
            FrontPoint(
                efficiency_weight=weight,
                folder=place,
                si_psnr_db=psnr,
                eff_signal=share,
                on_front=not any(
                    p >= psnr and s >= share and (p, s) != (psnr, share) for _, _, p, s in found
                ),
            )
            for weight, place, psnr, share in found
        ]
        baselines = designs[max(weights)].baselines
        result = FrontResult(**run_facts(), figure=name, points=points, baselines=baselines)
        write_front_report(folder, result, printers[""].name)
        result.write(folder)
    return result


_Job = tuple[float, str | Path | np.ndarray | Target, list[Printer], Path, HologramSettings, bool]


def _design(job: _Job) -> Design:
    _, target, (printer, *others), place, settings, announce = job
    return design_hologram(target, printer, place, settings=settings, ensemble=others, announce=announce)


def _printers(
    model: str | Path | Printer,
    ensemble: Sequence[str | Printer],
    layout: LayoutSettings,
    device: Device,
    extrapolate: bool,
) -> dict[str, Printer]:
    """The printer, without a name, and the others of the ensemble by theirs."""
    own = load_printer(model, layout, device=device, extrapolate=extrapolate)
    return {"": own, **load_printers(ensemble, layout, device=device, extrapolate=extrapolate)}
