"""A first result: one small hologram designed without and with a model of the printer, both printed by it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.images.targets import Target
from litho_design.judging.gap import GapResult
from litho_design.printers.source import Device
from litho_design.workflows.compare import compare

# The design for a perfect printer, the model that the other is made through, and a further judge.
WITHOUT, DESIGNER, JUDGE = "none", "pbl", "physics"


def small_hologram() -> HologramSettings:
    """Small enough for a minute on two cores, and close enough for its size to draw the letters."""
    small = {
        "layout.size_px": 256,
        "optics.distance_um": 25,
        "search.iterations": 20,
        "search.polish_rounds": 2,
    }
    return hologram_settings(changes=small)


def first(
    out: str | Path,
    *,
    target: str | Path | np.ndarray | Target = "text",
    settings: HologramSettings | None = None,
    device: Device = "cpu",
    announce: bool = True,
) -> GapResult:
    """Design the same hologram for a perfect printer and through PBL, and print both with PBL.

    Args:
        out: folder of the result; its ``report.html`` shows target, prints and images side by side.
        target: as for ``design_hologram``.
        settings: of both designs; a hologram that takes about a minute by default.
        device, announce: as for ``design_hologram``.

    Returns:
        The record written to ``out/gap.json``, as ``compare`` writes it. Physics, through which
        neither was designed, judges both too.

    Raises:
        InputError: what ``compare`` refuses.
    """
    return compare(
        settings or small_hologram(),
        {WITHOUT: "none", DESIGNER: f"zoo:{DESIGNER}"},
        out,
        judges={JUDGE: f"zoo:{JUDGE}"},
        target=target,
        seeds=(0,),
        device=device,
        announce=announce,
    )
