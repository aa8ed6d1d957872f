"""Compute the errors of a prediction over the valid pixels of one scan."""

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

# The designed optical elements are used with the red line of a helium-neon laser. The two values are the
# wavelength of this line, and the refractive index of the resist minus that of air at this wavelength.
INDEX_STEP, WAVELENGTH_UM = 0.548, 0.6328


class PrintGain(NamedTuple):
    """The straight line "measured height = slope · predicted height + intercept" that is fitted to a scan,
    and the standard error of its slope.

    ``slope`` is None for a constant prediction. ``slope_error`` is None for a constant prediction, and if
    there is only one block.
    """

    slope: float | None
    intercept_nm: float
    slope_error: float | None


def print_gain(
    height_um: Array, prediction_um: Array, used: Array, *, block_px: int = Blocks().block_px
) -> PrintGain:
    """Fit the measured height of a scan by a linear function of the predicted height. The fit uses least
    squares over the selected pixels.

    Residuals of neighbouring pixels are correlated, so the standard error is computed from blocks of pixels
    (Liang and Zeger 1986). In each block, the products of residual and predicted height (the regressor) are
    summed. These sums are assumed to be independent from block to block. This holds if the blocks are wide
    compared with the correlation length, which is 7 px on the measured prints.

    Args:
        height_um, prediction_um: measured and predicted height, µm, of shape (ny, nx).
        used: mask of the selected pixels, of shape (ny, nx); at least one must be True.
        block_px: side of a block, in pixels.
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
    """Compute the errors of a prediction on one scan. Measured and predicted height are in µm and have shape
    (ny, nx). ``free`` is the result of ``cross_fit`` for these two maps. The scored pixels are those at which
    ``free.residual_um`` is not NaN.

    The gain and the offset of the print are the slope and the intercept that ``print_gain`` fits.

    Raises:
        InputError: no pixel is scored.
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
    """Return the measured minus the expected map of a scan, after the per-scan terms are removed. The result
    is in µm, has shape (ny, nx), and is NaN at pixels that are not scored.
    """
    terms = policy_terms(protocol.policy)
    return cross_fit(scan.height_um, expected_um, scan.valid, terms, protocol.blocks).residual_um


def mean_error_nm(scans: Sequence[PrintedScan], heights_um: Iterable[Array]) -> float:
    """Return the datum-free error of a model, nm, averaged over scans. An offset is fitted to each scan
    (policy ``offset``). ``heights_um`` contains the predicted height of each scan, µm, of shape (ny, nx).
    """
    protocol = NuisanceProtocol()
    residuals = (residual_um(*pair, protocol) for pair in zip(scans, heights_um, strict=True))
    return NM_PER_UM * float(np.mean([np.nanmean(np.abs(residual)) for residual in residuals]))


def phase_waves(height_error_um: float) -> float:
    """Return the phase error, in waves, of light that passes through an element at a place where its height
    is wrong by ``height_error_um``.
    """
    return height_error_um * INDEX_STEP / WAVELENGTH_UM
