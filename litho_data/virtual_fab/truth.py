"""Define the record of the truth about a simulated run. It contains the knobs of the run, the positions of
the scans, and the noise in the scans. When a dataset is built from the run, this record must not be read.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from litho_data.foundation import YX, Array
from litho_data.foundation.results import Record, Result
from litho_data.level import level_polynomial
from litho_data.virtual_fab.knobs import KNOBS, KnobSetting
from litho_data.virtual_fab.settings import Microscope, Noise, Printer


class KnobTruth(Record):
    """The record of one knob that was set in the run."""

    name: str
    effect: str
    stage: str
    role: str
    strength: float
    unit: str
    seed: int

    @classmethod
    def of(cls, setting: KnobSetting, run_seed: int) -> KnobTruth:
        """Return the record of a knob's setting. If the setting has no seed, the record contains the seed of
        the run, which was used in its place.
        """
        knob = KNOBS[setting.name]
        return cls(
            name=knob.name,
            effect=knob.effect,
            stage=knob.stage,
            role=knob.role,
            strength=setting.strength,
            unit=knob.unit,
            seed=run_seed if setting.seed is None else setting.seed,
        )

    @property
    def setting(self) -> KnobSetting:
        """Return the setting of the knob with the seed that was used, so that the same effect can be made
        again.
        """
        return KnobSetting(self.name, self.strength, self.seed)


class ScanTruth(Record):
    """The record of one scan. It contains the scan's position, its datum (height offset), and its noise
    floor, i.e. the error that would remain even with perfect models of printer and AFM.
    """

    id: str
    use: str
    dose: float
    order: float
    field_um: YX
    scan_shape: tuple[int, int]
    scan_to_layout: list[list[float]]
    datum_nm: float
    floor_mae_nm: float
    floor_rmse_nm: float
    floor_full_mae_nm: float
    floor_full_rmse_nm: float


class Truth(Result):
    """The record ``truth.json`` of a simulated run.

    In the same folder, ``prints/<id>.npy`` contains the print of each scan without roughness, and
    ``surfaces/<id>.npy`` contains the print with roughness. Both files contain heights in µm on the layout's
    grid. ``settings`` contains the settings of the fields that were printed.
    """

    SCHEMA: ClassVar[str] = "litho-data/virtual-fab/1"
    FILE_NAME: ClassVar[str] = "truth.json"

    seed: int
    printer: Printer
    microscope: Microscope
    noise: Noise
    knobs: list[KnobTruth]
    settings: dict[str, Any]
    scans: list[ScanTruth]


def noise_floor(noise_um: Array) -> dict[str, float]:
    """Return the mean (offset), the mean absolute value and the root mean square of the noise in one scan, in
    nm.

    For the values ``floor_full_mae_nm`` and ``floor_full_rmse_nm``, offset, tilt and bow are removed from the
    noise. For ``floor_mae_nm`` and ``floor_rmse_nm``, only the offset is removed.
    """
    centred_nm = 1e3 * (noise_um - noise_um.mean())
    bent_nm = level_polynomial(centred_nm, total_degree=2).height
    return {
        "datum_nm": float(1e3 * noise_um.mean()),
        "floor_mae_nm": float(np.abs(centred_nm - np.median(centred_nm)).mean()),
        "floor_rmse_nm": float(centred_nm.std()),
        "floor_full_mae_nm": float(np.abs(bent_nm).mean()),
        "floor_full_rmse_nm": float(bent_nm.std()),
    }
