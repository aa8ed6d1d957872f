"""Find the orientation, polarity and approximate position of a scan in its layout, by masked normalised
cross-correlation over all shifts.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.geometry import ORIENTATIONS, orient

SEARCH_SIZE_PX = 128
MIN_OVERLAP = 0.4
TIE = 0.02


@dataclass(frozen=True)
class Hypothesis:
    """One possible orientation and polarity of the scan, with the shift at which it correlates best.

    ``layout_to_oriented`` is the 3×3 matrix of this shift, from pixel indices of the layout to pixel indices
    of the oriented scan. ``ncc`` is the correlation at this shift, multiplied by the polarity.
    """

    orientation: str
    polarity: int
    ncc: float
    layout_to_oriented: Array


def search_orientation(scan: Array, topography: Array) -> list[Hypothesis]:
    """Correlate a low-resolution copy of the scan, in every orientation and polarity, with a low-resolution
    copy of the layout.

    Args:
        scan: heights at the layout's pitch, shape (ny, nx), NaN where not measured.
        topography: topography predicted from the layout, shape (ny, nx).

    Returns:
        One hypothesis per orientation and polarity, the best first. The list is empty if the scan or the
        layout shows no structure at all.
    """
    factor = max(1, round(max(*scan.shape, *topography.shape) / SEARCH_SIZE_PX))
    small_scan, small_topography = reduce_image(scan, factor), reduce_image(topography, factor)
    oriented = [orient(small_scan, orientation) for orientation in ORIENTATIONS]
    correlations = _correlations(small_topography, oriented)
    found = []
    for orientation, moving, (correlation, overlap) in zip(ORIENTATIONS, oriented, correlations, strict=True):
        if np.isnan(correlation).all():
            continue
        # On a layout that repeats itself, several shifts have nearly equal correlation. This term prefers the
        # shift with the largest overlap.
        handicap = TIE * (1 - overlap / overlap.max())
        # The centre of a block of `factor` pixels lies (factor - 1) / 2 pixels after the block's first pixel.
        # If the scan's size is not a multiple of the factor, rotating the scan moves the cropped rows and
        # columns to the other side.
        cut_y, cut_x = _cut_off(orientation, scan.shape, factor)
        for polarity in (1, -1):
            row, column = np.unravel_index(np.nanargmax(polarity * correlation - handicap), correlation.shape)
            # Shifts run from -(fixed size - 1) to moving size - 1. Negative shifts are stored at the end.
            shift_y = int(row) - (correlation.shape[0] if row >= moving.shape[0] else 0)
            shift_x = int(column) - (correlation.shape[1] if column >= moving.shape[1] else 0)
            matrix = np.array(
                [[1.0, 0, factor * shift_x + cut_x], [0, 1, factor * shift_y + cut_y], [0, 0, 1]]
            )
            ncc = float(polarity * correlation[row, column])
            found.append(Hypothesis(orientation, polarity, ncc, matrix))
    return sorted(found, key=lambda hypothesis: -hypothesis.ncc)


def rival_alignment(registered: Array, topography: Array) -> float:
    """Return the largest correlation of scan and topography at a competing shift, divided by their
    correlation at zero shift.

    A competing shift is a local maximum of the correlation that lies at least a sixteenth of the field away
    from zero shift. If the topography is passed in place of the registered scan, the result says how strongly
    the layout repeats itself.
    """
    from scipy.ndimage import maximum_filter

    factor = max(1, round(max(topography.shape) / (2 * SEARCH_SIZE_PX)))
    correlation, _ = masked_correlation(reduce_image(topography, factor), reduce_image(registered, factor))
    own = correlation[0, 0]
    if not np.isfinite(own) or own <= 0:
        return float("nan")
    known = np.where(np.isfinite(correlation), correlation, -1.0)
    peaks = known >= maximum_filter(known, size=3, mode="wrap")
    distance = np.hypot(*np.meshgrid(*(_wrapped(n) for n in known.shape), indexing="ij"))
    rivals = known[peaks & (distance >= max(topography.shape) / factor / 16)]
    return float(max(rivals.max(initial=0.0), 0.0) / own)


def rival_orientation(registered: Array, topography: Array) -> float:
    """Return the largest correlation of the topography with the registered scan after the scan has been
    rotated, mirrored or inverted. All shifts are tried.
    """
    factor = max(1, round(max(topography.shape) / SEARCH_SIZE_PX))
    small, scan = reduce_image(topography, factor), reduce_image(registered, factor)
    rivals = []
    correlations = _correlations(small, (orient(scan, orientation) for orientation in ORIENTATIONS))
    for orientation, (correlation, _) in zip(ORIENTATIONS, correlations, strict=True):
        if not np.isnan(correlation).all():
            rivals.append(-np.nanmin(correlation))
            if orientation != "identity":
                rivals.append(np.nanmax(correlation))
    return float(max(rivals, default=float("nan")))


def reduce_image(image: Array, factor: int) -> Array:
    """Return the means of an image over blocks of ``factor`` × ``factor`` pixels.

    The mean is NaN if at least half of a block's pixels are missing. Rows and columns at the end that do not
    fill a block are cropped.
    """
    ny, nx = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: ny * factor, : nx * factor].reshape(ny, factor, nx, factor)
    measured = np.isfinite(blocks)
    count = measured.sum(axis=(1, 3))
    total = np.where(measured, blocks, 0.0).sum(axis=(1, 3))
    return np.divide(total, count, out=np.full((ny, nx), np.nan), where=2 * count > factor**2)


def masked_correlation(fixed: Array, moving: Array) -> tuple[Array, Array]:
    """Return the Pearson correlation of ``fixed[y, x]`` with ``moving[y + sy, x + sx]`` for every shift (sy,
    sx), over the pixels that are measured in both images.

    D. Padfield, Masked object registration in the Fourier domain, IEEE Trans. Image Process. 21 (2012),
    doi:10.1109/TIP.2011.2181402, eq. 11.

    Returns:
        Two arrays: the correlation, and the number of overlapping pixels. Both arrays are indexed by the
        shift modulo their shape. The correlation is NaN if the overlap is smaller than the share
        ``MIN_OVERLAP`` of the smaller image, or if one image is constant in the overlap.
    """
    return next(_correlations(fixed, [moving]))


def _correlations(fixed: Array, moving: Iterable[Array]) -> Iterator[tuple[Array, Array]]:
    """For each of the images in ``moving``, yield its ``masked_correlation`` with ``fixed``. Some terms
    depend only on the fixed image and the mask of the other image. They are computed once for all images with
    the same shape and mask.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    known: dict[Any, Any] = {}
    for image in moving:
        ny, nx = (next_fast_len(a + b - 1, real=True) for a, b in zip(fixed.shape, image.shape, strict=True))
        shape = (ny, nx)

        def summed(one: Array, other: Array, shape: Shape = shape) -> Array:
            return irfft2(one * other, shape)

        if shape not in known:
            measured1, *values1 = _masked(fixed)
            known[shape] = [np.conj(rfft2(one, shape)) for one in (measured1.astype(float), *values1)]
        mask1, height1, square1 = known[shape]
        measured2, *values2 = _masked(image)
        height2, square2 = (rfft2(one, shape) for one in values2)
        key = image.shape, measured2.tobytes()
        if key not in known:
            mask2 = rfft2(measured2.astype(float), shape)
            overlap = np.maximum(np.rint(summed(mask1, mask2)), 1.0)
            total1 = summed(height1, mask2)
            known[key] = overlap, total1, summed(square1, mask2) - total1**2 / overlap
        overlap, total1, variance1 = known[key]
        total2 = summed(mask1, height2)
        variance2 = summed(mask1, square2) - total2**2 / overlap
        covariance = summed(height1, height2) - total1 * total2 / overlap
        least = MIN_OVERLAP * min(np.isfinite(fixed).sum(), measured2.sum())
        # Rounding errors are about 1e-12 of the energy of the whole image. An overlap that contains less than
        # 1e-6 of this energy per pixel is taken as having no structure.
        usable = (overlap >= least) & (variance1 > 1e-6 * overlap) & (variance2 > 1e-6 * overlap)
        product = np.sqrt(np.where(usable, variance1 * variance2, 1.0))
        yield np.where(usable, np.clip(covariance / product, -1, 1), np.nan), overlap


def _masked(image: Array) -> list[Array]:
    """Return three images: the mask of measured pixels, the heights, and the squared heights. The heights are
    centred and scaled to a mean square of one.
    """
    measured = np.isfinite(image)
    mean = image[measured].mean() if measured.any() else 0.0
    values = np.where(measured, image - mean, 0.0)
    values /= max(float(np.sqrt((values**2).mean())), 1e-300)
    return [measured, values, values**2]


def _cut_off(orientation: str, shape: Shape, factor: int) -> tuple[int, int]:
    transpose, flip_y, flip_x = ORIENTATIONS[orientation]
    ny, nx = shape[::-1] if transpose else shape
    return (ny % factor if flip_y else 0), (nx % factor if flip_x else 0)


def _wrapped(size: int) -> Array:
    index = np.arange(size)
    return np.minimum(index, size - index)
