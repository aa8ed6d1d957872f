"""Build a dataset store and its report from raw files and a dataset card (``build_dataset``)."""

import functools
import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from litho_data.cards.card import with_tip
from litho_data.cards.listing import Listing, list_fields
from litho_data.commands.progress import progress, say
from litho_data.foundation import Facts, InputError
from litho_data.foundation.run_facts import software_record
from litho_data.making.assemble import Source, assemble, records_of_use
from litho_data.making.calibration import measure_scales, standards_of
from litho_data.making.day_tip import with_tip_found
from litho_data.making.jobs import FieldJob, Job, field_jobs, finish
from litho_data.making.operations import UNREGISTERED, load_recipe, no_recipe
from litho_data.making.report import write_report
from litho_data.making.result import BuildResult, report_folder
from litho_data.making.right_layout import doubts, fitting_layout, prints_of
from litho_data.making.verdict import Weight, findings, odd_heights, require_heights
from litho_data.sharing.workers import HERE, Workers, run_jobs
from litho_data.store.partial import PartialStore, partial_store
from litho_data.store.schema import DatasetId

# If the aspect ratio of a scan's pixels differs by more than this share from the aspect ratio in most scans,
# the scan's file is assumed to lack rows or columns.
_ASPECT_TOLERANCE = 1e-3
# Largest number of comparisons of an unregistered scan with a layout.
_MOST_SEARCHES = 2000


def build_dataset(
    card_path: str | Path,
    out: str | Path,
    *,
    data_dir: str | Path | None = None,
    workers: int = 1,
    dask: str | None = None,
    strict: bool = False,
    seed: int = 0,
    tip: float | str | None = None,
) -> BuildResult:
    """Build a dataset store from a dataset card (the TOML file that describes the raw files).

    Each scan is read, levelled by the card's recipe, registered, and resampled once onto the grid of its
    layout. A scan that cannot be used is skipped. The reason is printed on stderr and recorded in the
    manifest. The store appears at ``out`` only when it is complete. If a build is interrupted, running it
    again continues it. The report is written to ``<name>-report`` beside the store.

    Args:
        card_path: path of the dataset card.
        out: folder of the store. An older store there is replaced.
        data_dir: folder of the raw files. By default, it is the first of these folders that contains the
            files: the card's folder, ``$LITHO_DATA_DIR/<name>``, the user cache.
        workers: number of local processes.
        dask: address of a Dask scheduler, which is used in place of local processes. The store is the same
            either way.
        strict: if true, nothing is built if any id has to be left out, i.e. if its scan or its layout is
            missing or cannot be used.
        seed: seed of the robust estimator in the registration.
        tip: radius of the microscope's tip in µm, or ``blind`` to estimate it from the scans. It replaces the
            value in the card. Pixels that the tip possibly did not touch become invalid.

    Raises:
        InputError: the card is bad, no scan is usable, ``tip`` is not a radius or ``blind``, or ``out``
            contains something other than a store. With ``strict``, the error is also raised if any id has to
            be left out.
    """
    listing = list_fields(card_path, data_dir)
    if tip is not None:
        listing = replace(listing, card=with_tip(listing.card, tip))
    recipe = _recipe(listing)
    places = Workers(workers, dask)
    jobs = with_tip_found(field_jobs(listing, recipe, seed), places)
    source = _source(listing, recipe, seed, jobs)
    return make_store(source, Path(out), workers=places, strict=strict)


def _recipe(listing: Listing) -> dict[str, Any]:
    level = listing.card.process.level
    if level is None and (listing.card.scan.levelled or listing.card.scan.instrument == "sem"):
        return no_recipe()
    return load_recipe(None if level is None else listing.card_path.parent / level)


def _source(listing: Listing, recipe: Facts, seed: int, jobs: Sequence[Job]) -> Source:
    standards = standards_of(listing)
    if standards.described:
        # A bad calibration standard would spoil every scan. It is measured here, so that its error is
        # reported once and before any scan is processed.
        measure_scales(standards.described, list(standards.files.values()))
    return Source(
        card=listing.card,
        jobs=jobs,
        data_dir=listing.data_dir,
        standards=standards.files,
        files={key: {listing.relative(one): one for one in paths} for key, paths in listing.files.items()},
        recipe=recipe,
        seed=seed,
        assumptions=listing.assumptions,
        unpaired=listing.unpaired,
        refused=listing.refused,
    )


def make_store(source: Source, out: Path, *, workers: Workers = HERE, strict: bool = False) -> BuildResult:
    """Run the jobs of a source, and write the store and its report (see ``build_dataset``)."""
    started, clock = datetime.now(UTC), time.perf_counter()
    with partial_store(out) as partial:
        root = partial.open()
        try:
            records = partial.finished(root, {job.id: job.key for job in source.jobs})
            reused = len(records)
            skipped = dict(source.refused)
            for scan_id, reason in skipped.items():
                _report_skipped(scan_id, reason)
            todo = [job for job in source.jobs if job.id not in records]
            say(f"building {source.card.name}: {len(todo)} of {len(source.jobs)} scans to do")
            making = functools.partial(finish, unfinished=partial)
            finished = run_jobs(making, todo, workers, name=lambda job: job.id)
            what = f"building {source.card.name}"
            for job, outcome in progress(finished, what, total=len(todo), at_once=workers.processes):
                if isinstance(outcome, str):
                    # The data folder is removed from paths, because the manifest must not depend on where the
                    # raw files are stored.
                    skipped[job.id] = outcome.replace(f"{source.data_dir}{os.sep}", "")
                    _report_skipped(job.id, skipped[job.id])
                else:
                    records[job.id] = dict(outcome)
        except InputError:
            # A scan with bad input raises no error here. This error therefore comes from the workers, for
            # example from a Dask cluster. Finished scans are kept for the next run.
            if not records:
                partial.discard()
            raise
        try:
            for scan_id, reason in _odd_pixels(records, source.jobs).items():
                _leave_out(scan_id, reason, records, skipped, partial)
            prints = prints_of(records_of_use(list(records.values())), partial.samples)
            for scan_id, reason in odd_heights(prints).items():
                _leave_out(scan_id, reason, records, skipped, partial)
            prints = [one for one in prints if one.id in records]
            named = _name_layouts(source.jobs, skipped)
            left_out = {**skipped, **source.unpaired}
            _require_enough(records, left_out, strict, out)
            require_heights(prints, source.card)
        except InputError:
            partial.discard()
            raise
        doubted = doubts(prints)
        for scan_id, doubt in doubted.items():
            quality = dict(records[scan_id]["quality"])
            quality["warning"] = "; ".join(filter(None, (quality["warning"], doubt)))
            records[scan_id]["quality"] = quality
        kept = [records[scan_id] for scan_id in sorted(records)]
        build = {
            "started": started.isoformat(),
            "ended": datetime.now(UTC).isoformat(),
            "data_dir": _relative(source.data_dir, out.parent),
            "software": software_record(),
        }
        of_use = records_of_use(kept)
        found = findings(of_use, prints, {**doubted, **named}, left_out, source.card)
        for one in found:
            if one.weight != Weight.SKIPPED:
                print(f"check {one}", file=sys.stderr)
        sha256 = assemble(root, kept, partial.samples, source, skipped, build)
        result = BuildResult(
            store=out.name,
            dataset=DatasetId(name=source.card.name, sha256=sha256),
            n_scans=len(of_use),
            n_references=len(kept) - len(of_use),
            findings=found,
            skipped=dict(sorted(skipped.items())),
            unpaired=dict(sorted(source.unpaired.items())),
            reused=reused,
            seconds=round(time.perf_counter() - clock, 2),
            workers=workers.processes,
            software=software_record(),
        )
        write_report(result, partial.store, report_folder(out))
        partial.publish()
    return result


def _relative(folder: Path, start: Path) -> str:
    """Return the path of a folder relative to the folder ``start``. A relative path stays valid if raw files
    and store are moved together.

    Links in both paths are resolved first, because ``..`` after a link means the parent of the folder to
    which the link points.
    """
    try:
        return Path(os.path.relpath(folder.resolve(), start.resolve())).as_posix()
    except ValueError:  # on Windows, the folders may be on different drives
        return str(folder)


def _name_layouts(jobs: Sequence[Job], skipped: dict[str, str]) -> dict[str, str]:
    """Test whether any scan that could not be registered shows the layout of another id. If it does, the id
    of this layout is added to the reason that ``skipped`` gives for the scan. The result maps the ids of such
    scans to messages that name the layout.
    """
    named = {}
    fields = {job.id: job for job in jobs if isinstance(job, FieldJob)}
    lost = [key for key in skipped if key in fields and UNREGISTERED in skipped[key]]
    layouts = {key: layout for key, job in fields.items() if lost and (layout := job.layout()) is not None}
    # Several ids have the same layout if it was printed more than once, or if its print was scanned more than
    # once. The layout is then named after the first of these ids.
    distinct = {layout.tobytes(): name for name, layout in reversed(layouts.items())}
    # Comparing a scan with one layout takes about a twentieth of a second.
    for key in lost[: max(1, _MOST_SEARCHES // max(1, len(distinct)))]:
        chain = fields[key].begin()
        if "raw_height_um" not in chain.arrays:
            continue
        own = layouts[key].tobytes() if key in layouts else None
        others = {name: layouts[name] for held, name in distinct.items() if held != own}
        height_um, (pitch_y_um, pitch_x_um) = chain.arrays["raw_height_um"], chain.pitch_um
        pitch_um = fields[key].card.layout.pitch_um
        if fits := fitting_layout(height_um, (pitch_y_um, pitch_x_um), others, pitch_um):
            named[key] = f"it shows the layout of {fits}"
            skipped[key] += f"; {named[key]}"
    return named


def _odd_pixels(records: Mapping[str, Facts], jobs: Sequence[Job]) -> dict[str, str]:
    """Find the scans whose pixels have another aspect ratio than in most scans. The result maps the ids of
    these scans to the reason for leaving them out. Reference scans, and scans whose size is stated by their
    own file or by the card's table, are not compared.

    A text file that lacks its last rows can still be read as a matrix. Its pixels then seem too long along y,
    because the side length that the card states for all scans is divided by too few rows.
    """
    sized_by_card = {job.id for job in jobs if isinstance(job, FieldJob) and "size_um" not in job.field.read}
    aspects = {
        record["id"]: record["read"]["pitch_um"][0] / record["read"]["pitch_um"][1]
        for record in records_of_use(list(records.values()))
        if record["id"] in sized_by_card and not record["read"]["sized_by_file"]
    }
    ordered = sorted(aspects.values())
    most = ordered[len(ordered) // 2] if ordered else 1.0
    odd = {key: value for key, value in aspects.items() if abs(value / most - 1) > _ASPECT_TOLERANCE}
    if 2 * len(odd) >= len(aspects):
        return {}
    reason = "aspect ratio y/x of the pixels {:.4g}, but {:.4g} in most scans: rows or columns are missing"
    return {key: reason.format(value, most) for key, value in odd.items()}


def _leave_out(
    scan_id: str, reason: str, records: dict[str, Any], skipped: dict[str, str], partial: PartialStore
) -> None:
    skipped[scan_id] = reason
    _report_skipped(scan_id, reason)
    del records[scan_id]
    shutil.rmtree(partial.store / "scans" / scan_id)


def _report_skipped(scan_id: str, reason: str) -> None:
    print(f"skipped {scan_id}: {reason}", file=sys.stderr)


def _require_enough(
    records: Mapping[str, Facts], left_out: Mapping[str, str], strict: bool, out: Path
) -> None:
    shown = "; ".join(f"{scan_id}: {reason}" for scan_id, reason in sorted(left_out.items())[:2])
    if strict and left_out:
        raise InputError(
            f"{out} was not built: {len(left_out)} ids cannot be used",
            got=shown,
            wanted="a usable scan and layout for every id, because of --strict",
        )
    if not records_of_use(list(records.values())):
        raise InputError(
            f"{out} was not built: no scan can be used", got=shown, wanted="at least one good scan"
        )
