"""Define the jobs of a build. A job makes one finished scan of the store from the files of a printed field,
or gives a reason for skipping it.

Jobs are sent to other processes and computers, so they contain only paths and plain parameters.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from litho_data.cards.card import Card, Use
from litho_data.cards.listing import Listing, PrintedField
from litho_data.foundation import Array, Facts, InputError, file_sha256, record_sha256
from litho_data.making.calibration import NO_STANDARDS, Standards, defaults_beside, standards_of
from litho_data.making.chain import Chain
from litho_data.making.contour import REACH_PX
from litho_data.making.operations import OPERATIONS, READER_SHA256
from litho_data.readers.exported import sidecar_of
from litho_data.readers.read import own_reader_sha256
from litho_data.register.refine import BORDER_PX
from litho_data.store.partial import PartialStore, Piece

_LAYOUT_AWARE = "layout-aware"
# Width, in pixels, of the rim of level 0 that is added around the layout of a field that stands alone on the
# substrate. Models extend a layout by repeating its outermost levels. With the rim, they extend it with level
# 0.
_BARE_PX = 2
# Film in a gap of the layout counts as dirt if it lies farther than this, in px, from the edges of the
# layout. Bare ground at such a distance inside the layout's film counts as a pit.
_DIRT_PX = 5


class Job(Protocol):
    """The interface of a job, which makes one scan of the store."""

    @property
    def id(self) -> str:
        """Return the id of the scan."""

    def key(self) -> str:
        """Return the hash of everything that determines the result: files, parameters and code."""

    def run(self) -> Piece:
        """Make the scan's part of the store.

        Raises:
            InputError: the scan cannot be made from its files.
        """


def finish(job: Job, unfinished: PartialStore) -> Facts | str:
    """Run a job, add its arrays to the unfinished store, and return the record of the scan.

    The process that makes the arrays also stores them, so that only the record is sent to the main process.
    If the input is bad, the result is a text with the reason why the scan is skipped. A bad file therefore
    never stops a build.
    """
    try:
        piece = job.run()
    except InputError as error:
        return str(error)
    unfinished.add(piece)
    return piece.record


@dataclass(frozen=True)
class FieldJob:
    """The job that reads, levels, registers and resamples the scan of one printed field.

    ``scan_name`` and ``layout_name`` are the recorded names of the field's files, i.e. their paths relative
    to the data folder.
    """

    field: PrintedField
    card: Card
    recipe: Facts
    scan_name: str
    layout_name: str | None
    seed: int = 0
    standards: Standards = NO_STANDARDS

    @property
    def id(self) -> str:
        """Return the id of the scan."""
        return self.field.id

    def key(self) -> str:
        """Return the hash of everything that determines the result: files, parameters and code."""
        described = {**asdict(self.field), "scan": self.scan_name, "layout": self.layout_name}
        plan = [described, self.recipe, self.seed, self.card.model_dump(mode="json")]
        own = (self.field.scan, *self._layout_files.values(), *self.standards.files.values())
        files = [file_sha256(path) for path in own]
        code = {name: [operation.version, operation.code_sha256] for name, operation in OPERATIONS.items()}
        return record_sha256([*plan, self._read_params, self._standards_read, files, code])

    def layout(self) -> Array | None:
        """Return the levels of the field's layout, or None if the field has no readable layout."""
        chain = Chain()
        try:
            self._read_layout(chain)
        except InputError:
            return None
        return chain.arrays.get("mask_level")

    def begin(self) -> Chain:
        """Read the layout and the scan, and measure the scales of the microscope if the card names
        calibration standards.

        Raises:
            InputError: a file is unusable.
        """
        chain = Chain()
        self._read_layout(chain)
        file = {self.scan_name: self.field.scan}
        if self._is_micrograph:
            chain.run("read-micrograph", {"size_um": self._read_params["size_um"]}, file)
        else:
            chain.run("read-scan", self._read_params, file)
        if self.standards.described:
            chain.run("calibrate", {"standards": self._standards_read}, self.standards.files)
        return chain

    def register_params(self, chain: Chain) -> dict[str, Any]:
        """Return the parameters with which the scan is registered."""
        pitches = {"scan_pitch_um": chain.pitch_um, "layout_pitch_um": self.card.layout.pitch_um}
        # If the fast axis is unknown, it is assumed to be x.
        lines = {"fast_axis": "y"} if chain.read["fast_axis"] == "y" else {}
        return {**pitches, "model": self.card.process.registration, "seed": self.seed, **lines}

    def run(self) -> Piece:
        """Make the scan's part of the store.

        Raises:
            InputError: the scan cannot be made from its files.
        """
        chain = self.begin()
        (self._cover if self._is_micrograph else self._level)(chain)
        arrays, facts = chain.arrays, chain.facts
        quality: dict[str, Any] = {}
        for op in ("register", "uncertainty", "tip", "calibrate", "find-edges", "cover"):
            quality |= facts.get(op, {})
        notes = [*chain.read.get("notes", ()), *facts.get("level", {}).get("notes", ())]
        quality["warning"] = "; ".join(filter(None, (quality.get("warning", ""), *notes)))
        if "removed_um" in arrays:
            removed_nm = 1e3 * arrays["removed_um"].astype(float)
            quality["removed_range_nm"] = float(np.nanmax(removed_nm) - np.nanmin(removed_nm))
            quality["removed_sd_nm"] = float(np.nanstd(removed_nm))
        if "height_um" in arrays:
            quality["valid_fraction"] = float(arrays["valid"].mean())
        return chain.piece(
            id=self.id,
            key=self.key(),
            use=self.field.use,
            print=self.field.print_id,
            order=self.field.order,
            columns=dict(self.field.columns),
            quality=quality,
            notes=notes,
            read=chain.read,
            pitch_um=chain.pitch_um,
        )

    def _cover(self, chain: Chain) -> None:
        """Run the operations that follow the reading of a micrograph. They find the edges of the film,
        register the film onto the layout, and compute the heights and their uncertainty on the layout's grid.
        """
        full_level = self.card.layout.levels - 1
        film = {"film_um": full_level * self.card.layout.level_height_um}
        # Distances must be known up to the size of a layout pixel, even in a much finer micrograph.
        ratio = self.card.layout.pitch_um / min(chain.pitch_um)
        reach = {"reach_px": ratio} if ratio > REACH_PX else {}
        edges = chain.run("find-edges", {"scan_pitch_um": chain.pitch_um, **film, **reach})
        chain.run("register", self.register_params(chain))
        sigma = {"edge_sigma_um": edges["edge_sigma_nm"] / 1e3, "full_level": full_level}
        chain.run("cover", {"edge_px": 0, **self._place(chain), **film, **sigma, "dirt_px": _DIRT_PX})

    def _level(self, chain: Chain) -> None:
        """Run the operations that follow the reading of heights. They level the scan. If the scan is not a
        reference scan, they also register and resample it, and compute the uncertainty of its heights.
        """
        of_dataset = self.field.use == "dataset"
        pitch = {"scan_pitch_um": chain.pitch_um}
        recipe = dict(self.recipe)
        if not of_dataset:
            recipe["step"] = _without_layout(recipe["step"], self.field.use)
        elif any(step["op"] == _LAYOUT_AWARE for step in recipe["step"]):
            chain.run("locate", self.register_params(chain))
        chain.run("level", {**pitch, "recipe": recipe})
        if not of_dataset:
            return
        found = chain.run("register", self.register_params(chain))
        if self.card.process.tip is not None:
            chain.run("tip", {**pitch, "radius_um": self.card.process.tip})
        chain.run("resample", self._place(chain))
        fit = {name: found[name] for name in ("blur_um", "model")}
        lines = {"fast_axis": chain.read["fast_axis"] or "x", "levelled": bool(recipe["step"])}
        chain.run("uncertainty", {**pitch, "layout_pitch_um": self.card.layout.pitch_um, **fit, **lines})

    def _place(self, chain: Chain) -> dict[str, Any]:
        """Return the parameters that describe the grid of the layout. The heights at its border depend on
        what surrounds the field. If the card states that the surroundings belong to the print or are unknown,
        the layout does not show them. A border of ``edge_px`` pixels then becomes invalid.
        """
        grid = {"scan_pitch_um": chain.pitch_um, "layout_pitch_um": self.card.layout.pitch_um}
        grid["layout_shape"] = list(chain.arrays["mask_level"].shape)
        return {**grid, "edge_px": BORDER_PX} if self._surround in ("continues", "unknown") else grid

    def _read_layout(self, chain: Chain) -> None:
        if not (files := self._layout_files):
            return
        params: dict[str, Any] = {"levels": self.card.layout.levels}
        for name in ("grey_per_level", "average_px"):
            if (value := getattr(self.card.layout, name)) is not None:
                params[name] = value
        if self._surround == "substrate":
            params["bare_px"] = _BARE_PX
        chain.run("read-layout", params, files)

    @property
    def _layout_files(self) -> dict[str, Path]:
        """Return the files from which the levels are read, keyed by their recorded names. They are the layout
        file and, for a layout that the design package exported, its sidecar file.
        """
        if self.field.layout is None or self.layout_name is None:
            return {}
        sidecar = sidecar_of(self.field.layout)
        beside = {f"{self.layout_name}.json": sidecar} if sidecar else {}
        return {self.layout_name: self.field.layout, **beside}

    @property
    def _is_micrograph(self) -> bool:
        return self.card.scan.instrument == "sem"

    @property
    def _surround(self) -> str | float | None:
        write = self.card.write
        return self.field.columns.get("surround") or (write.surround if write else None)

    @property
    def _read_params(self) -> dict[str, Any]:
        scan = self.card.scan
        stated = {name: getattr(scan, name) for name in ("format", "unit", "size_um", "channel", "fast_axis")}
        stated |= dict(self.field.read)
        stated["size_um"] = list(stated["size_um"]) if stated["size_um"] else None
        missing = {} if scan.missing is None else {"missing": list(scan.missing)}
        defaults = {"defaults": defaults_beside(self.field.read)}
        own = {} if self._is_micrograph else _own_reader(self.field.scan, stated["format"])
        return {**stated, **missing, **defaults, "full_scale_um": self.field.full_scale_um, **own}

    @property
    def _standards_read(self) -> list[dict[str, Any]]:
        files = list(self.standards.files.values())
        return [
            {**one, **_own_reader(files[one["file"]], one["read"]["format"])}
            for one in self.standards.described
        ]


def _without_layout(steps: Sequence[Facts], use: Use) -> list[Facts]:
    """Return the steps with which a reference scan is levelled. They are the steps of the recipe that do not
    use the layout, because no layout can be located in a reference scan.

    In scans of a flat surface, polynomial steps of the same degrees replace the layout-aware steps. In scans
    of calibration steps and gratings, nothing replaces the layout-aware steps, because polynomials would
    remove part of the structure.
    """
    kept = []
    for step in steps:
        if step["op"] != _LAYOUT_AWARE:
            kept.append(step)
        elif use in ("flat", "substrate"):
            degrees = {name: value for name, value in step.items() if name != "blur_px"}
            kept.append({**degrees, "op": "polynomial"})
    return kept


def _own_reader(scan: Path, format: str) -> dict[str, str]:
    """If the user wrote the reader of a scan, return the parameter that identifies this reader. For a reader
    of this package, return an empty dict.
    """
    sha256 = own_reader_sha256(scan, format)
    return {READER_SHA256: sha256} if sha256 else {}


def field_jobs(listing: Listing, recipe: Facts, seed: int = 0) -> list[FieldJob]:
    """Return one job for every printed field that a card describes, in the order of the ids."""
    standards = standards_of(listing)
    return [
        FieldJob(
            field=field,
            card=listing.card,
            recipe=recipe,
            scan_name=listing.relative(field.scan),
            layout_name=listing.relative(field.layout) if field.layout else None,
            seed=seed,
            standards=standards,
        )
        for field in listing.fields
    ]
