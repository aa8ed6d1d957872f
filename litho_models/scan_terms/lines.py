"""Find the scan line to which each pixel belongs, and estimate the height offset of each line."""

from __future__ import annotations

import numpy as np

from litho_data.register import Bend
from litho_data.register.geometry import index_to_um, warped_grid
from litho_models.scan_terms.blocks import BoolMap
from litho_models.scan_terms.term import FloatMap, LineIndex


def scan_line_index(
    shape: tuple[int, int], scan_to_layout: np.ndarray, pitch_um: float, bend_um: Bend | None = None
) -> LineIndex:
    """Return, for each pixel of the layout, the index of the scan line to which it belongs, counted from 0. A
    scan line is a line of constant y in the coordinates of the scan. The result has shape (ny, nx).

    Args:
        shape: shape (ny, nx) of the layout.
        scan_to_layout: matrix of shape (3, 3) that maps homogeneous coordinates (x_um, y_um, 1) of the scan
            to homogeneous coordinates of the layout.
        pitch_um: size of a layout pixel. The distance between scan lines is assumed to equal this size.
        bend_um: bend of the scan, which ``scan_to_layout`` does not contain; None if the scan is not bent.
    """
    to_scan = np.linalg.inv(scan_to_layout) @ index_to_um((pitch_um, pitch_um))
    scan_y, _ = warped_grid(to_scan, shape, bend_um)
    if bend_um is not None:
        # Pixels outside the scan belong to its first or last line.
        scan_y = np.clip(scan_y, 0, 2 * bend_um.half[1] * (1 - 1e-9))
    line = np.floor(scan_y / pitch_um).astype(np.intp)
    return line - line.min()


def axis_along(line: LineIndex) -> int:
    """Return the array axis along which the lines run. It is 1 for lines along x, and 0 for lines along y.
    Lines along y occur in scans that are rotated by 90 degrees.
    """
    down, across = (np.abs(np.diff(line, axis=axis)).mean() for axis in (0, 1))
    return int(down >= across)


def shrunk_line_offsets(
    residual_um: FloatMap, used: BoolMap, line: LineIndex, block_px: int
) -> tuple[FloatMap, FloatMap, float]:
    """Estimate the height offset s_i of each line. The offsets are treated as random effects with s_i ~ N(0,
    v). The estimate is their best linear unbiased prediction (BLUP).

    Each line is divided into blocks. The noise variance of a line mean is estimated from the scatter of the
    block means within the lines. This estimate allows for correlation of the noise along the line. The
    estimate of v is the variance of the line means minus this noise variance. If all lines have the same
    number of blocks, this moment estimate equals the restricted maximum likelihood estimate (REML). The
    offset of a line without used pixels is 0.

    Args:
        residual_um: residual, µm, of shape (ny, nx).
        used: mask of the pixels to use, of shape (ny, nx).
        line: index of the line of each pixel, of shape (ny, nx).
        block_px: length of a block along the lines, in pixels.

    Returns:
        A tuple of three items: the offsets in µm, of shape (lines,); the shrinkage weight of each offset,
        from 0 to 1, of shape (lines,); and the variance v in µm².
    """
    block = np.indices(line.shape)[axis_along(line)] // block_px
    line_count, block_count = int(line.max()) + 1, int(block.max()) + 1
    cell = (line * block_count + block)[used]
    count, total = (
        np.bincount(cell, weights, line_count * block_count).reshape(line_count, block_count)
        for weights in (None, residual_um[used])
    )
    # Blocks with few pixels (at the edge of the scan) are left out, because all blocks have equal weight.
    means = np.ma.masked_where(count < max(1, count.max() // 2), total) / np.maximum(count, 1)
    blocks, line_mean = means.count(axis=1), means.mean(axis=1)
    freedom = np.maximum(blocks - 1, 0).sum()
    if freedom < 1 or line_mean.count() < 3:
        return np.zeros(line_count), np.zeros(line_count), 0.0
    # Lines without blocks are masked.
    noise = np.ma.divide((means.anom(axis=1) ** 2).sum() / freedom, blocks)
    variance = max(0.0, float(line_mean.var(ddof=1) - noise.mean()))
    weight = variance / np.maximum(variance + noise, np.finfo(float).tiny)
    return (weight * line_mean.anom()).filled(0), weight.filled(0), variance
