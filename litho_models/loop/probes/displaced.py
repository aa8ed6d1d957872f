"""A displaced copy of the layout, at any distance that a kernel around the pixel does not reach.

For every displacement the best amount of one copy follows from two correlations, of the layout with the
residual and of its square with the measured pixels. The displacement is chosen, and its amount estimated, on
training scans; both are judged on the scans left out. Beyond its edge a layout goes on as it does for the
base models: with its outermost levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, shift

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.kernel import reach_um
from litho_models.loop.probes.probe import Estimate, Probe
from litho_models.scan_terms import POLICIES, Terms, freed_um

# Beyond two thirds of the field too few pixels see a copy of something printed.
FARTHEST_UM, _FARTHEST_SHARE = 20.0, 2 / 3
# What is printed is no finer, and a quarter of the pixels is enough to find it.
_STEP_UM = 0.2
_SAME_PLACE_UM = 0.5


@dataclass(frozen=True)
class DisplacedCopy(Probe):
    """Residual = amount · layout displaced by (y, x), the same for all scans.

    Attributes:
        scores, information: (scans, places) correlations of the layout with the residual and of its square
            with the measured pixels, µm².
        places_um: (places, 2) displacements (y, x); ``pixels``: (scans,).
    """

    scores: np.ndarray
    information: np.ndarray
    places_um: np.ndarray
    pixels: np.ndarray

    @property
    def name(self) -> str:
        return "displaced-copy"

    @property
    def free(self) -> Terms:
        return POLICIES["full"]

    def held_out(self, fold_of: np.ndarray) -> Estimate:
        """(y, x, amount) without each fold and the gain of each scan by those that have not seen it."""
        return self._held_out(self.scores, fold_of)

    def controls(self, fold_of: np.ndarray, random: np.random.Generator, count: int) -> np.ndarray:
        """Mean held-out gains (count,), nm², with the residual of each scan upside down or not."""
        signs = random.choice([-1.0, 1.0], size=(count, len(self.scores), 1))
        return np.array([self._held_out(one * self.scores, fold_of).mean_gain_nm2 for one in signs])

    def agreement(self) -> float:
        """Ratio of the amounts that two halves of the scans find at one place; 0 at two places."""
        first, second = (self._best(self.scores[h::2].sum(0), self.information[h::2].sum(0)) for h in (0, 1))
        apart = np.hypot(*(self.places_um[first[0]] - self.places_um[second[0]]))
        small, large = sorted((first[1], second[1]), key=abs)
        return small / large if apart <= _SAME_PLACE_UM and large else 0.0

    def summary(self, parameters: np.ndarray) -> dict[str, tuple[float, str]]:
        """Displacement, and height per layout height."""
        y, x, amount = parameters.tolist()
        return {"shift_y": (y, "µm"), "shift_x": (x, "µm"), "amount": (amount, "1")}

    def correction(self, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        """The displaced layout, freed of its mean, (y, x) µm."""
        y, x, amount = parameters.tolist()
        apart_px = np.array([y, x]) / scan.stored.pitch_um
        return (amount * shift(_layout(scan), apart_px, order=1, mode="nearest")).astype(np.float32)

    def gain_nm2(self) -> np.ndarray:
        """Gain of one copy at each place with its best amount there, nm² in the mean over pixels."""
        score, information = self.scores.sum(axis=0), self.information.sum(axis=0)
        return self._gain(score, information) / self.pixels.sum() * NM_PER_UM**2

    def _held_out(self, scores: np.ndarray, fold_of: np.ndarray) -> Estimate:
        score, information = scores.sum(axis=0), self.information.sum(axis=0)
        per_fold, gains = [], np.zeros(len(scores))
        for fold in range(int(fold_of.max()) + 1):
            out = fold_of == fold
            at, amount = self._best(score - scores[out].sum(0), information - self.information[out].sum(0))
            per_fold.append([*self.places_um[at], amount])
            gains[out] = 2 * amount * scores[out, at] - amount**2 * self.information[out, at]
        at, amount = self._best(score, information)
        return Estimate(
            common=np.array([*self.places_um[at], amount]),
            per_fold=np.array(per_fold),
            gains_nm2=gains / self.pixels * NM_PER_UM**2,
        )

    def _best(self, score: np.ndarray, information: np.ndarray) -> tuple[int, float]:
        """Place of the largest gain, and the amount there."""
        at = int(np.argmax(self._gain(score, information)))
        return at, float(score[at] / max(information[at], np.finfo(float).tiny))

    def _gain(self, score: np.ndarray, information: np.ndarray) -> np.ndarray:
        return score**2 / np.maximum(information, np.finfo(float).tiny)


def displaced_copy(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], defects: Sequence[np.ndarray]
) -> DisplacedCopy | None:
    """Measure the correlations; None where the fields leave no room beyond the kernel's reach.

    Args:
        scans, predictions: scans and their held-out predictions (y, x) µm; ``defects``: pixels left out.
    """
    pitch_um = scans[0].stored.pitch_um
    ny, nx = (min(scan.stored.shape[axis] for scan in scans) for axis in (0, 1))
    farthest_um = min(FARTHEST_UM, _FARTHEST_SHARE * min(ny, nx) * pitch_um)
    stride = max(1, round(_STEP_UM / pitch_um))
    step_um = stride * pitch_um
    reach = int(farthest_um / step_um)
    offsets = np.arange(-reach, reach + 1)
    y, x = (part.ravel() for part in np.meshgrid(offsets, offsets, indexing="ij"))
    distance = np.hypot(y, x) * step_um
    wanted = (distance > reach_um((ny, nx), pitch_um)) & (distance <= farthest_um)
    if not wanted.any():
        return None
    y, x = y[wanted], x[wanted]
    scores, information, pixels = [], [], []
    for scan, prediction, defect in zip(scans, predictions, defects, strict=True):
        usable = scan.usable & ~defect
        residual = freed_um(scan.stored.height_um, prediction, usable, POLICIES["full"])[::stride, ::stride]
        layout, seen = _layout(scan)[::stride, ::stride], usable[::stride, ::stride].astype(float)
        continued = np.pad(layout, reach, mode="edge")
        scores.append(_correlation(residual, continued)[y - reach, x - reach])
        information.append(_correlation(seen, continued**2)[y - reach, x - reach])
        pixels.append(seen.sum())
    places = np.column_stack([y, x]) * step_um
    return DisplacedCopy(np.stack(scores), np.stack(information), places, np.array(pixels))


def _correlation(target: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Sum of target · (source displaced by d) at [d], negative d from the end; zeros beyond both."""
    shape = [next_fast_len(a + b, real=True) for a, b in zip(target.shape, source.shape, strict=True)]
    return irfft2(rfft2(target, shape) * np.conj(rfft2(source, shape)), shape)


def _layout(scan: PreparedScan) -> np.ndarray:
    """The layout without its mean, as sharp as it is printed, (y, x) µm."""
    layout = scan.stored.layout_um.astype(np.float64)
    return gaussian_filter(layout - layout.mean(), _STEP_UM / scan.stored.pitch_um, mode="nearest")
