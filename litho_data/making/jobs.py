"""One unit of work of a build: a field's files in, a finished piece or a reason for skipping out.

Jobs travel to other processes and machines, so they hold paths and plain parameters only.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from litho_data.cards.card import Card
from litho_data.cards.listing import Listing, PrintedField
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256, record_sha256
from litho_data.foundation.kinds import Array
from litho_data.foundation.run_facts import software_record
from litho_data.making.calibration import NO_STANDARDS, Standards, standards_of
from litho_data.making.operations import OPERATIONS, READERS
from litho_data.making.step import Done
from litho_data.register.refine import BORDER_PX
from litho_data.store.partial import PartialStore, Piece

_LAYOUT_AWARE = "layout-aware"
# Rim of level 0 around a field that is alone on the substrate, as models extend the edge of a layout.
_BARE_PX = 2
# Film or ground that a micrograph shows this deep, px, inside the opposite of its layout is dirt or a pit.
_DIRT_PX = 5


class Job(Protocol):
    """What a build needs of a unit of work."""

    @property
    def id(self) -> str:
        """Id of the scan."""

    def key(self) -> str:
        """Hash of everything that determines the piece: files, parameters, code."""

    def run(self) -> Piece:
        """Make the piece; InputError if the files do not allow it."""


@dataclass(frozen=True)
class Skipped:
    """A field that could not be used, and why."""

    id: str
    reason: str


def piece_of(steps: Sequence[Done], **said: Any) -> Piece:
    """The piece that these steps made, with further facts for its record."""
    record = {**said, "steps": [done.step.to_record() for done in steps], "software": software_record()}
    arrays = {name: array for done in steps for name, array in done.arrays.items()}
    return Piece(json.loads(json.dumps(record)), arrays)


def finish(job: Job, unfinished: PartialStore) -> Mapping[str, Any] | Skipped:
    """Run a job, keep its piece and return the record of the piece; arrays stay where they are made.

    Bad input becomes a reason for skipping, so one bad file never stops a build.
    """
    try:
        piece = job.run()
    except InputError as error:
        return Skipped(job.id, str(error))
    unfinished.add(piece)
    return piece.record


@dataclass(frozen=True)
class FieldJob:
    """Read, level, register and resample one printed field.

    ``scan_name`` and ``layout_name`` are the recorded names of its files, relative to the data folder.
    """

    field: PrintedField
    card: Card
    recipe: Mapping[str, Any]
    scan_name: str
    layout_name: str | None
    seed: int = 0
    standards: Standards = NO_STANDARDS

    @property
    def id(self) -> str:
        """Id of the scan."""
        return self.field.id

    def key(self) -> str:
        """Hash of everything that determines the piece."""
        one = self.field
        described = [
            one.id,
            one.print_id,
            one.order,
            one.use,
            one.full_scale_um,
            dict(one.columns),
            dict(one.read),
        ]
        plan = [described, self.scan_name, self.layout_name, self.recipe, self.seed]
        plan.append(self.card.model_dump(mode="json"))
        own = (self.field.scan, self.field.layout, *self.standards.files.values())
        files = [file_sha256(path) for path in own if path is not None]
        code = {name: [operation.version, operation.code_sha256] for name, operation in OPERATIONS.items()}
        return record_sha256([*plan, files, code])

    def layout(self) -> Array | None:
        """Levels of its layout; None if it has no layout that can be read."""
        try:
            done = self._read_layout()
        except InputError:
            return None
        return None if done is None else done.arrays["mask_level"]

    def read(self) -> Done:
        """The scan as it was read; InputError if that fails."""
        file = {self.scan_name: self.field.scan}
        if self._is_micrograph:
            return OPERATIONS["read-micrograph"].run({"size_um": self._read_params["size_um"]}, file, {})
        return OPERATIONS["read-scan"].run(self._read_params, file, {})

    def calibrate(self) -> Done | None:
        """The scales of the microscope, None without standards; InputError if these cannot be measured."""
        if not self.standards.described:
            return None
        described = {"standards": [dict(one) for one in self.standards.described]}
        return OPERATIONS["calibrate"].run(described, self.standards.files, {})

    def register_params(self, pitch_um: Sequence[float], fast_axis: str | None) -> dict[str, Any]:
        """Parameters of a registration of scans with this (y, x) pitch."""
        pitches = {"scan_pitch_um": pitch_um, "layout_pitch_um": self.card.layout.pitch_um}
        lines = {"fast_axis": "y"} if fast_axis == "y" else {}  # if unknown, the lines are taken as rows
        return {**pitches, "model": self.card.process.registration, "seed": self.seed, **lines}

    def run(self) -> Piece:
        """The finished scan; InputError if its files do not allow it."""
        steps = list(self._steps())
        arrays = {name: array for done in steps for name, array in done.arrays.items()}
        facts = {done.step.op: done.facts for done in steps}
        quality: dict[str, Any] = {}
        for op in ("register", "uncertainty", "tip", "calibrate", "find-edges", "cover"):
            quality |= facts.get(op, {})
        read = next(facts[op] for op in READERS if op in facts)
        notes = [*read.get("notes", ()), *facts.get("level", {}).get("notes", ())]
        said = (quality.get("warning", ""), *notes)
        quality["warning"] = "; ".join(filter(None, said))
        if "removed_um" in arrays:
            removed_nm = 1e3 * arrays["removed_um"].astype(float)
            quality["removed_range_nm"] = float(np.nanmax(removed_nm) - np.nanmin(removed_nm))
            quality["removed_sd_nm"] = float(np.nanstd(removed_nm))
        if "height_um" in arrays:
            quality["valid_fraction"] = float(arrays["valid"].mean())
        return piece_of(
            steps,
            id=self.id,
            key=self.key(),
            use=self.field.use,
            print=self.field.print_id,
            order=self.field.order,
            columns=dict(self.field.columns),
            quality=quality,
            notes=notes,
            read=read,
            pitch_um=scaled_pitch_um(read["pitch_um"], facts.get("calibrate", {})),
        )

    def _steps(self) -> Iterator[Done]:
        """The operations in order; each takes the arrays that it needs from the operations before it."""
        held: dict[str, Array] = {}

        def kept(done: Done) -> Done:
            held.update(done.arrays)
            return done

        def made(op: str, params: Mapping[str, Any]) -> Done:
            return kept(OPERATIONS[op].run(params, {}, held))

        if (layout := self._read_layout()) is not None:
            yield kept(layout)
        read = kept(self.read())
        yield read
        pitch_um = read.facts["pitch_um"]
        if (scales := self.calibrate()) is not None:
            yield kept(scales)
            pitch_um = scaled_pitch_um(pitch_um, scales.facts)
        pitch = {"scan_pitch_um": pitch_um}
        pitches = {**pitch, "layout_pitch_um": self.card.layout.pitch_um}
        # The layout does not show what lies around the field, so the outermost pixels are no evidence.
        aside = {"edge_px": BORDER_PX} if self._surround in ("continues", "unknown") else {}
        register_params = self.register_params(pitch_um, read.facts["fast_axis"])
        if self._is_micrograph:
            full_level = self.card.layout.levels - 1
            film = {"film_um": full_level * self.card.layout.level_height_um}
            edges = made("find-edges", {**pitch, **film})
            yield edges
            yield made("register", register_params)
            sigma = {"edge_sigma_um": edges.facts["edge_sigma_nm"] / 1e3, "full_level": full_level}
            place = {**pitches, "layout_shape": list(held["mask_level"].shape)}
            yield made("cover", {**place, **film, **sigma, "dirt_px": _DIRT_PX, "edge_px": 0, **aside})
            return
        recipe = dict(self.recipe)
        if layout is None or (self.field.use != "dataset" and not np.ptp(held["mask_level"])):
            # A reference has no layout, or a flat one that cannot be located.
            recipe["step"] = [step for step in recipe["step"] if step["op"] != _LAYOUT_AWARE]
        elif any(step["op"] == _LAYOUT_AWARE for step in recipe["step"]):
            yield made("locate", register_params)
        yield made("level", {**pitch, "recipe": recipe})
        if self.field.use != "dataset":
            return
        registered = made("register", register_params)
        yield registered
        if self.card.process.tip is not None:
            yield made("tip", {**pitch, "radius_um": self.card.process.tip})
        yield made("resample", {**pitches, "layout_shape": list(held["mask_level"].shape), **aside})
        fit = {name: registered.facts[name] for name in ("blur_um", "model")}
        lines = {"fast_axis": read.facts["fast_axis"] or "x", "levelled": bool(recipe["step"])}
        yield made("uncertainty", {**pitches, **fit, **lines})

    def _read_layout(self) -> Done | None:
        """The layout as it was read, None if the field has none; InputError if that fails."""
        if self.field.layout is None or self.layout_name is None:
            return None
        file = {self.layout_name: self.field.layout}
        params: dict[str, Any] = {"levels": self.card.layout.levels}
        for name in ("grey_per_level", "average_px"):
            if (value := getattr(self.card.layout, name)) is not None:
                params[name] = value
        if self._surround == "substrate":
            params["bare_px"] = _BARE_PX
        return OPERATIONS["read-layout"].run(params, file, {})

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
        # Facts from the table must agree with the file; those from the card are only defaults.
        defaults = {"defaults": True} if not {"unit", "size_um"} & set(self.field.read) else {}
        return {**stated, **missing, **defaults, "full_scale_um": self.field.full_scale_um}


def scaled_pitch_um(pitch_um: Sequence[float], scales: Mapping[str, float]) -> list[float]:
    """A stated (y, x) pitch times the scales of its axes, if they are known."""
    return [one * scales.get(f"scale_{axis}", 1.0) for axis, one in zip("yx", pitch_um, strict=True)]


def field_jobs(listing: Listing, recipe: Mapping[str, Any], seed: int = 0) -> list[FieldJob]:
    """The jobs of a card, in the order of its ids."""
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
