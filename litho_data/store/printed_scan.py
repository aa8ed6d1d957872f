"""Define one printed field as the whole project uses it, and the hash of its content."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from litho_data.foundation import Array, Facts, array_sha256, record_sha256
from litho_data.register.bend import Bend


@dataclass(frozen=True)
class PrintedScan:
    """One printed field: the layout sent to the printer and the height measured on the layout's grid.

    Args:
        id: name of the scan; ``print_id``: the block of fields with which it was printed; ``order``: its
            position in the writing order.
        mask_level: layout levels, uint8 (beyond 256 levels uint16), (ny, nx).
        height_um: float32 (ny, nx), µm, NaN where not measured.
        valid: bool (ny, nx), True where the pixel was measured and lies inside the scan.
        pitch_um: pixel pitch of all three arrays, µm; ``level_height_um``: nominal height of a level, µm.
        levels: number of levels that the layout may use.
        scan_to_layout: 3 x 3 float64, maps (x_um, y_um, 1) of the scan's own frame to the layout frame.
        write: the card's ``[write]`` table; None if the card has none.
        field_x_um, field_y_um: position of the scan in its write field, µm; ``dose``: relative dose. Each is
            None if the card does not state it.
        turned_deg: rotation of the scan relative to the others; ``direction``: 1 trace, -1 retrace; ``tip``:
            number of the tip; ``pixel_size``: pixel size of the scan relative to the others. Each is None if
            the card does not state it.
        bend_um: bend of the scan; ``scan_to_layout`` then acts on the straightened positions.
        tip_radius_um: radius of the microscope's tip, or its upper bound; None if the store has neither.
        height_sigma_um: float32 (ny, nx), µm, standard uncertainty of ``height_um`` apart from the scan's
            offset; NaN where not valid. None if the store has none.
        groups: named groups of the card's id pattern other than the print, such as the field, with values.
        instrument: name of the instrument, if the card's table gives it; ``seen_by``: its kind, which says
            what the heights are (``Instrument``).
        surround: what lies around the printed field: ``substrate`` (bare, as the rim of level 0 in the layout
            shows), ``continues`` (more of the print, so the outermost pixels are not valid) or ``unknown``
            (the default).
    """

    id: str
    print_id: str
    order: int
    mask_level: Array
    height_um: Array
    valid: Array
    pitch_um: float
    level_height_um: float
    levels: int
    scan_to_layout: Array
    write: Facts | None = None
    field_x_um: float | None = None
    field_y_um: float | None = None
    dose: float | None = None
    turned_deg: float | None = None
    direction: float | None = None
    tip: float | None = None
    pixel_size: float | None = None
    bend_um: Bend | None = None
    tip_radius_um: float | None = None
    height_sigma_um: Array | None = None
    groups: Mapping[str, str] = field(default_factory=dict)
    instrument: str = ""
    seen_by: str = "afm"
    surround: str = "unknown"

    def __repr__(self) -> str:
        ny, nx = self.shape
        return (
            f"<PrintedScan {self.id}: {ny} x {nx} px of {self.pitch_um:g} µm, print {self.print_id}, "
            f"{self.levels} levels of {self.level_height_um:g} µm, {self.valid.mean():.1%} valid>"
        )

    def _repr_html_(self) -> str:
        from litho_data.reports.pictures import shown_html

        return shown_html(repr(self), layout_um=self.layout_um, height_um=self.height_um)

    @property
    def quarter_turns(self) -> int:
        """Return how often ``rot90`` rotates the layout's grid to the scan's, 0 to 3, by the registration."""
        along = self.scan_to_layout[:2, 0]
        return round(math.atan2(along[1], along[0]) / (math.pi / 2)) % 4

    @property
    def usable(self) -> Array:
        """Return a mask of the measured pixels, bool (ny, nx)."""
        return np.asarray(self.valid, bool) & np.isfinite(self.height_um)

    @property
    def layout_um(self) -> Array:
        """Return the nominal height, float32 (ny, nx), µm."""
        return self.mask_level.astype(np.float32) * np.float32(self.level_height_um)

    @property
    def shape(self) -> tuple[int, int]:
        """Return (ny, nx) in pixels."""
        return self.mask_level.shape[0], self.mask_level.shape[1]


def scan_sha256(scan: PrintedScan) -> str:
    """Return the hash of all fields of a scan, which is its key in caches, resumed work and dataset ids."""
    return record_sha256(_hashed(scan))


def _hashed(value: Any) -> Any:
    if isinstance(value, Array):
        return array_sha256(value, "", ())
    if is_dataclass(value):
        return {one.name: _hashed(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {name: _hashed(inner) for name, inner in value.items()}
    if isinstance(value, np.generic):
        value = value.item()
    # JSON has no NaN.
    return repr(value) if isinstance(value, float) else value
