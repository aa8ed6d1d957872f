"""What ordinary prints say about the noise when no flat, step or repeated print was made.

No estimate here is the floor: each says what it contains, what it lacks, and on which side it errs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness import split_noise
from litho_data.store import PrintedScan, Store
from litho_data.store.access import has_child
from litho_models.noise.neighbourhoods import neighbourhood_noise
from litho_models.noise.spread_scores import GAUSSIAN_MAE
from litho_models.noise.surface import without_background
from litho_models.scoring.statistics import interval

Direction = Literal["lower bound", "upper bound", "estimate", "control"]
# Above this frequency a Gaussian spot of 0.2 µm passes less than 1 %: √(ln 100 / 2π²) / 0.2 µm.
PRINTER_CUTOFF_PER_UM = float(np.sqrt(np.log(100) / (2 * np.pi**2)) / 0.2)


class NoiseBound(Record):
    """One estimate of the noise, nm.

    Args:
        name: what was measured.
        of: which noise is meant: ``pixel`` (white), ``line`` (offsets of scan lines) or ``all``.
        direction: on which side of that noise it errs.
        sigma_nm: mean over scans, ``ci95_nm`` its interval over scans; ``mae_nm`` the mean absolute
            value, 0.798 σ unless measured.
        contains, lacks: in words.
    """

    name: str
    of: Literal["pixel", "line", "all"]
    direction: Direction
    sigma_nm: float
    ci95_nm: tuple[float, float] | None
    mae_nm: float
    scans: int
    contains: str
    lacks: str


def noise_bounds(store: Store, scans: Sequence[PrintedScan], seed: int = 0) -> list[NoiseBound]:
    """All estimates that these scans allow; repeated prints count only if there are some."""
    bounds = _differences(store, scans)
    bounds.append(_high_band(scans))
    for bound in (repeated_prints(scans), _neighbourhoods(scans, seed)):
        if bound is not None:
            bounds.append(bound)
    return bounds


def high_band_sigma_nm(height_um: np.ndarray, pitch_um: float, cutoff_per_um: float) -> float:
    """Root mean square of what lies above ``cutoff_per_um`` along x or along y, nm.

    From the two-dimensional spectrum under a Hann window, whose power is divided out.
    """
    deviation = NM_PER_UM * without_background(height_um, "quadratic")
    ny, nx = deviation.shape
    window = np.outer(np.hanning(ny + 2)[1:-1], np.hanning(nx + 2)[1:-1])
    power = np.abs(np.fft.fft2(deviation * window)) ** 2 / (np.sum(window**2) * deviation.size)
    fy, fx = (np.abs(np.fft.fftfreq(size, pitch_um)) for size in (ny, nx))
    beyond = (fy[:, None] > cutoff_per_um) | (fx[None, :] > cutoff_per_um)
    return float(np.sqrt(power[beyond].sum()))


def repeated_prints(scans: Sequence[PrintedScan]) -> NoiseBound | None:
    """Half the variance between prints of one layout at one dose, each pair freed of a quadratic."""
    groups: dict[tuple[object, ...], list[PrintedScan]] = {}
    for scan in scans:
        groups.setdefault((scan.shape, scan.dose, scan.mask_level.tobytes()), []).append(scan)
    sigmas, absolute, members = [], [], set()
    for group in groups.values():
        for number, first in enumerate(group):
            for second in group[number + 1 :]:
                both = first.valid & second.valid
                difference = np.where(both, first.height_um - second.height_um, np.nan)
                if np.isfinite(difference).sum() < 64:
                    continue
                rest = NM_PER_UM * without_background(difference, "quadratic")
                rest = rest[np.isfinite(rest)] / np.sqrt(2)
                sigmas.append(float(np.sqrt(np.mean(rest**2))))
                absolute.append(float(np.abs(rest).mean()))
                members |= {first.id, second.id}
    if not sigmas:
        return None
    sigma = float(np.sqrt(np.mean(np.square(sigmas))))
    return NoiseBound(
        name="repeated prints, half the variance of their difference",
        of="all",
        direction="estimate",
        sigma_nm=sigma,
        ci95_nm=interval(sigmas),
        mae_nm=float(np.mean(absolute)),
        scans=len(members),
        contains="print and microscope noise, registration error at edges; offset and bow of a pair removed",
        lacks="whatever repeats from print to print",
    )


def _differences(store: Store, scans: Sequence[PrintedScan]) -> list[NoiseBound]:
    splits = [split_noise(_measured(store, scan)) for scan in scans]
    topography = "white pixel noise and the topography's own bend over two pixels"
    slow = "drift, lines, roughness longer than two pixels"
    line = np.array([split.line_nm for split in splits])
    column = np.array([split.column_nm for split in splits])
    excess = np.sqrt(np.maximum(0.0, line**2 - column**2))
    return [
        _bound("second differences along x", "pixel", "upper bound", [s.pixel_nm for s in splits],
               topography, slow),
        _bound("second differences along y", "pixel", "upper bound", [s.pixel_slow_nm for s in splits],
               topography + ", and line offsets if x is the fast axis", slow),
        _bound("steps between the medians of neighbouring rows", "line", "upper bound", line.tolist(),
               "offsets of rows, and what the layout changes from row to row", "what all rows share"),
        _bound("the same between columns", "line", "control", column.tolist(),
               "what the layout changes from column to column", "offsets of rows"),
        _bound("rows beyond columns, in quadrature", "line", "estimate", excess.tolist(),
               "offsets of rows, of the print or of the microscope",
               "what rows and columns share; a layout that differs between the axes counts wrongly"),
    ]  # fmt: skip


def _high_band(scans: Sequence[PrintedScan]) -> NoiseBound:
    sigmas = []
    for scan in scans:
        inside = _largest_measured(scan)
        sigmas.append(high_band_sigma_nm(inside, scan.pitch_um, PRINTER_CUTOFF_PER_UM))
    return _bound(
        f"power above {PRINTER_CUTOFF_PER_UM:.1f} cycles/µm, on the layout grid",
        "all",
        "lower bound",
        sigmas,
        "all noise in the band that a spot of 0.2 µm (σ) passes with less than 1 %; edges that the printer "
        "makes sharper than that would count too",
        "all noise at lower frequencies, where line-shaped roughness has most of its power; what the "
        "resampling onto the layout smoothed away",
    )


def _neighbourhoods(scans: Sequence[PrintedScan], seed: int) -> NoiseBound | None:
    found = neighbourhood_noise(scans, seed=seed)
    if found is None:
        return None
    return NoiseBound(
        name="pixels whose layout surroundings are alike, extrapolated to equal ones",
        of="all",
        direction="estimate",
        sigma_nm=found.sigma_nm,
        ci95_nm=found.ci95_nm,
        mae_nm=found.mae_nm,
        scans=found.scans,
        contains="all that the layout within about 3 µm does not decide: roughness, microscope, lines, bow "
        "and slow drift within a scan; each scan's offset removed",
        lacks="noise shared by places 4 µm apart in one scan; a model that knows the position may do better",
    )


def _bound(
    name: str,
    of: Literal["pixel", "line", "all"],
    direction: Direction,
    values: Sequence[float],
    contains: str,
    lacks: str,
) -> NoiseBound:
    sigma = float(np.mean(values))
    return NoiseBound(
        name=name,
        of=of,
        direction=direction,
        sigma_nm=sigma,
        ci95_nm=interval(values),
        mae_nm=GAUSSIAN_MAE * sigma,
        scans=len(values),
        contains=contains,
        lacks=lacks,
    )


def _measured(store: Store, scan: PrintedScan) -> np.ndarray:
    """Height in the scan's own frame, where resampling has not smoothed it; else on the layout grid."""
    if has_child(store.root, f"scans/{scan.id}"):
        return _finite_rectangle(store.scan_frame(scan.id, "levelled_height_um"))
    return _largest_measured(scan)


def _largest_measured(scan: PrintedScan) -> np.ndarray:
    return _finite_rectangle(np.where(scan.valid, scan.height_um, np.nan))


def _finite_rectangle(height_um: np.ndarray) -> np.ndarray:
    """The field without the border rows and columns that hold unmeasured pixels; holes become the median."""
    finite = np.isfinite(height_um)
    top, bottom, left, right = 0, finite.shape[0], 0, finite.shape[1]
    while min(bottom - top, right - left) > 8:
        sides = {
            "top": finite[top, left:right].mean(),
            "bottom": finite[bottom - 1, left:right].mean(),
            "left": finite[top:bottom, left].mean(),
            "right": finite[top:bottom, right - 1].mean(),
        }
        worst = min(sides, key=lambda side: sides[side])
        if sides[worst] == 1:
            break
        top, bottom = top + (worst == "top"), bottom - (worst == "bottom")
        left, right = left + (worst == "left"), right - (worst == "right")
    field = height_um[top:bottom, left:right].astype(np.float64)
    return np.where(np.isfinite(field), field, np.nanmedian(field))
