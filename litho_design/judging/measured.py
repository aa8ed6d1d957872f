"""Level a measured height map of the printed part, and register it to its layout."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
import torch
from numpy.polynomial import Legendre
from torch import Tensor

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.hashes import file_sha256
from litho_data.foundation.results import Record
from litho_data.register.flows import GENERATORS, LADDER, changes, normalisation
from litho_data.register.pyramid import SCAN_BLUR_PX
from litho_data.register.refine import interior_of
from litho_data.register.topography import predicted_topography, smooth_measured
from litho_data.scan import Scan
from litho_design.images.measurements import Levelling, MeasuredSource
from litho_design.images.noise import DRAWS, covariance_by_tiles, white_noise
from litho_design.judging.loaded import LoadedDesign

# Smallest share of the element that must be measured. With fewer measured pixels, the score would depend too
# much on the filled-in part.
_SMALLEST_COVERAGE = 0.8
# Smallest correlation between a scan and the expected print at which the scan is accepted. After levelling,
# the prints of the measured layouts have a correlation of 0.9 or more with the print that a model predicts.
_SMALLEST_NCC = 0.6
_SMALLEST_FOR_TIP = 64
# Deviations count as dust only if they are larger than the random errors of a print, and wider than the
# deviations at a displaced step.
_DUST_BLUR_PX, _DUST_SIGMAS, _LOWEST_DUST_UM = 1.5, 7.0, 0.1
# A deviation counts as dust if the share of deviating pixels among all others with the same expected height
# is smaller than this value. Heights that differ by less than ``_LIKE_HEIGHT_UM`` count as the same.
_LARGEST_DUSTY_SHARE, _LIKE_HEIGHT_UM = 0.3, 0.005
# Standard deviation of the shift of the whole print along one axis, by which models of the same printer
# differ (rms over 80 prints by two of five models, less the scatter between tiles). A lag along x causes most
# of it.
_PRINT_SHIFT_UM = 0.0075
# Standard deviation of the height correction for the AFM tip, as a share of this correction.
_TIP_SD = 0.3
# Tilt and bow are fitted to the bare substrate around the print if enough of it was measured. The substrate
# closer to the print than ``_FOOT_UM`` is left out, because blur and the tip raise it there. On every side,
# at least the share ``_BARE_SHARE`` of the pixels within an eighth of the element must be measured. The
# spread of the heights must be at most ``_FLAT_UM``; otherwise, the substrate is not bare.
_FOOT_UM, _BARE_SHARE, _FLAT_UM = 0.5, 0.3, 0.02
# Roughness of a substrate is correlated, so this number of pixels counts as one independent height.
_ALIKE_PX = 25
# Total orders of the Legendre polynomials from which the possible tilt and bow of the print itself are
# extrapolated.
_ORDERS = (3, 4, 5, 6)
# The deviation of a print from the expected print is larger in tilt and bow than in the orders above, by the
# factor ``_LARGER``. In addition, all terms of tilt and bow may have one common relative error, whose
# standard deviation is ``_COMMON_SD``. Both numbers were found with ``benchmarks.coverage``.
_LARGER, _COMMON_SD = 2.0, 0.1
# Total orders of the polynomials that each kind of levelling removes.
_FITTED: dict[Levelling, tuple[int, ...]] = {"none": (), "plane": (1,), "bow": (1, 2)}
# Number of groups into which the pixels are divided by their expected height.
_HEIGHTS = 32


class MeasuredRecord(Record):
    """The scan, its agreement with the expected print, and its processing.

    ``orientation`` is the operation that brings the scan into the orientation of the layout.
    ``tilt_um_per_um`` (x, y) is the removed tilt, and ``bow_um`` is the height range of the removed bow over
    the element. They were measured on the bare substrate around the print (``levelled_on`` is ``substrate``),
    or together with the gain of the expected print (``print``), which also removes tilt and bow of the print
    itself. ``removed_sd_um`` contains the standard deviation of each of these terms (x, y, x², xy, y²).
    ``noise_um`` is the standard deviation of the noise, estimated from spatial frequencies at which prints
    have no structure. ``warp_errors_um`` contains independent errors of the registration, each as large as
    its standard deviation: the six of ``_warp_errors_px``, and two shifts of the whole print, along x and
    along y, because a registration cannot tell whether the print or the scan is shifted. It is empty for an
    aligned scan. ``scale_sd`` is the relative standard deviation of the height scale. ``defect_share`` is the
    share of the element that shows dust or scars instead of the print.
    """

    name: str
    sha256: str
    coverage: float
    registration_ncc: float
    aligned: bool
    height_offset_um: float
    orientation: str
    warning: str
    levelling: Levelling
    levelled_on: Literal["substrate", "print"]
    tilt_um_per_um: tuple[float, float]
    bow_um: float
    removed_sd_um: list[float]
    noise_um: float
    warp_errors_um: list[list[float]]
    scale_sd: float
    defect_share: float
    tip_um: float
    tip_change_um: float

    def remarks(self) -> list[str]:
        """Return remarks on the tilt and other effects that were removed from the scan, and on its
        orientation, one phrase each.
        """
        found = [] if not self.warning else [self.warning]
        found += ["the scan was used without registration"] if self.aligned else []
        if self.orientation != "identity":
            found.append(f"the orientation of the scan was corrected by {self.orientation}")
        if self.levelling == "none":
            found.append("no tilt or bow was removed")
        else:
            x, y = self.tilt_um_per_um
            found.append(
                f"a tilt of {x:+.4f}, {y:+.4f} µm/µm and a bow of {1000 * self.bow_um:.0f} nm were removed, "
                + (
                    "as measured on the bare substrate around the print"
                    if self.levelled_on == "substrate"
                    else "which may hide tilt and bow of the print itself"
                )
            )
        if self.defect_share:
            found.append(
                f"dust or scars cover {100 * self.defect_share:.2g} % of the element and were excluded"
            )
        if self.tip_um:
            change = f"{1000 * self.tip_change_um:.0f} nm rms"
            found.append(
                f"the widening caused by a tip with a radius of {1000 * self.tip_um:.0f} nm was removed, "
                f"which changed the heights by {change}"
            )
        return found


def measured_print(loaded: LoadedDesign, source: MeasuredSource) -> tuple[Tensor, MeasuredRecord, Tensor]:
    """Resample the measured heights of a printed design onto the pixels of its layout.

    The zero of an AFM map is arbitrary, and a constant height is only a constant phase. The zero is therefore
    set so that the median difference between the measured and the expected print is 0. The expected print is
    the one that was predicted when the layout was designed. Tilt and bow of the scanner are fitted to the
    bare substrate around the print. If the scan does not show enough of it, they are fitted together with the
    gain of the expected print, so that the tilt and bow of the expected print are not removed. Unmeasured
    pixels are filled with the heights of the expected print.

    Args:
        loaded: the design.
        source: the scan, in any format that ``litho-data inspect`` reads.

    Returns:
        The height of the print, µm, shape (size, size), the record of the measurement, and a map of the same
        shape. It contains the height, µm, that the print itself may have in addition where it was taken for
        dust or a scar.

    Raises:
        InputError: the scan cannot be registered, covers too little of the element, or does not resemble the
            expected print.
    """
    from litho_data.readers import read_scan

    require_known("levelling", source.levelling, get_args(Levelling))
    if not source.scale_sd >= 0:
        raise InputError("uncertainty of the height scale", got=source.scale_sd, wanted="0 or more")
    layout = loaded.record.layout
    size_um = (source.size_um,) * 2 if isinstance(source.size_um, float) else source.size_um
    scan = read_scan(source.path, unit=source.unit, size_um=size_um)
    place = _as_it_lies if source.aligned else _registered
    scan, tip_um, tip_change_um = _without_tip(scan, source.tip_um)
    placed = place(scan, loaded.level.cpu().numpy(), layout.pitch_um)
    height, valid = (placed.inner(one) for one in (placed.height_um, placed.valid))
    coverage = float(valid.mean())
    if coverage < _SMALLEST_COVERAGE:
        raise InputError(
            f"scan {source.path}",
            got=f"{100 * coverage:.0f} % of the element",
            wanted=f"at least {100 * _SMALLEST_COVERAGE:.0f} %",
            hint="a hologram needs its whole area; stitch the scans first",
        )
    expected = loaded.expected_um.cpu().numpy()
    bare = substrate_background(placed, layout.pitch_um, source.levelling)
    background = bare or fitted_background(height, expected, valid, layout.pitch_um, source.levelling)
    defects = _defects(np.where(valid, height - background.map_um - expected, 0.0), expected, valid)
    valid = valid & ~defects
    background = bare or fitted_background(height, expected, valid, layout.pitch_um, source.levelling)
    levelled = height - background.map_um
    ncc = float(np.corrcoef(levelled[valid], expected[valid])[0, 1])
    if not ncc >= _SMALLEST_NCC:
        raise InputError(
            f"scan {source.path}",
            got=f"a correlation of {ncc:.2f} with the print that the design expects",
            wanted=f"at least {_SMALLEST_NCC}",
            hint="use --scan-levelling bow" if source.levelling != "bow" else "",
        )
    offset = float(np.median(levelled[valid] - expected[valid]))
    complete = np.where(valid, levelled - offset, expected).astype(np.float32)
    # Up to the nominal height of the highest level, the print itself may be what looks like dust.
    plausible = np.clip(levelled - offset, 0, (layout.levels - 1) * layout.level_height_um)
    doubt = np.where(defects, plausible - expected, 0.0).astype(np.float32)
    record = MeasuredRecord(
        name=Path(source.path).name,
        sha256=file_sha256(source.path),
        coverage=coverage,
        registration_ncc=ncc,
        height_offset_um=offset,
        aligned=source.aligned,
        orientation=placed.orientation,
        warning=placed.warning,
        levelling=source.levelling,
        levelled_on="substrate" if bare else "print",
        tilt_um_per_um=background.tilt_um_per_um,
        bow_um=background.bow_um,
        removed_sd_um=bare.sd_um if bare else [_removed_sd_um(complete - expected, expected)] * 5,
        noise_um=white_noise(complete - expected),
        warp_errors_um=(layout.pitch_um * placed.warp_errors_px).tolist(),
        scale_sd=source.scale_sd,
        defect_share=float(defects.mean()),
        tip_um=tip_um,
        tip_change_um=tip_change_um,
    )
    return torch.from_numpy(complete).to(loaded.device), record, torch.from_numpy(doubt).to(loaded.device)


def _without_tip(scan: Scan, tip_um: float | None) -> tuple[Scan, float, float]:
    """Correct a scan for the AFM tip, which makes structures wider. Return the corrected scan, the radius of
    the tip, µm, and the rms change of the heights, µm.
    """
    from litho_data.tip import estimate_tip, paraboloid_erosion

    radius_um = tip_um
    if radius_um is None and min(scan.height_um.shape) >= _SMALLEST_FOR_TIP:
        found = estimate_tip([scan])
        radius_um = found.radius_um if found.kind == "estimate" else None
    if not radius_um:
        return scan, 0.0, 0.0
    if not radius_um > 0:
        raise InputError("radius of the tip", got=f"{radius_um} µm", wanted="a positive length, or 0")
    surface = paraboloid_erosion(scan.height_um, scan.require_pitch(), radius_um).surface
    change_um = float(np.nanstd(surface - scan.height_um))
    return replace(scan, height_um=surface), radius_um, change_um


def _defects(off_um: np.ndarray, expected_um: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return a mask of dust and scars.

    A spot of deviating pixels counts as dust if few of the other pixels with the same expected height
    deviate. If many of them deviate, the printer is the cause. If no other pixel has this expected height,
    the spot counts as dust.

    Args:
        off_um: deviation of a print from the expected print, without tilt and bow, shape (ny, nx). It is zero
            at unmeasured pixels.
        expected_um: height of the expected print, shape (ny, nx).
        valid: mask of the measured pixels, shape (ny, nx).
    """
    from scipy.ndimage import binary_dilation, gaussian_filter, label

    from litho_data.level.scars import mark_scars

    # If a step of the print is displaced by a pixel, the deviation is positive in one place and negative next
    # to it, so a blur removes it.
    smooth = gaussian_filter(off_um, _DUST_BLUR_PX)
    middle = np.median(smooth)
    spread = 1.4826 * float(np.median(np.abs(smooth - middle)))
    size_um = np.abs(smooth - middle)
    dust = (size_um > max(_DUST_SIGMAS * spread, _LOWEST_DUST_UM)) & valid
    spots, count = label(dust)
    foreign = np.zeros_like(dust)
    for spot in range(1, count + 1):
        inside = spots == spot
        core = inside & (size_um >= np.median(size_um[inside]))
        low, high = np.percentile(expected_um[core], (25, 75)) + _LIKE_HEIGHT_UM * np.array([-1, 1])
        elsewhere = (expected_um >= low) & (expected_um <= high) & valid & ~inside
        if not elsewhere.any() or dust[elsewhere].mean() < _LARGEST_DUSTY_SHARE:
            foreign |= inside
    strict: Any = {"high": 4.0, "low": 2.5, "max_width_px": 2}
    scars = mark_scars(off_um, **strict) | mark_scars(off_um.T, **strict).T
    return binary_dilation(foreign | scars, iterations=2) & valid


class _Placed(NamedTuple):
    """A scan resampled on the pixels of the layout and of ``margin_px`` pixels around it. It contains the
    heights and the mask of measured pixels, both of shape (ny + 2 margin, nx + 2 margin), the orientation, a
    warning, and the errors of the registration (see ``MeasuredRecord``).
    """

    height_um: np.ndarray
    valid: np.ndarray
    margin_px: int = 0
    orientation: str = "identity"
    warning: str = ""
    warp_errors_px: np.ndarray = np.zeros((0, 6))

    def inner(self, one: np.ndarray) -> np.ndarray:
        """Return the part of a map that lies on the layout, of shape (ny, nx)."""
        ny, nx = one.shape
        return one[self.margin_px : ny - self.margin_px, self.margin_px : nx - self.margin_px]


def _as_it_lies(scan: Scan, level: np.ndarray, pitch_um: float) -> _Placed:
    own_pitch = scan.require_pitch()
    if scan.height_um.shape != level.shape or not np.allclose(own_pitch, pitch_um, rtol=1e-3):
        raise InputError(
            f"aligned scan {scan.source}",
            got=f"{scan.height_um.shape} px of {own_pitch[0]:g} µm",
            wanted=f"{level.shape} px of {pitch_um:g} µm, the pixels of the element",
        )
    return _Placed(scan.height_um, np.isfinite(scan.height_um))


def _registered(scan: Scan, level: np.ndarray, pitch_um: float) -> _Placed:
    from litho_data.register import register_scan, resample_to_layout

    pitches: Any = {"scan_pitch_um": scan.require_pitch(), "layout_pitch_um": pitch_um}
    found = register_scan(scan.height_um, level, **pitches, model="affine")
    quality = found.quality
    if not quality.passed:
        raise InputError(
            f"scan {scan.source} on the layout of the design",
            got=quality.reason,
            wanted="a match",
            hint="use --scan-aligned if the scan has the pixels of the element",
        )
    margin_px = min(level.shape) // 8
    moved = np.eye(3)
    moved[:2, 2] = margin_px * pitch_um
    height, valid = resample_to_layout(
        scan.height_um, moved @ found.scan_to_layout, tuple(size + 2 * margin_px for size in level.shape),
        **pitches, bend_um=found.bend_um,
    )  # fmt: skip
    placed = _Placed(height, valid, margin_px, quality.dihedral, quality.warning)
    topography = predicted_topography(level, quality.blur_um / pitch_um).astype(float)
    errors_px = _warp_errors_px(placed.inner(height), topography)
    shifts_px = _PRINT_SHIFT_UM / pitch_um * np.eye(2, 6)
    return placed._replace(warp_errors_px=np.vstack([errors_px, shifts_px]))


def _warp_errors_px(height_um: np.ndarray, topography: np.ndarray) -> np.ndarray:
    """Return six independent errors of the affine map that registers a scan, one in each row, shape (6, 6).

    Each error is as large as its standard deviation. It consists of the coefficients of the six generators of
    an affine map (see ``register.flows``), in pixels: a coefficient of 1 displaces the middle of an edge of a
    square by one pixel. The errors are computed from the deviation of the heights from the topography, the
    image to which the scan was registered. Gain and a quadratic background are fitted, too.

    Args:
        height_um: height of the registered scan, shape (ny, nx), NaN where not measured.
        topography: height of the layout after blurring, in any unit, shape (ny, nx).
    """
    shape = topography.shape
    used = interior_of(shape) & np.isfinite(height_um)
    height = smooth_measured(height_um, SCAN_BLUR_PX)
    still = np.dstack([_shapes(shape, (0, 1, 2)), topography])
    found, *_ = np.linalg.lstsq(still[used], height[used], rcond=None)
    moved = np.moveaxis(changes(found[-1] * topography, LADDER["affine"]), 0, -1)
    slopes = np.where(used[..., None], np.dstack([still, moved]), 0.0)
    residual = np.where(used, height - still @ found, 0.0)
    covariance = covariance_by_tiles(slopes.reshape(-1, slopes.shape[-1]), residual.ravel(), shape)
    variance, ways = np.linalg.eigh(covariance[-6:, -6:])
    errors: np.ndarray = (ways * np.sqrt(variance.clip(0))).T
    return errors


@dataclass(frozen=True)
class Background:
    """Tilt and bow of a scan. ``map_um`` is their sum, shape (ny, nx). The other fields are the slopes of the
    tilt along x and y, the range of the bow, and the standard deviation of each term.
    """

    map_um: np.ndarray
    tilt_um_per_um: tuple[float, float]
    bow_um: float
    sd_um: list[float]

    @classmethod
    def of(cls, terms_um: np.ndarray, shape: tuple[int, int], pitch_um: float, sd_um: list[float]) -> Self:
        """Make the background with the given coefficients of x, y, x², xy and y² (see ``_shapes``)."""
        terms_um = np.pad(terms_um, (0, 5 - len(terms_um)))
        shapes = _shapes(shape, (1, 2))
        bow = shapes[..., 2:] @ terms_um[2:]
        lengths_um = [(size - 1) / 2 * pitch_um for size in shape[::-1]]
        x, y = (math.sqrt(3) * term / length for term, length in zip(terms_um, lengths_um, strict=False))
        return cls(shapes @ terms_um, (float(x), float(y)), float(np.ptp(bow)), sd_um)


def fitted_background(
    height_um: np.ndarray, expected_um: np.ndarray, valid: np.ndarray, pitch_um: float, levelling: Levelling
) -> Background:
    """Fit the tilt and bow of a scan, together with the gain of the expected print, by least squares. All
    maps have shape (ny, nx).
    """
    shapes = _shapes(height_um.shape, _FITTED[levelling])
    columns = np.dstack([shapes, expected_um, np.ones_like(expected_um)])
    found, *_ = np.linalg.lstsq(columns[valid], height_um[valid].astype(float), rcond=None)
    return Background.of(found[:-2], expected_um.shape, pitch_um, [])


def substrate_background(placed: _Placed, pitch_um: float, levelling: Levelling) -> Background | None:
    """Fit the tilt and bow of a scan to the bare substrate around the print, without pixels that deviate.
    Return None if too little of the substrate was measured, or if the substrate is not flat.
    """
    margin, foot = placed.margin_px, math.ceil(_FOOT_UM / pitch_um)
    width, shape = margin - foot, placed.inner(placed.valid).shape
    if width < 1 or levelling == "none":
        return None
    bare = placed.valid.copy()
    bare[width:-width, width:-width] = False
    sides = bare[:width], bare[-width:], bare[:, :width], bare[:, -width:]
    if min(side.mean() for side in sides) < _BARE_SHARE:
        return None
    columns = _shapes(shape, (0, *_FITTED[levelling]), margin)
    for _ in range(3):
        seen, height = columns[bare], placed.height_um[bare].astype(float)
        found, *_ = np.linalg.lstsq(seen, height, rcond=None)
        rest = np.abs(height - seen @ found)
        spread_um = 1.4826 * float(np.median(rest))
        bare[bare] = rest <= 4 * spread_um
    if spread_um > _FLAT_UM or min(side.mean() for side in sides) < _BARE_SHARE:
        return None
    variances = np.diag(np.linalg.inv(seen.T @ seen))[1:] * _ALIKE_PX
    return Background.of(found[1:], shape, pitch_um, (spread_um * np.sqrt(variances)).tolist())


def with_more_noise(height_um: Tensor, record: MeasuredRecord) -> Iterator[Tensor]:
    """Yield pairs of prints of shape (ny, nx), in µm, with added random noise, which is as strong as the
    noise of the scan. In the two prints of a pair, the same noise has opposite signs.
    """
    generator = np.random.default_rng(0)
    for _ in range(DRAWS):
        yield from _pair(record.noise_um * generator.standard_normal(height_um.shape), height_um)


def with_other_scale(height_um: Tensor, record: MeasuredRecord, pitch_um: float) -> Iterator[Tensor]:
    """Yield pairs of prints of shape (ny, nx), in µm, in which the height scale or the effect of the tip
    differs by plus and minus its standard deviation.
    """
    from litho_data.tip import paraboloid_erosion

    measured = height_um.double().cpu().numpy()
    yield from _pair(record.scale_sd * measured, height_um)
    if record.tip_um:
        narrower = paraboloid_erosion(measured, (pitch_um, pitch_um), record.tip_um).surface
        yield from _pair(_TIP_SD * (narrower - measured), height_um)


def with_other_fits(
    height_um: Tensor, record: MeasuredRecord, pitch_um: float, doubt_um: Tensor
) -> Iterator[Tensor]:
    """Yield pairs of prints of shape (ny, nx), in µm, that the processing of the scan cannot distinguish from
    the measured print. The two prints of a pair differ from the measured print in one quantity: by plus its
    standard deviation in the first, and by minus it in the second. This quantity is a term of the print's own
    tilt and bow, a factor common to all these terms (unless they were measured on the substrate), or an error
    of the registration. In the last pair, all or none of ``doubt_um`` belongs to the print instead of dust.
    """
    measured = height_um.double().cpu().numpy()
    removed = _shapes(measured.shape, _FITTED[record.levelling])
    for shape, sd_um in zip(np.moveaxis(removed, -1, 0), record.removed_sd_um, strict=False):
        yield from _pair(sd_um * shape, height_um)
    if removed.size and record.levelled_on == "print":
        yield from _pair(_COMMON_SD * removed @ _amounts(measured - measured.mean(), removed), height_um)
    for error_um in record.warp_errors_um:
        for sign in (1, -1):
            motion_px = sign * np.array(error_um) / pitch_um
            yield torch.from_numpy(_displaced(measured, motion_px)).to(height_um)
    if doubt_um.any():
        # The deviation may be dust or print with equal probability, so the score is corrected by half of its
        # effect.
        yield from (height_um + doubt_um, height_um)


def _pair(change_um: np.ndarray, height_um: Tensor) -> Iterator[Tensor]:
    """Yield the print plus the change, and the print minus the change."""
    for sign in (1, -1):
        yield height_um + torch.from_numpy(sign * change_um).to(height_um)


def _displaced(height_um: np.ndarray, motion_px: np.ndarray) -> np.ndarray:
    """Return a print of shape (ny, nx) whose height at each pixel is that of the given print at a displaced
    position. ``motion_px`` contains six coefficients of an affine map (see ``_warp_errors_px``).
    """
    from scipy.ndimage import affine_transform

    ny, nx = height_um.shape
    motion = np.tensordot(motion_px, GENERATORS[: LADDER["affine"]], 1)
    # The third coordinate, 1, comes last, and scipy's coordinates are (y, x).
    to_place = np.eye(3) + motion @ normalisation((ny, nx))
    matrix, offset = to_place[1::-1, 1::-1], to_place[1::-1, 2]
    found: np.ndarray = affine_transform(height_um, matrix, offset, order=3, mode="nearest")
    return found


def _shapes(shape: tuple[int, ...], orders: Iterable[int], margin_px: int = 0) -> np.ndarray:
    """Return all products of a Legendre polynomial in y and a Legendre polynomial in x whose two orders add
    up to a number in ``orders``. Each product has an rms of 1 over ``shape``, which is (ny, nx). The result
    has shape (ny + 2 margin, nx + 2 margin, number of products), because it continues beyond ``shape``.
    """
    reaches = (1 + 2 * margin_px / (size - 1) for size in shape)
    y, x = (
        np.linspace(-reach, reach, size + 2 * margin_px) for reach, size in zip(reaches, shape, strict=True)
    )
    pairs = [(i, order - i) for order in orders for i in range(order + 1)]
    along = [[math.sqrt(2 * n + 1) * Legendre.basis(n)(at) for n in range(max(_ORDERS) + 1)] for at in (y, x)]
    products = [np.outer(along[0][i], along[1][j]) for i, j in pairs]
    return np.stack(products, axis=-1) if products else np.zeros((len(y), len(x), 0))


def _removed_sd_um(off_um: np.ndarray, expected_um: np.ndarray) -> float:
    """Return the standard deviation, µm, that each polynomial term of order 1 or 2 (tilt and bow) may have in
    the print itself.

    It is extrapolated from finer terms of ``off_um``, the deviation from the expected print. First, the mean
    deviation at each expected height is subtracted. The result is ``_LARGER`` times the rms of the terms of
    orders 3 to 6 in the remaining map. Both maps have shape (ny, nx).
    """
    foreign = off_um.ravel().copy()
    for places in np.array_split(np.argsort(expected_um, axis=None), _HEIGHTS):
        foreign[places] -= foreign[places].mean()
    finer = _amounts(foreign.reshape(off_um.shape), _shapes(off_um.shape, _ORDERS))
    return _LARGER * float(np.sqrt(np.mean(finer**2)))


def _amounts(height_um: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Return the n coefficients of a map with respect to ``shapes``, which are orthogonal and have shape (ny,
    nx, n).
    """
    found: np.ndarray = np.tensordot(height_um, shapes, 2) / height_um.size
    return found
