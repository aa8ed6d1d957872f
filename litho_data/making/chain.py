"""Run the operations on one scan in turn, and collect the part of the store that they make."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from litho_data.foundation import Array, Facts
from litho_data.foundation.run_facts import software_record
from litho_data.making.operations import OPERATIONS, READERS
from litho_data.making.step import Step
from litho_data.store.partial import Piece


@dataclass
class Chain:
    """The results of the operations that have run so far: recorded steps, arrays by name, and facts by
    operation.
    """

    steps: list[Step] = field(default_factory=list)
    arrays: dict[str, Array] = field(default_factory=dict)
    facts: dict[str, Facts] = field(default_factory=dict)

    def run(self, op: str, params: Facts, files: Mapping[str, Path] | None = None) -> Facts:
        """Run an operation on these files and on earlier arrays; raise InputError if that is impossible."""
        step, arrays, self.facts[op] = OPERATIONS[op].run(params, files or {}, self.arrays)
        self.steps.append(step)
        self.arrays |= arrays
        return self.facts[op]

    @property
    def read(self) -> Facts:
        """Return what the reader says about the scan."""
        return next(self.facts[op] for op in READERS if op in self.facts)

    @property
    def scales(self) -> Facts:
        """Return the scales of the microscope; empty without standards."""
        return self.facts.get("calibrate", {})

    @property
    def pitch_um(self) -> list[float]:
        """Return the (y, x) pitch that the scan states, multiplied by the scales of its axes if they are
        known.
        """
        axes = zip("yx", self.read["pitch_um"], strict=True)
        return [one * self.scales.get(f"scale_{axis}", 1.0) for axis, one in axes]

    def piece(self, **said: Any) -> Piece:
        """Return the part of the store that these steps made, with the facts ``said`` in its record."""
        steps = [step.to_record() for step in self.steps]
        record = {**said, "steps": steps, "software": software_record()}
        return Piece(json.loads(json.dumps(record)), self.arrays)
