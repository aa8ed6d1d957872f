"""A first result for new users. A small hologram is designed twice, without and with a printer model, and
this model predicts the prints of both designs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.images.targets import Target
from litho_design.judging.gap import GapResult
from litho_design.printers.source import Device
from litho_design.workflows.compare import compare

# Names of three printers. The first design is made with nominal heights, and the second design with a model.
# The third printer is a model that only predicts the prints of both designs.
WITHOUT, DESIGNER, JUDGE = "none", "pbl", "physics"


def small_hologram() -> HologramSettings:
    """Return the settings of a hologram that takes a minute to design on two cores.

    The image plane is so close that the hologram can resolve the letters of the target.
    """
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
    """Design the same hologram twice, once for a perfect printer and once with the printer model PBL, and
    predict both prints with PBL.

    Args:
        out: folder of the result. The page ``report.html`` in it shows the target and the images behind both
            prints side by side.
        target: as for ``design_hologram``.
        settings: settings of both designs; by default, the result of ``small_hologram``.
        device, announce: as for ``design_hologram``.

    Returns:
        The record written to ``out/gap.json``, as returned by ``compare``. The model Physics, which was used
        for neither design, also predicts the prints of both designs.

    Raises:
        InputError: ``compare`` rejects an argument.
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
