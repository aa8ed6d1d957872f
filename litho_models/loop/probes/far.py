"""What the layout does far away and along some directions: averages of it that trail off to one side.

A stage that lags, a feedback that settles, a developer that flows, a spot that is not round: each leaves at a
pixel what was printed some micrometres to one side of it. The columns are exponential averages along rays.
A ridge mixes them, so that a response to both sides, or all round, is one too. They are smooth, so a coarse
grid holds them; beyond its edge a layout goes on with its outermost levels.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.linear import Left, LinearProbe, linear_probe

# Rays 10 degrees apart: 6 µm out they lie 1 µm apart, about as far as features are wide.
DIRECTIONS = 36
LENGTHS_UM = (2.0, 6.0)
_GRID_UM = 0.4
# The grid is periodic; what comes round after twice this many of the longest lengths is lost in the noise.
_PADDED_LENGTHS = 5
# Angles are told from here, so that none along an axis or a diagonal lies where they start again.
_FIRST_DEG = -22.5
# Of the strongest direction's response, what makes another one part of it.
_ALIKE = 0.5
_ANGLES = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS


def far_response(left: Left) -> LinearProbe | None:
    """One exponential average of the layout per direction and length; None where no layout varies."""
    if all(np.ptp(scan.stored.layout_um) == 0 for scan in left.scans):
        return None
    penalty = np.eye(DIRECTIONS * len(LENGTHS_UM))
    return linear_probe("far-response", _columns, penalty, None, summary, left)


def summary(coefficients: np.ndarray) -> dict[str, tuple[float, str]]:
    """Where the strongest part of a response lies, and what lies across from it.

    Returns:
        ``direction``: of the response seen from what causes it, degrees from x to y. ``length`` and
        ``amount`` of the exponential response nearest to it, the latter in height per layout height.
        ``opposite`` and ``across``: share of the same response on the other side, and at right angles.
    """
    # One response lies on a few rays: on each one, what it shares with its neighbours.
    rays = coefficients.reshape(len(LENGTHS_UM), DIRECTIONS)
    rays = rays + np.roll(rays, 1, axis=1) + np.roll(rays, -1, axis=1)
    lengths = np.array(LENGTHS_UM)
    sums = lengths[:, None] + lengths
    # Integrals over the distance s of k(s)² and of s k(s)², k being the sum of w/L exp(-s/L).
    products = rays.T @ (1 / sums) @ rays
    sizes = np.diag(products)
    quarter = DIRECTIONS // 4
    both_ways = products[np.arange(DIRECTIONS), (np.arange(DIRECTIONS) + 2 * quarter) % DIRECTIONS]
    at = int(np.argmax(sizes))
    size = max(float(sizes[at]), np.finfo(float).tiny)
    opposite, across = (
        float(np.mean([products[at, (at + turn) % DIRECTIONS] for turn in turns])) / size
        for turns in ((2 * quarter,), (quarter, 3 * quarter))
    )
    near = np.arange(-2, 3)
    weights = sizes[(at + near) % DIRECTIONS]
    if opposite >= _ALIKE:
        weights = weights + both_ways[(at + near) % DIRECTIONS].clip(0)
    angle = np.rad2deg(_ANGLES[at]) + 360 / DIRECTIONS * float(near @ weights) / max(weights.sum(), size)
    turn_deg = 180 if opposite >= _ALIKE else 360
    moment = float(rays[:, at] @ (np.outer(lengths, lengths) / sums**2) @ rays[:, at])
    length_um = 2 * moment / size
    amount = 2 * length_um * float((rays[:, at] / (lengths + length_um)).sum())
    return {
        "direction": (float((angle - _FIRST_DEG) % turn_deg + _FIRST_DEG), "°"),
        "length": (length_um, "µm"),
        "amount": (amount, "1"),
        "opposite": (opposite, "1"),
        "across": (across, "1"),
    }


def in_words(found: Mapping[str, float]) -> str:
    """What a response looks like; ``found``: the values of ``summary``."""
    reach = f"with a length of {found['length']:.1f} µm"
    if found["opposite"] >= _ALIKE and found["across"] >= _ALIKE:
        return f"the layout all round, {reach}"
    along = f"at {round(found['direction'])}° from x to y"
    if found["opposite"] >= _ALIKE:
        return f"the layout along one direction, {along}, to both sides alike, {reach}"
    if found["opposite"] <= -_ALIKE:
        return f"the layout along one direction, {along}, with opposite sign on the other side, {reach}"
    return f"the layout to one side, {along}, {reach}"


def drawn(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (y, x) from the layout (n, 2), µm, and the response there, its height per µm."""
    lengths = np.array(LENGTHS_UM)[:, None]
    away_um = np.arange(_GRID_UM, 2 * max(LENGTHS_UM), _GRID_UM)
    response = (np.exp(-away_um / lengths) / lengths).T @ coefficients.reshape(len(LENGTHS_UM), DIRECTIONS)
    y, x = (np.multiply.outer(away_um, part(_ANGLES)) for part in (np.sin, np.cos))
    return np.stack([y, x], axis=-1).reshape(-1, 2), response.ravel()


def _columns(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """The layout averaged along every ray, all directions of a length in turn, (m, y, x) µm."""
    pitch_um = scan.stored.pitch_um
    stride = max(1, round(_GRID_UM / pitch_um))
    step_um = stride * pitch_um
    layout = scan.stored.layout_um.astype(np.float64)
    smooth = gaussian_filter(layout - layout.mean(), stride / 2, mode="nearest")
    coarse = smooth[stride // 2 :: stride, stride // 2 :: stride]
    pad = round(_PADDED_LENGTHS * max(LENGTHS_UM) / step_um)
    ny, nx = (next_fast_len(n + 2 * pad, real=True) for n in coarse.shape)
    widths = [(pad, full - n - pad) for full, n in zip((ny, nx), coarse.shape, strict=True)]
    spectrum = rfft2(np.pad(coarse, widths, mode="edge").astype(np.float32))
    along = (
        np.multiply.outer(np.sin(_ANGLES), np.fft.fftfreq(ny, step_um))[:, :, None]
        + (np.multiply.outer(np.cos(_ANGLES), np.fft.rfftfreq(nx, step_um))[:, None, :])
    )
    inside = slice(pad, pad + coarse.shape[0]), slice(pad, pad + coarse.shape[1])
    averages = [
        # The transform of exp(-s / L) / L along one ray.
        irfft2(spectrum / (1 + 2j * np.pi * length * ray).astype(np.complex64), (ny, nx))[inside]
        for length in LENGTHS_UM
        for ray in along
    ]
    rows, columns = (_between(size, n, stride) for size, n in zip(layout.shape, coarse.shape, strict=True))
    return rows @ np.stack(averages) @ columns.T


def _between(size: int, count: int, stride: int) -> np.ndarray:
    """Linear interpolation (size, count) from a coarse axis, constant beyond its ends."""
    places = (np.arange(size) - stride // 2) / stride
    hats = 1 - np.abs(places.clip(0, count - 1)[:, None] - np.arange(count))
    return hats.clip(0).astype(np.float32)
