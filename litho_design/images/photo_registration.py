"""Clean a photograph and register it to the expected image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.hashes import file_sha256
from litho_data.register.geometry import ORIENTATIONS, orient, orientation_matrix
from litho_design.images.camera_counts import (
    LARGEST_SATURATED,
    flattened,
    saturated_share,
    without_outliers,
)
from litho_design.images.camera_fit import (
    fit_camera,
    fitted_dark_level,
    inside_photograph,
    print_moves,
)
from litho_design.images.camera_pose import best_correlation
from litho_design.images.measurements import PhotoSource
from litho_design.images.noise import noise_of_light
from litho_design.images.photograph import CameraRecord, Photograph
from litho_design.images.targets import read_grey

_SMALLEST_CORRELATION = 0.45
_SMALLEST_COVERAGE = 0.9
# Limit of |log(gamma)| above which a photograph is rejected. The counts are proportional to light^gamma.
_LARGEST_GAMMA_OFF = 0.2
# Standard deviation of the relative loss of light in the corners of a photograph, which depends on the
# objective.
_VIGNETTING_SD = 0.1
# Orientations are compared on images with about this side, px; correlations that differ by less than ``_TIE``
# are a tie.
_SMALL_PX = 192
_TIE = 0.03


def photographed_image(
    wanted: np.ndarray,
    wanted_pitch_um: float,
    source: PhotoSource,
    finest_per_um: float,
    averaged_um: float = 0.0,
    others: Sequence[np.ndarray] = (),
) -> Photograph:
    """Register a photograph to the expected image, which was predicted for the design.

    The dark level is subtracted, and single hot or dead pixels are replaced by the median of their
    neighbours. Then a model of the camera is fitted by least squares, so that the photograph matches the
    expected image. The parameters of the camera are position, rotation, tilt, gain and background. The scale
    is fitted only if the pitch has an uncertainty, because a fitted scale would conceal that a print makes
    its image too large. All eight orientations are tried. A photograph that fits another orientation better
    than ``orientation`` is rejected.

    Args:
        wanted: expected image in any unit, shape (m, m).
        wanted_pitch_um: side of the pixels of ``wanted``, µm.
        source: greyscale image of any bit depth whose counts are proportional to the light. If the dark level
            is unknown, it is chosen so that the darkest pixels have the expected brightness.
        finest_per_um: highest spatial frequency of the image, 2 NA / wavelength; finer detail is removed.
        averaged_um: side, µm, of the pixels over which the expected image is averaged; the photograph is
            averaged over the same area. Give 0 if the expected image contains values at points.
        others: images behind the prints that other models predict for the same layout, each of shape (m, m).
            They show how far the image may move from printer to printer. This movement is added to the
            uncertainty of the position.

    Raises:
        InputError: the file is not an image, the pitch is not positive or too coarse for the finest detail of
            the image, or the orientation is unknown. The error is also raised if the photograph is
            overexposed or not linear, if it does not resemble the expected image, or if it is mirrored or
            rotated.
    """
    photo_file, pitch_um, pitch_sd = source.path, source.pitch_um, source.pitch_sd
    dark_level, orientation = source.dark_level, source.orientation
    if not pitch_um > 0 or not pitch_sd >= 0:
        raise InputError("camera pitch", got=f"{pitch_um} µm ± {pitch_sd}", wanted="a positive number")
    # The finest fringes need two pixels per period. The limit is rounded down to whole nanometres.
    coarsest_um = math.floor(500 / finest_per_um) / 1000
    if pitch_um > coarsest_um:
        raise InputError(
            "camera pitch",
            got=f"{pitch_um:g} µm, too coarse for the finest detail of the light",
            wanted=f"at most {coarsest_um:g} µm",
            hint="use a higher magnification",
        )
    require_known("camera orientation", orientation, ORIENTATIONS)
    raw, notes = read_grey(photo_file, "photograph")
    photo = raw.astype(np.float32)
    saturated = saturated_share(raw)
    may_cut_off = raw.min() == 0 and (dark_level is None or dark_level > 0)
    cut_off = float((raw == 0).mean()) if may_cut_off else 0.0
    if max(saturated, cut_off) > LARGEST_SATURATED:
        raise InputError(
            f"photograph {photo_file}",
            got=f"{100 * max(saturated, cut_off):.1f} % of its pixels at the lowest or highest value",
            wanted=f"at most {100 * LARGEST_SATURATED:g} %",
            hint="use a shorter exposure" if saturated > cut_off else "raise the black level above the noise",
        )
    cleaned, replaced = without_outliers(photo, pitch_um * finest_per_um)
    if source.flat is not None:
        cleaned = flattened(cleaned, source.flat, dark_level)
    wanted, scale = wanted.astype(np.float32) / wanted.max(), pitch_um / wanted_pitch_um
    ambiguous = _check_orientation(cleaned, wanted, scale, pitch_sd, orientation, photo_file)
    upright = np.ascontiguousarray(orient(cleaned, orientation))
    fit = fit_camera(upright, wanted, scale, pitch_sd, print_moves(wanted, others))
    if fit.correlation < _SMALLEST_CORRELATION:
        raise _unlike(photo_file, fit.correlation)
    coverage = float(inside_photograph(fit.window_to_photo, upright.shape, len(wanted)).mean())
    if coverage < _SMALLEST_COVERAGE:
        got = f"{100 * coverage:.0f} % of the image"
        wanted_share = f"at least {100 * _SMALLEST_COVERAGE:.0f} %"
        raise InputError(f"photograph {photo_file}", got=got, wanted=wanted_share)
    # If the print differs from the expected one, its image is bright and dark in other places. The fit can
    # mistake this difference for a gamma other than 1.
    open_gamma = _LARGEST_GAMMA_OFF + 2 * (1 - fit.correlation)
    if abs(math.log(fit.gamma)) > max(open_gamma, 3 * fit.gamma_sd):
        raise InputError(
            f"photograph {photo_file}",
            got=f"counts proportional to the light to the power {fit.gamma:.2f} ± {fit.gamma_sd:.2f}",
            wanted="counts proportional to the light",
            hint="use the camera's raw file, or undo its gamma",
        )
    dark, dark_sd = (dark_level, 0.0) if dark_level is not None else fitted_dark_level(upright, wanted, fit)
    counts = upright - np.float32(dark)
    noise_counts, noise_share = noise_of_light(counts)
    to_window = np.linalg.inv(fit.window_to_photo) @ orientation_matrix(orientation, cleaned.shape)
    record = CameraRecord(
        name=Path(photo_file).name,
        sha256=file_sha256(photo_file),
        pitch_um=pitch_um,
        pitch_sd=pitch_sd,
        dark_level=dark,
        replaced_pixels=replaced,
        saturated_share=saturated,
        correlation=fit.correlation,
        photo_to_window=(to_window / to_window[2, 2]).tolist(),
        orientation=orientation,
        ambiguous=ambiguous,
        noise_counts=noise_counts,
        noise_share=noise_share,
        dark_level_sd=dark_sd,
        position_sd_um=fit.position_sd_px * wanted_pitch_um,
        scale_sd=fit.scale_sd,
        vignetting_sd=_VIGNETTING_SD if source.flat is None else 0.0,
        blur_um=fit.blur_px * wanted_pitch_um,
        gamma=fit.gamma,
        coverage=coverage,
        notes=notes,
    )
    side = len(wanted)
    where, lit, warps = fit.window_to_photo, fit.gain * wanted, fit.other_warps
    return Photograph(counts, where, side, wanted_pitch_um, finest_per_um, averaged_um, record, lit, warps)


def _check_orientation(
    photo: np.ndarray, wanted: np.ndarray, scale: float, pitch_sd: float, asked: str, photo_file: str | Path
) -> list[str]:
    """Return the names of the other orientations in which the photograph fits the expected image as well as
    in the requested orientation.

    Raises:
        InputError: the photograph fits better in another orientation, or it fits in no orientation.
    """
    import cv2

    shrink = max(1, wanted.shape[0] // _SMALL_PX)
    side = wanted.shape[0] // shrink
    small: Any = cv2.resize(wanted, (side, side), interpolation=cv2.INTER_AREA)
    # The photograph is averaged over pixels as large as those of the reduced expected image, so that
    # the noise of the photograph does not influence which orientation fits best.
    finer = max(1, round(wanted.shape[0] / side / scale))
    counts: Any = cv2.blur(photo, (finer, finer)) if finer > 1 else photo
    small_scale = scale * side / wanted.shape[0]
    found = {
        name: best_correlation(np.ascontiguousarray(orient(counts, name)), small, small_scale, pitch_sd)
        for name in ORIENTATIONS
    }
    best = max(found, key=lambda name: found[name])
    if found[best] < _SMALLEST_CORRELATION:
        raise _unlike(photo_file, found[best])
    if found[asked] < found[best] - _TIE:
        raise InputError(
            f"photograph {photo_file}",
            got=f"an image that fits better after {best} (correlation {found[best]:.2f}) than after {asked} "
            f"({found[asked]:.2f})",
            wanted="an upright photograph",
            hint=f"if the camera and not the print caused this, use --camera-orientation {best}",
        )
    return [name for name in found if name != asked and found[name] > found[asked] - _TIE]


def _unlike(photo_file: str | Path, correlation: float) -> InputError:
    return InputError(
        f"photograph {photo_file}",
        got=f"a correlation of {correlation:.2f} with the expected image in any orientation",
        wanted=f"at least {_SMALLEST_CORRELATION}",
        hint="check the camera pitch; give --camera-pitch-sd if it is uncertain",
    )
