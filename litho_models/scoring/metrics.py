"""Compute the errors of one scan over its valid pixels."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scan_terms import Blocks, CrossFit, NuisanceProtocol, cross_fit, policy_terms
from litho_models.scoring.records import ScanErrors
from litho_models.scoring.statistics import rms

# Difference of the refractive index between resist and air at the red helium-neon line, for which the
# elements are designed.
INDEX_STEP, WAVELENGTH_UM = 0.548, 0.6328


class PrintGain(NamedTuple):
    """A fitted line, measured height = slope · prediction + intercept, and the standard error of its slope.

    A value is None if it cannot be computed: a constant prediction has no slope, and a single block gives no
    error.
    """

    slope: float | None
    intercept_nm: float
    slope_error: float | None


def print_gain(
    height_um: Array, prediction_um: Array, used: Array, *, block_px: int = Blocks().block_px
) -> PrintGain:
    """Fit a least-squares line to the selected pixels of a scan.

    Residuals of neighbouring pixels are correlated, so the variance is computed from whole blocks (Liang and
    Zeger 1986). In each block, the products of residual and regressor are summed. The sums of different
    blocks are assumed to be independent, which holds if the blocks are wide compared with the correlation
    length (7 px on the measured prints).

    Args:
        height_um, prediction_um: (ny, nx), float.
        used: (ny, nx), bool; True for the selected pixels, of which there is at least one.
        block_px: side of a block.
    """
    x, y = (np.asarray(a, np.float64)[used] for a in (prediction_um, height_um))
    middle, height = float(x.mean()), float(y.mean())
    power = float(((x - middle) ** 2).sum())
    if power <= 0:
        return PrintGain(None, NM_PER_UM * height, None)
    regressor = (x - middle) / power
    slope = float(regressor @ y)
    rows, columns = np.nonzero(used)
    block = (rows // block_px) * (used.shape[1] // block_px + 1) + columns // block_px
    influence = np.bincount(block, weights=regressor * (y - height - slope * (x - middle)))
    count = np.unique(block).size
    error = float(np.sqrt((influence**2).sum() * count / (count - 1))) if count > 1 else None
    return PrintGain(slope, NM_PER_UM * (height - slope * middle), error)


def scan_errors(scan_id: str, height_um: Array, prediction_um: Array, free: CrossFit) -> ScanErrors:
    """Score a prediction against a scan, both (ny, nx) in µm, on the pixels that ``cross_fit`` scores.

    ``print_gain`` computes the slope and the intercept, which are the gain and the offset of the print.

    Raises:
        InputError: no valid pixel.
    """
    scored = np.isfinite(free.residual_um)
    if not scored.any():
        raise InputError(f"scan {scan_id}", got="no valid pixel", wanted="at least one to score")
    height, prediction = (np.asarray(a, np.float64)[scored] for a in (height_um, prediction_um))
    plain = (height - prediction) * NM_PER_UM
    error = np.abs(free.residual_um[scored]) * NM_PER_UM
    return ScanErrors(
        pixels=int(scored.sum()),
        mae_abs_nm=float(np.abs(plain).mean()),
        bias_nm=float(plain.mean()),
        mae_datum_free_nm=float(error.mean()),
        rmse_datum_free_nm=rms(error),
        median_abs_datum_free_nm=float(np.median(error)),
        p95_abs_datum_free_nm=float(np.quantile(error, 0.95)),
        **print_gain(height_um, prediction_um, scored)._asdict(),
    )


def residual_um(scan: PrintedScan, expected_um: Array, protocol: NuisanceProtocol) -> Array:
    """Return the measured minus the expected map of a scan after its per-scan terms are removed. The result
    is (ny, nx) in µm, and NaN at pixels that are not scored.
    """
    terms = policy_terms(protocol.policy)
    return cross_fit(scan.height_um, expected_um, scan.valid, terms, protocol.blocks).residual_um


def mean_error_nm(scans: Sequence[PrintedScan], heights_um: Iterable[Array]) -> float:
    """Return the datum-free error of a model under policy ``offset``, averaged over scans. ``heights_um``
    contains the predicted heights (ny, nx) of each scan.
    """
    protocol = NuisanceProtocol()
    residuals = (residual_um(*pair, protocol) for pair in zip(scans, heights_um, strict=True))
    return NM_PER_UM * float(np.mean([np.nanmean(np.abs(residual)) for residual in residuals]))


def phase_waves(height_error_um: float) -> float:
    """Return the phase error, in waves, of light that passes through an element whose height is wrong by
    ``height_error_um``.
    """
    return height_error_um * INDEX_STEP / WAVELENGTH_UM
