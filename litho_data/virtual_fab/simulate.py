"""Run the virtual fab. It writes raw files as a laboratory would deliver them. The truth about these files is
written to a separate folder.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from litho_data.cards.card import load_card
from litho_data.commands.progress import progress
from litho_data.foundation import YX, InputError, Shape, array_sha256, record_sha256, require_known
from litho_data.foundation.begun import whole_folder
from litho_data.layouts.card_text import CARD_NAME, TABLE_NAME, write_card, write_layout, write_table
from litho_data.level.scan import write_heights
from litho_data.readers.text_matrix import write_text_matrix
from litho_data.virtual_fab.fab import Fab, FabScan, scan_job
from litho_data.virtual_fab.jobs import PRINT_PATTERN, SCANNING, Plan, jobs_of_card, random_jobs
from litho_data.virtual_fab.knobs import KnobBoard, KnobSetting
from litho_data.virtual_fab.printer import Cause, Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer
from litho_data.virtual_fab.truth import KnobTruth, ScanTruth, Truth, noise_floor

T = TypeVar("T")


def simulate(
    out: str | Path,
    *,
    count: int = 12,
    size_px: int | Shape = 256,
    seed: int = 0,
    knobs: Iterable[KnobSetting | str] = (),
    cause: Cause | None = None,
    noise: Noise | str = "default",
    microscope: Microscope | str = "default",
    printer: Printer | None = None,
    fields_per_print: int = 4,
    write_field_um: float | None = None,
    references: bool = False,
    jobs: Sequence[Job] | None = None,
    name: str = "virtual-fab",
    plan_of: str = "",
    print_pattern: str = PRINT_PATTERN,
) -> Path:
    """Print and scan a set of fields in the virtual fab, and return the path of the dataset card,
    ``out/raw/card.toml``.

    The folder ``out/raw`` contains what a laboratory would deliver: the card, its table, the layouts and the
    scans. The folder ``out/truth`` contains what is known only in a simulation. It holds the record
    ``truth.json`` and the heights of every print, once without and once with roughness. Scans are made one at
    a time, so the memory that is used does not grow with the number of scans.

    Args:
        out: folder of the run.
        count: number of scans with random layouts.
        size_px: size of each layout in pixels, as one number for both sides or as (ny, nx).
        seed: seed of all random draws of the run.
        knobs: effects that are added to plain printing and scanning, given as settings or as texts
            ``name=strength[@seed]``.
        cause: an effect that you define yourself and that is not a knob. The truth does not record it.
        noise: ``default``, ``off``, or your own standard deviations.
        microscope: ``default`` (scans with a margin and small affine errors), ``aligned`` (scans with a
            margin but without affine errors), or your own microscope.
        printer: your own printer; None stands for the default printer.
        fields_per_print: number of fields in each print.
        write_field_um: side, in µm, of the write field that all fields of a print share. With None, each
            field has its own write field.
        references: whether to add scans of a bare substrate, a flat print and a staircase of five steps.
        jobs: your own layouts, which are printed in place of random ones. Arguments about random layouts are
            then ignored.
        name: name of the dataset, which is written to the card.
        plan_of: hash of the dataset with which the layouts were planned. It is written to the card.
        print_pattern: regular expression that finds the name of the print in the id of a scan. It is written
            to the card.

    Raises:
        InputError: a knob is unknown or its strength is out of range, the layouts cannot be printed, or the
            folder contains other files or a run with other settings.
    """
    if references and jobs is not None:
        raise InputError(
            "reference prints cannot be added to your own layouts",
            wanted="reference layouts among your own, marked in the column use of the card's table",
        )
    settings = [KnobSetting.parse(knob) if isinstance(knob, str) else knob for knob in knobs]
    fab = Fab(
        printer=printer or Printer(),
        microscope=_named(
            microscope, "microscope", {"default": Microscope(), "aligned": Microscope.aligned()}
        ),
        noise=_named(noise, "noise", {"default": Noise(), "off": Noise.off()}),
        knobs=KnobBoard(settings, seed),
        seed=seed,
        cause=cause,
    )
    shape = (size_px, size_px) if isinstance(size_px, int) else size_px
    plan = Plan(count, shape, fields_per_print, write_field_um, references)
    if jobs is not None:
        _check_jobs(jobs, fab.printer)
    source: Iterator[Job] = iter(jobs) if jobs is not None else random_jobs(plan, fab.printer, seed)
    total = len(jobs) if jobs is not None else plan.total
    asked = asdict(plan) if jobs is None else {"jobs": record_sha256([_described(job) for job in jobs])}
    facts: dict[str, Any] = {
        "seed": seed,
        "printer": asdict(fab.printer),
        "microscope": asdict(fab.microscope),
        "noise": asdict(fab.noise),
        "knobs": [KnobTruth.of(setting, seed).model_dump() for setting in fab.knobs.settings],
        "settings": asked,
    }
    record = f"truth/{Truth.FILE_NAME}"
    raw_files = (CARD_NAME, TABLE_NAME, "layouts/*.tif", "scans/*.txt", "scans/*.gsf")
    holds = (*(f"raw/{name}" for name in raw_files), "truth/prints/*.npy", "truth/surfaces/*.npy", record)
    with whole_folder(out, *holds, record=record, facts=facts) as folder:
        raw, hidden = folder / "raw", folder / "truth"
        for part in (raw / "scans", hidden / "prints", hidden / "surfaces"):
            part.mkdir(parents=True)
        rows: list[tuple[object, ...]] = []
        sizes_um: list[YX] = []
        scans: list[ScanTruth] = []
        for job in progress(source, "printing and scanning", total):
            scan = scan_job(fab, job)
            write_layout(raw, job.id, job.level)
            _write_scan(raw / "scans" / job.id, scan, fab.microscope)
            np.save(hidden / "prints" / f"{job.id}.npy", scan.clean_um.astype(np.float32))
            np.save(hidden / "surfaces" / f"{job.id}.npy", scan.surface_um.astype(np.float32))
            rows.append(_row(job, len(rows)))
            sizes_um.append(scan.frame.size_um)
            scans.append(_scan_truth(scan))
        _write_table(raw, rows, sizes_um)
        in_prints = all(re.fullmatch(print_pattern, str(row[0])) for row in rows)
        tables: dict[str, Any] = {
            "ids": {"print": print_pattern if in_prints else None, "table": TABLE_NAME},
            "write": {"slow_axis": "y", "field_um": job.write_field_um},
        }
        if job.grating_um is not None:
            tables["grating"] = {"period_um": job.grating_um}
        if plan_of:
            tables["plan"] = {"dataset_sha256": plan_of}
        write_card(
            raw,
            name=name,
            title="Simulated two-photon prints with simulated AFM scans",
            pitch_um=fab.printer.pitch_um,
            level_height_um=fab.printer.level_height_um,
            levels=fab.printer.levels,
            scan_size_um=scan.frame.size_um,
            scan_format=fab.microscope.files,
            # A build must not level the scans, because tilt and bow are among the simulated effects.
            levelled=True,
            **tables,
        )
        Truth(**facts, scans=scans).write(hidden)
    return Path(out) / "raw" / "card.toml"


def _write_scan(file: Path, scan: FabScan, microscope: Microscope) -> None:
    """Write the file of one scan in the format ``microscope.files``. The suffix is appended to the whole id,
    because an id may contain dots.
    """
    if microscope.files == "gsf":
        pitch_um = (scan.frame.pitch_um, scan.frame.pitch_um)
        path = file.with_name(f"{file.name}.gsf")
        write_heights(path, scan.height_um, pitch_um=pitch_um, title=scan.job.id)
    else:
        write_text_matrix(file.with_name(f"{file.name}.txt"), scan.height_um)


# The values that a usual scan has in the columns SCANNING. Such a scan is not rotated, is made in trace with
# the first tip, and has pixels as large as those of the layout.
AS_EVER = (0.0, 1.0, 1.0, 1.0)


def _row(job: Job, number: int) -> tuple[object, ...]:
    place = (job.field_um[1], job.field_um[0])
    return (job.id, number, *place, job.dose, job.use, *(getattr(job, name) for name in SCANNING))


def _named(value: T | str, what: str, known: dict[str, T]) -> T:
    if not isinstance(value, str):
        return value
    require_known(what, value, known)
    return known[value]


def _described(job: Job) -> dict[str, Any]:
    """Return the attributes of a job as a dictionary, with a hash in place of the layout."""
    return {**vars(job), "level": array_sha256(job.level, "level", ("y", "x"))}


def _check_jobs(jobs: Sequence[Job], printer: Printer) -> None:
    if not jobs:
        raise InputError("layouts to print", got="none", wanted="at least one")
    if len({job.id for job in jobs}) != len(jobs):
        raise InputError("ids of the layouts to print", got=[job.id for job in jobs], wanted="unique ids")
    if len({job.level.shape for job in jobs}) > 1:
        raise InputError(
            "layouts to print",
            got=sorted({job.level.shape for job in jobs}),
            wanted="layouts of one size",
            hint="split the set by size",
        )
    highest = max(int(job.level.max()) for job in jobs)
    if highest >= printer.levels:
        raise InputError("level in a layout", got=highest, wanted=f"0 to {printer.levels - 1}")


def _write_table(raw: Path, rows: list[tuple[object, ...]], sizes_um: list[YX]) -> None:
    """Write the card's table. The columns ``SCANNING`` are left out if every scan was made in the usual way,
    i.e. has the values ``AS_EVER`` in these columns. The sizes (y, x) are left out if all scans have the same
    size.
    """
    ways = SCANNING if any(row[-len(SCANNING) :] != AS_EVER for row in rows) else ()
    columns = ("id", "order", "field_x_um", "field_y_um", "dose", "use", *ways)
    rows = [row[: len(columns)] for row in rows]
    sizes = [" x ".join(f"{round(side, 9)}" for side in size_um) for size_um in sizes_um]
    if len(set(sizes)) > 1:
        columns, rows = (*columns, "size_um"), [(*row, size) for row, size in zip(rows, sizes, strict=True)]
    write_table(raw, columns, rows)


def _scan_truth(scan: FabScan) -> ScanTruth:
    return ScanTruth(
        id=scan.job.id,
        use=scan.job.use,
        dose=scan.job.dose,
        order=scan.job.order,
        field_um=scan.job.field_um,
        scan_shape=scan.frame.shape,
        scan_to_layout=[[float(value) for value in row] for row in scan.frame.scan_to_layout],
        **noise_floor(scan.height_um - scan.noiseless_um),
    )


def simulate_plan(plan: str | Path, fab: str | Path, out: str | Path, *, seed: int = 1) -> Path:
    """Print and scan planned layouts in the virtual fab of an earlier run, and return the path of the new
    card.

    The printer, the microscope, the noise and the knobs with their seeds are those of the earlier run.
    Properties that vary from print to print or from scan to scan are drawn anew.

    Args:
        plan: folder with ``card.toml``, layouts and ``scans.csv``, as ``litho-models next-print`` writes it.
        fab: folder of the earlier run, which contains ``truth``.
        out: folder of the new run, in which ``raw`` and ``truth`` are written.
        seed: seed of the new random draws. It must differ from the seed of the earlier run.

    Raises:
        InputError: the plan or the truth is missing, the seed is equal to the seed of the earlier run, or the
            printer cannot print the layouts.
    """
    card = Path(plan) / CARD_NAME
    truth = Truth.read(Path(fab) / "truth")
    if seed == truth.seed:
        raise InputError(
            "seed of the new run",
            got=f"{seed}, as in the earlier run",
            wanted="another seed, because the prints are new",
        )
    about = load_card(card)
    return simulate(
        out,
        jobs=jobs_of_card(card, first=len(truth.scans), printer=truth.printer),
        seed=seed,
        knobs=[knob.setting for knob in truth.knobs],
        noise=truth.noise,
        microscope=truth.microscope,
        printer=truth.printer,
        name=about.name,
        print_pattern=about.ids.print or "",
        plan_of=about.plan.dataset_sha256 if about.plan else "",
    )
