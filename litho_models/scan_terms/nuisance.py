"""What a scan adds to the height (datum, gain, plane, bow, line offsets), fitted on pixels not scored.

A microscope's datum or a bow says nothing about the printer, so an error figure may be freed of it;
but a nuisance fitted on the pixels that it is scored on flatters the model. Each scan is therefore
cut into two halves of blocks: fit on one, score the other, swap. Calibration blocks are shrunk by
one residual correlation length, so every pixel is scored once and never near a pixel fitted on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.errors import InputError

if TYPE_CHECKING:
    from litho_data.register import Bend

Policy = Literal["none", "offset", "offset-gain", "full", "full+rows"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
TERM_COUNT = {"none": 0, "offset": 1, "offset-gain": 2, "full": 7, "full+rows": 7}

BLOCK_PX = 32
# Residual autocorrelation on the measured prints is about 0.5 at 5 px: exp(-d / 7.2 px).
BUFFER_PX = 7

FloatMap = NDArray[np.float64]
BoolMap = NDArray[np.bool_]


class Half(NamedTuple):
    """One half of a scan: nuisances are fitted on ``calibrate`` and applied to ``score``; bool (ny, nx)."""

    calibrate: BoolMap
    score: BoolMap


@dataclass(frozen=True)
class CrossFit:
    """A scan freed of its nuisances.

    Attributes:
        residual_um: measured minus predicted minus nuisance, (ny, nx) µm, NaN where not scored.
        degrees_of_freedom: fitted per half; the shrunk line offsets count with their weight.
        row_sd_um: standard deviation of the line offsets (policy ``full+rows``), otherwise 0.
    """

    residual_um: FloatMap
    degrees_of_freedom: float
    row_sd_um: float


def cross_fitted_residual(
    height_um: np.ndarray,
    prediction_um: np.ndarray,
    valid: np.ndarray,
    policy: Policy = "offset",
    *,
    block_px: int = BLOCK_PX,
    buffer_px: int = BUFFER_PX,
    seed: int = 0,
    scan_line: np.ndarray | None = None,
) -> CrossFit:
    """Residual of one scan with the nuisances of ``policy`` estimated on the other half of its pixels.

    Args:
        height_um: measured height (ny, nx), µm; NaN allowed where not valid.
        prediction_um: the process model's height (ny, nx), µm.
        valid: bool (ny, nx), pixels that count.
        policy: terms per scan, see ``nuisance_basis``; ``full+rows`` adds one offset per scan line.
        block_px, buffer_px, seed: geometry of the calibration blocks, see ``calibration_blocks``.
        scan_line: integer index of the scan line of each pixel (ny, nx); rows of the array if None.

    Raises:
        InputError: unknown policy, shapes that differ, a non-finite prediction, or too small a scan.
    """
    _check_policy(policy)
    height, prediction = np.asarray(height_um, np.float64), np.asarray(prediction_um, np.float64)
    if not height.shape == prediction.shape == valid.shape:
        shapes = f"height {height.shape}, prediction {prediction.shape}, valid {valid.shape}"
        raise InputError("shapes of one scan differ", got=shapes, wanted="one (ny, nx)")
    usable = np.asarray(valid, bool) & np.isfinite(height)
    if not np.isfinite(prediction[usable]).all():
        raise InputError(
            "prediction", got=f"{np.sum(~np.isfinite(prediction[usable]))} non-finite pixels", wanted="none"
        )
    difference = np.where(usable, height - prediction, 0.0)
    residual = np.full(height.shape, np.nan)
    if policy == "none":
        residual[usable] = difference[usable]
        return CrossFit(residual, 0.0, 0.0)

    basis = nuisance_basis(prediction, policy)
    lines = _line_index(height.shape, scan_line) if policy == "full+rows" else None
    split = calibration_stripes if lines is not None else calibration_blocks
    freedom, row_variance = [], []
    for half in split(height.shape, block_px=block_px, buffer_px=buffer_px, seed=seed):
        calibrate, score = half.calibrate & usable, half.score & usable
        nuisance = _fit_terms(basis, difference, calibrate)
        dof = float(len(basis))
        if lines is not None:
            offsets, weight, variance = shrunk_line_offsets(difference - nuisance, calibrate, lines, block_px)
            nuisance = nuisance + offsets[lines]
            dof += float(weight.sum())
            row_variance.append(variance)
        residual[score] = (difference - nuisance)[score]
        freedom.append(dof)
    row_sd = float(np.sqrt(np.mean(row_variance))) if row_variance else 0.0
    return CrossFit(residual, float(np.mean(freedom)), row_sd)


def nuisance_basis(prediction_um: np.ndarray, policy: Policy) -> FloatMap:
    """Terms of a policy as maps, shape (k, ny, nx): 1; P (prediction); x, y, x², xy, y² on -1 ... 1.

    ``full`` and ``full+rows`` have all seven. All but the first have zero mean over the field, so
    that the first alone is the scan's datum.
    """
    _check_policy(policy)
    prediction = np.asarray(prediction_um, np.float64)
    if not TERM_COUNT[policy]:
        return np.empty((0, *prediction.shape))
    terms = [np.ones_like(prediction), prediction - prediction.mean(), *smooth_shapes(prediction.shape)]
    return np.stack(terms[: TERM_COUNT[policy]])


def smooth_shapes(shape: tuple[int, ...]) -> FloatMap:
    """x, y, x², xy, y² on -1 ... 1 over a field (ny, nx), each of zero mean: (5, ny, nx)."""
    ny, nx = shape
    y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
    return np.stack([term - term.mean() for term in (x, y, x * x, x * y, y * y)])


def calibration_blocks(
    shape: tuple[int, int], *, block_px: int = BLOCK_PX, buffer_px: int = BUFFER_PX, seed: int = 0
) -> tuple[Half, Half]:
    """Checkerboard of square blocks as two halves; the seed moves its origin.

    A pixel to calibrate on is more than ``buffer_px`` rows or columns away from every pixel scored.
    """
    row, column = _block_numbers(shape, block_px, buffer_px, seed)
    return _halves((row[:, None] + column[None, :]) % 2 == 0, buffer_px)


def calibration_stripes(
    shape: tuple[int, int], *, block_px: int = BLOCK_PX, buffer_px: int = BUFFER_PX, seed: int = 0
) -> tuple[Half, Half]:
    """Alternate stripes of columns as two halves, so that each row has pixels of both."""
    _, column = _block_numbers(shape, block_px, buffer_px, seed)
    return _halves(np.broadcast_to(column % 2 == 0, shape), buffer_px)


def shrunk_line_offsets(
    residual_um: FloatMap, calibrate: BoolMap, lines: NDArray[np.intp], block_px: int = BLOCK_PX
) -> tuple[FloatMap, FloatMap, float]:
    """Offsets of the scan lines as a variance component: best linear prediction of s_i ~ N(0, v).

    The means of the column blocks within a line give the noise of a line's mean (correlation along
    the line included); what the line means vary beyond it is v. For equal counts this moment
    estimate is the REML one. A line without calibration pixels gets 0.

    Returns:
        offsets (lines,) µm, their shrinkage weights (lines,) in 0 ... 1, and v in µm².
    """
    line_count = int(lines.max()) + 1
    block = np.broadcast_to(np.arange(residual_um.shape[1]) // block_px, residual_um.shape)
    block_count = int(block.max()) + 1
    cell = (lines * block_count + block)[calibrate]
    count = np.bincount(cell, minlength=line_count * block_count).reshape(line_count, block_count)
    total = np.bincount(cell, residual_um[calibrate], minlength=count.size).reshape(count.shape)
    # Blocks with a handful of pixels (the edge of the scan) would count as much as full ones.
    filled = count >= max(1, count.max() // 2)
    means = np.where(filled, total / np.maximum(count, 1), 0.0)
    blocks = filled.sum(axis=1)
    line_mean = means.sum(axis=1) / np.maximum(blocks, 1)
    within = (np.where(filled, means - line_mean[:, None], 0.0) ** 2).sum()
    freedom = np.maximum(blocks - 1, 0).sum()
    seen = blocks > 0
    if freedom < 1 or seen.sum() < 3:
        return np.zeros(line_count), np.zeros(line_count), 0.0
    noise = within / freedom / np.maximum(blocks, 1)
    variance = max(0.0, float(np.var(line_mean[seen], ddof=1) - noise[seen].mean()))
    weight = np.where(seen, variance / np.maximum(variance + noise, np.finfo(float).tiny), 0.0)
    return weight * (line_mean - line_mean[seen].mean()), weight, variance


def scan_line_index(
    shape: tuple[int, int], scan_to_layout: np.ndarray, pitch_um: float, bend_um: Bend | None = None
) -> NDArray[np.intp]:
    """Index of the scan line (constant y in the scan's frame) under each layout pixel, (ny, nx), from 0.

    Args:
        shape: (ny, nx) of the layout.
        scan_to_layout: 3 x 3, maps (x_um, y_um, 1) of the scan frame to the layout frame.
        pitch_um: layout pitch; lines are counted in the same steps.
        bend_um: of a bent scan, which ``scan_to_layout`` does not contain.
    """
    y, x = np.meshgrid(*((np.arange(n) + 0.5) * pitch_um for n in shape), indexing="ij")
    inverse = np.linalg.inv(np.asarray(scan_to_layout, np.float64))
    scan_x, scan_y, depth = (row[0] * x + row[1] * y + row[2] for row in inverse)
    scan_x, scan_y = scan_x / depth, scan_y / depth
    if bend_um is not None:
        # What the scan does not show is given to its first or last line; the end itself is beyond the last.
        end = 2 * bend_um.half[1] * (1 - 1e-9)
        scan_y = np.clip(bend_um.undo(scan_x, scan_y)[1], 0, end)
    line = np.floor(scan_y / pitch_um).astype(np.intp)
    return line - line.min()


def row_index(shape: tuple[int, int]) -> NDArray[np.intp]:
    """Row number of each pixel, (ny, nx)."""
    return np.broadcast_to(np.arange(shape[0], dtype=np.intp)[:, None], shape)


def _fit_terms(basis: FloatMap, difference: FloatMap, calibrate: BoolMap) -> FloatMap:
    design = basis[:, calibrate]
    if design.shape[1] <= 2 * len(basis):
        raise InputError(
            "too few calibration pixels for the nuisance terms",
            got=f"{design.shape[1]} pixels for {len(basis)} terms",
            wanted=f"more than {2 * len(basis)}",
            hint="use a larger field, a smaller block_px, or policy 'none'",
        )
    coefficients = least_squares(design, difference[calibrate])
    return np.tensordot(coefficients, basis, axes=1)


def least_squares(design: FloatMap, target: FloatMap) -> FloatMap:
    """Coefficients (k,) of ``design`` (k, n) that come closest to ``target`` (n,); smallest if not unique."""
    return np.linalg.lstsq(design @ design.T, design @ target, rcond=1e-12)[0].astype(np.float64)


def _block_numbers(
    shape: tuple[int, int], block_px: int, buffer_px: int, seed: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    if block_px <= 2 * buffer_px:
        raise InputError("block_px", got=block_px, wanted=f"more than twice the buffer of {buffer_px} px")
    shift = np.random.default_rng(seed).integers(0, 2 * block_px, size=2)
    rows, columns = ((np.arange(n) + s) // block_px for n, s in zip(shape, shift, strict=True))
    return rows, columns


def _halves(first: BoolMap, buffer_px: int) -> tuple[Half, Half]:
    from scipy.ndimage import minimum_filter

    inner, outer = (
        minimum_filter(part, size=2 * buffer_px + 1, mode="constant", cval=1) for part in (first, ~first)
    )
    return Half(calibrate=inner, score=~first), Half(calibrate=outer, score=np.array(first))


def _line_index(shape: tuple[int, int], scan_line: np.ndarray | None) -> NDArray[np.intp]:
    if scan_line is None:
        return row_index(shape)
    if scan_line.shape != shape or scan_line.min() < 0:
        raise InputError("scan_line", got=f"shape {scan_line.shape}", wanted=f"indices from 0, shape {shape}")
    return scan_line


def _check_policy(policy: str) -> None:
    if policy not in POLICIES:
        raise InputError("nuisance policy", got=repr(policy), wanted=", ".join(POLICIES))
