"""A measured height map of the printed part, registered onto its layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record
from litho_design.judging.loaded import LoadedDesign

# With fewer measured pixels the score would describe the filled-in part more than the print.
_SMALLEST_COVERAGE = 0.8


class MeasuredRecord(Record):
    """The scan, its agreement with the expected print, and the share of the element that it covers."""

    name: str
    sha256: str
    coverage: float
    registration_ncc: float
    height_offset_um: float


def measured_print(
    loaded: LoadedDesign,
    scan_file: str | Path,
    *,
    unit: str | None = None,
    size_um: tuple[float, float] | None = None,
) -> tuple[Tensor, MeasuredRecord]:
    """The measured height of a printed design on its layout's pixels.

    The zero of an AFM map is arbitrary, and a constant height is only a constant phase: the zero is set so
    that the medians of measured and designed print agree. Unmeasured pixels take the designed print.

    Args:
        loaded: the design.
        scan_file: any format that ``litho-data inspect`` reads.
        unit, size_um: for files that do not state them.

    Returns:
        Height (size, size), µm, and its record.

    Raises:
        InputError: a scan that cannot be registered, or that covers too little of the element.
    """
    from litho_data.readers import read_scan
    from litho_data.register import register_scan, resample_to_layout

    scan = read_scan(scan_file, unit=unit, size_um=size_um)
    pitch = scan.require_pitch()
    layout = loaded.record.layout
    levels = loaded.level.cpu().numpy()
    registration = register_scan(
        scan.height_um, levels, scan_pitch_um=pitch, layout_pitch_um=layout.pitch_um, model="affine"
    )
    quality = registration.quality
    if not quality.passed:
        raise InputError(
            f"scan {scan_file} on the layout of the design", got=quality.reason, wanted="a match"
        )
    height, valid = resample_to_layout(
        scan.height_um,
        registration.scan_to_layout,
        levels.shape,
        scan_pitch_um=pitch,
        layout_pitch_um=layout.pitch_um,
        bend_um=registration.bend_um,
    )
    coverage = float(valid.mean())
    if coverage < _SMALLEST_COVERAGE:
        raise InputError(
            f"scan {scan_file}",
            got=f"{100 * coverage:.0f} % of the element",
            wanted=f"at least {100 * _SMALLEST_COVERAGE:.0f} %",
            hint="a hologram needs its whole area; stitch the scans first",
        )
    expected = loaded.expected_um.cpu().numpy()
    offset = float(np.median(height[valid] - expected[valid]))
    complete = np.where(valid, height - offset, expected).astype(np.float32)
    record = MeasuredRecord(
        name=Path(scan_file).name,
        sha256=file_sha256(scan_file),
        coverage=coverage,
        registration_ncc=float(np.corrcoef(height[valid], expected[valid])[0, 1]),
        height_offset_um=offset,
    )
    return torch.from_numpy(complete).to(loaded.device), record
