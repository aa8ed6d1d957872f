"""Design an element through a frozen model of the printer, and write the folder of the design."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import Target, load_target
from litho_design.lenses.objects import with_objects
from litho_design.lenses.settings import LensSettings, lens_settings
from litho_design.lenses.task import LensTask
from litho_design.optimisation.process_window import YIELD_DRAWS
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printer, load_printers
from litho_design.reports.hologram import write_hologram_report
from litho_design.reports.lens import write_lens_report
from litho_design.tasks.design import HEIGHT_FILE, Design
from litho_design.tasks.run import run_design


def design_hologram(
    target: str | Path | np.ndarray | Target,
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: HologramSettings | None = None,
    ensemble: Iterable[str | Printer] = (),
    device: Device = "cpu",
    extrapolate: bool = False,
    announce: bool = True,
) -> Design:
    """Optimise the layout of a hologram so that its print shows the wanted image.

    Args:
        target: a drawing by name, an image file, or an array (size_px, size_px) in [0, 1].
        model: folder of a frozen model, ``zoo:NAME``, ``none`` for nominal heights, or a loaded printer.
        out: folder of the design; an interrupted run in it resumes.
        settings: geometry, optics, search and loss; ``hologram_settings()`` by default.
        ensemble: further models, MODEL or NAME=MODEL: the loss is the mean over all models, plus a
            penalty on their disagreement.
        device: where models are loaded.
        extrapolate: accept heights beyond a model's calibration; recorded in the result.
        announce: print the expected time and memory to stderr before starting.

    Returns:
        The record written to ``out/design.json``.

    Raises:
        InputError: a target of another size or without dark and bright pixels, a model that does not
            fit the layout, or a folder that holds another result.
    """
    settings = settings or hologram_settings()
    printer = load_printer(model, settings.layout, device=device, extrapolate=extrapolate)
    others = load_printers(ensemble, settings.layout, device=device, extrapolate=extrapolate)
    wanted = load_target(target, settings.layout.size_px)
    task = HologramTask(settings, printer, wanted, list(others.values()))

    def report(folder: Path, design: Design, history: list[dict[str, float]]) -> None:
        draws = task.window_scores(_printed_um(folder, printer), YIELD_DRAWS)
        write_hologram_report(folder, design, history, draws)

    return run_design(task, settings, out, report, announce=announce)


def design_lens(
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: LensSettings | None = None,
    objects: Sequence[str | Path] = (),
    held_out_objects: Sequence[str | Path] = (),
    ensemble: Iterable[str | Printer] = (),
    device: Device = "cpu",
    extrapolate: bool = False,
    announce: bool = True,
) -> Design:
    """Optimise the layout of a lens so that its print focuses, or images after reconstruction.

    Args:
        model: as for ``design_hologram``.
        out: folder of the design; an interrupted run in it resumes.
        settings: geometry, optics, task and search; ``lens_settings()`` by default.
        objects: pictures, or folders of them, that a computational lens images instead of the drawings.
        held_out_objects: pictures or folders that are only scored (see ``with_objects``).
        ensemble, device, extrapolate, announce: as for ``design_hologram``.

    Returns:
        The record written to ``out/design.json``.

    Raises:
        InputError: as for ``design_hologram``; a radial search of a layout without rings or with a
            square aperture; or objects that are not pictures.
    """
    settings = settings or lens_settings()
    printer = load_printer(model, settings.layout, device=device, extrapolate=extrapolate)
    others = load_printers(ensemble, settings.layout, device=device, extrapolate=extrapolate)
    settings, pictures = with_objects(settings, objects, held_out_objects)
    return run_lens(settings, printer, out, pictures, ensemble=list(others.values()), announce=announce)


def run_lens(
    settings: LensSettings,
    printer: Printer,
    out: str | Path,
    pictures: Mapping[str, np.ndarray],
    *,
    ensemble: Sequence[Printer] = (),
    announce: bool = True,
) -> Design:
    """``design_lens`` with its printers loaded and the pixels of its pictures read (``with_objects``)."""
    task = LensTask(settings, printer, ensemble, pictures)

    def report(folder: Path, design: Design, history: list[dict[str, float]]) -> None:
        draws = task.window_scores(_printed_um(folder, printer), YIELD_DRAWS)
        write_lens_report(folder, design, history, task.bench, draws)

    return run_design(task, settings, out, report, announce=announce)


def _printed_um(folder: Path, printer: Printer) -> Tensor:
    return torch.from_numpy(np.load(folder / HEIGHT_FILE)).to(printer.device)
