"""A finished design, read back from its folder, for any judge to print and score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.results import Record
from litho_data.reports.pictures import shown_html
from litho_design.holograms.task import HologramTask
from litho_design.lenses.task import LensTask
from litho_design.optics.thin_element import ElementKind
from litho_design.printers.printer import Printer
from litho_design.printers.source import check_device
from litho_design.reliefs.task import UNPRINTABLE_FILE
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, Design, read_array
from litho_design.tasks.task import Task, registered_task


class LoadedDesign:
    """The layout of a design folder, its optics and its scores, whatever its task.

    Attributes:
        folder: folder of the design.
        record: what ``design.json`` holds.
        level: layout (size, size).
        expected_um: height (size, size), µm, of the print that the design expects.
        task: what it was designed for.
        target: wanted image (size, size) of a hologram; None for other tasks.
        bench: the optics, from a height map to an image or a PSF.

    Args:
        folder: a design folder; its arrays are checked against the hashes in the record.
        device: where prints and waves are computed.
        element: ``thin`` or ``thick`` instead of the design's own (see ``Optics``).

    Raises:
        InputError: an incomplete or altered folder, a task that is not registered here, or a device that
            this machine does not have.
    """

    def __init__(
        self, folder: str | Path, *, device: str | torch.device = "cpu", element: ElementKind | None = None
    ):
        check_device(device)
        self.folder, self.record = Path(folder), Design.read(folder)
        if element is not None:
            optics = self.record.optics.model_copy(update={"element": element})
            settings = self.record.settings | {"optics": optics.model_dump()}
            self.record = self.record.model_copy(update={"optics": optics, "settings": settings})
        self.device = torch.device(device)
        self.level, self.expected_um = (self._tensor(name) for name in (LEVELS_FILE, HEIGHT_FILE))
        own = {LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE, UNPRINTABLE_FILE}
        arrays = [name for name in self.record.files if name.endswith(".npy") and name not in own]
        # The design is only scored, so its task needs a device but no model.
        nominal = Printer(None, self.record.layout, source="none").to(self.device)
        kind = registered_task(self.record.task)
        inputs = {name.removesuffix(".npy"): read_array(folder, name) for name in arrays}
        made = kind.settings_type.model_validate(self.record.settings)
        self.task: Task = kind(made, nominal, inputs=inputs)
        self.bench = self.task.bench
        self.target = self.task.target if isinstance(self.task, HologramTask) else None

    def __repr__(self) -> str:
        pitch_um, printer = self.record.layout.pitch_um, self.record.printer.name
        return (
            f"<LoadedDesign {self.record.task} in {self.folder}: {len(self.level)} px of {pitch_um:g} µm, "
            f"designed through {printer}>"
        )

    def _repr_html_(self) -> str:
        maps = {"layout (level)": self.level, "expected_height_um": self.expected_um}
        return shown_html(repr(self), **{name: one.cpu().numpy().astype(float) for name, one in maps.items()})

    @torch.no_grad()
    def printed_um(self, judge: Printer) -> Tensor:
        """Height (size, size), µm, of the layout as printed by ``judge``."""
        return judge(self.level[None, None].float())[0, 0]

    @torch.no_grad()
    def image(self, height_um: Tensor) -> np.ndarray:
        """Image or PSF behind a print: share of the incident power per pixel."""
        return self.bench(height_um).cpu().numpy()

    def score(self, height_um: Tensor) -> Record:
        """Score of a print (size, size), µm."""
        return self.task.score(height_um, self.expected_um)

    def display(self, image: np.ndarray) -> np.ndarray:
        """The image as reports show it: scaled to its target; for a PSF, the root of PSF over peak."""
        return self.task.display(image)

    @property
    def window_um(self) -> float:
        """Side of the image or of the PSF window, µm."""
        return self.bench.window.size_um[0]

    @property
    def frame_um(self) -> float:
        """Side of a lens's objects, or of the image of another task, µm."""
        if not isinstance(self.task, LensTask):
            return self.window_um
        imaging = self.task.settings.imaging
        return imaging.object_px * imaging.pixel_px * self.record.layout.pitch_um

    def _tensor(self, name: str) -> Tensor:
        return torch.from_numpy(read_array(self.folder, name)).to(self.device)


def task_named(name: str) -> type[Task]:
    """The task of that name; importing this module registers holograms, lenses and reliefs.

    Raises:
        InputError: no such task.
    """
    return registered_task(name)


def load_design(folder: str | Path, *, device: str | torch.device = "cpu") -> LoadedDesign:
    """The finished design in ``folder``, ready to be printed and scored on ``device``.

    Raises:
        InputError: what ``LoadedDesign`` refuses.
    """
    return LoadedDesign(folder, device=device)
