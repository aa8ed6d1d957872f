"""Held-out error of predictions, freed of chosen per-scan terms that were fitted on other pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects.measurement_height import CREEP_DECAYS
from litho_models.loop.prepared import Field
from litho_models.scan_terms.nuisance import (
    Half,
    calibration_blocks,
    calibration_stripes,
    least_squares,
    nuisance_basis,
    row_index,
    shrunk_line_offsets,
)
from litho_models.scoring.statistics import bootstrap_interval

Terms = frozenset[str]
# Per-scan terms by the measurement effect that they stand for, in the order in which they are tested.
TERMS_OF: dict[str, Terms] = {
    "datum-offset": frozenset({"offset"}),
    "z-gain": frozenset({"gain"}),
    "tilt-bow": frozenset({"bow"}),
    "slow-drift": frozenset({"drift"}),
    "registration-residual": frozenset({"warp", "distortion"}),
    "scan-line-stripes": frozenset({"rows"}),
    "line-roughness": frozenset({"print-rows"}),
}
# Offsets of lines, along the scan or along the layout; their halves are stripes of columns.
LINE_TERMS = frozenset({"rows", "print-rows"})
DATUM_FREE: Terms = frozenset({"offset"})


@dataclass(frozen=True)
class Score:
    """Errors of one set of predictions, one entry per scan, nm, and the residual maps, µm."""

    mae_nm: np.ndarray
    mse_nm2: np.ndarray
    degrees_of_freedom: float
    residual_um: list[np.ndarray]

    @property
    def mean_mae_nm(self) -> float:
        return float(self.mae_nm.mean())

    @property
    def rmse_nm(self) -> float:
        return float(np.sqrt(self.mse_nm2.mean()))

    def interval_nm(self, seed: int = 0) -> tuple[float, float]:
        """Bootstrap interval over scans of the mean absolute error."""
        low, high = bootstrap_interval(self.mae_nm.tolist(), seed=seed)
        return low, high


def score(
    fields: Sequence[Field],
    predictions: Sequence[np.ndarray],
    terms: Terms,
    seed: int,
    *,
    stripes: bool | None = None,
) -> Score:
    """Score predictions (y, x) µm; ``stripes`` forces alternate column stripes as the two halves."""
    maps, freedom = [], []
    for field, prediction in zip(fields, predictions, strict=True):
        residual, dof = cross_fit(
            field, prediction, terms, seed, stripes=bool(LINE_TERMS & terms) if stripes is None else stripes
        )
        maps.append(residual)
        freedom.append(dof)
    values = [m[np.isfinite(m)] * NM_PER_UM for m in maps]
    return Score(
        mae_nm=np.array([np.abs(v).mean() for v in values]),
        mse_nm2=np.array([(v**2).mean() for v in values]),
        degrees_of_freedom=float(np.mean(freedom)),
        residual_um=maps,
    )


def cross_fit(
    field: Field, prediction: np.ndarray, terms: Terms, seed: int, *, stripes: bool
) -> tuple[np.ndarray, float]:
    """Residual (y, x) µm, NaN where not scored, with the terms fitted on the other half; and their number."""
    difference = np.where(field.usable, field.scan.height_um - prediction, 0.0).astype(np.float64)
    residual = np.full(difference.shape, np.nan)
    basis = term_maps(prediction, terms, field.line)
    if not terms:
        residual[field.usable] = difference[field.usable]
        return residual, 0.0
    freedom = []
    for half in _halves(difference.shape, seed, stripes):
        calibrate, scored = half.calibrate & field.usable, half.score & field.usable
        nuisance = np.tensordot(least_squares(basis[:, calibrate], difference[calibrate]), basis, axes=1)
        dof = float(len(basis))
        for term in sorted(LINE_TERMS & terms):
            line = field.line if term == "rows" else row_index(difference.shape)
            offsets, weight, _ = shrunk_line_offsets(difference - nuisance, calibrate, line)
            nuisance = nuisance + offsets[line]
            dof += float(weight.sum())
        residual[scored] = (difference - nuisance)[scored]
        freedom.append(dof)
    return residual, float(np.mean(freedom))


@lru_cache(maxsize=8)
def _halves(shape: tuple[int, int], seed: int, stripes: bool) -> tuple[Half, Half]:
    return (calibration_stripes if stripes else calibration_blocks)(shape, seed=seed)


def term_maps(prediction: np.ndarray, terms: Terms, line: np.ndarray | None = None) -> np.ndarray:
    """The smooth per-scan terms as maps (k, y, x).

    Args:
        prediction: predicted height (y, x), µm.
        terms: which ones.
        line: scan line of each pixel (y, x); the rows of the array by default.
    """
    offset, gain, *bow = nuisance_basis(prediction, "full")
    chosen = [offset] if terms else []
    if "gain" in terms:
        chosen.append(gain)
    if "bow" in terms:
        chosen += bow
    if "drift" in terms:
        line = row_index(prediction.shape) if line is None else line
        time = line / max(int(line.max()), 1)
        creeps = [np.exp(-time / decay) for decay in CREEP_DECAYS.values()]
        chosen += [creep - creep.mean() for creep in creeps]
    if {"warp", "distortion"} & terms:
        x, y = bow[0], bow[1]
        slopes = np.gradient(prediction.astype(np.float64))
        if "warp" in terms:
            chosen += [slope * by for slope in slopes for by in (1.0, y, x)]
        if "distortion" in terms:
            # Centred: a distortion that all scans have in common then brings no shift along.
            chosen += [slope * by for slope in slopes for by in (y * y - 1 / 3, x * y, x * x - 1 / 3)]
    return np.stack(chosen) if chosen else np.empty((0, *prediction.shape))


def names_to_terms(effects: Sequence[str]) -> Terms:
    """Per-scan terms that the accepted measurement effects stand for."""
    return frozenset().union(*(TERMS_OF[name] for name in effects if name in TERMS_OF))


def scan_parameter_names(terms: Terms) -> list[str]:
    """Names of the smooth per-scan terms, in the order of ``term_maps``; coordinates run from -1 to 1."""
    names = ["offset (nm)"] if terms else []
    if "gain" in terms:
        names.append("gain")
    if "bow" in terms:
        names += [f"{power} (nm)" for power in ("x", "y", "x²", "xy", "y²")]
    if "drift" in terms:
        names += [f"creep over {decay:g} of the scan (nm)" for decay in CREEP_DECAYS.values()]
    if "warp" in terms:
        names += [f"shift {axis}{by} (px)" for axis in ("y", "x") for by in ("", " by y", " by x")]
    if "distortion" in terms:
        names += [
            f"shift {axis} by {by} (px)" for axis in ("y", "x") for by in ("y² - 1/3", "xy", "x² - 1/3")
        ]
    return names
