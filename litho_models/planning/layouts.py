"""Choose how each print is scanned, and optimise layouts so that the predictions of the rivals (competing
explanations) differ as much as possible.

A layout is built from tiles. Each tile starts as a calibration pattern or a random layout, and is changed by
gradient ascent to increase the separation of the rivals, i.e. the difference of their predictions relative to
the noise. In every step, the tile is low-pass filtered and clipped, so that it stays similar to the layouts
to which the models were fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation import Array, InputError, atomic_file
from litho_data.layouts.patterns import checkerboard, line_space_sweep
from litho_data.layouts.random_layout import random_layout
from litho_data.register.coarse import SEARCH_BLUR_PX
from litho_data.register.orientation import rival_alignment
from litho_data.register.topography import predicted_topography
from litho_models.effects import FieldContext
from litho_models.planning.questions import OpenQuestions
from litho_models.planning.rivalry import PLAIN, WAYS, Print, Rivalry, planned_scans

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
        below, above = np.cumsum(share), np.cumsum(share[::-1])[::-1]
        known = levels[(below >= _RARE) & (above >= _RARE)].tolist()
        if not open_.cutoff_per_um or len(known) == 1:
            raise InputError(
                "layouts of the earlier prints",
                got="a single level in each of them",
                wanted="layouts in which the level varies",
                hint="print random layouts, and close the loop on these prints",
            )
        mean = float(share @ levels)
        sd = float(np.sqrt(share @ (levels - mean) ** 2))
        return cls(known[0], known[-1], open_.cutoff_per_um, pitch_um, mean, sd)

    def soft(self, free: Tensor) -> Tensor:
        """Apply a low-pass filter to unrestricted values, and clip them to the range of the levels. The
        result contains soft (not yet rounded) levels and has shape (ny, nx).
        """
        y, x = (torch.fft.fftfreq(n, self.pitch_um).abs() <= self.cutoff_per_um for n in free.shape)
        smooth = torch.fft.ifft2(torch.fft.fft2(free) * (y[:, None] & x)).real
        return smooth.clamp(self.lowest, self.highest)

    def random(self, size_px: int, seed: int, finest: float = 1.0) -> Array:
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


def starts(size_px: int, limits: Limits, seed: int) -> dict[str, Array]:
    """Return the layouts from which an optimisation may start, keyed by name. Each layout consists of level
    numbers and has shape (size_px, size_px).

    A periodic pattern is surrounded by a frame with a random layout, because a scan of only a periodic
    pattern cannot be registered. The width of the frame is a fifth of the side length.
    """
    feature = max(3, round(0.5 / limits.cutoff_per_um / limits.pitch_um))
    inset = size_px // 5
    shape = (size_px - 2 * inset,) * 2
    low, high = limits.lowest, limits.highest
    lines = line_space_sweep(shape, narrowest_px=feature, high=high, low=low)
    squares = checkerboard(shape, cell_px=2 * feature, high=high, low=low)
    found = {
        f"random-{number + 1}": limits.random(size_px, seed + number, finest)
        for number, finest in enumerate((1.0, 0.5, 0.8))
    }
    for name, pattern in {"checkerboard": squares, "lines": lines, "lines-along-x": lines.T}.items():
        found[name] = limits.random(size_px, seed + 7)
        found[name][inset:-inset, inset:-inset] = pattern
    return found


def score(rivalry: Rivalry, prints: Sequence[Print]) -> float:
    """Return the separation of the two most similar rivals on planned prints, in standard deviations."""
    return float(rivalry.separations(prints, rivalry.refitted(prints)).min())


def climb(
    rivalry: Rivalry,
    start: Array,
    scans_of: Callable[[Tensor], Print],
    limits: Limits,
    steps: int,
) -> Array:
    """Increase the separation of the rivals by gradient ascent from the layout ``start``. Return the best
    soft (not rounded) levels, of shape (ny, nx). The function ``scans_of`` plans the scans of a layout.
    """
    free = torch.tensor(start, dtype=torch.float32, requires_grad=True)
    climber = torch.optim.Adam([free], lr=_STEP_LEVELS)
    found = []
    for step in range(steps + 1):
        soft = limits.soft(free)
        fresh = step % _REFIT_EVERY == 0 or step == steps
        if fresh:
            refitted = rivalry.refitted([scans_of(soft.detach())])
        apart = rivalry.separations([scans_of(soft)], refitted)
        # The separation is exact only in steps in which the rivals have been refitted to the current layout,
        # so only these steps may give the best layout.
        if fresh:
            found.append((apart.min().item(), soft.detach().numpy()))
        # The negative log-sum-exp is a soft minimum over the pairs of rivals. With a hard minimum, the ascent
        # would alternate between pairs.
        far = (soft.mean() - limits.mean).abs() + (soft.std() - limits.sd).abs()
        penalty = _PRICE * torch.relu(far - _FREE_LEVELS) ** 2
        climber.zero_grad()
        (penalty + torch.logsumexp(-apart, 0)).backward()
        climber.step()
    return max(found, key=lambda one: one[0])[1]


def assemble(tiles: Sequence[Array], number: int, size_px: int, limits: Limits) -> Array:
    """Assemble the tiles of a print into a layout with whole level numbers, which the printer can print. The
    order of the tiles depends on ``number``, the number of the print, so it differs between prints. The
    result has shape (size_px, size_px).
    """
    side = -(-size_px // len(tiles[0]))
    order = (np.arange(side**2).reshape(side, side) + number) % len(tiles)
    whole = np.block([[tiles[at] for at in row] for row in order])[:size_px, :size_px]
    soft = limits.soft(torch.tensor(whole, dtype=torch.float32))
    return soft.round().numpy().astype(np.min_scalar_type(limits.highest))


class Chosen(NamedTuple):
    """The choice of how to make and scan prints, for one question or for all questions.

    ``ways`` lists the ways in which each print is scanned, one per scan, as keys of ``WAYS``. ``at_edge``
    states whether every other print, starting with the first, lies at the edge of the write field.
    ``weaker`` states whether every other print, starting with the second, has a smaller dose. ``tried``
    contains the separation of the two most similar rivals, in standard deviations, in each experiment that
    was tried, keyed by a description of the experiment.
    """

    ways: tuple[str, ...]
    at_edge: bool
    weaker: bool
    tried: dict[str, float]

    def prints(self, levels: Sequence[Array], plain: FieldContext, count: int) -> list[Print]:
        """Plan the scans of the first prints of a series of ``count`` prints, given the levels of each of
        their layouts. ``plain`` is as for ``planned_scans``.
        """
        return [
            planned_scans(
                plain,
                level,
                self.ways,
                at_edge=self.at_edge and number % 2 == 0,
                order=number / max(count - 1, 1) - 0.5,
                dose=SECOND_DOSE if self.weaker and number % 2 else 1.0,
            )
            for number, level in enumerate(levels)
        ]


def choose(rivalry: Rivalry, level: Array, plain: FieldContext) -> Chosen:
    """Choose the ways to print and scan that best separate the rivals of a question.

    Args:
        rivalry: the rivals.
        level: layout on which the ways are tried, as level numbers of shape (ny, nx).
        plain: as for ``planned_scans``. Its layout has the size of a print.
    """

    def separation(ways: Sequence[str], at_edge: bool = False, doses: Sequence[float] = (1.0,)) -> float:
        return score(
            rivalry, [planned_scans(plain, level, ways, at_edge=at_edge, dose=dose) for dose in doses]
        )

    ways: tuple[str, ...] = (PLAIN,)
    reached = separation(ways)
    tried = {"one plain scan": reached}
    for _ in range(_MOST_EXTRAS):
        scores = {way: separation((*ways, way)) for way in WAYS if way not in ways}
        # The report states the separation for the plain scan together with a single other scan. These values
        # are computed in the first round, so later rounds do not overwrite them.
        for way, own in scores.items():
            tried.setdefault(f"a scan {way}", own)
        best = max(scores, key=scores.__getitem__)
        if not _worth(scores[best], reached):
            break
        ways, reached = (*ways, best), scores[best]
    # A print that fills the write field, to within a pixel, cannot be moved.
    size_px = max(plain.layout_um.shape[-2:])
    at_edge = 2 * (plain.field_radius_um or 0.0) > (size_px + 1) * plain.pitch_um
    if at_edge:
        tried["at the edge of the write field"] = there = separation(ways, at_edge)
        at_edge = _worth(there, reached)
    one, two = (separation(ways, at_edge, (1.0, dose)) for dose in (1.0, SECOND_DOSE))
    both = "two prints with these scans"
    tried |= {both: one, f"{both}, the second at {SECOND_DOSE:g} of the dose": two}
    return Chosen(ways, at_edge, _worth(two, one), tried)


def together(choices: Collection[Chosen], asked: Sequence[str]) -> Chosen:
    """Combine the choices that were made for each question into one choice for all questions. ``asked``
    contains the ways to scan that are needed for questions whose answer does not depend on a layout.
    """
    ways = dict.fromkeys([PLAIN, *asked, *(way for one in choices for way in one.ways)])
    at_edge, weaker = any(one.at_edge for one in choices), any(one.weaker for one in choices)
    return Chosen(tuple(ways), at_edge, weaker, {})


def _worth(more: float, reached: float) -> bool:
    return more >= max(_WORTH * reached, _NOTHING)


def climbed(
    rivalries: Sequence[Rivalry],
    chosen: Chosen,
    starting: Mapping[str, Array],
    limits: Limits,
    plain: FieldContext,
    count: int,
    *,
    steps: int,
    kept: Path,
    report: Callable[[str], None],
) -> list[Array]:
    """Optimise ``count`` tiles. Each tile is optimised for one question. Successive tiles cycle through the
    questions. Return the soft (not rounded) levels of each tile.

    Args:
        rivalries: the rivals of each question.
        chosen: the ways to print and scan.
        starting: layouts from which the optimisation may start, as returned by ``starts``.
        limits: limits for the layouts.
        plain: as for ``planned_scans``.
        count: number of tiles.
        steps: number of ascent steps for each tile.
        kept: folder in which finished tiles are saved. Tiles that an interrupted run has saved there are
            reused.
        report: function that receives the progress messages.
    """
    report(f"{len([*kept.glob('[0-9]*.npy')])} of {count} tiles are kept from an earlier run")
    scans_of = partial(planned_scans, plain, ways=chosen.ways)
    able = [one for one in starting.items() if _repeats(one[1]) <= _MOST_REPEATING]
    ranked = [sorted(able, key=lambda one: -score(rivalry, [scans_of(one[1])])) for rivalry in rivalries]
    tiles = []
    for number in range(count):
        rank, which = divmod(number, len(rivalries))
        rivalry, (name, start) = rivalries[which], ranked[which][rank % len(able)]
        file = kept / f"{number}.npy"
        if not file.is_file():
            asked = rivalry.question.name
            report(f"optimising tile {number + 1} of {count} for {asked}, starting from {name}")
            tile = climb(rivalry, start, partial(scans_of, at_edge=chosen.at_edge), limits, steps)
            with atomic_file(file) as temporary:
                np.save(temporary, tile)
        tiles.append(np.load(file))
    return tiles


def _repeats(level: Array) -> float:
    """Return the self-similarity of a layout: how well it matches shifted copies of itself, as the
    registration would measure it.

    If the value is 1, the layout matches a shifted copy of itself perfectly, and registration cannot
    determine the shift.
    """
    topography = predicted_topography(level, SEARCH_BLUR_PX)
    return rival_alignment(topography, topography)
