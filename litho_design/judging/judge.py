"""A finished design, ready to be printed by any judge: one door for holograms and lenses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.results import Record
from litho_design.lens.bench import ImagingSettings, LensBench
from litho_design.lens.metrics import score_lens
from litho_design.lens.objects import picture_records
from litho_design.printers.printer import Printer
from litho_design.printers.source import check_device
from litho_design.tasks.design import HEIGHT_FILE, LEVELS_FILE, PICTURES_FILE, TARGET_FILE, Design, read_array
from litho_design.tasks.hologram import HologramBench
from litho_design.tasks.settings import HoeSettings, LensSettings


class Judging:
    """The layout of a design folder, its optics and its figures.

    Args:
        folder: a design folder; its arrays are checked against the hashes in the record.
        device: where prints and waves are computed.

    Raises:
        InputError: an incomplete or altered folder, or a device that this machine does not have.
    """

    def __init__(self, folder: str | Path, *, device: str | torch.device = "cpu"):
        check_device(device)
        self.design = Design.read(folder)
        self.device = torch.device(device)
        self.level = self._load(folder, LEVELS_FILE)
        self.expected_um = self._load(folder, HEIGHT_FILE)
        self.target = self._load(folder, TARGET_FILE) if TARGET_FILE in self.design.files else None
        if self.design.task == "hoe":
            self._hoe = HoeSettings.model_validate(self.design.settings)
            self.bench: HologramBench | LensBench = HologramBench(self.design.layout, self.design.optics)
        else:
            self.lens = LensSettings.model_validate(self.design.settings)
            self.bench = LensBench(self.design.layout, self.design.optics, self.lens.view)
            self.pictures = self._read_pictures(folder, self.lens.imaging)
        self.bench.to(self.device)

    @torch.no_grad()
    def printed_um(self, judge: Printer) -> Tensor:
        """Height (size, size), µm, that ``judge`` prints from the layout."""
        return judge(self.level[None, None].float())[0, 0]

    @torch.no_grad()
    def image(self, height_um: Tensor) -> np.ndarray:
        """Image or PSF behind a print: share of the incident power per pixel."""
        return self.bench(height_um).cpu().numpy()

    def figures(self, height_um: Tensor) -> Record:
        """All figures of a print."""
        if isinstance(self.bench, LensBench):
            return score_lens(self.lens, self.bench, height_um, self.expected_um, self.pictures)
        assert self.target is not None
        return self.bench.score(height_um, self.target, self._hoe.camera)

    def display(self, image: np.ndarray) -> np.ndarray:
        """As pictures show it: a hologram at the scale of its target, a PSF as the root over its peak."""
        if self.target is None:
            return np.sqrt(image / image.max())
        target = self.target.cpu().numpy()
        return (image * target).sum() / max(float((image**2).sum()), 1e-30) * image

    @property
    def window_um(self) -> float:
        """Side of the image or of the PSF window, µm."""
        return (self.bench.window if isinstance(self.bench, LensBench) else self.bench.grid).size_um[0]

    @property
    def frame_um(self) -> float:
        """Side of what a lens images, or of the image of a hologram, µm."""
        if self.target is not None:
            return self.window_um
        imaging = self.lens.imaging
        return imaging.object_px * imaging.pixel_px * self.design.layout.pitch_um

    def _read_pictures(self, folder: str | Path, imaging: ImagingSettings) -> dict[str, np.ndarray]:
        records = picture_records((*imaging.objects, *imaging.test_objects))
        if not records:
            return {}
        pixels = read_array(folder, PICTURES_FILE)
        return {record.sha256: picture for record, picture in zip(records, pixels, strict=True)}

    def _load(self, folder: str | Path, name: str) -> Tensor:
        return torch.from_numpy(read_array(folder, name)).to(self.device)
