"""Change a measured print by errors that it may have."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from litho_data.register.flows import GENERATORS, LADDER, normalisation
from litho_design.images.noise import DRAWS
from litho_design.scans.background import FITTED_ORDERS
from litho_design.scans.record import MeasuredRecord
from litho_design.scans.shapes import amounts, legendre_shapes

# Tilt and bow of a print may all be wrong by one common factor. This is its standard deviation, found with
# ``benchmarks.coverage``.
_COMMON_SD = 0.1
# Standard deviation of the height correction for the AFM tip, as a share of the change that a second
# correction makes.
_TIP_SD = 0.3


def with_more_noise(height_um: Tensor, record: MeasuredRecord) -> Iterator[Tensor]:
    """Yield pairs of prints of shape (ny, nx), in µm, with added random noise, which is as strong as the
    noise of the scan. In the two prints of a pair, the same noise has opposite signs.
    """
    generator = np.random.default_rng(0)
    for _ in range(DRAWS):
        yield from _pair(record.noise_um * generator.standard_normal(height_um.shape), height_um)


def with_other_prints(height_um: Tensor, record: MeasuredRecord, pitch_um: float) -> Iterator[Tensor]:
    """Yield pairs of prints of shape (ny, nx), in µm, any of which may be the true print. The two prints of a
    pair differ from the measured print in one quantity: by plus its standard deviation in the first, and by
    minus it in the second.

    This quantity is the height scale of the scan, the effect of the tip, a term of the print's own tilt and
    bow, a factor common to all these terms (unless they were measured on the substrate), or an error of the
    registration.
    """
    from litho_data.tip import paraboloid_erosion

    measured = height_um.double().cpu().numpy()
    yield from _pair(record.scale_sd * measured, height_um)
    if record.tip_um:
        narrower = paraboloid_erosion(measured, (pitch_um, pitch_um), record.tip_um).surface
        yield from _pair(_TIP_SD * (narrower - measured), height_um)
    removed = legendre_shapes(measured.shape, FITTED_ORDERS[record.levelling])
    for shape, sd_um in zip(np.moveaxis(removed, -1, 0), record.removed_sd_um, strict=True):
        yield from _pair(sd_um * shape, height_um)
    if removed.size and record.levelled_on == "print":
        yield from _pair(_COMMON_SD * removed @ amounts(measured - measured.mean(), removed), height_um)
    for error_um in record.warp_errors_um:
        for sign in (1, -1):
            motion_px = sign * np.array(error_um) / pitch_um
            yield torch.from_numpy(displaced(measured, motion_px)).to(height_um)


def with_dust(height_um: Tensor, doubt_um: Tensor) -> Iterator[Tensor]:
    """Yield the print with the doubtful height, µm, and the print without it. Yield nothing if no height is
    doubtful.
    """
    if doubt_um.any():
        yield from (height_um + doubt_um, height_um)


def _pair(change_um: np.ndarray, height_um: Tensor) -> Iterator[Tensor]:
    """Yield the print plus the change, and the print minus the change."""
    for sign in (1, -1):
        yield height_um + torch.from_numpy(sign * change_um).to(height_um)


def displaced(height_um: np.ndarray, motion_px: np.ndarray) -> np.ndarray:
    """Return a print of shape (ny, nx) whose height at each pixel is that of the given print at a displaced
    position. ``motion_px`` contains six coefficients of an affine map (see ``placing.warp_errors_px``).
    """
    from scipy.ndimage import affine_transform

    ny, nx = height_um.shape
    motion = np.tensordot(motion_px, GENERATORS[: LADDER["affine"]], 1)
    # The third coordinate, 1, comes last, and scipy's coordinates are (y, x).
    to_place = np.eye(3) + motion @ normalisation((ny, nx))
    matrix, offset = to_place[1::-1, 1::-1], to_place[1::-1, 2]
    found: np.ndarray = affine_transform(height_um, matrix, offset, order=3, mode="nearest")
    return found
