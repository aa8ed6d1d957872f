"""Determine the scale factors of a microscope from scans of calibration standards. The standards are gratings
and a step, and the dataset card names their scans.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.cards.card import Grating
from litho_data.cards.listing import Listing, leads_out, list_fields
from litho_data.foundation import Array, Facts, InputError, about
from litho_data.readers import read_scan
from litho_data.roughness import Scale, axis_scales, find_step, find_wave

SCALES = ("y", "x", "z")
# If the measured and the known height of the step differ by more than this factor, a unit or a file is
# assumed to be wrong.
_MOST_Z = 1.5


def calibrate(card_path: str | Path, data_dir: str | Path | None = None) -> dict[str, Scale]:
    """Return the scales with which a build of the card would correct lengths and heights. The keys are those
    of the axes ``y``, ``x`` and ``z`` for which the card names a calibration standard.

    Raises:
        InputError: the card has no table ``[calibration]``, a file is missing, or a scan does not show its
            grating or step.
    """
    listing = list_fields(card_path, data_dir)
    standards = standards_of(listing)
    if not standards.described:
        raise InputError(
            f"card {card_path}", got="no [calibration]", wanted="a table [calibration] with x, y or z"
        )
    found = measure_scales(standards.described, list(standards.files.values()))
    named = {axis: Scale(factor=row[0], uncertainty=row[1]) for axis, row in zip(SCALES, found, strict=True)}
    return {axis: scale for axis, scale in named.items() if axis in standards.scales}


@dataclass(frozen=True)
class Standards:
    """The calibration standards that a card names. There are none if the card has no table ``[calibration]``.

    Attributes:
        described: for every standard, a mapping with the keys ``scale`` (the axis x, y or z that it
            calibrates), ``file`` (the position of its scan in ``files``), ``known_um`` (the known period or
            height), ``uncertainty_um`` (the uncertainty of this value), ``across`` (the axis along which
            profiles are taken) and ``read`` (the arguments of ``read_scan``).
        files: paths of the scans, keyed by their recorded names.
    """

    described: tuple[Facts, ...] = ()
    files: Mapping[str, Path] = field(default_factory=dict)

    @property
    def scales(self) -> set[str]:
        """Return the axes for which there is a standard."""
        return {one["scale"] for one in self.described}


NO_STANDARDS = Standards()


def standards_of(listing: Listing) -> Standards:
    """Return the calibration standards that a card names.

    Raises:
        InputError: the file of a standard is missing, or is a link that leads out of the data folder.
    """
    card = listing.card
    standards: list[dict[str, Any]] = []
    files: dict[str, Path] = {}
    for scale in SCALES if card.calibration else ():
        one = getattr(card.calibration, scale)
        if one is None:
            continue
        path = listing.data_dir / one.file
        outside = leads_out((path,), listing.data_dir)
        if outside or not path.is_file():
            got = outside or f"no file {one.file}"
            raise InputError(
                f"card {listing.card_path}: calibration.{scale}.file",
                got=got,
                wanted="a scan in the data folder",
            )
        files.setdefault(listing.relative(path), path)
        size = one.size_um or card.scan.size_um
        missing = card.scan.missing if one.missing is None else one.missing
        own = [name for name in ("unit", "size_um") if getattr(one, name) is not None]
        standards.append(
            {
                "scale": scale,
                "file": list(files).index(listing.relative(path)),
                "known_um": one.period_um if isinstance(one, Grating) else one.height_um,
                "uncertainty_um": one.uncertainty_um,
                "across": scale if isinstance(one, Grating) else one.axis,
                "read": {
                    "format": one.format or card.scan.format,
                    "unit": one.unit or card.scan.unit,
                    "size_um": list(size) if size else None,
                    "channel": one.channel or card.scan.channel,
                    **({} if missing is None else {"missing": list(missing)}),
                    "defaults": defaults_beside(own),
                },
            }
        )
    return Standards(tuple(standards), files)


def defaults_beside(own: Collection[str]) -> list[str]:
    """Return those of the arguments ``unit`` and ``size_um`` of ``read_scan`` that the card states only for
    all scans together. For these arguments, the value in the file of a scan takes precedence over the value
    in the card.

    ``own`` contains the names of the arguments that the card or its table states for this scan alone. The
    file of the scan must agree with their values, so these names are not returned.
    """
    return [name for name in ("unit", "size_um") if name not in own]


def measure_scales(standards: Sequence[Facts], files: Sequence[Path]) -> Array:
    """Return the scale factor of every axis and the standard uncertainty of each factor. The result has shape
    (3, 2).

    The rows are in the order of ``SCALES``. An axis without a standard has the factor 1 and the uncertainty
    0.

    Raises:
        InputError: a scan does not show a grating or step of about the known size.
    """
    # The result is cached, because it is needed for every scan of a build.
    times = tuple(file.stat().st_mtime_ns for file in files)
    return _measured(json.dumps(list(standards)), tuple(files), times).copy()


@lru_cache(maxsize=4)
def _measured(standards: str, files: tuple[Path, ...], times: tuple[int, ...]) -> Array:
    found = np.array([[1.0, 0.0]] * len(SCALES))
    waves, axes = [], []
    z = None
    for one in json.loads(standards):
        file, size = files[one["file"]], one["read"]["size_um"]
        scan = read_scan(file, **{**one["read"], "size_um": tuple(size) if size else None})
        if one["scale"] == "z":
            z = one, scan
            continue
        with about(f"calibration scan {file.name}"):
            wave = find_wave(scan.height_um, scan.require_pitch(), one["known_um"], one["scale"])
        waves.append((wave, one["known_um"], one["uncertainty_um"]))
        axes.append(one["scale"])
    for axis, scale in (axis_scales(waves, axes) if waves else {}).items():
        found[SCALES.index(axis)] = scale.factor, scale.uncertainty
    if z is not None:
        found[SCALES.index("z")] = _z_scale(*z, files[z[0]["file"]].name)
    return np.round(found, 10)


def _z_scale(one: Facts, scan: Any, name: str) -> tuple[float, float]:
    pitch_y_um, pitch_x_um = scan.require_pitch()
    pitch_um = pitch_x_um if one["across"] == "x" else pitch_y_um
    with about(f"calibration scan {name}"):
        step = find_step(scan.height_um, pitch_um, axis=one["across"])
    factor = 1e3 * one["known_um"] / step.height_nm
    if not 1 / _MOST_Z < factor < _MOST_Z:
        raise InputError(
            f"calibration scan {name}: height of the step",
            got=f"{step.height_nm / 1e3:.4g} µm",
            wanted=f"about {one['known_um']:g} µm",
            hint="check the unit and the file",
        )
    relative = np.hypot(one["uncertainty_um"] / one["known_um"], step.uncertainty_nm / step.height_nm)
    return factor, factor * float(relative)
