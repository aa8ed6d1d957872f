"""Define the settings of the plain fab (printer, microscope, default noise) and the named presets of runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from litho_data.foundation import Shape, require_known, table_beside


@dataclass(frozen=True)
class Printer:
    """A two-photon printer and its resist.

    Args:
        pitch_um: hatch pitch, which is also the pitch of the layout, µm.
        level_height_um: slice height, µm.
        levels: number of levels; the tallest column has ``levels - 1`` slices.
        spot_sigma_um: sd of the focal *intensity*, µm. Two-photon absorption is proportional to the square
            of the intensity, whose sd is smaller by a factor of √2 (0.2 µm).
        threshold_dose: dose at which conversion rises fastest, as a share of the full column's dose.
        threshold_steepness: slope parameter of the logistic conversion curve, per full dose.
        network_reach_um: sd of the neighbourhood whose conversion determines how much a column shrinks, µm.
        loose_retention: share of its height that an isolated, loose network keeps; a dense network keeps its
            whole height.
        base_um: height of the base layer's surface above the zero of the scans, µm.
        stitch_field_um: side of the fields into which a larger layout is divided for writing, µm; the knob
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
        """Return the nominal height of the highest level, µm."""
        return (self.levels - 1) * self.level_height_um


@dataclass(frozen=True)
class Microscope:
    """A microscope: the margin of its scans, and a small affine error that is drawn for each scan.

    Args:
        margin_px: number of pixels by which a scan extends beyond the layout on each side, per 512 px of
            layout.
        rotation_deg: largest rotation angle, degrees.
        scale: largest relative error of each lateral scale.
        shear: largest shear.
        shift_um: largest shift along each axis, µm.
        files: format of the scan files, either ``text-matrix`` (only heights, in metres) or ``gsf`` (with
            size and unit).
    """

    margin_px: float = 14.0
    rotation_deg: float = 0.6
    scale: float = 0.015
    shear: float = 0.005
    shift_um: float = 0.3
    files: Literal["text-matrix", "gsf"] = "text-matrix"

    @classmethod
    def aligned(cls) -> Microscope:
        """Return a microscope without warp, whose scan pixels coincide with layout pixels."""
        return cls(rotation_deg=0.0, scale=0.0, shear=0.0, shift_um=0.0)


@dataclass(frozen=True)
class Noise:
    """The default noise, as standard deviations in nm.

    On a flat print, the noise is the quadrature sum of ``roughness_nm``, ``line_nm`` and ``pixel_nm``. On a
    bare substrate, it is that of ``substrate_nm``, ``line_nm`` and ``pixel_nm``.

    Args:
        roughness_nm: line-shaped roughness of printed surfaces.
        substrate_nm: roughness of the bare substrate.
        line_nm: offset of each scan line.
        pixel_nm: uncorrelated pixel noise.
        datum_nm: offset of each scan.
    """

    roughness_nm: float = 15.9
    substrate_nm: float = 0.8
    line_nm: float = 0.6
    pixel_nm: float = 0.75
    datum_nm: float = 30.0

    @classmethod
    def off(cls) -> Noise:
        """Return noise settings that are all zero."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Preset:
    """Named settings of a run. Arguments that the caller passes override these settings.

    Args:
        count: number of scans.
        size_px: side of the layouts, pixels (one number, or ny and nx).
        fields_per_print: number of fields in one print block.
        knobs: settings of the form ``name=strength[@seed]``.
        printer, microscope, noise: settings of the machines.
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
    """Return the preset with this name.

    Raises:
        InputError: there is no preset with this name.
    """
    require_known("preset", name, PRESETS)
    return PRESETS[name]
