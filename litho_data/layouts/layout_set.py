"""Make sets of random layouts or calibration patterns for a printer, with a dataset card, a table and a
report.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from litho_data.commands.progress import progress
from litho_data.foundation import Array, Shape, require_known
from litho_data.foundation.begun import whole_folder
from litho_data.foundation.quantities import LEVELS
from litho_data.layouts.card_text import CARD_NAME, TABLE_NAME, write_card, write_layout, write_table
from litho_data.layouts.patterns import (
    checkerboard,
    flat,
    framed_ladder,
    isolated_features,
    line_space_sweep,
    relative_doses,
    siemens_star,
    step_ladder,
)
from litho_data.layouts.random_layout import random_layout
from litho_data.layouts.statistics import LayoutStatistics, layout_statistics
from litho_data.layouts.statistics_report import statistics_page

# Width of each step of a framed ladder. The printer blurs each edge over 1 µm on both sides, so a flat strip
# of 1 µm remains in the middle of the step.
_TREAD_UM = 3.0


@dataclass(frozen=True)
class NamedLayout:
    """One layout, and what the table of the dataset card states about it: its id, its relative dose, and the
    use of its scan.
    """

    id: str
    level: Array
    dose: float = 1.0
    use: str = "dataset"


@dataclass(frozen=True)
class SetSettings:
    """The arguments of `write_layout_set`, as a record."""

    count: int
    shape: Shape
    levels: int
    cutoff_per_um: float
    passband: str
    pitch_um: float
    seed: int
    quantiser: str = "round"
    field_px: int | None = None

    @property
    def highest(self) -> int:
        """Return the highest level."""
        return self.levels - 1


def write_layout_set(
    out: str | Path,
    *,
    pattern: str = "random",
    count: int = 12,
    size_px: int | Shape = 512,
    levels: int = 13,
    cutoff_per_um: float = 0.25,
    passband: str = "square",
    pitch_um: float = 0.1,
    level_height_um: float = 0.1,
    seed: int = 0,
    quantiser: str = "round",
    field_px: int | None = None,
) -> Path:
    """Write a set of layouts into the folder ``out``, and return the path of the set's dataset card.

    The folder contains `card.toml`, `scans.csv`, ``layouts/*.tif``, `layouts.json` and a report with the
    set's statistics. The card names the folder ``scans/`` in which the measured scans are expected.

    Args:
        pattern: a key of `PATTERNS`.
        count: number of random layouts, or number of doses in a dose matrix (one layout printed with several
            doses).
        size_px: side length of a square layout in pixels, or its shape (ny, nx).
        levels: number of levels.
        cutoff_per_um: cut-off frequency, in cycles/µm, of the low-pass filter with which random layouts are
            made.
        passband: shape of the pass band of this filter, ``square`` or ``round``; see ``random_layout``.
        pitch_um: pixel pitch, µm.
        level_height_um: nominal height of a level, µm.
        seed: seed of every random draw.
        quantiser: how random layouts are rounded to whole levels, ``round`` or ``floor``; see
            ``random_layout``.
        field_px: side length, in pixels, of a larger random field from whose middle each random layout is
            cut. If None, each layout is a whole field.

    Raises:
        InputError: the pattern is unknown or does not fit into the size, a length is not positive, or the
            folder contains scans, files of another kind, or a set that was made with other settings.
    """
    require_known("pattern", pattern, PATTERNS)
    LEVELS.require("levels of a layout", levels)
    shape = (size_px, size_px) if isinstance(size_px, int) else size_px
    settings = SetSettings(count, shape, levels, cutoff_per_um, passband, pitch_um, seed, quantiser, field_px)
    made = {"pattern": pattern, **asdict(settings), "level_height_um": level_height_um}
    record = LayoutStatistics.FILE_NAME
    holds = (CARD_NAME, TABLE_NAME, "layouts/*.tif", record, "levels.csv", "report.html")
    with whole_folder(out, *holds, record=record, facts={"settings": made}) as folder:
        paths: list[Path] = []
        rows: list[tuple[object, ...]] = []
        make, meaning = PATTERNS[pattern]
        for layout in progress(make(settings), "writing layouts"):
            paths.append(write_layout(folder, layout.id, layout.level))
            rows.append((layout.id, len(rows), f"{layout.dose:.10g}", layout.use))
        write_table(folder, ("id", "order", "dose", "use"), rows)
        write_card(
            folder,
            name=f"{pattern}-layouts",
            title=f"Layouts: {meaning}",
            pitch_um=pitch_um,
            level_height_um=level_height_um,
            levels=levels,
            scan_size_um=(shape[0] * pitch_um, shape[1] * pitch_um),
            ids={"table": TABLE_NAME},
        )
        statistics = layout_statistics(paths, levels=levels, pitch_um=pitch_um)
        statistics = statistics.model_copy(update={"settings": made})
        statistics.write(folder)
        statistics_page(statistics, paths).write(folder)
    return Path(out) / CARD_NAME


def _random(settings: SetSettings) -> Iterator[NamedLayout]:
    digits = len(str(settings.count))
    for index in range(settings.count):
        level = random_layout(
            settings.shape,
            levels=settings.levels,
            cutoff_per_um=settings.cutoff_per_um,
            pitch_um=settings.pitch_um,
            seed=np.random.SeedSequence(settings.seed, spawn_key=(index,)),
            passband=settings.passband,
            quantiser=settings.quantiser,
            field_px=settings.field_px,
        )
        yield NamedLayout(f"R{index + 1:0{digits}}", level)


def _flat(settings: SetSettings) -> Iterator[NamedLayout]:
    yield NamedLayout("flat", flat(settings.shape, level=settings.highest // 2), use="flat")


def _steps(settings: SetSettings) -> Iterator[NamedLayout]:
    yield NamedLayout("steps", step_ladder(settings.shape, highest=settings.highest), use="steps")


def _checkerboard(settings: SetSettings) -> Iterator[NamedLayout]:
    cell_px = max(1, min(settings.shape) // 16)
    yield NamedLayout("checkerboard", checkerboard(settings.shape, cell_px=cell_px, high=settings.highest))


def _lines(settings: SetSettings) -> Iterator[NamedLayout]:
    for along in ("x", "y"):
        level = line_space_sweep(settings.shape, high=settings.highest, along=along)
        yield NamedLayout(f"lines-{along}", level)


def _star(settings: SetSettings) -> Iterator[NamedLayout]:
    yield NamedLayout("star", siemens_star(settings.shape, spokes=18, high=settings.highest))


def _pillars(settings: SetSettings) -> Iterator[NamedLayout]:
    yield NamedLayout("pillars", _features(settings, settings.highest, 0))


def _pits(settings: SetSettings) -> Iterator[NamedLayout]:
    yield NamedLayout("pits", _features(settings, 0, settings.highest))


def _features(settings: SetSettings, feature: int, ground: int) -> Array:
    widest_px = min(settings.shape) // 4 // 3
    widths_px = np.unique(np.geomspace(1, max(1, widest_px), 16).round().astype(int))
    return isolated_features(settings.shape, widths_px=widths_px.tolist(), feature=feature, ground=ground)


def _dose_matrix(settings: SetSettings) -> Iterator[NamedLayout]:
    # The frame is a random layout with twice the cut-off frequency of the settings, because finer structure
    # determines the lateral scale better.
    frame = random_layout(
        settings.shape,
        levels=settings.levels,
        cutoff_per_um=2 * settings.cutoff_per_um,
        pitch_um=settings.pitch_um,
        seed=settings.seed,
        passband=settings.passband,
    )
    tread_px = round(_TREAD_UM / settings.pitch_um)
    layout = framed_ladder(frame, highest=settings.highest, tread_px=tread_px)
    digits = len(str(settings.count))
    for index, dose in enumerate(relative_doses(settings.count)):
        yield NamedLayout(f"dose{index + 1:0{digits}}", layout, dose=float(dose))


PATTERNS: dict[str, tuple[Callable[[SetSettings], Iterator[NamedLayout]], str]] = {
    "random": (_random, "the paper's random layouts"),
    "flat": (_flat, "one level everywhere"),
    "step-ladder": (_steps, "stairs over all levels"),
    "checkerboard": (_checkerboard, "squares with sides of 1/16 of the layout"),
    "line-space": (_lines, "lines and spaces, each one pixel wider than the last, along x and along y"),
    "siemens-star": (_star, "18 wedges around the centre"),
    "pillars": (_pillars, "isolated squares of full height on bare ground, one pixel wide and more"),
    "pits": (_pits, "isolated square holes in a film of full height, one pixel wide and more"),
    "dose-matrix": (_dose_matrix, "one framed step ladder per dose, from 0.7 to 1.3 times the nominal dose"),
}
