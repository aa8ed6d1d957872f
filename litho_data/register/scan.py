"""Registration of one scan onto the layout it was printed from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from litho_data.errors import InputError
from litho_data.register.coarse import SEARCH_BLUR_PX, CoarseFit, find_coarse
from litho_data.register.evidence import (
    bootstrap_corner_sd_px,
    height_correlation,
    match_blocks_of_field,
    mutual_information_bit,
)
from litho_data.register.geometry import (
    centre,
    index_to_um,
    linear_part,
    orient,
    orientation_matrix,
    overlap_of,
)
from litho_data.register.ladder import climb
from litho_data.register.orientation import rival_alignment, rival_orientation
from litho_data.register.pyramid import FineFit, refine_pyramid
from litho_data.register.quality import RegistrationQuality, Thresholds, judge, unregistered_quality
from litho_data.register.refine import Model
from litho_data.register.resample import Resampler, noise_variance_factor, resample_to_layout
from litho_data.register.topography import predicted_topography, quadratic_basis, remove_bow

MIN_SIZE_PX = 32
# A picometre: below any instrument, above rounding.
SMALLEST_STRUCTURE_UM = 1e-6


@dataclass(frozen=True)
class Registration:
    """Where a scan lies on its layout.

    ``scan_to_layout`` is 3×3 and maps (x_um, y_um, 1) of the scan's frame to the layout's; both frames
    have pixel centres at ``(i + 0.5) * pitch``. If ``quality.passed`` is false it is the best guess, or the
    centred placement where there was none.
    """

    scan_to_layout: np.ndarray
    quality: RegistrationQuality


def register_scan(
    scan_height_um: np.ndarray,
    layout_level: np.ndarray,
    *,
    scan_pitch_um: tuple[float, float],
    layout_pitch_um: float,
    model: Model | Literal["ladder"] = "affine",
    orientation: Literal["search", "identity"] = "search",
    thresholds: Thresholds | None = None,
    seed: int = 0,
) -> Registration:
    """Finds the warp from a scan to its layout and says how far it can be trusted.

    Args:
        scan_height_um: (ny, nx) heights, NaN where not measured.
        layout_level: (ny, nx) integer levels.
        scan_pitch_um: (y, x) pitch of the scan.
        layout_pitch_um: pitch of the layout.
        model: a rung of the ladder, or ``ladder`` to let held-out blocks choose it.
        orientation: ``search`` tries eight orientations and both polarities, ``identity`` upright only.
        thresholds: limits of a pass.
        seed: of the robust estimator and the bootstrap.

    Raises:
        InputError: arrays that are not 2-D or smaller than 32 pixels, or pitches that are not positive.
            A fit that fails does not raise: ``quality.passed`` and ``quality.reason`` tell.
    """
    height = np.asarray(scan_height_um, dtype=np.float64)
    layout = np.asarray(layout_level)
    _check(height, layout, scan_pitch_um, layout_pitch_um)
    centred = centred_placement(height.shape, scan_pitch_um, layout.shape, layout_pitch_um)
    if not np.isfinite(height).any():
        return Registration(centred, unregistered_quality("no measured pixel in the scan"))
    scan = remove_bow(_at_layout_pitch(height, scan_pitch_um, layout_pitch_um))
    has_structure = layout.min() < layout.max() and np.nanstd(scan) > SMALLEST_STRUCTURE_UM
    limits = thresholds or Thresholds()
    smooth_layout = predicted_topography(layout, SEARCH_BLUR_PX)
    layout_repeats = rival_alignment(smooth_layout, smooth_layout) if has_structure else float("nan")
    features = layout_repeats <= limits.max_layout_repeats
    search = orientation == "search"
    coarse = None
    if has_structure:
        coarse = find_coarse(scan, layout, smooth_layout, search=search, features=features, seed=seed)
    if coarse is None:
        return Registration(centred, unregistered_quality("no structure in the scan or the layout"))

    oriented = coarse.polarity * orient(scan, coarse.orientation)
    fine = refine_pyramid(
        oriented, layout, coarse.layout_to_oriented, "affine" if model == "ladder" else model
    )
    if model == "ladder":
        fine = climb(fine)
    to_scan = np.linalg.inv(orientation_matrix(coarse.orientation, _shape(scan)))
    frame = index_to_um((layout_pitch_um, layout_pitch_um))
    layout_to_scan = frame @ to_scan @ fine.refinement.layout_to_scan @ np.linalg.inv(frame)
    scan_to_layout = _rounded(np.linalg.inv(layout_to_scan))

    resampler = Resampler(height, scan_pitch_um=scan_pitch_um, layout_pitch_um=layout_pitch_um)
    before, after = (resampler.at(place, _shape(layout))[0] for place in (centred, scan_to_layout))
    figures = {
        **_figures_of_fit(coarse, fine, layout_pitch_um),
        **_figures_of_warp(layout_to_scan, _shape(layout), layout_pitch_um),
        **_figures_of_evidence(fine, layout_pitch_um, seed),
        "layout_repeats": layout_repeats,
        "overlap": float(np.isfinite(after).mean()),
        "ncc_before": height_correlation(before, layout),
        "ncc_after": height_correlation(after, layout),
        "mutual_information_before_bit": mutual_information_bit(before, layout),
        "mutual_information_after_bit": mutual_information_bit(after, layout),
        "noise_variance_factor": noise_variance_factor(scan_pitch_um, layout_pitch_um),
    }
    passed, reason, warning = judge(figures, limits, fine.blur_px)
    quality = RegistrationQuality(passed=passed, reason=reason, warning=warning, **figures)
    return Registration(scan_to_layout, quality)


def centred_placement(
    scan_shape: tuple[int, ...],
    scan_pitch_um: tuple[float, float],
    layout_shape: tuple[int, ...],
    layout_pitch_um: float,
) -> np.ndarray:
    """The shift, as ``scan_to_layout``, that puts the middle of the scan on the middle of the layout."""
    matrix = np.eye(3)
    matrix[0, 2] = (layout_shape[1] * layout_pitch_um - scan_shape[1] * scan_pitch_um[1]) / 2
    matrix[1, 2] = (layout_shape[0] * layout_pitch_um - scan_shape[0] * scan_pitch_um[0]) / 2
    return matrix


def _check(
    height: np.ndarray, layout: np.ndarray, scan_pitch_um: tuple[float, float], layout_pitch_um: float
) -> None:
    for name, image in (("scan", height), ("layout", layout)):
        if image.ndim != 2 or min(image.shape) < MIN_SIZE_PX:
            wanted = f"(ny, nx) of at least {MIN_SIZE_PX} pixels each"
            raise InputError(f"shape of the {name}", got=image.shape, wanted=wanted)
    if not all(np.isfinite(pitch) and pitch > 0 for pitch in (*scan_pitch_um, layout_pitch_um)):
        raise InputError("pitch", got=(scan_pitch_um, layout_pitch_um), wanted="positive numbers in µm")


def _at_layout_pitch(
    height: np.ndarray, scan_pitch_um: tuple[float, float], layout_pitch_um: float
) -> np.ndarray:
    """A copy to compare with; the heights that are kept are resampled once, from the original."""
    if np.allclose(scan_pitch_um, layout_pitch_um, rtol=1e-6):
        return height
    ny, nx = (
        max(1, round(n * p / layout_pitch_um)) for n, p in zip(height.shape, scan_pitch_um, strict=True)
    )
    resampled, _ = resample_to_layout(
        height, np.eye(3), (ny, nx), scan_pitch_um=scan_pitch_um, layout_pitch_um=layout_pitch_um
    )
    return resampled.astype(np.float64)


def _rounded(matrix: np.ndarray) -> np.ndarray:
    """Digits far below any physical meaning cut off, so that they cannot change between machines."""
    matrix = matrix / matrix[2, 2]
    rounded = np.round(matrix, 8)
    rounded[:2, 2] = np.round(matrix[:2, 2], 6)
    rounded[2, :2] = np.round(matrix[2, :2], 10)
    return rounded + 0.0  # no negative zeros


def _figures_of_fit(coarse: CoarseFit, fine: FineFit, pitch_um: float) -> dict[str, Any]:
    points, warp = coarse.points, fine.refinement.layout_to_scan
    figures: dict[str, Any] = {
        "model": fine.refinement.model,
        "method": coarse.method,
        "dihedral": coarse.orientation,
        "polarity": coarse.polarity,
        "converged": fine.refinement.converged,
        "ecc": fine.refinement.correlation,
        "blur_um": fine.blur_px * pitch_um,
        "keypoints": points.keypoints if points else 0,
        "matches": len(points.inlier) if points else 0,
        "inlier_ratio": float(points.inlier.mean()) if points else float("nan"),
        "reprojection_px": points.reprojection_px(warp) if points else float("nan"),
        "coverage": float("nan"),
    }
    if points:
        overlap = overlap_of(warp, _shape(fine.topography), np.isfinite(fine.scan))
        figures["coverage"] = points.coverage(overlap)
    figures["reprojection_nm"] = figures["reprojection_px"] * pitch_um * 1e3
    return figures


def _figures_of_warp(
    layout_to_scan: np.ndarray, layout_shape: tuple[int, int], pitch_um: float
) -> dict[str, Any]:
    linear = np.linalg.inv(linear_part(layout_to_scan, (centre(layout_shape) + 0.5) * pitch_um))
    left, singular, right = np.linalg.svd(linear)
    turn = left @ right
    return {
        "singular_max": float(singular[0]),
        "singular_min": float(singular[1]),
        "rotation_deg": float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))),
    }


def _figures_of_evidence(fine: FineFit, pitch_um: float, seed: int) -> dict[str, Any]:
    warp, shape = fine.refinement.layout_to_scan, _shape(fine.topography)
    background = np.einsum("k,kyx->yx", fine.refinement.background, quadratic_basis(shape))
    aligned = fine.refinement.warped - background
    measured = overlap_of(warp, shape, np.isfinite(fine.scan))
    registered = np.where(measured, aligned, np.nan)
    blocks = match_blocks_of_field(fine.refinement, aligned, measured, fine.topography)
    median, p95 = blocks.held_out_error_percentiles_px(50, 95)
    corner_sd = bootstrap_corner_sd_px(fine.refinement, shape, seed)
    nm_per_px = pitch_um * 1e3
    return {
        "tre_windows": len(blocks.shift_px),
        "tre_median_px": median,
        "tre_p95_px": p95,
        "tre_median_nm": median * nm_per_px,
        "tre_p95_nm": p95 * nm_per_px,
        "curve_x_px": blocks.curve_px(axis=0),
        "curve_y_px": blocks.curve_px(axis=1),
        "corner_sd_px": corner_sd,
        "corner_sd_nm": corner_sd * nm_per_px,
        "second_alignment": rival_alignment(registered, fine.topography),
        "second_orientation": rival_orientation(registered, fine.topography),
    }


def _shape(image: np.ndarray) -> tuple[int, int]:
    return image.shape[0], image.shape[1]
