"""Register one scan onto the layout from which it was printed."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from litho_data.foundation import YX, Array, InputError, Shape
from litho_data.register.bend import Bend, fit_bent_affine
from litho_data.register.coarse import SEARCH_BLUR_PX, CoarseFit, find_coarse
from litho_data.register.curved import refine_curved
from litho_data.register.defects import refine_around_defects, without_defects
from litho_data.register.evidence import BlockShifts, height_correlation
from litho_data.register.figures import figures_of_evidence, figures_of_fit, figures_of_warp
from litho_data.register.flows import Model
from litho_data.register.geometry import (
    apply_transform,
    index_to_um,
    lattice,
    orient,
    orientation_matrix,
    slow_axis,
)
from litho_data.register.orientation import rival_alignment
from litho_data.register.pyramid import FineFit, climb, refine_pyramid
from litho_data.register.quality import MAX_LAYOUT_REPEATS, RegistrationQuality, judge, unregistered_quality
from litho_data.register.refine import Refinement
from litho_data.register.resample import noise_variance_factor, resample_to_layout
from litho_data.register.topography import predicted_topography, remove_bow
from litho_data.scan import Axis, Scan

MIN_SIZE_PX = 32
# One picometre is below the resolution of any instrument, but above rounding errors.
SMALLEST_STRUCTURE_UM = 1e-6
# The kinds of warp for which a bend may be fitted. A bend is fitted together with an affine map. If the
# caller chose a kind with fewer parameters than an affine map, no bend is fitted.
BENDABLE = ("affine", "homography", "ladder")
# A bend is accepted if the error on held-out blocks is at most this share of the error without the bend. A
# real bend removes nearly all of the error, so the limit separates real bends from spurious ones.
BENT_SHARE = 0.5


@dataclass(frozen=True)
class Registration:
    """The registration of a scan onto its layout.

    ``scan_to_layout`` is a 3×3 matrix that maps positions (x_um, y_um, 1) in the scan's frame to positions in
    the layout's frame. In both frames, pixel centres lie at ``(i + 0.5) * pitch``. If ``quality.passed`` is
    false, the matrix is the best fit that was found. If nothing could be fitted, it places the centre of the
    scan on the centre of the layout.

    ``bend_um`` describes how the scanner bent the scan, and is None for a scan that is not bent. For a bent
    scan, ``bend_um.straighten`` gives the true positions of points (x_um, y_um), and ``scan_to_layout`` maps
    the true positions to the layout. The complete map from scan to layout includes the bend.
    ``scan_to_layout`` is also the affine map that is closest to the complete map.

    ``defects`` is a bool array of shape (ny, nx) on the layout's pixels. It marks where the scan shows
    something other than the print, such as dust, or collapsed or lifted parts. It is None if nothing is
    marked.
    """

    scan_to_layout: Array
    quality: RegistrationQuality
    bend_um: Bend | None = None
    defects: Array | None = None


def register_scan(
    scan: Scan | Array,
    layout_level: Array,
    *,
    layout_pitch_um: float,
    scan_pitch_um: YX | None = None,
    model: Model | Literal["ladder"] = "affine",
    fast_axis: Axis | None = None,
    seed: int = 0,
) -> Registration:
    """Find the warp that maps a scan onto its layout, and assess the quality of the warp.

    The scan may be rotated or mirrored, and its heights may be inverted.

    Args:
        scan: a ``Scan`` with a known pitch, or heights in µm as an array of shape (ny, nx), NaN where not
            measured.
        layout_level: integer levels of the layout, shape (ny, nx).
        layout_pitch_um: pitch of the layout in µm.
        scan_pitch_um: pitch (y, x) of the scan in µm. It is needed if ``scan`` is an array.
        model: the kind of warp: ``translation``, ``euclidean``, ``similarity``, ``affine`` or ``homography``.
            Each of these kinds contains all kinds named before it. With ``ladder``, every kind is fitted, and
            the result is the simplest kind that predicts held-out blocks as well as every more general kind.
            With ``affine``, ``homography`` and ``ladder``, a bend or creep may be fitted in addition (see
            ``Registration.bend_um``).
        fast_axis: the axis along which the tip moved fast. It is used only if the scan does not state it.
            None counts as ``x``.
        seed: seed of the robust estimator and of the bootstrap.

    Raises:
        InputError: an array is not two-dimensional or has fewer than 32 pixels on a side, or a pitch is
            missing or not positive. A fit that fails raises no error; ``quality.passed`` and
            ``quality.reason`` report it.
    """
    if isinstance(scan, Scan):
        scan_pitch_um, fast_axis, scan = scan.require_pitch(), scan.fast_axis or fast_axis, scan.height_um
    if scan_pitch_um is None:
        raise InputError(
            "registration of an array of heights",
            got="no scan_pitch_um",
            wanted="the pitch (y, x) of the scan in µm",
        )
    height = np.asarray(scan, dtype=float)
    layout = np.asarray(layout_level)
    _check(height, layout, scan_pitch_um, layout_pitch_um)
    centred = centred_placement(height.shape, scan_pitch_um, layout.shape, layout_pitch_um)
    if not np.isfinite(height).any():
        return Registration(centred, unregistered_quality("the scan has no measured pixel"))
    flat = remove_bow(at_layout_pitch(height, scan_pitch_um, layout_pitch_um))
    has_structure = layout.min() < layout.max() and np.nanstd(flat) > SMALLEST_STRUCTURE_UM
    smooth_layout = predicted_topography(layout, SEARCH_BLUR_PX)
    layout_repeats = rival_alignment(smooth_layout, smooth_layout) if has_structure else float("nan")
    features = layout_repeats <= MAX_LAYOUT_REPEATS
    coarse = None
    if has_structure:
        coarse = find_coarse(flat, layout, smooth_layout, features=features, seed=seed)
    if coarse is None:
        why = "the scan or the layout shows no structure"
        if np.nanstd(flat) <= SMALLEST_STRUCTURE_UM:
            why = f"the scan shows no structure: its heights vary by {np.nanstd(flat):.1e} µm; check the unit"
        return Registration(centred, unregistered_quality(why))

    oriented = coarse.polarity * orient(flat, coarse.orientation)
    start, rung = coarse.layout_to_oriented, "affine" if model == "ladder" else model
    fine = refine_pyramid(oriented, layout, start, rung)
    fine, defects = refine_around_defects(fine, oriented, layout, start, rung)
    if defects is not None:
        oriented = without_defects(oriented, defects, fine.refinement.layout_to_scan)
    if model == "ladder":
        fine = climb(fine)
    before = _on_layout(height, centred, layout.shape, scan_pitch_um, layout_pitch_um)
    known = {
        "layout_repeats": layout_repeats,
        "ncc_before": height_correlation(before, layout),
        "defect_share": 0.0 if defects is None else float(defects.mean()),
        "noise_variance_factor": noise_variance_factor(scan_pitch_um, layout_pitch_um),
    }
    case = _Case(height, layout, scan_pitch_um, layout_pitch_um, seed, defects, known)
    slow = slow_axis(coarse.orientation, fast_axis)
    straight, blocks = case.registration(coarse, fine)
    if model not in BENDABLE or not features:
        return straight
    found = [straight] if straight.quality.passed else []
    if blocks.bends_along(slow) and (crept := refine_curved(oriented, layout, fine, slow)):
        with_creep, _ = case.registration(coarse, crept)
        if with_creep.quality.passed:
            found = [with_creep]
    if (
        not straight.quality.passed
        and (curved := refine_curved(oriented, layout, fine, "quadratic")) is not None
    ):
        bent, _ = case.registration(coarse, curved)
        found += [bent] if _explains(bent.quality, straight.quality) else []
    return min(found, key=lambda one: one.quality.tre_median_px, default=straight)


def _explains(bent: RegistrationQuality, straight: RegistrationQuality) -> bool:
    """Return whether the fit with a bend passed, and its error on held-out blocks is at most half the error
    of the straight fit.
    """
    return bent.passed and bent.tre_median_px <= BENT_SHARE * straight.tre_median_px


@dataclass(frozen=True)
class _Case:
    """One scan with its layout. ``known`` contains the quality values that are the same for every warp."""

    height_um: Array
    layout: Array
    scan_pitch_um: YX
    layout_pitch_um: float
    seed: int
    defects: Array | None
    known: Mapping[str, float]

    def registration(self, coarse: CoarseFit, fine: FineFit) -> tuple[Registration, BlockShifts]:
        """Convert a fit to µm, compute its quality values, and judge whether it passes.

        Return the registration, and the shifts of the field's blocks relative to the warp.
        """
        height, layout, pitch_um = self.height_um, self.layout, self.layout_pitch_um
        layout_to_scan, bend_um = self._in_um(coarse, fine.refinement)
        scan_to_layout = _rounded(np.linalg.inv(layout_to_scan))
        after = _on_layout(height, scan_to_layout, layout.shape, self.scan_pitch_um, pitch_um, bend_um)
        if self.defects is not None:
            after = np.where(self.defects, np.nan, after)
        evidence, blocks = figures_of_evidence(fine, pitch_um, self.seed)
        figures = {
            **figures_of_fit(coarse, fine, pitch_um),
            **figures_of_warp(layout_to_scan, layout.shape, pitch_um),
            **evidence,
            **self.known,
            "overlap": float(np.isfinite(after).mean()),
            "ncc_after": height_correlation(after, layout),
        }
        passed, reason, warning = judge(figures, fine.blur_px, bend_um)
        quality = RegistrationQuality(passed=passed, reason=reason, warning=warning, **figures)
        return Registration(scan_to_layout, quality, bend_um, self.defects), blocks

    def _in_um(self, coarse: CoarseFit, found: Refinement) -> tuple[Array, Bend | None]:
        """Return the matrix that maps the layout to the straightened scan, and the bend of the scan. Both are
        in µm, in the frame of the scan as it was read.
        """
        frame = index_to_um((self.layout_pitch_um, self.layout_pitch_um))
        ny, nx = self.height_um.shape
        size_um = np.array([nx * self.scan_pitch_um[1], ny * self.scan_pitch_um[0]])
        shape = _shape_at(self.layout_pitch_um, self.height_um.shape, self.scan_pitch_um)
        to_oriented = orientation_matrix(coarse.orientation, shape)
        if found.bend is None:
            to_scan = np.linalg.inv(to_oriented)
            return frame @ to_scan @ found.layout_to_scan @ np.linalg.inv(frame), None
        # The scan as it was read may be rotated or mirrored. In its frame, the bend has other coefficients.
        # These coefficients are fitted to a grid of points and the positions of these points in the layout.
        points_um = lattice(*[np.linspace(0, 1, 9)] * 2) * size_um
        oriented = apply_transform(to_oriented @ np.linalg.inv(frame), points_um)
        to_layout = frame @ np.linalg.inv(found.layout_to_scan)
        images_um = apply_transform(to_layout, found.bend.straighten(oriented))
        scan_to_layout, bend_um = fit_bent_affine(
            points_um, images_um, size_um / 2, size_um / 2, found.bend.degree
        )
        # The bend is rounded to the digits that have a physical meaning, as ``_rounded`` does for the matrix.
        bend_um = replace(bend_um, amount=np.round(bend_um.amount, 6) + 0.0)
        return np.linalg.inv(scan_to_layout), bend_um


def centred_placement(
    scan_shape: Shape,
    scan_pitch_um: YX,
    layout_shape: Shape,
    layout_pitch_um: float,
) -> Array:
    """Return the matrix ``scan_to_layout`` (3×3, µm) that places the scan's centre on the layout's centre."""
    matrix = np.eye(3)
    matrix[0, 2] = (layout_shape[1] * layout_pitch_um - scan_shape[1] * scan_pitch_um[1]) / 2
    matrix[1, 2] = (layout_shape[0] * layout_pitch_um - scan_shape[0] * scan_pitch_um[0]) / 2
    return matrix


def _check(height: Array, layout: Array, scan_pitch_um: YX, layout_pitch_um: float) -> None:
    for name, image in (("scan", height), ("layout", layout)):
        if image.ndim != 2 or min(image.shape) < MIN_SIZE_PX:
            wanted = f"(ny, nx) of at least {MIN_SIZE_PX} pixels each"
            raise InputError(f"shape of the {name}", got=image.shape, wanted=wanted)
    if not all(np.isfinite(pitch) and pitch > 0 for pitch in (*scan_pitch_um, layout_pitch_um)):
        raise InputError("pitch", got=(scan_pitch_um, layout_pitch_um), wanted="positive numbers in µm")


def at_layout_pitch(height: Array, scan_pitch_um: YX, layout_pitch_um: float) -> Array:
    """Return the heights of the scan resampled to the layout's pitch, shape (ny, nx).

    This copy is used only to find the warp. The heights of the dataset are resampled from the original scan,
    so that they are interpolated only once.
    """
    if np.allclose(scan_pitch_um, layout_pitch_um, rtol=1e-6):
        return height
    shape = _shape_at(layout_pitch_um, height.shape, scan_pitch_um)
    return _on_layout(height, np.eye(3), shape, scan_pitch_um, layout_pitch_um).astype(float)


def _on_layout(
    height: Array,
    scan_to_layout: Array,
    shape: Shape,
    scan_pitch_um: YX,
    layout_pitch_um: float,
    bend_um: Bend | None = None,
) -> Array:
    return resample_to_layout(
        height,
        scan_to_layout,
        shape,
        scan_pitch_um=scan_pitch_um,
        layout_pitch_um=layout_pitch_um,
        bend_um=bend_um,
    )[0]


def _shape_at(layout_pitch_um: float, scan_shape: Shape, scan_pitch_um: YX) -> tuple[int, int]:
    """Return the shape (ny, nx) that a scan has after resampling to the layout's pitch."""
    ny, nx = (max(1, round(n * p / layout_pitch_um)) for n, p in zip(scan_shape, scan_pitch_um, strict=True))
    return ny, nx


def _rounded(matrix: Array) -> Array:
    """Round the matrix to the digits that have a physical meaning. The digits that are dropped may differ
    from computer to computer.
    """
    matrix = matrix / matrix[2, 2]
    rounded = np.round(matrix, 8)
    rounded[:2, 2] = np.round(matrix[:2, 2], 6)
    rounded[2, :2] = np.round(matrix[2, :2], 10)
    return rounded + 0.0  # no negative zeros
