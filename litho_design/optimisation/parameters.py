"""The free parameters of a layout of cells or rings. Each cell has either a Gumbel-Softmax distribution over
levels, or one real-valued level, which is rounded for the print.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_design.optimisation.process_window import blurred
from litho_design.optimisation.settings import SearchSettings
from litho_design.printers.layout import LayoutSettings

# With 13 levels (12 steps between them), a learning rate of 1 moves the level of a cell by about one level
# per iteration. With another number of levels, this rate moves the level by the same share of the range.
_RATE_STEPS = 12
# Width of the distributions at the start, in levels. With this width, the first step of the search can reach
# the levels next to the starting level.
_START_SPREAD_LEVELS = 1.0


class CellMap(nn.Module):
    """Spread one value per cell over the pixels of the layout, and average pixel values over cells.

    If ``rows`` is given, the map covers only these rows of pixels, and the method ``own`` selects the cells
    in these rows from the cells of the whole layout. In the docstrings below, *cells stands for the shape of
    an array with one value per cell.
    """

    ring: Tensor

    def __init__(self, layout: LayoutSettings, rows: range | None = None):
        super().__init__()
        self.size_px, self.radial = layout.size_px, layout.symmetry == "radial"
        if self.radial:
            centre = torch.arange(self.size_px, dtype=torch.float64) - (self.size_px - 1) / 2
            radius_px = torch.hypot(centre[:, None], centre[None, :])
            ring = (radius_px / layout.ring_px).floor().long()
            self.register_buffer("ring", ring, persistent=False)
            self.cells: tuple[int, ...] = (int(ring.max()) + 1,)
        else:
            self.cell_px = layout.cell_px
            self.cells = (self.size_px // self.cell_px,) * 2
        self.of_all, self._own = self.cells, slice(None)
        if rows is not None:
            self._own = slice(rows.start // self.cell_px, rows.stop // self.cell_px)
            self.cells = (len(rows) // self.cell_px, self.cells[-1])

    def own(self, values: Tensor) -> Tensor:
        """Select the values of the cells that this map covers. ``values`` contains one value per cell of the
        whole layout.
        """
        return values[self._own]

    def forward(self, values: Tensor) -> Tensor:
        """Spread values of shape (..., *cells) over the pixels. The result has shape (..., size, size)."""
        if self.radial:
            return values[..., self.ring]
        return values.repeat_interleave(self.cell_px, -1).repeat_interleave(self.cell_px, -2)

    def average(self, pixels: Tensor) -> Tensor:
        """Return the mean of real or complex pixel values over each cell. ``pixels`` has shape (size, size).
        The mean of a ring without pixels is 0.
        """
        if not self.radial:
            blocks = pixels.unflatten(-1, (-1, self.cell_px)).unflatten(-3, (-1, self.cell_px))
            return blocks.mean((-3, -1))
        index = self.ring.flatten()
        total = pixels.new_zeros(self.cells).index_add_(0, index, pixels.flatten())
        count = torch.bincount(index, minlength=self.cells[0]).clamp(min=1)
        return total / count


class GumbelLevels(nn.Module):
    """One categorical distribution over levels for each cell, sampled with Gumbel-Softmax.

    A sample of a cell is the weighted mean of all levels, with randomly drawn weights (Jang, Gu and Poole
    2017, arXiv:1611.01144).
    """

    # The learning rate is multiplied by this factor. It is 1, because logits, unlike levels, have no range to
    # which the rate could be scaled.
    rate_unit = 1.0

    def __init__(self, layout: LayoutSettings, cells: CellMap | None = None):
        super().__init__()
        self.cells = cells or CellMap(layout)
        self.levels = layout.levels
        self.logits = nn.Parameter(torch.zeros(layout.levels, *self.cells.cells))

    def sample(self, temperature: float, seed: int) -> Tensor:
        """Return sampled levels on the pixels, float of shape (1, 1, size, size). The same seed gives the
        same sample.
        """
        devices = [self.logits.device] if self.logits.is_cuda else []
        with torch.random.fork_rng(devices=devices):
            torch.manual_seed(seed)
            weights = F.gumbel_softmax(self.logits, tau=temperature, dim=0)
        ladder = torch.arange(self.levels, dtype=weights.dtype, device=weights.device)
        return self.cells(torch.tensordot(ladder, weights, dims=1))[None, None]

    def best_levels(self) -> Tensor:
        """Return the most probable level of each cell, int64 of shape (*cells)."""
        return self.logits.detach().argmax(0)

    @torch.no_grad()
    def start_from(self, levels: Tensor, *, jitter_levels: float = 0.0, seed: int = 0) -> None:
        """Centre the distributions on real-valued levels of shape (*cells), to which Gaussian noise with the
        standard deviation ``jitter_levels`` is added.
        """
        levels = _jittered(levels.to(self.logits), jitter_levels, seed, self.levels)
        ladder = torch.arange(self.levels, device=self.logits.device).view(-1, *[1] * levels.dim())
        self.logits.copy_(-((ladder - levels) ** 2) / (2 * _START_SPREAD_LEVELS**2))

    @torch.no_grad()
    def start_random(self, seed: int) -> None:
        """Start from standard normal logits."""
        generator = torch.Generator().manual_seed(seed)
        self.logits.copy_(torch.randn(self.logits.shape, generator=generator))

    def project(self) -> None:
        """Do nothing, because logits have no range to clamp to."""


class DirectLevels(nn.Module):
    """One real-valued level per cell. The levels are filtered if the layout has a cell filter.

    A sample with ``hard=True`` has rounded levels. Its gradient is computed as if the levels had not been
    rounded (straight-through estimator).
    """

    def __init__(self, layout: LayoutSettings, cells: CellMap | None = None):
        super().__init__()
        self.cells = cells or CellMap(layout)
        self.levels = layout.levels
        self.rate_unit = (layout.levels - 1) / _RATE_STEPS
        self.height = nn.Parameter(torch.zeros(self.cells.cells))
        self.filter_cells = layout.cell_filter_um / layout.cell_um

    def sample(self, temperature: float = 1.0, seed: int = 0, *, hard: bool = False) -> Tensor:
        """Return the levels on the pixels, float of shape (1, 1, size, size). Nothing is drawn at random."""
        free, kept = self._filtered(), self._kept()
        level = free + ((kept.round() if hard else kept) - free).detach()
        return self.cells(level)[None, None]

    @torch.no_grad()
    def project(self) -> None:
        """Clamp levels that an optimiser step moved out of the range."""
        self.height.clamp_(0, self.levels - 1)

    def best_levels(self) -> Tensor:
        """Return the nearest integer level of each cell, int64 of shape (*cells)."""
        return self._kept().detach().round().long()

    @torch.no_grad()
    def start_from(self, levels: Tensor, *, jitter_levels: float = 0.0, seed: int = 0) -> None:
        """Start at real-valued levels of shape (*cells), to which Gaussian noise with the standard deviation
        ``jitter_levels`` is added.
        """
        self.height.copy_(_jittered(levels.to(self.height), jitter_levels, seed, self.levels))

    @torch.no_grad()
    def start_random(self, seed: int) -> None:
        """Start from random levels, uniform over the whole range."""
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.rand(self.cells.of_all, generator=generator)
        self.height.copy_(self.cells.own(drawn) * (self.levels - 1))

    def _kept(self) -> Tensor:
        """Return the levels clamped to their range. A step of the optimiser may have moved levels out of this
        range, and ``project`` may not have been called after the step.
        """
        return self._filtered().clamp(0, self.levels - 1)

    def _filtered(self) -> Tensor:
        return blurred(self.height, self.filter_cells) if self.filter_cells else self.height


Parametrisation = GumbelLevels | DirectLevels


def make_parametrisation(
    layout: LayoutSettings, search: SearchSettings, cells: CellMap | None = None
) -> Parametrisation:
    """Make the free parameters: ``GumbelLevels`` or ``DirectLevels``, as ``search.parametrisation`` says.
    ``cells`` may cover only a part of the layout.

    Raises:
        InputError: the layout has a cell filter, but the parameters are distributions over levels.
    """
    if search.parametrisation == "direct":
        return DirectLevels(layout, cells)
    if layout.cell_filter_um:
        raise InputError(
            "cell filter",
            got="the parametrisation gumbel",
            wanted="direct, because distributions cannot be filtered",
        )
    return GumbelLevels(layout, cells)


def _jittered(levels: Tensor, jitter_levels: float, seed: int, level_count: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    jitter = torch.randn(levels.shape, generator=generator).to(levels) * jitter_levels
    return (levels + jitter).clamp(0, level_count - 1)
