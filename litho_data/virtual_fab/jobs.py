"""Make the jobs of a run. Each job describes one field to print and scan. The layouts are random or come from
a dataset card. Reference fields for a noise analysis can be added to fields with random layouts.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from litho_data.cards.card import load_card
from litho_data.cards.listing import files_by_id
from litho_data.cards.tables import read_table
from litho_data.foundation import YX, InputError, Shape
from litho_data.layouts.random_layout import random_layout
from litho_data.readers import read_layout
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Printer

# The columns of a card's table that state how a scan was made.
SCANNING = ("turned_deg", "direction", "tip", "pixel_size")
PRINT_PATTERN = r"P(?P<print>\d+)F\d+"
_STEPS = 5
# Cut-off frequencies of the random layouts, in cycles/µm. Successive prints use the two values alternately.
_CUTOFFS_PER_UM = (0.25, 0.5)


@dataclass(frozen=True)
class Plan:
    """A set of fields with random layouts to print.

    Args:
        count: number of fields.
        size_px: shape (ny, nx) of each layout, in pixels.
        fields_per_print: number of fields in each print.
        write_field_um: side, in µm, of the write field that all fields of a print share. With None, each
            field lies at the centre of its own write field.
        references: whether to add print 0, which consists of a bare substrate, a flat print and a staircase
            of five steps.
    """

    count: int = 12
    size_px: Shape = (256, 256)
    fields_per_print: int = 4
    write_field_um: float | None = None
    references: bool = False

    def __post_init__(self) -> None:
        if self.count < 1 or self.fields_per_print < 1:
            raise InputError(
                "plan of a virtual-fab run",
                got=f"{self.count} fields in total and {self.fields_per_print} per print",
                wanted="at least one field in total and at least one per print",
            )
        if min(self.size_px) < 32:
            raise InputError("size of a layout", got=f"{self.size_px} px", wanted="at least 32 x 32 px")

    def scan_id(self, block: int, field: int) -> str:
        """Return the name of a field. The numbers in the name are padded with zeros, so that the alphabetical
        order of the names is the order of printing.
        """
        blocks = -(-self.count // self.fields_per_print)
        return f"P{block + 1:0{len(str(blocks))}}F{field + 1:0{len(str(self.fields_per_print))}}"

    @property
    def total(self) -> int:
        """Return the number of scans, including those of reference fields."""
        return self.count + 3 * self.references


def random_jobs(plan: Plan, printer: Printer, seed: int) -> Iterator[Job]:
    """Yield the jobs of a plan in the order of printing. Each layout depends only on the seed and the number
    of its field.
    """
    for index in range(plan.count):
        block, field = divmod(index, plan.fields_per_print)
        yield Job(
            id=plan.scan_id(block, field),
            level=random_layout(
                plan.size_px,
                levels=printer.levels,
                cutoff_per_um=_CUTOFFS_PER_UM[block % len(_CUTOFFS_PER_UM)],
                pitch_um=printer.pitch_um,
                seed=np.random.SeedSequence(seed, spawn_key=(index, 0)),
            ),
            index=index,
            order=index / (plan.count - 1) - 0.5 if plan.count > 1 else 0.0,
            field_um=_field_position_um(plan, printer, field),
            write_field_um=plan.write_field_um,
        )
    if plan.references:
        yield from _reference_jobs(plan, printer)


def _field_position_um(plan: Plan, printer: Printer, field: int) -> YX:
    """Return the centre (y, x) of a field in the write field of its print, in µm from the write field's
    centre. The fields of a print fill the write field row by row.
    """
    if plan.write_field_um is None:
        return 0.0, 0.0
    side = int(np.ceil(plan.fields_per_print**0.5))
    rows, columns = divmod(field, side)
    steps_um = [plan.write_field_um / side] * 2
    if not all(size * printer.pitch_um <= step for size, step in zip(plan.size_px, steps_um, strict=True)):
        raise InputError(
            "side of the write field",
            got=f"{plan.write_field_um:g} µm",
            wanted=f"room for {side} x {side} fields of {max(plan.size_px) * printer.pitch_um:g} µm",
        )
    return (rows - (side - 1) / 2) * steps_um[0], (columns - (side - 1) / 2) * steps_um[1]


def _reference_jobs(plan: Plan, printer: Printer) -> Iterator[Job]:
    """Yield the jobs of the reference fields: a bare substrate, a flat print of the middle level, and a
    staircase of five steps, each one level high.
    """
    middle = (printer.levels - 1) // 2
    flat = np.full(plan.size_px, middle, np.uint8)
    stairs = np.arange(plan.size_px[1]) * _STEPS // plan.size_px[1] + 1
    steps = np.broadcast_to(np.minimum(stairs, printer.levels - 1).astype(np.uint8), plan.size_px)
    yield Job(id="P0F1", level=np.zeros(plan.size_px, np.uint8), index=plan.count, use="substrate")
    yield Job(id="P0F2", level=flat, index=plan.count + 1, use="flat")
    yield Job(id="P0F3", level=np.ascontiguousarray(steps), index=plan.count + 2, use="steps")


def jobs_of_card(path: str | Path, *, first: int = 0, printer: Printer | None = None) -> list[Job]:
    """Make the jobs that print and scan the layouts of a dataset card.

    The columns ``turned_deg``, ``direction``, ``tip`` and ``pixel_size`` of the card's table may state how
    each scan is made. Rows with a value in any of these columns, the same print and the same layout are scans
    of one printed field.

    Args:
        path: path of the card.
        first: number of the first scan. The random draws for a scan or a print depend on its number.
        printer: the printer that prints the layouts. None stands for the default printer.

    Raises:
        InputError: the card is invalid or has no layout files, or the pitch or level height in the card
            differs from that of the printer.
    """
    card = load_card(path)
    printer = printer or Printer()
    geometry = (card.layout.pitch_um, card.layout.level_height_um)
    if geometry != (printer.pitch_um, printer.level_height_um):
        raise InputError(
            f"card {path}: pitch and level height",
            got=f"{geometry} µm",
            wanted=f"those of the printer, {(printer.pitch_um, printer.level_height_um)} µm",
        )
    folder = Path(path).parent
    table = read_table(folder / card.ids.table) if card.ids.table else {}
    files = files_by_id(folder, card.layout.files)
    if not files:
        raise InputError(f"layouts of card {path}", got="none", wanted=f"files {card.layout.files}")
    ids = sorted(files, key=lambda one: files[one][0])
    rank = {scan_id: table.get(scan_id, {}).get("order", place) for place, scan_id in enumerate(ids)}
    spread = max(1, len(ids) - 1)
    jobs: list[Job] = []
    printed: dict[tuple[str, bytes], tuple[int, float]] = {}
    for index, scan_id in enumerate(sorted(ids, key=rank.__getitem__)):
        row = table.get(scan_id, {})
        level = read_layout(files[scan_id][0])
        match = re.fullmatch(card.ids.print, scan_id) if card.ids.print else None
        block = match["print"] if match and any(name in row for name in SCANNING) else scan_id
        place = index / spread - 0.5 if len(ids) > 1 else 0.0
        print_index, order = printed.setdefault((block, level.tobytes()), (first + index, place))
        jobs.append(
            Job(
                id=scan_id,
                level=level,
                index=first + index,
                print_index=print_index,
                order=order,
                **{name: row[name] for name in SCANNING if name in row},
                dose=row.get("dose", 1.0),
                field_um=(row.get("field_y_um", 0.0), row.get("field_x_um", 0.0)),
                write_field_um=card.write.field_um if card.write else None,
                use=row.get("use", "dataset"),
                grating_um=card.grating.period_um if card.grating else None,
            )
        )
    return jobs
