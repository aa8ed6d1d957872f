"""The folder of a finished design: the record design.json, the levels, the predicted print and the image."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts, run_facts
from litho_design.images.targets import TargetRecord
from litho_design.optics import Optics
from litho_design.optics.stroke import Stroke
from litho_design.optimisation.budget import peak_memory_gib
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import PrinterRecord, TilingCheck
from litho_design.printers.training import OutOfDistribution
from litho_design.tasks.width import Width

LEVELS_FILE = "layout_level.npy"
HEIGHT_FILE = "predicted_height_um.npy"
IMAGE_FILE = "image_share.npy"
TARGET_FILE = "target.npy"
# File of the levels of a lens that consists of rings. It contains one level per pixel along one radius,
# instead of the levels on a plane.
RINGS_FILE = "ring_level.npy"
RING_HEIGHT_FILE = "ring_height_um.npy"
# Name of the subfolder for the designs in the folder of a result that contains several designs.
DESIGNS = "designs"


class RunRecord(RunFacts):
    """Command, software, device and duration of a run. The duration includes earlier runs that were
    interrupted.
    """

    device: str
    threads: int
    seconds: float
    seconds_per_iteration: float
    peak_memory_gib: float

    @classmethod
    def of(cls, device: torch.device, seconds: float, seconds_per_iteration: float) -> RunRecord:
        """Make the record of the run that this process is finishing."""
        return cls(
            **run_facts(),
            device=str(device),
            threads=torch.get_num_threads(),
            seconds=seconds,
            seconds_per_iteration=seconds_per_iteration,
            peak_memory_gib=peak_memory_gib(device),
        )


class Findings(Record):
    """What a task reports about the levels of the finished design and about their predicted print.

    ``thick`` contains the scores of the same print if it is treated as a thick element.
    """

    tiling: TilingCheck | None = None
    out_of_distribution: OutOfDistribution | None = None
    reference_efficiency: float | None = None
    predicted: dict[str, float]
    baselines: dict[str, dict[str, float]] | None = None
    thick: dict[str, float] | None = None


class Design(Findings, Result):
    """The contents of design.json. ``ensemble_sha256`` contains the SHA-256 of the weights of each further
    model that the search used; it is empty if the search used only ``printer``.
    """

    SCHEMA: ClassVar[str] = "litho-design/design/1"
    FILE_NAME: ClassVar[str] = "design.json"
    FORMER: ClassVar[frozenset[str]] = frozenset({"ensemble", "printability"})

    task: str
    variant: str
    fingerprint: str
    run: RunRecord
    settings: dict[str, Any]
    layout: LayoutSettings
    optics: Optics
    target: TargetRecord | None = None
    printer: PrinterRecord
    ensemble_sha256: list[str] = Field(default_factory=list)
    stroke: Stroke
    notes: list[str] = Field(default_factory=list)
    iterations: int
    start_loss: float
    sample_loss: float
    argmax_loss: float
    polished_loss: float
    width: Width | None = None
    files: dict[str, str]

    @property
    def in_rings(self) -> bool:
        """Return True if the levels and heights of the design lie along a radius instead of on a plane."""
        return RINGS_FILE in self.files

    @property
    def layout_sha256(self) -> str:
        """Return the SHA-256 of the file that contains the levels."""
        return self.files[RINGS_FILE if self.in_rings else LEVELS_FILE]


def write_arrays(folder: Path, arrays: dict[str, np.ndarray]) -> dict[str, str]:
    """Save each array under its file name, and save the levels also as a 16-bit greyscale PNG. Return a dict
    from file name to SHA-256.
    """
    hashes = {}
    for name, array in arrays.items():
        with atomic_file(folder / name) as temporary, open(temporary, "wb") as stream:
            np.save(stream, array, allow_pickle=False)
        hashes[name] = file_sha256(folder / name)
    if LEVELS_FILE in arrays:
        import cv2

        picture = folder / Path(LEVELS_FILE).with_suffix(".png")
        encoded = cv2.imencode(".png", arrays[LEVELS_FILE].astype(np.uint16))[1]
        with atomic_file(picture) as temporary:
            temporary.write_bytes(encoded.tobytes())
        hashes[picture.name] = file_sha256(picture)
    return hashes


def read_array(folder: str | Path, name: str, *, on_disk: bool = False) -> np.ndarray:
    """Read one array of a design folder, and check its file against the hash in the record.

    With ``on_disk``, the file is memory-mapped instead of read completely.

    Raises:
        InputError: there is no such file, or the file was changed after the design was written.
    """
    path = Path(folder) / name
    wanted = Design.read(folder).files.get(name)
    if wanted is None or not path.exists():
        raise InputError(f"array {name}", got=f"no such file in {folder}", wanted="a complete design folder")
    if file_sha256(path) != wanted:
        raise InputError(
            f"array {path}", got="a file that changed after the design", wanted=f"SHA-256 {wanted}"
        )
    found: np.ndarray = np.load(path, mmap_mode="r" if on_disk else None, allow_pickle=False)
    return found
