"""The front of efficiency against likeness: a hologram designed with several weights of missing light."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.outputs import require_own_folder
from litho_data.foundation.run_facts import run_facts
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.images.targets import Target
from litho_design.judging.front import FrontPoint, FrontResult
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printer, load_printers
from litho_design.reports.front import write_front_report
from litho_design.tasks.design import DESIGNS
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
) -> FrontResult:
    """Design a hologram once per weight of the light that misses the target; an interrupted run resumes.

    Args:
        weights: values of ``loss.efficiency_weight``.
        target, model, out, settings, ensemble, device, extrapolate, announce: as for ``design_hologram``; the
            designs lie in ``out/designs``.

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
    require_own_folder(folder, FrontResult.FILE_NAME, DESIGNS)
    fit: Any = {"device": device, "extrapolate": extrapolate}
    printer = load_printer(model, made.layout, **fit)
    others = list(load_printers(ensemble, made.layout, **fit).values())
    name = "si_psnr_window_db" if made.loss.signal_window_um else "si_psnr_db"
    found: list[tuple[float, str, float, float]] = []
    for weight in sorted(weights):
        loss = made.loss.model_copy(update={"efficiency_weight": weight})
        place = Path(DESIGNS) / f"weight_{weight:g}"
        design = design_hologram(
            target, printer, folder / place, settings=made.model_copy(update={"loss": loss}),
            ensemble=others, announce=announce,
        )  # fmt: skip
        found.append((weight, str(place), design.predicted[name], design.predicted["eff_signal"]))
    points = [
        FrontPoint(
            efficiency_weight=weight,
            folder=place,
            si_psnr_db=psnr,
            eff_signal=share,
            on_front=not any(p >= psnr and s >= share and (p, s) != (psnr, share) for _, _, p, s in found),
        )
        for weight, place, psnr, share in found
    ]
    result = FrontResult(**run_facts(), figure=name, points=points, baselines=design.baselines)
    write_front_report(folder, result, printer.name)
    result.write(folder)
    return result
