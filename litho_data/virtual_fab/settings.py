"""Define the settings of the virtual fab's printer, microscope and default noise. A preset is a named set of
settings for a whole run. Knobs are defined in ``virtual_fab.knobs``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from litho_data.foundation import Shape, require_known, table_beside


@dataclass(frozen=True)
class Printer:
    """A two-photon printer and its resist. Lengths are in µm.

    Args:
        pitch_um: distance between hatch lines, which is also the pitch of the layout.
        level_height_um: height of a slice.
        levels: number of levels. The highest column has ``levels - 1`` slices.
        spot_sigma_um: standard deviation of the *intensity* in the focus. Two-photon absorption is
            proportional to the squared intensity. The standard deviation of the squared intensity is smaller
            by a factor of √2, and is 0.2 µm by default.
        threshold_dose: dose at which the conversion of the resist rises fastest, as a share of the full dose.
        threshold_steepness: steepness of the logistic curve of conversion against dose. The dose is in units
            of the full dose.
        network_reach_um: standard deviation of the Gaussian with which the conversion around a column is
            averaged. This mean determines how much the column shrinks.
        loose_retention: share of the height that a column keeps when it dries, if no resist around it is
            converted. If all resist around it is converted, a column keeps its whole height.
        base_um: height of the base layer's surface above the zero height of the scans.
        stitch_field_um: side of the write fields into which a larger layout is divided. The knob
            ``stitching`` displaces these fields.
    """

    pitch_um: float = 0.1
    level_height_um: float = 0.1
    levels: int = 13
    spot_sigma_um: float = 0.2 * 2**0.5
    threshold_dose: float = 0.3
    threshold_steepness: float = 1.6
    network_reach_um: float = 2.0
    loose_retention: float = 0.35
    base_um: float = 0.14
    stitch_field_um: float = 100.0

    @property
    def full_height_um(self) -> float:
        """Return the nominal height of the highest level in µm."""
        return (self.levels - 1) * self.level_height_um


@dataclass(frozen=True)
class Microscope:
    """The settings of a microscope. Each scan extends beyond the layout by a margin, and has a small affine
    error that is drawn at random.

    Args:
        margin_px: number of pixels by which a scan extends beyond the layout on each side, for a layout of
            512 px. For other layouts, the margin is proportional to their side lengths.
        rotation_deg: largest random rotation, in degrees.
        scale: largest relative error of the scale of each axis.
        shear: largest random shear.
        shift_um: largest random shift along each axis, in µm.
        files: format of the scans' files. Files in the format ``text-matrix`` contain only heights, in
            metres. Files in the format ``gsf`` also contain the size of the scan and the unit.
    """

    margin_px: float = 14.0
    rotation_deg: float = 0.6
    scale: float = 0.015
    shear: float = 0.005
    shift_um: float = 0.3
    files: Literal["text-matrix", "gsf"] = "text-matrix"

    @classmethod
    def aligned(cls) -> Microscope:
        """Return a microscope without affine errors. The pixels of its scans coincide with those of the
        layout.
        """
        return cls(rotation_deg=0.0, scale=0.0, shear=0.0, shift_um=0.0)


@dataclass(frozen=True)
class Noise:
    """The standard deviations, in nm, of the default noise, which is added without any knob.

    On a flat print, the variance of the total noise is the sum of the squares of ``roughness_nm``,
    ``line_nm`` and ``pixel_nm``. On a bare substrate, ``substrate_nm`` takes the place of ``roughness_nm``.

    Args:
        roughness_nm: roughness of printed surfaces, shaped like hatch lines.
        substrate_nm: roughness of the bare substrate.
        line_nm: height offsets of individual scan lines.
        pixel_nm: noise that is independent from pixel to pixel.
        datum_nm: height offsets of whole scans.
    """

    roughness_nm: float = 15.9
    substrate_nm: float = 0.8
    line_nm: float = 0.6
    pixel_nm: float = 0.75
    datum_nm: float = 30.0

    @classmethod
    def off(cls) -> Noise:
        """Return settings without any noise."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Preset:
    """The named settings of a run. Arguments that the caller passes take precedence over them.

    Args:
        count: number of scans.
        size_px: size of each layout in pixels, as one number for both sides or as (ny, nx).
        fields_per_print: number of fields in each print.
        knobs: settings of the knobs, as texts ``name=strength[@seed]``.
        printer, microscope, noise: settings of the printer, the microscope and the default noise.
    """

    count: int
    size_px: int | Shape
    fields_per_print: int = 4
    knobs: tuple[str, ...] = ()
    printer: Printer = Printer()
    microscope: Microscope = Microscope()
    noise: Noise = Noise()


_MACHINES = {"printer": Printer, "microscope": Microscope, "noise": Noise}


def _value(key: str, value: Any) -> Any:
    made = _MACHINES[key](**value) if key in _MACHINES else value
    return tuple(made) if isinstance(made, list) else made


PRESETS = {
    name: Preset(**{key: _value(key, value) for key, value in one.items()})
    for name, one in table_beside(__file__, "presets.toml").items()
}


def preset(name: str) -> Preset:
    """Return the preset with the given name.

    Raises:
        InputError: there is no preset with this name.
    """
    require_known("preset", name, PRESETS)
    return PRESETS[name]
