"""The virtual fab (a simulated printer) as a judge of designs. It can print finished layouts, but it provides
no gradients, so no layout can be designed with it. The fab shares no code with the models. It includes the
hidden effects with which the training prints of the models were simulated, so it prints a layout as the
simulated printer would.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.virtual_fab import Job, Truth
from litho_data.virtual_fab.canvas import GUARD_PX, Canvas, cut_layout
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.printer import print_clean, surface_noise
from litho_design.printers.layout import LayoutSettings

# Number of the random stream for the surface roughness. The stream is separate, so that no scan that was
# simulated with the truth file has the same roughness.
_ROUGHNESS_STREAM = 2


@dataclass(frozen=True)
class ElementJob(Job):
    """A print job for a layout that stands alone on the substrate."""

    def canvas(self, pitch_um: float) -> Canvas:
        """Surround the layout with a frame of level 0. The write field has the size of the layout, and the
        frame lies outside it.
        """
        framed = np.pad(self.level, GUARD_PX)
        return Canvas(framed, pitch_um, self.field_um, max(self.level.shape) * pitch_um)


class FabSimulator(nn.Module):
    """The virtual fab that a ``truth.json`` describes. It is called in the same way as a frozen model. Its
    prints have surface roughness but no effects of a scan. It provides no gradients. The roughness is the
    same for all layouts of the same size, so differences between their prints come only from the layouts.
    """

    name = "fab"
    # ``Printer`` adds no guard ring, because ``ElementJob`` already adds a frame of level 0.
    guard_px = 0

    def __init__(self, truth: Truth):
        super().__init__()
        self.printer, self.noise = truth.printer, truth.noise
        self.knobs = KnobBoard([knob.setting for knob in truth.knobs], truth.seed)
        self.scans, self.seed = len(truth.scans), truth.seed
        # This text contains everything that determines the print. The hash of the text identifies the fab,
        # just as the hash of its weights identifies a model.
        text = truth.model_dump_json(include={"printer", "noise", "knobs", "seed"})
        self.register_buffer("settings", torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8))

    @torch.no_grad()
    def forward(self, layout_um: Tensor, pitch_um: float) -> Tensor:
        """Return the printed height, µm, from nominal heights, µm; both have shape (b, 1, y, x)."""
        levels = (layout_um / self.printer.level_height_um).round().to(torch.uint8).cpu().numpy()
        prints = np.stack([self._print(level) for level in levels[:, 0]])[:, None]
        return torch.from_numpy(prints.astype(np.float32)).to(layout_um.device)

    def _print(self, level: np.ndarray) -> np.ndarray:
        job = ElementJob(id="element", level=level, index=self.scans)
        rng = np.random.default_rng([self.seed, self.scans, _ROUGHNESS_STREAM])
        rough = surface_noise(job, self.printer, self.noise, self.knobs, rng)
        return cut_layout(print_clean(job, self.printer, self.knobs) + rough)


def is_fab(source: str | Path) -> bool:
    """Return True if ``source`` is a truth file written by ``litho-data simulate``, or a folder that contains
    one.
    """
    path = Path(source)
    return path.name == Truth.FILE_NAME or (path / Truth.FILE_NAME).is_file()


def load_fab(source: str | Path, layout: LayoutSettings) -> FabSimulator:
    """Load the virtual fab that a truth file describes.

    Raises:
        InputError: there is no truth file, the layout differs from the fab in pitch or level height, or the
            layout has more levels than the fab prints.
    """
    fab = FabSimulator(Truth.read(source))
    asked = {"pitch_um": layout.pitch_um, "level_height_um": layout.level_height_um}
    for name, value in asked.items():
        prints = getattr(fab.printer, name)
        if abs(prints - value) > 1e-9:
            raise InputError(
                f"{name} of the layout", got=f"{value:g} µm", wanted=f"{prints:g} µm, as the fab prints"
            )
    if layout.levels > fab.printer.levels:
        raise InputError("levels of the layout", got=layout.levels, wanted=f"at most {fab.printer.levels}")
    return fab
