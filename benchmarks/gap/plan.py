"""Define a comparison: the fab with its hidden effects, the arms (models used to make designs), the effort,
and the places in its folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record, Result

ARMS = ("none", "affine", "affine-mtf", "physics", "fno", "pbl", "pbl-scan-axis")
# These arms use the trained model of another arm, frozen with other options. By default, PBL leaves effects
# along the scan lines out of its printer, because scans in one orientation cannot show whether the printer or
# the microscope causes them. The other models include such effects. In this fab, the printer causes them, so
# only `pbl-scan-axis`, which includes them, contains as much as the other models.
FROZEN_WITH = {"pbl-scan-axis": ("pbl", ("--attribute", "scan-axis=printer"))}
# The strengths were chosen before any design was made, by one rule: each effect of the printer changes the
# training prints by 10 nm rms after the offset, gain, plane and bow of each scan are removed. The Physics
# model contains none of these effects, and two of them are not in the catalogue. The effects of the
# microscope are as large as in the measured prints. They do not act on designs.
PRINT_KNOBS = {
    "write-order-memory": 0.167,
    "slope-thinning-x": 0.346,
    "ghost-spot": 0.0847,
    "edge-bead": 0.107,
}
SCAN_KNOBS = {"scan-line-stripes": 8.0, "tilt-bow": 20.0, "min-to-zero-datum": 1.0}
_FULL_HOE_PX, _FULL_LENS_PX = 1024, 1200


class Effort(Record):
    """How much is printed, trained and designed. All arms of a task have the same number of iterations."""

    hoe_px: int = _FULL_HOE_PX
    lens_px: int = _FULL_LENS_PX
    hoe_iterations: int = 80
    lens_iterations: int = 100
    # The precision of the networks during the search. Prints, judges and scores always use float32.
    search_precision: str = "float32"
    seeds: int = 3
    # The tasks are repeated with smaller elements and more seeds, which gives narrower intervals.
    reduced_to: float = 0.25
    reduced_seeds: int = 10
    zoo_seeds: int = 1
    scans: int = 24
    scan_px: int = 512
    training_steps: int = 2000
    window_px: int = 158
    object_px: int = 96

    def side_px(self, kind: str, scale: float = 1.0) -> int:
        """Return the side of the elements, in pixels. ``kind`` is ``hoe``, or any other kind for a lens."""
        return round(scale * (self.hoe_px if kind == "hoe" else self.lens_px))

    def distance_um(self, kind: str, scale: float = 1.0) -> float:
        """Return the distance of the image from the element in µm. It is proportional to the size of the
        element. At full size, it is 300 µm for holograms and 400 µm for lenses.
        """
        full_um, full_px = (300, _FULL_HOE_PX) if kind == "hoe" else (400, _FULL_LENS_PX)
        return round(full_um * self.side_px(kind, scale) / full_px, 3)

    @classmethod
    def small(cls, size_px: int) -> Effort:
        """Return a small effort for trying the benchmark. Its elements are ``size_px`` pixels wide."""
        return cls(
            hoe_px=size_px,
            lens_px=size_px,
            hoe_iterations=6,
            lens_iterations=6,
            seeds=2,
            reduced_to=1.0,
            reduced_seeds=2,
            scans=4,
            scan_px=128,
            training_steps=4,
            window_px=64,
            object_px=32,
        )


class Plan(Result):
    """The settings of the comparison in a folder, which are stored there as ``plan.json``."""

    SCHEMA: ClassVar[str] = "litho-design/benchmark-gap-plan/1"
    FILE_NAME: ClassVar[str] = "plan.json"

    effort: Effort
    print_knobs: dict[str, float] = PRINT_KNOBS
    scan_knobs: dict[str, float] = SCAN_KNOBS
    corrected: str | None = None


def open_plan(out: Path, effort: Effort, corrected: str | None) -> Plan:
    """Write the plan into the folder. If the folder already contains a plan, check that it is the same.

    Raises:
        InputError: the folder contains a comparison with other settings.
    """
    plan = Plan(effort=effort, corrected=corrected)
    if not (out / Plan.FILE_NAME).exists():
        plan.write(out)
    elif Plan.read(out) != plan:
        raise InputError(
            f"comparison in {out}",
            got="other settings",
            wanted=f"those of its {Plan.FILE_NAME}",
            hint="choose another --out",
        )
    return plan


def store(out: Path, name: str) -> Path:
    """Return the path of the dataset store with the prints of a fab."""
    return out / f"{name}.zarr"


def trained_as(arm: str) -> tuple[str, tuple[str, ...]]:
    """Return the name of the trained model from which an arm is frozen, and the options of ``freeze`` for
    it.
    """
    return FROZEN_WITH.get(arm, (arm, ()))


def model(out: Path, name: str) -> Path:
    """Return the folder of the frozen model of an arm."""
    return out / "models" / name
