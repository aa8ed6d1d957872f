"""Define PrintedScan, which contains the layout and the heights of one printed field. The whole project uses
this class. The module also computes the hash of a scan's content.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import Any

import numpy as np

from litho_data.foundation import Array, Facts, array_sha256, record_sha256
from litho_data.register.bend import Bend


@dataclass(frozen=True)
class PrintedScan:
    """One printed field: the layout sent to the printer and the height measured on the layout's grid.

    Args:
        id: name of the scan. ``print_id`` is the name of the print, i.e. of the block of fields that contains
            this field. ``order`` is the position of the field in the writing order.
        mask_level: level of each pixel of the layout (the layout is also called mask), shape (ny, nx); uint8,
            or uint16 if there are more than 256 levels.
        height_um: measured height of each pixel in µm, shape (ny, nx), float32; NaN where not measured.
        valid: bool array of shape (ny, nx) that is True where the pixel was measured and lies inside the
            scan.
        pitch_um: pixel pitch of ``mask_level``, ``height_um`` and ``valid``, µm. ``level_height_um`` is the
            nominal height of a level, µm.
        levels: number of levels that the layout may use.
        scan_to_layout: 3 x 3 matrix, float64, that maps homogeneous coordinates (x_um, y_um, 1) in the scan's
            own frame to those in the layout frame.
        write: the ``[write]`` table of the dataset card, which says how the printer wrote the fields; None if
            the card has no such table.
        field_x_um, field_y_um: position of the scan in its write field, µm. ``dose`` is the relative dose.
            None means that the card does not state the value.
        turned_deg: rotation of the print under the microscope. ``direction`` is 1 for trace and -1 for
            retrace, ``tip`` is the number of the tip, and ``pixel_size`` is the pixel size relative to that
            of the other scans. None means that the card does not state the value.
        bend_um: bend of the scan; None if the scan is not bent. For a bent scan, ``scan_to_layout`` applies
            to positions from which the bend has been removed.
        tip_radius_um: radius of the microscope's tip, or an upper bound for it; None if the store has
            neither.
        height_sigma_um: standard uncertainty of ``height_um`` in µm, shape (ny, nx), float32; NaN where not
            valid. It does not include the uncertainty of the scan's zero height. None means that the store
            does not contain it.
        groups: parts of the scan's id, such as the number of the field, keyed by name. They are the named
            groups of the id pattern in the dataset card, except the group ``print``.
        instrument: name of the instrument, if the card's table gives it. ``seen_by`` is the kind of
            instrument, which determines what the heights mean (see ``Instrument``).
        surround: what lies around the printed field. ``substrate`` means bare substrate, which the layout
            shows as a rim of level 0. ``continues`` means more of the same print. The layout does not show
            this surrounding print, so the outermost pixels are not valid. The default is ``unknown``.
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
        """Return the number of quarter turns (``k`` of ``numpy.rot90``, 0 to 3) that rotate the layout's grid
        to that of the scan.
        """
        along = self.scan_to_layout[:2, 0]
        return round(math.atan2(along[1], along[0]) / (math.pi / 2)) % 4

    @cached_property
    def usable(self) -> Array:
        """Return a bool array of shape (ny, nx) that is True at valid pixels with a finite height."""
        return np.asarray(self.valid, bool) & np.isfinite(self.height_um)

    @property
    def layout_um(self) -> Array:
        """Return the nominal height of each pixel in µm, a float32 array of shape (ny, nx)."""
        return self.mask_level.astype(np.float32) * np.float32(self.level_height_um)

    @property
    def exposed_um(self) -> Array:
        """Return the exposure of each pixel, expressed as a nominal height in µm: the layout times the
        relative dose, because a smaller dose acts like a lower layout. Models predict prints from it. The
        array is float32 and of shape (ny, nx).
        """
        return self.layout_um * np.float32(self.dose or 1)

    @property
    def shape(self) -> tuple[int, int]:
        """Return the shape (ny, nx) in pixels."""
        return self.mask_level.shape[0], self.mask_level.shape[1]


def scan_sha256(scan: PrintedScan) -> str:
    """Return a hash of all attributes of a scan. It identifies the scan in caches, resumed work and dataset
    ids. Attributes that a subclass adds are left out.
    """
    return record_sha256({one.name: _hashed(getattr(scan, one.name)) for one in fields(PrintedScan)})


def _hashed(value: Any) -> Any:
    if isinstance(value, Array):
        return array_sha256(value, "", ())
    if is_dataclass(value):
        return {one.name: _hashed(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {name: _hashed(inner) for name, inner in value.items()}
    if isinstance(value, np.generic):
        value = value.item()
    # JSON has no NaN, so floats are written as text.
    return repr(value) if isinstance(value, float) else value
