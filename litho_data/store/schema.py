"""Define the arrays and columns of a dataset store, and the hash of a dataset. The file ``variables.toml``
lists the arrays.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from litho_data.foundation import Array, Facts, array_sha256, record_sha256, table_beside
from litho_data.foundation.quantities import DOSE, ORDER, PLACE_UM, Range
from litho_data.foundation.results import Record

STORE_SCHEMA = "litho-data/store/1"
WRITE = "write_"
"""Prefix of the names of the root attributes that contain the entries of the dataset card's ``[write]``
table.
"""


@dataclass(frozen=True)
class Variable:
    """One array of the store: name, dimensions, type, unit (UDUNITS spelling) and CF long name.

    ``wider`` is the type that is used if ``dtype`` cannot represent all values.
    """

    name: str
    dims: tuple[str, ...]
    dtype: str
    unit: str
    long_name: str
    wider: str = ""

    @property
    def sample_dims(self) -> tuple[str, ...]:
        """Return the names of the dimensions of one scan's part of the array."""
        return tuple(dim for dim in self.dims if dim != "scan")

    def stored_as(self, sample: Array) -> str:
        """Return the type in which the store holds these values: ``dtype``, or ``wider`` if ``dtype`` cannot
        represent them.
        """
        return self.wider if str(sample.dtype) == self.wider else self.dtype

    def sample_sha256(self, sample: Array) -> str:
        """Return the hash of one scan's part of the array. ``sample`` is this part without padding."""
        return array_sha256(np.asarray(sample, dtype=self.stored_as(sample)), self.unit, self.sample_dims)


class DatasetId(Record):
    """The dataset to which a result refers: its name, and the hash of all data that a model can use."""

    name: str
    sha256: str


SAMPLE_VARIABLES, (SIGMA,), SCAN_VARIABLES = (
    tuple(Variable(name, tuple(dims.split()), *rest) for name, (dims, *rest) in table.items())
    for table in table_beside(__file__, "variables.toml").values()
)
"""The arrays that a store can contain, as ``variables.toml`` defines them, in three groups: arrays over all
scans, the uncertainty of the heights, and arrays of single scans.
"""
LAYOUT_VARIABLES = (*SAMPLE_VARIABLES, SIGMA)
"""The arrays over all scans on the layout grid, including the uncertainty of the heights."""
# For each array whose elements have different units, a text that states these units. The hash of such an
# array uses the unit 1.
MIXED_UNITS = {"scan_to_layout": "units of its rows: 1, 1, um; 1, 1, um; um-1, um-1, 1"}
VARIABLES = {variable.name: variable for variable in (*LAYOUT_VARIABLES, *SCAN_VARIABLES)}
OPTIONAL_COLUMNS = {
    "field_x_um": PLACE_UM,
    "field_y_um": PLACE_UM,
    "dose": DOSE,
    "turned_deg": Range(0, 360, "degrees"),
    "direction": Range(-1, 1),
    "tip": ORDER,
    "pixel_size": Range(1e-3, 1e3),
}
"""Columns of optional numbers, one per scan, that the card's CSV table may contain, with the allowed range of
each. Where a row of the table is empty, the number is NaN.
"""
Instrument = Literal["afm", "profilometer", "confocal", "sem"]
"""Kind of instrument. Heights are measured by a probe (``afm``, ``profilometer``) or by light (``confocal``).
With ``sem``, a height is the film's full height times the share of the pixel that the film covers, computed
from the film's edges in an electron micrograph.
"""
Surround = Literal["substrate", "continues", "unknown"]
TEXT_COLUMNS = ("instrument", "surround")
"""Columns of optional words, one per scan, that the card's CSV table may contain. Where a row of the table is
empty, the word is an empty string.
"""


def dataset_facts(geometry: Any, instrument: str, write: Facts | None) -> dict[str, Any]:
    """Return the facts that all scans of a dataset have in common and that its hash includes.

    Args:
        geometry: an object with ``pitch_um``, ``level_height_um`` and ``levels``.
        instrument: kind of instrument.
        write: the ``[write]`` table of the dataset card, which says how the printer wrote the fields; None if
            the card has no such table.
    """
    facts = {name: getattr(geometry, name) for name in ("pitch_um", "level_height_um", "levels")}
    kind = {} if instrument == "afm" else {"instrument": instrument}
    return {**facts, **kind, **({"write": dict(write)} if write else {})}


def dataset_sha256(facts: Facts, scans: Sequence[Facts]) -> str:
    """Return the hash of all data of a dataset that a model can use.

    The hash does not depend on padding, descriptive metadata, or how the arrays are divided into chunks.

    Args:
        facts: facts common to all scans, as ``dataset_facts`` returns them.
        scans: one dict per scan, in stored order. The keys of each dict are ``id``, ``print``, ``order``, the
            optional columns that are not NaN, and ``arrays``, which maps the name of each variable to its
            hash (:meth:`Variable.sample_sha256`).
    """
    return record_sha256({"facts": dict(facts), "scans": [dict(scan) for scan in scans]})
