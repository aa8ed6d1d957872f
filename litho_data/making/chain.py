"""Run operations on one scan, one after another, and collect the arrays and records that they add to the
store.
"""

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
    """The results of the operations that have run on a scan so far.

    ``steps`` contains the records of the operations, in the order in which they ran. ``arrays`` contains the
    arrays that the operations made, keyed by array name. ``facts`` contains the facts that each operation
    found, keyed by the name of the operation.
    """

    steps: list[Step] = field(default_factory=list)
    arrays: dict[str, Array] = field(default_factory=dict)
    facts: dict[str, Facts] = field(default_factory=dict)

    def run(self, op: str, params: Facts, files: Mapping[str, Path] | None = None) -> Facts:
        """Run an operation on the given files and on the arrays that earlier operations made, and return the
        facts that it found.

        Raises:
            InputError: the operation cannot be run on this input.
        """
        step, arrays, self.facts[op] = OPERATIONS[op].run(params, files or {}, self.arrays)
        self.steps.append(step)
        self.arrays |= arrays
        return self.facts[op]

    @property
    def read(self) -> Facts:
        """Return the facts that the reader found in the scan's file."""
        return next(self.facts[op] for op in READERS if op in self.facts)

    @property
    def scales(self) -> Facts:
        """Return the calibrated scales of the microscope. The mapping is empty if there are no calibration
        standards.
        """
        return self.facts.get("calibrate", {})

    @property
    def pitch_um(self) -> list[float]:
        """Return the pitch (y, x) of the scan in µm. It is the pitch that the file or the card states. If an
        axis was calibrated, its pitch is multiplied by the calibrated scale.
        """
        axes = zip("yx", self.read["pitch_um"], strict=True)
        return [one * self.scales.get(f"scale_{axis}", 1.0) for axis, one in axes]

    def piece(self, **said: Any) -> Piece:
        """Return the finished scan that the operations made. Its record contains the entries ``said``, to
        which ``steps`` and ``software`` are added.
        """
        steps = [step.to_record() for step in self.steps]
        record = {**said, "steps": steps, "software": software_record()}
        return Piece(json.loads(json.dumps(record)), self.arrays)
