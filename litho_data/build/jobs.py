"""One unit of work of a build: a field's files in, a finished piece or a reason for skipping out.

Jobs travel to other processes and machines, so they hold paths and plain parameters only.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from litho_data.build.operations import OPERATIONS
from litho_data.build.quality import levelling_figures, noise_figures
from litho_data.build.step import Done
from litho_data.cards.card import Card
from litho_data.cards.listing import Listing, PrintedField
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256, record_sha256
from litho_data.foundation.run_facts import software_record
from litho_data.store.partial import Piece


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


def attempt(job: Job) -> Piece | Skipped:
    """Run a job; bad input becomes a reason for skipping, so one bad file never stops a build."""
    try:
        return job.run()
    except InputError as error:
        return Skipped(job.id, str(error))


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

    @property
    def id(self) -> str:
        """Id of the scan."""
        return self.field.id

    def key(self) -> str:
        """Hash of everything that decides the piece."""
        one = self.field
        described = [one.id, one.print_id, one.order, one.use, one.full_scale_um, dict(one.columns)]
        plan = [described, self.scan_name, self.layout_name, self.recipe, self.seed]
        plan.append(self.card.model_dump(mode="json"))
        files = [file_sha256(path) for path in (self.field.scan, self.field.layout) if path is not None]
        code = {name: [operation.version, operation.code_sha256] for name, operation in OPERATIONS.items()}
        return record_sha256([*plan, files, code])

    def layout(self) -> np.ndarray | None:
        """Levels of its layout; None if there is none that can be read."""
        try:
            done = self._read_layout()
        except InputError:
            return None
        return None if done is None else done.arrays["mask_level"]

    def read(self) -> Done:
        """The scan as it was read; InputError if that fails."""
        return OPERATIONS["read-scan"].run(self._read_params, {self.scan_name: self.field.scan}, {})

    def run(self) -> Piece:
        """The finished scan; InputError if its files do not allow it."""
        steps = list(self._steps())
        arrays = {name: array for done in steps for name, array in done.arrays.items()}
        facts = {done.step.op: done.facts for done in steps}
        quality: dict[str, Any] = {**facts.get("register", {}), **facts.get("tip", {})}
        quality |= noise_figures(arrays["raw_height_um"]) | levelling_figures(arrays["removed_um"])
        if "height_um" in arrays:
            quality["valid_fraction"] = float(arrays["valid"].mean())
        record = {
            "id": self.id,
            "key": self.key(),
            "use": self.field.use,
            "print": self.field.print_id,
            "order": self.field.order,
            "columns": dict(self.field.columns),
            "steps": [done.step.to_record() for done in steps],
            "quality": quality,
            "read": facts["read-scan"],
            "software": software_record(),
        }
        return Piece(json.loads(json.dumps(record)), arrays)

    def _steps(self) -> Iterator[Done]:
        """The operations in order; each sees the arrays of those before it."""
        layout: dict[str, np.ndarray] = {}
        if (done := self._read_layout()) is not None:
            layout = done.arrays
            yield done
        read = self.read()
        yield read
        pitch = {"scan_pitch_um": read.facts["pitch_um"]}
        pitches = {**pitch, "layout_pitch_um": self.card.layout.pitch_um}
        register_params = {**pitches, "model": self.card.process.registration, "seed": self.seed}
        if read.facts["fast_axis"] == "y":
            register_params["fast_axis"] = "y"  # otherwise the lines are rows

        level_inputs = dict(read.arrays)
        if any(step["op"] == "layout-aware" for step in self.recipe["step"]):
            if not layout:
                raise InputError("layout-aware levelling", got="a scan without layout", wanted="a layout")
            raw = {"raw_height_um": read.arrays["raw_height_um"]}
            located = OPERATIONS["locate"].run(register_params, {}, {**layout, **raw})
            level_inputs |= located.arrays
            yield located
        levelled = OPERATIONS["level"].run({**pitch, "recipe": self.recipe}, {}, level_inputs)
        yield levelled
        if self.field.use != "dataset":
            return
        height = {"levelled_height_um": levelled.arrays["levelled_height_um"]}
        registered = OPERATIONS["register"].run(register_params, {}, {**layout, **height})
        yield registered
        found = dict(registered.arrays)
        if self.card.process.tip is not None:
            touched = OPERATIONS["tip"].run({**pitch, "radius_um": self.card.process.tip}, {}, height)
            found |= touched.arrays
            yield touched
        shape = {"layout_shape": list(layout["mask_level"].shape)}
        yield OPERATIONS["resample"].run({**pitches, **shape}, {}, {**height, **found})

    def _read_layout(self) -> Done | None:
        """The layout as it was read, None if the field has none; InputError if that fails."""
        if self.field.layout is None or self.layout_name is None:
            return None
        file = {self.layout_name: self.field.layout}
        return OPERATIONS["read-layout"].run({"levels": self.card.layout.levels}, file, {})

    @property
    def _read_params(self) -> dict[str, Any]:
        scan = self.card.scan
        return {
            "format": scan.format,
            "unit": scan.unit,
            "size_um": list(scan.size_um) if scan.size_um else None,
            "channel": scan.channel,
            "fast_axis": scan.fast_axis,
            "full_scale_um": self.field.full_scale_um,
        }


def field_jobs(listing: Listing, recipe: Mapping[str, Any], seed: int = 0) -> list[FieldJob]:
    """The jobs of a card, in the order of its ids."""
    return [
        FieldJob(
            field=field,
            card=listing.card,
            recipe=recipe,
            scan_name=listing.relative(field.scan),
            layout_name=listing.relative(field.layout) if field.layout else None,
            seed=seed,
        )
        for field in listing.fields
    ]
