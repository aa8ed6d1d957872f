"""Choose how each print is scanned, and optimise layouts so that the predictions of the rivals (competing
explanations) differ as much as possible.

A layout is built from tiles. Each tile starts as a calibration pattern or a random layout, and is changed by
gradient ascent to increase the separation of the rivals, i.e. the difference of their predictions relative to
the noise. In every step, the tile is low-pass filtered and clipped, so that it stays similar to the layouts
to which the models were fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file
from litho_data.layouts.patterns import checkerboard, line_space_sweep
from litho_data.layouts.random_layout import quantise, random_layout
from litho_data.register.coarse import SEARCH_BLUR_PX
from litho_data.register.orientation import rival_alignment
from litho_data.register.topography import predicted_topography
from litho_models.fitting.least_squares import Linearised
from litho_models.planning.questions import OpenQuestions
from litho_models.planning.rivalry import Place, PlannedPrint, Rivalry, Way

TILE_PX = 256
STEPS = 40
_REFIT_EVERY = 10
_STEP_LEVELS = 0.3
# The lowest levels that together cover less than this fraction of the area of earlier prints count as unknown
# to the models, and so do the highest levels for which this holds. Planned prints use only the levels in
# between.
_RARE = 1e-3
# The mean and the standard deviation of the levels may differ from those of earlier prints. There is no
# penalty as long as the sum of these two differences, in levels, does not exceed this value.
_FREE_LEVELS = 1.5
_PRICE = 2.0
TURNED = Way(turned_deg=90)
WORDS = {
    TURNED: "rotated by 90°",
    Way(direction=-1): "in the other direction",
    Way(tip=2): "with a new, sharp tip",
    Way(pixel_size=0.5): "with half the pixel size and the same time per pixel",
}
_MOST_EXTRAS = 2
# A further scan of each print is planned if it increases the separation of the rivals by at least this
# factor.
_WORTH = 1.3
# Relative dose of the second print. A dose below 1 keeps every exposure in the range to which the models were
# fitted; a higher dose would not.
SECOND_DOSE = 0.8
# If the separation of the rivals is below this value (in standard deviations), the layout counts as not
# showing any difference between them.
_NOTHING = 0.3
# Registration rejects layouts whose self-similarity (see ``_repeats``) exceeds 0.9. The limit here is lower,
# because prints have less contrast than layouts.
_MOST_REPEATING = 0.7


@dataclass(frozen=True)
class Limits:
    """Limits for planned layouts: the lowest and highest level number, the highest spatial frequency
    (cycles/µm), and the mean and standard deviation of the level numbers in earlier prints.
    """

    lowest: int
    highest: int
    cutoff_per_um: float
    pitch_um: float
    mean: float
    sd: float

    @classmethod
    def of(cls, open_: OpenQuestions, pitch_um: float) -> Limits:
        """Derive the limits from earlier prints. Very rare levels at both ends are excluded: the levels below
        the lowest allowed level together cover less than a thousandth of the area of these prints, and so do
        the levels above the highest allowed level. The highest spatial frequency is
        ``open_.cutoff_per_um``.

        Raises:
            InputError: every earlier layout has only one level, or nearly the whole area of these layouts has
                the same level.
        """
        share = np.array(open_.level_share)
        levels = np.arange(len(share))
        lowest = int(np.argmax(np.cumsum(share) >= _RARE))
        highest = len(share) - 1 - int(np.argmax(np.cumsum(share[::-1]) >= _RARE))
        if not open_.cutoff_per_um or lowest == highest:
            raise InputError(
                "layouts of the earlier prints",
                got="a single level in each of them",
                wanted="layouts in which the level varies",
                hint="print random layouts, and close the loop on these prints",
            )
        mean = float(share @ levels)
        sd = float(np.sqrt(share @ (levels - mean) ** 2))
        return cls(lowest, highest, open_.cutoff_per_um, pitch_um, mean, sd)

    def soft(self, free: Tensor) -> Tensor:
        """Apply a low-pass filter to unrestricted values, and clip them to the range of the levels. The
        result contains soft (not yet rounded) levels and has shape (ny, nx).
        """
        y, x = (torch.fft.fftfreq(n, self.pitch_um).abs() <= self.cutoff_per_um for n in free.shape)
        smooth = torch.fft.ifft2(torch.fft.fft2(free) * (y[:, None] & x)).real
        return smooth.clamp(self.lowest, self.highest)

    def whole(self, soft: np.ndarray) -> np.ndarray:
        """Round soft levels to whole level numbers, which the printer can print."""
        span = self.highest - self.lowest
        above = quantise((soft - self.lowest) / span, span + 1)
        return above.astype(np.min_scalar_type(self.highest)) + self.lowest

    def price(self, soft: Tensor) -> Tensor:
        """Return a penalty. It is 0 if the mean and the standard deviation of the levels are close to their
        values in earlier prints, and grows with the distance from these values.
        """
        far = (soft.mean() - self.mean).abs() + (soft.std() - self.sd).abs()
        return _PRICE * torch.relu(far - _FREE_LEVELS) ** 2

    def random(self, size_px: int, seed: int, finest: float = 1.0) -> np.ndarray:
        """Make a random layout with whole levels, of shape (size_px, size_px). ``finest`` is its cut-off
        frequency as a fraction of the highest allowed frequency.
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
    """Yield the layouts from which an optimisation may start. Each layout is yielded as a pair: its name, and
    its level numbers as an array of shape (size_px, size_px).

    A periodic pattern is surrounded by a frame with a random layout, because a scan of only a periodic
    pattern cannot be registered. The width of the frame is a fifth of the side length.
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
    known: dict[tuple[Way, Place, float], list[list[Linearised]]] | None = None,
) -> float:
    """Return the separation of the two most similar rivals, in standard deviations. It is computed for an
    experiment in which the layout is printed once at each of the given doses. ``known`` is a cache of
    linearised scans of this layout, which several experiments share.
    """
    known = {} if known is None else known
    prints = [PlannedPrint(as_tensor(level), ways, place, dose=dose) for dose in doses]
    scans = {(way, place, one.dose): replace(one, ways=(way,)) for one in prints for way in ways}
    known |= {scan: rivalry.linearised([one]) for scan, one in scans.items() if scan not in known}
    first = [
        [known[way, place, dose][at][0] for dose in doses for way in ways] for at in range(len(rivalry.twins))
    ]
    return float(rivalry.separations(prints, rivalry.refitted(prints, first=first)).min())


def climb(
    rivalry: Rivalry,
    start: np.ndarray,
    ways: tuple[Way, ...],
    limits: Limits,
    *,
    place: Place = "centre",
    steps: int = STEPS,
) -> np.ndarray:
    """Increase the separation of the rivals by gradient ascent from the layout ``start``. Return the best
    soft (not rounded) levels, of shape (ny, nx).
    """
    free = as_tensor(start).requires_grad_()
    climber = torch.optim.Adam([free], lr=_STEP_LEVELS)
    best, highest = start.astype(np.float32), -np.inf
    for step in range(steps + 1):
        soft = limits.soft(free)
        fresh = step % _REFIT_EVERY == 0 or step == steps
        if fresh:
            refitted = rivalry.refitted([PlannedPrint(soft.detach(), ways, place)])
        apart = rivalry.separations([PlannedPrint(soft, ways, place)], refitted)
        # The separation is exact only in steps in which the rivals have been refitted to the current layout,
        # so only these steps may give the best layout.
        if fresh and apart.min().item() > highest:
            best, highest = soft.detach().numpy().copy(), apart.min().item()
        # The negative log-sum-exp is a soft minimum over the pairs of rivals. With a hard minimum, the ascent
        # would alternate between pairs.
        climber.zero_grad()
        (limits.price(soft) + torch.logsumexp(-apart, 0)).backward()
        climber.step()
    return best


def assemble(tiles: Sequence[np.ndarray], number: int, size_px: int, limits: Limits) -> np.ndarray:
    """Assemble the tiles of a print into a layout with whole level numbers. The order of the tiles depends on
    ``number``, the number of the print, so it differs between prints. The result has shape (size_px,
    size_px).
    """
    side = -(-size_px // tiles[0].shape[0])
    order = [tiles[(place + number) % len(tiles)] for place in range(side**2)]
    whole = np.block([order[row * side : (row + 1) * side] for row in range(side)])[:size_px, :size_px]
    return limits.whole(limits.soft(as_tensor(whole)).numpy())


def as_tensor(level: np.ndarray) -> Tensor:
    """Convert the levels of a planned print to a float32 tensor."""
    return torch.from_numpy(level.astype(np.float32))


class Chosen(NamedTuple):
    """The choice of how to make and scan prints, for one question or for all questions.

    ``ways`` lists the ways in which each print is scanned, one per scan. Successive prints cycle through
    ``places``, the positions in the write field, and through ``doses``, the relative doses. ``tried``
    contains the separation of the two most similar rivals, in standard deviations, in each experiment that
    was tried, keyed by a description of the experiment.
    """

    ways: tuple[Way, ...]
    places: tuple[Place, ...]
    doses: tuple[float, ...]
    tried: dict[str, float]


def choose(rivalry: Rivalry, level: np.ndarray, can_move: bool) -> Chosen:
    """Choose the ways to print and scan that best separate the rivals of a question.

    Args:
        level: layout on which the ways are tried, as level numbers of shape (ny, nx).
        can_move: whether the write field is larger than a print.
    """
    separation = partial(score, rivalry, level, known={})
    ways: tuple[Way, ...] = (Way(),)
    reached = separation(ways)
    tried = {"one plain scan": reached}
    for _ in range(_MOST_EXTRAS):
        scores = {way: separation((*ways, way)) for way in WORDS if way not in ways}
        # The report states the separation for the plain scan together with a single other scan. These values
        # are computed in the first round, so later rounds do not overwrite them.
        tried = tried | {f"a scan {WORDS[way]}": own for way, own in scores.items()} | tried
        best = max(scores, key=lambda way: scores[way])
        if not _worth(scores[best], reached):
            break
        ways, reached = (*ways, best), scores[best]
    places: tuple[Place, ...] = ("centre",)
    if can_move:
        tried["at the edge of the write field"] = at_edge = separation(ways, "edge")
        places = ("edge", "centre") if _worth(at_edge, reached) else places
    one, two = (separation(ways, places[0], (1.0, dose)) for dose in (1.0, SECOND_DOSE))
    both = "two prints with these scans"
    tried |= {both: one, f"{both}, the second at {SECOND_DOSE:g} of the dose": two}
    return Chosen(ways, places, (1.0, SECOND_DOSE) if _worth(two, one) else (1.0,), tried)


def together(choices: Sequence[Chosen], asked: tuple[Way, ...]) -> Chosen:
    """Combine the choices that were made for each question into one choice for all questions. ``asked``
    contains the ways to scan that are needed for questions whose answer does not depend on a layout.
    """
    ways = dict.fromkeys([Way(), *asked, *(way for one in choices for way in one.ways)])
    places = max((one.places for one in choices), key=len, default=("centre",))
    return Chosen(tuple(ways), places, max((one.doses for one in choices), key=len, default=(1.0,)), {})


def _worth(more: float, reached: float) -> bool:
    return more >= max(_WORTH * reached, _NOTHING)


def climbed(
    rivalries: Sequence[Rivalry],
    chosen: Chosen,
    limits: Limits,
    tile_px: int,
    count: int,
    *,
    seed: int,
    steps: int,
    kept: Path,
    report: Callable[[str], None],
) -> list[np.ndarray]:
    """Optimise ``count`` tiles. Each tile is optimised for one question. Successive tiles cycle through the
    questions. Return the soft (not rounded) levels of each tile.

    Args:
        rivalries: the rivals of each question.
        chosen: the ways to print and scan.
        limits: limits for the layouts.
        tile_px: side length of a tile in pixels.
        count: number of tiles.
        seed: seed of the random layouts from which the optimisation starts.
        steps: number of ascent steps for each tile.
        kept: folder in which finished tiles are saved. Tiles that an interrupted run has saved there are
            reused.
        report: function that receives the progress messages.
    """
    kept.mkdir(parents=True, exist_ok=True)
    report(f"{sum(1 for _ in kept.glob('[0-9]*.npy'))} of {count} tiles are kept from an earlier run")
    able = [one for one in starts(tile_px, limits, seed) if _repeats(one[1]) <= _MOST_REPEATING]
    ranked = [sorted(able, key=lambda one: -score(rivalry, one[1], chosen.ways)) for rivalry in rivalries]
    tiles = []
    for number in range(count):
        rank, which = divmod(number, len(rivalries))
        name, start = ranked[which][rank % len(ranked[which])]
        file = kept / f"{number}.npy"
        if not file.is_file():
            rivalry = rivalries[which]
            asked = rivalry.question.name
            report(f"optimising tile {number + 1} of {count} for {asked}, starting from {name}")
            tile = climb(rivalry, start, chosen.ways, limits, place=chosen.places[0], steps=steps)
            with atomic_file(file) as temporary:
                np.save(temporary, tile)
        tiles.append(np.load(file))
    return tiles


def _repeats(level: np.ndarray) -> float:
    """Return the self-similarity of a layout: how well it matches shifted copies of itself, as the
    registration would measure it.

    If the value is 1, the layout matches a shifted copy of itself perfectly, and registration cannot
    determine the shift.
    """
    topography = predicted_topography(level, SEARCH_BLUR_PX)
    return rival_alignment(topography, topography)
