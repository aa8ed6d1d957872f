"""Optimise layouts for which the predictions of the rivals differ most.

A layout is built from tiles. Each tile starts as a calibration pattern or a random layout and follows the
gradient of the rivals' separation. The tile is low-passed and clipped in every step, so it stays similar to
the layouts that the models know.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from litho_data.layouts.patterns import checkerboard, line_space_sweep
from litho_data.layouts.random_layout import quantise, random_layout
from litho_models.planning.questions import OpenQuestions
from litho_models.planning.rivalry import Place, PlannedPrint, Rivalry, Way

TILE_PX = 256
STEPS = 40
_REFIT_EVERY = 10
_STEP_LEVELS = 0.3
# Levels that cover less than this share of earlier prints are unknown to the models.
_RARE = 1e-3
# The levels' mean and spread may differ from those of earlier prints by this sum without a penalty.
_FREE_LEVELS = 1.5
_PRICE = 2.0


@dataclass(frozen=True)
class Limits:
    """Limits of planned layouts: lowest and highest level, cut-off frequency (cycles/µm), and mean and
    spread of the levels in earlier prints.
    """

    lowest: int
    highest: int
    cutoff_per_um: float
    pitch_um: float
    mean: float
    sd: float

    @classmethod
    def of(cls, open_: OpenQuestions, pitch_um: float) -> Limits:
        """Derive the limits from earlier prints. A level is allowed if it covers at least a thousandth of
        these prints, and structures may not be finer than in these prints.
        """
        share = np.array(open_.level_share)
        levels = np.arange(len(share))
        known = levels[share >= _RARE].tolist()
        mean = float(share @ levels)
        sd = float(np.sqrt(share @ (levels - mean) ** 2))
        return cls(known[0], known[-1], open_.cutoff_per_um, pitch_um, mean, sd)

    def soft(self, free: Tensor) -> Tensor:
        """Low-pass unrestricted values and clip them to soft levels (y, x) that can be printed."""
        y, x = (torch.fft.fftfreq(n, self.pitch_um).abs() <= self.cutoff_per_um for n in free.shape)
        smooth = torch.fft.ifft2(torch.fft.fft2(free) * (y[:, None] & x)).real
        return smooth.clamp(self.lowest, self.highest)

    def whole(self, soft: np.ndarray) -> np.ndarray:
        """Round to the levels that the printer can print."""
        span = self.highest - self.lowest
        above = quantise((soft - self.lowest) / span, span + 1)
        return above.astype(np.min_scalar_type(self.highest)) + self.lowest

    def price(self, soft: Tensor) -> Tensor:
        """Return a penalty for levels whose mean or spread is far from that of earlier prints."""
        far = (soft.mean() - self.mean).abs() + (soft.std() - self.sd).abs()
        return _PRICE * torch.relu(far - _FREE_LEVELS) ** 2

    def random(self, size_px: int, seed: int, finest: float = 1.0) -> np.ndarray:
        """Make a random layout with whole levels (size, size). ``finest`` is its cut-off frequency as a
        fraction of the largest allowed one.
        """
        level = random_layout(
            (size_px, size_px),
            levels=self.highest + 1,
            # Even a small print contains at least one period.
            cutoff_per_um=max(finest * self.cutoff_per_um, 1.001 / (size_px * self.pitch_um)),
            pitch_um=self.pitch_um,
            seed=seed,
        )
        return np.maximum(level, self.lowest)


def starts(size_px: int, limits: Limits, seed: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the names and levels (size, size) of the layouts from which an optimisation may start.

    Patterns get a random frame, a fifth of the side wide, because scans of periodic patterns cannot be
    registered.
    """
    for number, finest in enumerate((1.0, 0.5, 0.8)):
        yield f"random-{number + 1}", limits.random(size_px, seed + number, finest)
    feature = max(3, round(0.5 / limits.cutoff_per_um / limits.pitch_um))
    inset = size_px // 5
    shape = (size_px - 2 * inset,) * 2
    sweep = partial(line_space_sweep, shape, narrowest_px=feature, high=limits.highest, low=limits.lowest)
    patterns = {
        "checkerboard": checkerboard(shape, cell_px=2 * feature, high=limits.highest, low=limits.lowest),
        "lines": sweep(),
        "lines-along-x": sweep(along="x"),
    }
    for name, pattern in patterns.items():
        whole = limits.random(size_px, seed + 7)
        whole[inset:-inset, inset:-inset] = pattern
        yield name, whole


def score(
    rivalry: Rivalry,
    level: np.ndarray,
    ways: tuple[Way, ...],
    place: Place = "centre",
    doses: Sequence[float] = (1.0,),
) -> float:
    """Return the separation of the nearest pair of rivals, in standard deviations.

    One print of the layout is made at each dose.
    """
    prints = [PlannedPrint(as_tensor(level), ways, place, dose=dose) for dose in doses]
    return float(rivalry.separations(prints, rivalry.refitted(prints)).min())


def climb(
    rivalry: Rivalry,
    start: np.ndarray,
    ways: tuple[Way, ...],
    limits: Limits,
    *,
    place: Place = "centre",
    steps: int = STEPS,
) -> np.ndarray:
    """Return the soft levels (y, x) after gradient ascent from ``start``."""
    free = as_tensor(start).requires_grad_()
    climber = torch.optim.Adam([free], lr=_STEP_LEVELS)
    best, highest = start.astype(np.float32), -np.inf
    for step in range(steps + 1):
        soft = limits.soft(free)
        fresh = step % _REFIT_EVERY == 0 or step == steps
        if fresh:
            refitted = rivalry.refitted([PlannedPrint(soft.detach(), ways, place)])
        apart = rivalry.separations([PlannedPrint(soft, ways, place)], refitted)
        # The separation is exact only if the rivals have been refitted to this layout.
        if fresh and apart.min().item() > highest:
            best, highest = soft.detach().numpy().copy(), apart.min().item()
        # This is a soft minimum over pairs. With a hard minimum, the ascent would alternate between pairs.
        climber.zero_grad()
        (limits.price(soft) + torch.logsumexp(-apart, 0)).backward()
        climber.step()
    return best


def assemble(tiles: Sequence[np.ndarray], number: int, size_px: int, limits: Limits) -> np.ndarray:
    """Assemble the tiles into whole levels (size, size), in a different order for each print."""
    side = -(-size_px // tiles[0].shape[0])
    order = [tiles[(place + number) % len(tiles)] for place in range(side**2)]
    whole = np.block([order[row * side : (row + 1) * side] for row in range(side)])[:size_px, :size_px]
    return limits.whole(limits.soft(as_tensor(whole)).numpy())


def as_tensor(level: np.ndarray) -> Tensor:
    """Convert the levels of a planned print to a tensor."""
    return torch.from_numpy(level.astype(np.float32))
