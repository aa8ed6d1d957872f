"""Choose the crops on which a model is trained, and cut them out of layouts and scans. A crop can be cut out
together with a margin.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from litho_data.store import PrintedScan
from litho_models.fitting.config import TrainingConfig

# Largest number of pixels that the network processes at once. To compute its gradient, a network stores
# hundreds of bytes per pixel.
_PASS_PX = 256**2
# Smallest number of measured pixels that is enough for a fit, in a scan or in the part of a scan that is
# fitted.
FEWEST_PIXELS = 1024


def part_to_fit(counts: Sequence[int], usual: int) -> int:
    """Return the index of the part of a scan that is fitted: ``usual`` if the part with this index has enough
    measured pixels, and otherwise the part with the most measured pixels. ``counts`` contains the number of
    measured pixels of each part.
    """
    enough = counts[usual] >= min(FEWEST_PIXELS, max(counts))
    return usual if enough else int(np.argmax(counts))


@dataclass(frozen=True)
class Window:
    """A square window in a scan. ``scan`` is the number of the scan, ``y`` and ``x`` are the indices of the
    window's first pixel, and ``size_px`` is its side.
    """

    scan: int
    y: int
    x: int
    size_px: int


def cut(field: np.ndarray, window: Window, margin_px: int = 0) -> np.ndarray:
    """Cut a window with a margin of ``margin_px`` on each side out of a field of shape (ny, nx). If the
    margin extends beyond the field, the outermost pixels of the field are repeated there.
    """
    (top, left), size = (window.y - margin_px, window.x - margin_px), window.size_px + 2 * margin_px
    ny, nx = field.shape
    if min(top, left) >= 0 and top + size <= ny and left + size <= nx:
        return field[top : top + size, left : left + size]
    rows, columns = (
        np.clip(np.arange(start, start + size), 0, length - 1) for start, length in ((top, ny), (left, nx))
    )
    return field[np.ix_(rows, columns)]


def stack(fields: Sequence[np.ndarray], windows: Sequence[Window], margin_px: int = 0) -> Tensor:
    """Cut each window out of the field of its scan, and stack the crops. The result is float32 of shape
    (windows, 1, size, size), where size is the side of a window including its margin.
    """
    crops = [cut(fields[window.scan], window, margin_px) for window in windows]
    return torch.from_numpy(np.stack(crops)[:, None].astype(np.float32))


def plan_batch(shapes: Sequence[tuple[int, int]], config: TrainingConfig, step: int) -> list[Window]:
    """Choose the windows of one optimiser step. For given scan shapes and settings (which include the seed),
    this choice depends only on the number of the step. A run that was interrupted and resumed therefore gives
    the same result.
    """
    if config.crops == "quadrants":
        return _from_permuted_quadrants(shapes, config, step)
    random = np.random.default_rng([config.seed, step])
    windows = []
    for _ in range(config.batch):
        scan = int(random.integers(len(shapes)))
        size = min(config.crop_px, *shapes[scan])
        y, x = (int(random.integers(length - size + 1)) for length in shapes[scan])
        windows.append(Window(scan, y, x, size))
    return windows


def in_passes(windows: Sequence[Window], device: torch.device) -> list[list[Window]]:
    """Divide the windows of a step into groups, which the network processes one after the other.

    On a CPU, a group has at most ``_PASS_PX`` pixels, unless a single window is larger. Groups of this size
    need less memory and no more time than all windows at once. On other devices, all windows form one group.
    """
    per_pass = len(windows)
    if device.type == "cpu":
        per_pass = max(1, _PASS_PX // max(window.size_px**2 for window in windows))
    return [list(windows[start : start + per_pass]) for start in range(0, len(windows), per_pass)]


def quadrants(shapes: Sequence[tuple[int, int]], size_px: int) -> list[Window]:
    """Divide each scan into squares of side ``size_px``, and return the squares that lie completely inside
    the scan. A scan of 512 px, for example, has four quadrants of 256 px.
    """
    return [
        Window(scan, y, x, size_px)
        for scan, (ny, nx) in enumerate(shapes)
        for y in range(0, ny - size_px + 1, size_px)
        for x in range(0, nx - size_px + 1, size_px)
    ]


def _from_permuted_quadrants(
    shapes: Sequence[tuple[int, int]], config: TrainingConfig, step: int
) -> list[Window]:
    size = min(config.crop_px, *(length for shape in shapes for length in shape))
    every = quadrants(shapes, size)
    windows = []
    for number in range(step * config.batch, (step + 1) * config.batch):
        epoch, position = divmod(number, len(every))
        order = np.random.default_rng([config.seed, epoch]).permutation(len(every))
        windows.append(every[order[position]])
    return windows


def grid_pixels(scan: PrintedScan, count: int) -> np.ndarray:
    """Choose about ``count`` pixels on a square grid over the scan. Return the flat indices of those chosen
    pixels that were measured.
    """
    step = max(1, round((scan.usable.size / count) ** 0.5))
    grid = np.zeros_like(scan.usable)
    grid[::step, ::step] = True
    return np.flatnonzero(scan.usable & grid)
