"""Level a measured height map of the printed part, and register it to its layout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.hashes import file_sha256
from litho_data.scan import Scan
from litho_design.images.measurements import Levelling, MeasuredSource
from litho_design.images.noise import white_noise
from litho_design.judging.loaded import LoadedDesign
from litho_design.scans.background import (
    FITTED_ORDERS,
    fitted_background,
    print_terms_sd_um,
    substrate_background,
)
from litho_design.scans.dust import foreign_pixels
from litho_design.scans.placing import as_it_lies, registered
from litho_design.scans.record import MeasuredRecord

# Smallest share of the element that must be measured. With fewer measured pixels, the score would depend too
# much on the filled-in part.
_SMALLEST_COVERAGE = 0.8
# Smallest correlation between a scan and the expected print at which the scan is accepted. After levelling,
# the prints of the measured layouts have a correlation of 0.9 or more with the print that a model predicts.
_SMALLEST_NCC = 0.6
_SMALLEST_FOR_TIP = 64


def measured_print(loaded: LoadedDesign, source: MeasuredSource) -> tuple[Tensor, MeasuredRecord, Tensor]:
    """Resample the measured heights of a printed design onto the pixels of its layout.

    The zero of an AFM map is arbitrary, and a constant height is only a constant phase. The zero is therefore
    set so that the median difference between the measured and the expected print is 0. The expected print is
    the one that was predicted when the layout was designed. Tilt and bow of the scanner are fitted to the
    bare substrate around the print. If the scan does not show enough of it, they are fitted together with the
    gain of the expected print, so that the tilt and bow of the expected print are not removed. Unmeasured
    pixels are filled with the heights of the expected print.

    Args:
        loaded: the design.
        source: the scan, in any format that ``litho-data inspect`` reads.

    Returns:
        The height of the print, µm, shape (size, size), the record of the measurement, and a map of the same
        shape. It contains the height, µm, that the print itself may have in addition where it was taken for
        dust or a scar.

    Raises:
        InputError: the scan cannot be registered, covers too little of the element, or does not resemble the
            expected print.
    """
    from litho_data.readers import read_scan

    require_known("levelling", source.levelling, get_args(Levelling))
    if not source.scale_sd >= 0:
        raise InputError("uncertainty of the height scale", got=source.scale_sd, wanted="0 or more")
    layout = loaded.record.layout
    size_um = (source.size_um,) * 2 if isinstance(source.size_um, float) else source.size_um
    scan = read_scan(source.path, unit=source.unit, size_um=size_um)
    place = as_it_lies if source.aligned else registered
    scan, tip_um, tip_change_um = _without_tip(scan, source.tip_um)
    placed = place(scan, loaded.level.cpu().numpy(), layout.pitch_um)
    height, valid = (placed.inner(one) for one in (placed.height_um, placed.valid))
    coverage = float(valid.mean())
    _check_coverage(source, coverage, "a hologram needs its whole area; stitch the scans first")
    expected = loaded.expected_um.cpu().numpy()
    bare = substrate_background(placed, layout.pitch_um, source.levelling)
    background = bare or fitted_background(height, expected, valid, layout.pitch_um, source.levelling)
    defects = foreign_pixels(np.where(valid, height - background.map_um - expected, 0.0), expected, valid)
    valid = valid & ~defects
    _check_coverage(source, float(valid.mean()), "clean the sample; dust and scars cover the rest")
    background = bare or fitted_background(height, expected, valid, layout.pitch_um, source.levelling)
    levelled = height - background.map_um
    ncc = float(np.corrcoef(levelled[valid], expected[valid])[0, 1])
    if not ncc >= _SMALLEST_NCC:
        raise InputError(
            f"scan {source.path}",
            got=f"a correlation of {ncc:.2f} with the print that the design expects",
            wanted=f"at least {_SMALLEST_NCC}",
            hint="use --scan-levelling bow" if source.levelling != "bow" else "",
        )
    offset = float(np.median(levelled[valid] - expected[valid]))
    complete = np.where(valid, levelled - offset, expected).astype(np.float32)
    # Up to the nominal height of the highest level, the print itself may be what looks like dust.
    plausible = np.clip(levelled - offset, 0, (layout.levels - 1) * layout.level_height_um)
    doubt = np.where(defects, plausible - expected, 0.0).astype(np.float32)
    terms = sum(order + 1 for order in FITTED_ORDERS[source.levelling])
    removed_sd_um = bare.sd_um if bare else [print_terms_sd_um(complete - expected, expected)] * terms
    record = MeasuredRecord(
        name=Path(source.path).name,
        sha256=file_sha256(source.path),
        coverage=coverage,
        registration_ncc=ncc,
        height_offset_um=offset,
        aligned=source.aligned,
        orientation=placed.orientation,
        warning=placed.warning,
        levelling=source.levelling,
        levelled_on="substrate" if bare else "print",
        tilt_um_per_um=background.tilt_um_per_um,
        bow_um=background.bow_um,
        removed_sd_um=removed_sd_um,
        noise_um=placed.noise_factor * white_noise(complete - expected),
        warp_errors_um=(layout.pitch_um * placed.warp_errors_px).tolist(),
        scale_sd=source.scale_sd,
        defect_share=float(defects.mean()),
        tip_um=tip_um,
        tip_change_um=tip_change_um,
    )
    return torch.from_numpy(complete).to(loaded.device), record, torch.from_numpy(doubt).to(loaded.device)


def _check_coverage(source: MeasuredSource, share: float, hint: str) -> None:
    if share < _SMALLEST_COVERAGE:
        raise InputError(
            f"scan {source.path}",
            got=f"{100 * share:.0f} % of the element",
            wanted=f"at least {100 * _SMALLEST_COVERAGE:.0f} %",
            hint=hint,
        )


def _without_tip(scan: Scan, tip_um: float | None) -> tuple[Scan, float, float]:
    """Correct a scan for the AFM tip, which makes structures wider. Return the corrected scan, the radius of
    the tip, µm, and the rms change of the heights, µm.
    """
    from litho_data.tip import estimate_tip, paraboloid_erosion

    radius_um = tip_um
    if radius_um is None and min(scan.height_um.shape) >= _SMALLEST_FOR_TIP:
        found = estimate_tip([scan])
        radius_um = found.radius_um if found.kind == "estimate" else None
    if not radius_um:
        return scan, 0.0, 0.0
    if not radius_um > 0:
        raise InputError("radius of the tip", got=f"{radius_um} µm", wanted="a positive length, or 0")
    surface = paraboloid_erosion(scan.height_um, scan.require_pitch(), radius_um).surface
    change_um = float(np.nanstd(surface - scan.height_um))
    return replace(scan, height_um=surface), radius_um, change_um
