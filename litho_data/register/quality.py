"""Define the record of a registration's quality, and the limits that a registration must meet to pass."""

from dataclasses import dataclass, fields
from typing import Any

from litho_data.register.bend import Bend


@dataclass(frozen=True)
class RegistrationQuality:
    """The quality record of one registration. A value that could not be computed is NaN.

    Lengths in px are in layout pixels. The values in nm are the same lengths, converted with the layout's
    pitch.
    """

    passed: bool
    reason: str  # why the registration failed; empty if it passed
    warning: str  # what the user should know about the registration, even if it passed
    model: str
    method: str  # how the coarse fit was found: orb (matched keypoints) or correlation
    dihedral: str  # the rotation or reflection that gives the scan the orientation of the layout
    polarity: int  # -1 if heights fall where the layout's levels rise, otherwise 1
    converged: bool
    keypoints: int
    matches: int
    inlier_ratio: float
    reprojection_px: float
    coverage: float
    overlap: float
    defect_share: float
    ncc_before: float
    ncc_after: float
    ecc: float
    blur_um: float
    tre_windows: int
    tre_median_px: float
    tre_p95_px: float
    tre_median_nm: float
    tre_p95_nm: float
    curve_x_px: float
    curve_y_px: float
    curve_x_by_y_px: float
    curve_y_by_x_px: float
    corner_sd_px: float
    corner_sd_nm: float
    singular_max: float
    singular_min: float
    shift_x_um: float
    shift_y_um: float
    rotation_deg: float
    layout_repeats: float
    second_alignment: float
    second_orientation: float
    noise_variance_factor: float


# A registration must meet these limits to pass; docs/registration.md gives the reason for each.
MIN_OVERLAP, MIN_ECC = 0.5, 0.7
TRE_MEDIAN_WARNING_PX, MAX_TRE_MEDIAN_PX, MAX_CORNER_SD_PX = 1.0, 1.5, 1.5
# If the sigma of the print's blur exceeds this, the limits MAX_TRE_MEDIAN_PX and MAX_CORNER_SD_PX are
# multiplied by the ratio of that sigma to this value.
BLUR_OF_LIMITS_PX = 8.0
SINGULAR_RANGE, SINGULAR_WARNING_RANGE = (0.90, 1.10), (0.95, 1.05)
MAX_LAYOUT_REPEATS, MAX_SECOND_ALIGNMENT, MIN_ORIENTATION_MARGIN = 0.9, 0.9, 0.1
# If the slope of a bend is 1 or more, two points of the scan may show the same place of the print.
MAX_BEND_SLOPE = 1.0


def judge(figures: dict[str, Any], blur_px: float, bend_um: Bend | None = None) -> tuple[bool, str, str]:
    """Compare the quality values of one registration with the limits, and return (passed, reason, warning).

    The reason names every limit that is not met.

    Args:
        figures: the quality values of the registration, keyed by the names in ``RegistrationQuality``.
        blur_px: sigma, in layout pixels, of the blur that makes the layout most similar to the scan.
        bend_um: the bend of the scan in its own frame, or None if none was fitted.
    """
    smallest, largest = figures["singular_min"], figures["singular_max"]
    scale = f"scale {smallest:.3f} to {largest:.3f}"
    ecc, tre_px, repeats = figures["ecc"], figures["tre_median_px"], figures["layout_repeats"]
    margin, second = ecc - figures["second_orientation"], figures["second_alignment"]
    upright = figures["dihedral"] == "identity" and figures["polarity"] == 1
    softness = max(1.0, blur_px / BLUR_OF_LIMITS_PX)
    overlap, spread_px, defects = figures["overlap"], figures["corner_sd_px"], figures["defect_share"]
    fits, repeating = ecc >= MIN_ECC, repeats > MAX_LAYOUT_REPEATS
    tied = fits and margin < MIN_ORIENTATION_MARGIN
    low, high = SINGULAR_RANGE
    warning_low, warning_high = SINGULAR_WARNING_RANGE
    bent_um = 0.0 if bend_um is None else bend_um.largest
    how = "a quadratic distortion was fitted"
    if bend_um is not None and bend_um.kind == "creep":
        how = "its lines creep along the slow axis, and the creep was corrected"
    # Some conditions are written as "not >=", so that a value that could not be computed (NaN) fails them.
    failures = {
        f"the correlation of scan and layout is {ecc:.2f}, but must be at least {MIN_ECC}": not fits,
        f"ambiguous: the layout repeats itself (correlation {repeats:.2f} with a shifted copy)": repeating,
        f"ambiguous: at another shift, the correlation is {second:.2f} times that of the fit": fits
        and not repeating
        and second > MAX_SECOND_ALIGNMENT,
        f"ambiguous: the correlation in another orientation or polarity is lower by only {margin:.2f}": tied
        and not upright,
        f"the overlap of scan and layout is {overlap:.2f}, but must be at least {MIN_OVERLAP}": not (
            overlap >= MIN_OVERLAP
        ),
        f"{scale}, but only {low} to {high} is allowed; check the pitch": not (
            low <= smallest <= largest <= high
        ),
        f"the target registration error of {tre_px:.2f} px is too large": tre_px
        > softness * MAX_TRE_MEDIAN_PX,
        "the fit does not determine the positions of the corners": spread_px != spread_px,
        f"the positions of the corners are uncertain by {spread_px:.2f} px": spread_px
        > softness * MAX_CORNER_SD_PX,
        f"the bend of up to {bent_um:.2f} µm is so steep that it may fold the scan": bend_um is not None
        and not bend_um.slope < MAX_BEND_SLOPE,
    }
    warnings = {
        f"scan bent by up to {bent_um:.2f} µm: {how}": bend_um is not None,
        f"{defects:.1%} of the field does not show the print and was excluded": defects > 0,
        f"{scale}; check the pitch": not warning_low <= smallest <= largest <= warning_high,
        "the layout looks the same in another orientation, so the scan was assumed to be upright": tied
        and upright,
        f"the target registration error is {tre_px:.2f} px": tre_px > TRE_MEDIAN_WARNING_PX,
        "the contrast of the scan is inverted": figures["polarity"] == -1,
        "the coarse fit used only correlation and no matched keypoints": figures["method"] != "orb",
        "the refinement did not converge": not figures["converged"],
    }
    reasons, said = ("; ".join(text for text, so in one.items() if so) for one in (failures, warnings))
    return not reasons, reasons, said


def unregistered_quality(reason: str) -> RegistrationQuality:
    """Return the quality record of a scan that could not be fitted at all. It contains the reason but no
    values.
    """
    empty: dict[Any, Any] = {int: 0, float: float("nan"), str: "none", bool: False}
    figures = {field.name: empty[field.type] for field in fields(RegistrationQuality)}
    return RegistrationQuality(**{**figures, "reason": reason, "warning": ""})
