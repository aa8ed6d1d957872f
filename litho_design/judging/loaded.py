"""Read a finished design from its folder. Any model can then predict the print of the design, and this print
can be scored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.reports.pictures import shown_html
from litho_design.holograms.task import HologramTask
from litho_design.large.bands import BAND_PX, Bands
from litho_design.large.hologram import BandedHologram
from litho_design.large.lens import RingLens
from litho_design.lenses.task import LensTask
from litho_design.optics.thin_element import ElementKind, known_height
from litho_design.printers.printer import Printer
from litho_design.printers.source import check_device
from litho_design.reliefs.task import UNPRINTABLE_FILE
from litho_design.tasks.design import (
    HEIGHT_FILE,
    IMAGE_FILE,
    LEVELS_FILE,
    RING_HEIGHT_FILE,
    RINGS_FILE,
    Design,
    read_array,
)
from litho_design.tasks.task import Task, registered_task


class LoadedDesign:
    """A design of any task, read from its folder. It contains the layout and the optics, and it computes
    scores.

    Attributes:
        folder: folder of the design.
        record: the contents of ``design.json``.
        level: levels of the layout, shape (size, size).
        expected_um: height, µm, of the expected print, which was predicted when the layout was designed,
            shape (size, size).
        task: the task that the layout was designed for.
        target: target image of a hologram, shape (size, size), or None for other tasks.
        bench: the optics, which turn a height map into an image or a PSF.

    Args:
        folder: a design folder; its arrays are checked against the hashes in the record. For a lens of rings,
            levels and heights are given along a radius, not over a plane.
        device: where prints and waves are computed.
        element: ``thin`` or ``thick``; replaces the kind of element that the record states (see ``Optics``).
        band_px: if given, the print of a large hologram is predicted and scored in bands of at most this many
            rows.

    Raises:
        InputError: the folder is incomplete or was altered, the task is not registered here, this machine
            does not have the device, or bands are requested although the design is not a thin hologram.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        device: str | torch.device = "cpu",
        element: ElementKind | None = None,
        band_px: int | None = None,
    ):
        check_device(device)
        self.folder, self.record = Path(folder), Design.read(folder)
        if element is not None:
            optics = self.record.optics.model_copy(update={"element": element})
            settings = self.record.settings | {"optics": optics.model_dump()}
            self.record = self.record.model_copy(update={"optics": optics, "settings": settings})
        self.device = torch.device(device)
        of_rings = self.record.in_rings
        arrays = (RINGS_FILE, RING_HEIGHT_FILE) if of_rings else (LEVELS_FILE, HEIGHT_FILE)
        self.level, self.expected_um = (self._tensor(name) for name in arrays)
        self.task = self._task(band_px)
        self.bench = self.task.bench
        whole = isinstance(self.task, HologramTask) and self.task.in_one_piece
        self.target: Tensor | None = getattr(self.task, "target", None) if whole else None

    def _task(self, band_px: int | None) -> Task:
        """Return the task of the design. It needs a device but no model of the printer, because it is used
        only to compute scores.
        """
        record, kind = self.record, registered_task(self.record.task)
        nominal = Printer(None, record.layout, source="none").to(self.device)
        made: Any = kind.settings_type.model_validate(record.settings)
        if record.in_rings:
            return RingLens(made, nominal, BAND_PX)
        own = {LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE, UNPRINTABLE_FILE}
        names = [name for name in record.files if name.endswith(".npy") and name not in own]
        inputs = {name.removesuffix(".npy"): read_array(self.folder, name) for name in names}
        if band_px is None:
            return kind(made, nominal, inputs=inputs)
        if kind is not HologramTask:
            raise InputError("design to score in bands", got=record.task, wanted="a hologram")
        return BandedHologram(made, nominal, Bands(record.layout.size_px, band_px), inputs=inputs)

    def __repr__(self) -> str:
        pitch_um, printer = self.record.layout.pitch_um, self.record.printer.name
        return (
            f"<LoadedDesign {self.record.task} in {self.folder}: {len(self.level)} px of {pitch_um:g} µm, "
            f"designed through {printer}>"
        )

    def _repr_html_(self) -> str:
        maps = {"layout (level)": self.level, "expected_height_um": self.expected_um}
        shown = {name: np.atleast_2d(one.cpu().numpy()).astype(float) for name, one in maps.items()}
        return shown_html(repr(self), **shown)

    @torch.no_grad()
    def printed_um(self, judge: Printer) -> Tensor:
        """Return the printed height, µm, that ``judge`` predicts for the layout, shape (size, size)."""
        self.task.check_printer(judge)
        return self.task.printed_um(self.level, judge)

    @torch.no_grad()
    def image(self, height_um: Tensor | np.ndarray) -> np.ndarray:
        """Return the image or PSF behind a print. Each pixel gives its share of the incident power."""
        return self.bench(known_height(height_um, self.expected_um)).cpu().numpy()

    def score(self, height_um: Tensor | np.ndarray) -> Record:
        """Return the score of a print, given as heights in µm of shape (size, size)."""
        return self.task.score(known_height(height_um, self.expected_um), self.expected_um)

    def display(self, image: np.ndarray) -> np.ndarray:
        """Return a picture of ``image`` for reports. The image of a hologram is scaled to match its target.
        For a PSF, the picture is sqrt(PSF / peak).
        """
        return self.task.display(image)

    @property
    def window_um(self) -> float:
        """Return the side of the image or of the PSF window, µm."""
        return self.bench.window.size_um[0]

    @property
    def frame_um(self) -> float:
        """Return the side, µm, of the objects of a lens or, for other tasks, the side of the image."""
        if not isinstance(self.task, LensTask):
            return self.window_um
        imaging = self.task.settings.imaging
        return imaging.object_px * imaging.pixel_px * self.record.layout.pitch_um

    def _tensor(self, name: str) -> Tensor:
        return torch.from_numpy(read_array(self.folder, name)).to(self.device)


def load_design(folder: str | Path, *, device: str | torch.device = "cpu") -> LoadedDesign:
    """Return the finished design in ``folder``. Its prints are predicted and scored on ``device``.

    Raises:
        InputError: ``LoadedDesign`` rejects the folder or the device.
    """
    return LoadedDesign(folder, device=device)
