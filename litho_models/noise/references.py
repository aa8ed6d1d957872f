"""Measure the noise from reference scans (of the bare substrate, of flat prints and of steps) and from
repeated prints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from pydantic import Field

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness.texture import FEWEST_LINES
from litho_data.store import PrintedScan, Store
from litho_models.noise.staircase import StepPrint, step_print
from litho_models.noise.surface import (
    BACKGROUNDS,
    PrintNoise,
    SurfaceNoise,
    print_noise,
    surface_noise,
    without_background,
)
from litho_models.noise.texture import Texture, texture
from litho_models.scoring.statistics import Interval, interval

_SQUARE_WITHIN = 0.01
# Two prints of one layout are compared only if at least this number of pixels is measured in both of them.
_FEWEST_PIXELS = 64


@dataclass(frozen=True)
class Reference:
    """A scan from which the noise is measured. ``use`` says what the scan shows: the bare substrate
    (``substrate``), a flat print (``flat``) or a print of steps (``steps``).
    """

    id: str
    use: str
    height_um: np.ndarray
    pitch_um: tuple[float, float]


class ReferencePrints(Record):
    """The results from the reference scans. They are the roughness of each substrate and flat print, the
    roughness that printing adds to the substrate, and the evaluation of steps.

    ``textures`` contains the textures of those substrates and flat prints whose scans have square pixels,
    after a quadratic background is removed.
    """

    substrates: list[SurfaceNoise] = Field(default_factory=list)
    flats: list[SurfaceNoise] = Field(default_factory=list)
    print_noise: list[PrintNoise] = Field(default_factory=list)
    steps: list[StepPrint] = Field(default_factory=list)
    textures: list[Texture] = Field(default_factory=list)


def store_references(store: Store) -> list[Reference]:
    """Return the levelled scans of substrates, flat prints and steps in a store. The heights of each scan are
    on the grid of the scan itself, not on the grid of a layout.
    """
    return [
        Reference(
            scan_id,
            use,
            store.scan_frame(scan_id, "levelled_height_um"),
            store.scan_frame_pitch_um(scan_id),
        )
        for scan_id, use in store.references().items()
        if use != "grating"
    ]


def reference_prints(references: Sequence[Reference], level_height_um: float) -> ReferencePrints:
    """Compute the results from the reference scans. The roughness of substrates and flat prints is computed
    twice: once after an offset is removed, and once after a quadratic background is removed.
    """

    def surfaces(use: str) -> list[SurfaceNoise]:
        return [
            surface_noise(one.id, one.height_um, background)
            for one in references
            if one.use == use
            for background in BACKGROUNDS
        ]

    substrates, flats = surfaces("substrate"), surfaces("flat")
    alone = [
        print_noise(flat, [one for one in substrates if one.background == flat.background])
        for flat in flats
        if substrates
    ]
    steps = [
        step_print(one.id, one.height_um, one.pitch_um, level_height_um)
        for one in references
        if one.use == "steps"
    ]
    textures = [
        texture(one.id, [without_background(one.height_um, "quadratic")], one.pitch_um[1])
        for one in references
        if one.use in ("substrate", "flat") and _has_texture(one)
    ]
    return ReferencePrints(
        substrates=substrates, flats=flats, print_noise=alone, steps=steps, textures=textures
    )


def _has_texture(one: Reference) -> bool:
    """Return True if a scan has square pixels and enough lines for an analysis of its texture."""
    pitch_y_um, pitch_x_um = one.pitch_um
    return min(one.height_um.shape) >= FEWEST_LINES and abs(pitch_y_um / pitch_x_um - 1) < _SQUARE_WITHIN


class RepeatedPrints(Record):
    """The noise of a single print, nm, from the differences between repeated prints of one layout. This noise
    comes from the printing, from the microscope and, at edges, from the registration.

    A polynomial of second degree is removed from the difference between two prints, so datum, tilt and bow
    are not included. Errors that repeat from print to print are not included either. ``ci95_nm`` is the 95 %
    confidence interval of ``sigma_nm``, from resampling whole prints. The interval is None if there are fewer
    than six prints, or if one print belongs to every pair.
    """

    sigma_nm: float
    ci95_nm: Interval
    mae_nm: float
    scans: int


def repeated_prints(scans: Sequence[PrintedScan]) -> RepeatedPrints | None:
    """Estimate the noise from repeated prints, which are prints of the same layout at the same dose. The
    variance of the noise is half the variance of the difference between two such prints. Return None if there
    are no repeated prints.

    If several scans may show the same printed field, only the first of them is used, because the difference
    between two scans of one field does not contain the noise of the print.

    The mean absolute value of the noise is the mean absolute difference divided by √2. The factor √2 is exact
    for Gaussian noise, and correct within a few percent for other distributions (see ``floor_of_residuals``).
    """
    groups: dict[tuple[object, ...], list[PrintedScan]] = {}
    for scan in scans:
        group = groups.setdefault((scan.shape, scan.dose, scan.mask_level.tobytes()), [])
        if all(_different_fields(scan, other) for other in group):
            group.append(scan)
    squares, absolute, prints, members = [], [], [], set()
    for first, second in (pair for group in groups.values() for pair in combinations(group, 2)):
        difference = np.where(first.valid & second.valid, first.height_um - second.height_um, np.nan)
        if np.isfinite(difference).sum() < _FEWEST_PIXELS:
            continue
        rest = NM_PER_UM * without_background(difference, "quadratic")
        rest = rest[np.isfinite(rest)] / np.sqrt(2)
        squares.append(float(np.mean(rest**2)))
        absolute.append(float(np.abs(rest).mean()))
        prints.append((first.print_id, second.print_id))
        members |= {first.id, second.id}
    if not squares:
        return None
    return RepeatedPrints(
        sigma_nm=float(np.sqrt(np.mean(squares))),
        ci95_nm=_sigma_interval(np.array(squares), prints),
        mae_nm=float(np.mean(absolute)),
        scans=len(members),
    )


def _sigma_interval(squares_nm2: np.ndarray, prints: Sequence[tuple[str, str]]) -> Interval:
    """Return the 95 % confidence interval of the root of the mean of ``squares_nm2``, which has one value per
    pair of prints.

    Pairs that share a print are not independent, so the N prints are resampled instead of the pairs. Each
    print is represented by its jackknife pseudo-value: N times the mean over all pairs, minus N - 1 times the
    mean over the pairs without this print. If all pairs of the N prints are compared and the noise is white,
    the pseudo-value equals the variance of the noise of this print.
    """
    names = list(dict.fromkeys(name for pair in prints for name in pair))
    without = np.array([[name not in pair for pair in prints] for name in names])
    if not without.any(axis=1).all():
        return None
    others = without @ squares_nm2 / without.sum(axis=1)
    ends = interval((len(names) * squares_nm2.mean() - (len(names) - 1) * others).tolist())
    # A pseudo-value may be negative.
    return ends and (float(np.sqrt(max(ends[0], 0.0))), float(np.sqrt(max(ends[1], 0.0))))


def _different_fields(first: PrintedScan, second: PrintedScan) -> bool:
    """Return True if two scans are known to show different printed fields. This is so if the fields belong to
    two prints, or if different positions in one print are stated for them.
    """
    places = [(scan.field_x_um, scan.field_y_um) for scan in (first, second)]
    stated = all(None not in place for place in places)
    return first.print_id != second.print_id or (stated and places[0] != places[1])
