"""A finished design, read back from its folder: any judge can print and score it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.results import Record
from litho_design.holograms.bench import HologramBench
from litho_design.holograms.settings import HologramSettings
from litho_design.lenses.bench import LensBench
from litho_design.lenses.objects import picture_records
from litho_design.lenses.score import score_lens
from litho_design.lenses.settings import ImagingSettings, LensSettings
from litho_design.printers.printer import Printer
from litho_design.printers.source import check_device
from litho_design.tasks.design import HEIGHT_FILE, LEVELS_FILE, PICTURES_FILE, TARGET_FILE, Design, read_array


class LoadedDesign:
    """The layout of a design folder, its optics and its scores, for holograms and lenses alike.

    Attributes:
        folder: where it lies.
        record: what ``design.json`` holds.
        level: layout (size, size).
        expected_um: height (size, size), µm, of the print that the design expects.
        target: wanted image (size, size) of a hologram; None for a lens.
        bench: the optics, from a height map to an image or a PSF.

    Args:
        folder: a design folder; its arrays are checked against the hashes in the record.
        device: where prints and waves are computed.

    Raises:
        InputError: an incomplete or altered folder, or a device that this machine does not have.
    """

    def __init__(self, folder: str | Path, *, device: str | torch.device = "cpu"):
        check_device(device)
        self.folder, self.record = Path(folder), Design.read(folder)
        self.device = torch.device(device)
        self.level = self._load(folder, LEVELS_FILE)
        self.expected_um = self._load(folder, HEIGHT_FILE)
        self.target = self._load(folder, TARGET_FILE) if TARGET_FILE in self.record.files else None
        if self.record.task == "hoe":
            self.hologram = HologramSettings.model_validate(self.record.settings)
            self.bench: HologramBench | LensBench = HologramBench(self.record.layout, self.record.optics)
        else:
            self.lens = LensSettings.model_validate(self.record.settings)
            self.bench = LensBench(self.record.layout, self.record.optics, self.lens.view)
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

    def score(self, height_um: Tensor) -> Record:
        """Score of a print (size, size), µm."""
        if isinstance(self.bench, LensBench):
            return score_lens(self.lens, self.bench, height_um, self.expected_um, self.pictures)
        assert self.target is not None
        return self.bench.score(height_um, self.target, self.hologram.camera)

    def display(self, image: np.ndarray) -> np.ndarray:
        """The image as reports show it: scaled to its target, or the root of a PSF over its peak."""
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
        return imaging.object_px * imaging.pixel_px * self.record.layout.pitch_um

    def _read_pictures(self, folder: str | Path, imaging: ImagingSettings) -> dict[str, np.ndarray]:
        records = picture_records((*imaging.objects, *imaging.test_objects))
        if not records:
            return {}
        pixels = read_array(folder, PICTURES_FILE)
        return {record.sha256: picture for record, picture in zip(records, pixels, strict=True)}

    def _load(self, folder: str | Path, name: str) -> Tensor:
        return torch.from_numpy(read_array(folder, name)).to(self.device)


def load_design(folder: str | Path, *, device: str | torch.device = "cpu") -> LoadedDesign:
    """The finished design in ``folder``, ready to be printed and scored on ``device``.

    Raises:
        InputError: an incomplete or altered folder, or a device that this machine does not have.
    """
    return LoadedDesign(folder, device=device)
