"""Compute the values in a registration's quality record from the fitted warp and from the images that were
compared in the fit.
"""

from typing import Any

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.coarse import CoarseFit
from litho_data.register.evidence import BlockShifts, bootstrap_corner_sd_px, match_blocks_of_field
from litho_data.register.geometry import apply_transform, centre, linear_part, overlap_of
from litho_data.register.orientation import rival_alignment, rival_orientation
from litho_data.register.pyramid import FineFit
from litho_data.register.topography import quadratic_basis


def figures_of_fit(coarse: CoarseFit, fine: FineFit, pitch_um: float) -> dict[str, Any]:
    """Return the quality values that say how the warp was found, and how well it explains the matched
    keypoints and the heights. The keys are the names in ``RegistrationQuality``.
    """
    points, warp, bend = coarse.points, fine.refinement.layout_to_scan, fine.refinement.bend
    overlap = overlap_of(warp, fine.topography.shape, np.isfinite(fine.scan), bend)
    return {
        "model": fine.refinement.model if bend is None else bend.kind,
        "method": coarse.method,
        "dihedral": coarse.orientation,
        "polarity": coarse.polarity,
        "converged": fine.refinement.converged,
        "ecc": fine.refinement.correlation,
        "blur_um": fine.blur_px * pitch_um,
        "keypoints": points.keypoints if points else 0,
        "matches": len(points.inlier) if points else 0,
        "inlier_ratio": float(points.inlier.mean()) if points else float("nan"),
        "reprojection_px": points.reprojection_px(warp, bend) if points else float("nan"),
        "coverage": points.coverage(overlap) if points else float("nan"),
    }


def figures_of_warp(layout_to_scan: Array, layout_shape: Shape, pitch_um: float) -> dict[str, Any]:
    """Return the shift, the scales and the rotation of the warp at the layout's centre. For a bent scan,
    these values describe the affine part of the warp.

    The shift is the position of the layout's centre in the scan minus its position in the layout.
    """
    middle_um = (centre(layout_shape) + 0.5) * pitch_um
    linear = np.linalg.inv(linear_part(layout_to_scan, middle_um))
    shift_um = apply_transform(layout_to_scan, middle_um[None])[0] - middle_um
    left, singular, right = np.linalg.svd(linear)
    turn = left @ right
    return {
        "singular_max": float(singular[0]),
        "singular_min": float(singular[1]),
        "shift_x_um": float(shift_um[0]),
        "shift_y_um": float(shift_um[1]),
        "rotation_deg": float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))),
    }


def figures_of_evidence(fine: FineFit, pitch_um: float, seed: int) -> tuple[dict[str, Any], BlockShifts]:
    """Return the quality values that say how certain the warp is, and the shifts of the field's blocks.

    The values are computed from blocks that were left out of the fit, from a bootstrap over the blocks, and
    from the correlation of scan and layout at other shifts and in other orientations.
    """
    warp, shape = fine.refinement.layout_to_scan, fine.topography.shape
    background = np.einsum("k,kyx->yx", fine.refinement.background, quadratic_basis(shape))
    aligned = fine.refinement.warped - background
    measured = overlap_of(warp, shape, np.isfinite(fine.scan), fine.refinement.bend)
    registered = np.where(measured, aligned, np.nan)
    blocks = match_blocks_of_field(fine.refinement, aligned, measured, fine.topography)
    median, p95 = blocks.held_out_error_percentiles_px(50, 95)
    corner_sd = bootstrap_corner_sd_px(fine.refinement, shape, seed)
    nm_per_px = pitch_um * 1e3
    figures = {
        "tre_windows": len(blocks.shift_px),
        "tre_median_px": median,
        "tre_p95_px": p95,
        "tre_median_nm": median * nm_per_px,
        "tre_p95_nm": p95 * nm_per_px,
        "curve_x_px": blocks.curve_px(axis=0, along=0),
        "curve_y_px": blocks.curve_px(axis=1, along=1),
        "curve_x_by_y_px": blocks.curve_px(axis=0, along=1),
        "curve_y_by_x_px": blocks.curve_px(axis=1, along=0),
        "corner_sd_px": corner_sd,
        "corner_sd_nm": corner_sd * nm_per_px,
        "second_alignment": rival_alignment(registered, fine.topography),
        "second_orientation": rival_orientation(registered, fine.topography),
    }
    return figures, blocks
