"""Simulate films that are exposed by an electron beam or through a lens, then etched, and finally imaged in a
scanning electron microscope.

The simulation shares no code with the models that are tested on it. Electron scattering is a convolution,
computed as a product of spectra. The image behind a lens is the mean of the images that the individual points
of the light source produce. Etching shifts all edges by the same distance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from scipy.ndimage import distance_transform_edt, zoom

from litho_data.commands.progress import progress
from litho_data.foundation import Array, InputError, Shape, require_known
from litho_data.foundation.begun import whole_folder
from litho_data.foundation.quantities import DOSE, LENGTH_UM, PLACE_UM, Range
from litho_data.foundation.results import Result
from litho_data.layouts.card_text import CARD_NAME, write_layout
from litho_data.layouts.random_layout import random_layout
from litho_data.virtual_fab.canvas import blur

# The first value is the number of fine pixels along the side of a layout pixel. The micrograph, and the image
# in which edges are located, have these fine pixels. The second value is the number of fine pixels by which
# the image with the edges is padded.
_FINER, _AROUND = 4, 64
# Width, in px, of the rim without film around a random layout.
_RIM_PX = 12
_RESIST = 30.0
# Number of source points along the diameter of the light source. With 9 points, the numerical error displaces
# edges by 1.5 nm; with 21 points, by 0.5 nm.
_SOURCE_POINTS = 21
_CARD = """name = "virtual-{process}"
title = "Simulated films of the process {process}, with simulated micrographs"

[layout]
files = "layouts/{{id}}.tif"
pitch_um = {pitch_um}
levels = 2
level_height_um = {film_um}

[scan]
files = "scans/{{id}}.png"
instrument = "sem"
size_um = [{side_um}, {side_um}]

[write]
surround = "unknown"
"""


@dataclass(frozen=True)
class FilmKnobs:
    """The effects that can be added to the plain process of a film. Lengths are in µm.

    Attributes:
        backscatter: dose from backscattered electrons, or from stray light in projection, relative to the
            direct dose.
        backscatter_um: range of the backscattered electrons, as the standard deviation of a Gaussian.
        diffusion_um: standard deviation of the diffusion of the exposed species in the resist.
        etch_bias_um: outward shift of every edge by etching.
        defocus_um: defocus of the lens.
        dose_error: relative error of the dose.
        charging: relative change of the brightness from the middle of a micrograph to its right edge.

    Raises:
        InputError: a value is not finite or is out of range.
    """

    backscatter: float = 0.0
    backscatter_um: float = 0.1
    diffusion_um: float = 0.0
    etch_bias_um: float = 0.0
    defocus_um: float = 0.0
    dose_error: float = 0.0
    charging: float = 0.0

    def __post_init__(self) -> None:
        for name, allowed in _KNOB_RANGES.items():
            allowed.require(f"value of film knob {name}", getattr(self, name))


_KNOB_RANGES = {
    "backscatter": Range(0, 1e3),
    "backscatter_um": LENGTH_UM,
    "diffusion_um": Range(0, LENGTH_UM.high, LENGTH_UM.unit),
    "etch_bias_um": PLACE_UM,
    "defocus_um": PLACE_UM,
    # The relative dose is 1 plus ``dose_error``.
    "dose_error": Range(DOSE.low - 1, DOSE.high - 1),
    "charging": Range(-1, 1),
}


@dataclass(frozen=True)
class FilmPrinter:
    """A machine that prints films, and its resist.

    Attributes:
        process: how the resist is exposed: ``e-beam`` for an electron beam, ``projection`` for light through
            a lens.
        pitch_um: pitch of the layout's pixels.
        spot_um: standard deviation of the electron beam.
        film_um: thickness of the film.
        threshold: dose above which film remains, relative to the dose of a large exposed area.
        wavelength_um: wavelength of the light. It is used only for projection.
        na: numerical aperture of the lens.
        source: radius of the light source divided by the radius of the lens aperture (partial coherence
            factor).
    """

    process: Literal["e-beam", "projection"]
    pitch_um: float
    spot_um: float = 0.02
    film_um: float = 0.22
    threshold: float = 0.5
    wavelength_um: float = 0.365
    na: float = 0.5
    source: float = 0.6

    @property
    def resolved_um(self) -> float:
        """Return the width, in µm, of the smallest feature that the beam or the lens resolves."""
        return self.spot_um if self.process == "e-beam" else 0.25 * self.wavelength_um / self.na


FILM_PRINTERS = {
    "e-beam": FilmPrinter("e-beam", pitch_um=0.004),
    "projection": FilmPrinter("projection", pitch_um=0.06, threshold=0.3),
}


class FilmTruth(Result):
    """The record ``films.json`` of simulated films.

    For each film, the file ``<id>.npy`` in the same folder contains signed distances from the film's edge, in
    layout pixels, at 4 × 4 points in each pixel (see ``edge_distance_px``).
    """

    SCHEMA: ClassVar[str] = "litho-data/virtual-films/1"
    FILE_NAME: ClassVar[str] = "films.json"

    process: str
    knobs: FilmKnobs
    seed: int
    count: int
    size_px: int


def film_knobs(words: Iterable[str]) -> FilmKnobs:
    """Make the knobs of a film from texts ``name=value``.

    Raises:
        InputError: a name is unknown or repeated, or a value is not a number or is out of range.
    """
    values: dict[str, float] = {}
    for name, value in (word.split("=", 1) if "=" in word else (word, "") for word in words):
        require_known("knob of a film", name, [one.name for one in fields(FilmKnobs)])
        if name in values:
            raise InputError("knobs of a film", got=f"{name} more than once", wanted="each name at most once")
        try:
            values[name] = float(value)
        except ValueError:
            raise InputError(f"value of film knob {name}", got=repr(value), wanted="a number") from None
    return FilmKnobs(**values)


def edge_distance_px(level: Array, printer: FilmPrinter, knobs: FilmKnobs) -> Array:
    """Return the signed distance from the nearest edge of the film, at 4 × 4 points in each pixel of a
    layout. The layout contains the levels 0 and 1.

    Distances are in layout pixels and positive on the film. The layout is extended periodically.
    """
    pitch = printer.pitch_um
    written = np.asarray(level, float)
    if knobs.backscatter:
        back = blur(written, pitch, knobs.backscatter_um)
        written = (written + knobs.backscatter * back) / (1 + knobs.backscatter)
    if printer.process == "e-beam":
        dose = blur(written, pitch, printer.spot_um)
    else:
        dose = _imaged(written, printer, knobs.defocus_um)
    field, threshold = (1 + knobs.dose_error) * dose, printer.threshold
    if knobs.diffusion_um:
        turned = 1 / (1 + np.exp(-_RESIST * (field - threshold)))
        field, threshold = blur(turned, pitch, knobs.diffusion_um), 0.5
    fine = zoom(field, _FINER, order=3, mode="grid-wrap", grid_mode=True) > threshold
    # The image is padded because the nearest edge may lie beyond its border, in the periodic extension.
    fine = np.pad(fine, _AROUND, mode="wrap")
    inside, outside = distance_transform_edt(fine), distance_transform_edt(~fine)
    distance = np.where(fine, inside - 0.5, 0.5 - outside)[_AROUND:-_AROUND, _AROUND:-_AROUND]
    return distance / _FINER + knobs.etch_bias_um / pitch


def micrograph(distance_px: Array, knobs: FilmKnobs, rng: np.random.Generator) -> Array:
    """Return the electron micrograph of a film as uint8. The micrograph has bright rims and noise, and
    charging changes its brightness along x.
    """
    film = 1 / (1 + np.exp(-_FINER * distance_px / 0.5))
    grey = 70 + film * (70 + 60 * np.exp(-np.maximum(_FINER * distance_px, 0) / 12))
    grey = grey * (1 + knobs.charging * np.linspace(-1, 1, distance_px.shape[1]))
    return np.clip(grey + rng.normal(0, 3, grey.shape), 0, 255).astype(np.uint8)


def simulate_films(
    out: str | Path,
    process: str,
    *,
    count: int = 12,
    size_px: int = 256,
    seed: int = 0,
    knobs: FilmKnobs = FilmKnobs(),
) -> Path:
    """Simulate films of random layouts and their micrographs, and return the path of the dataset card.

    The folder ``out/raw`` contains what a laboratory would deliver: the card, the layouts and the
    micrographs. The folder ``out/truth`` contains the knobs and the distances from the films' edges.

    Args:
        out: folder of the run.
        process: ``e-beam`` or ``projection``.
        count: number of films.
        size_px: side of each layout in pixels.
        seed: seed of all random draws.
        knobs: the effects that are added to the plain process.

    Raises:
        InputError: the process is unknown, a defocus is set for the process ``e-beam``, or the folder
            contains other files or a run with other settings.
    """
    import cv2

    require_known("process of a film", process, FILM_PRINTERS)
    if knobs.defocus_um and process != "projection":
        raise InputError(
            "film knob defocus_um", got=f"the process {process}", wanted="the process projection"
        )
    printer = FILM_PRINTERS[process]
    truth = FilmTruth(process=process, knobs=knobs, seed=seed, count=count, size_px=size_px)
    facts = truth.model_dump(mode="json", exclude={"schema_"})
    record = f"truth/{truth.FILE_NAME}"
    holds = (f"raw/{CARD_NAME}", "raw/layouts/*.tif", "raw/scans/*.png", "truth/*.npy", record)
    with whole_folder(out, *holds, record=record, facts=facts) as folder:
        raw, hidden = folder / "raw", folder / "truth"
        for part in (raw / "scans", hidden):
            part.mkdir(parents=True)
        # Bare ground is added around each field, so that the field is too far away from its periodic copies
        # to be affected by them.
        longest_um = max(8 * printer.resolved_um, 3 * knobs.backscatter_um * (knobs.backscatter > 0))
        bare_px = math.ceil(longest_um / 2 / printer.pitch_um)
        inner = (slice(_FINER * bare_px, -_FINER * bare_px),) * 2
        for number in progress(range(count), "printing films"):
            rng, name = np.random.default_rng([seed, number]), f"F{number:02}"
            level = random_film((size_px, size_px), printer, rng, finer=number % 3)
            distance = edge_distance_px(np.pad(level, bare_px), printer, knobs)[inner]
            write_layout(raw, name, level)
            np.save(hidden / f"{name}.npy", distance.astype(np.float32))
            cv2.imwrite(str(raw / "scans" / f"{name}.png"), micrograph(distance, knobs, rng))
        side_um = round(size_px * printer.pitch_um, 9)
        text = _CARD.format(
            process=process, pitch_um=printer.pitch_um, film_um=printer.film_um, side_um=side_um
        )
        (raw / CARD_NAME).write_text(text, encoding="utf-8")
        truth.write(hidden)
    return Path(out) / "raw" / CARD_NAME


def random_film(shape: Shape, printer: FilmPrinter, rng: np.random.Generator, finer: int = 0) -> Array:
    """Return a random layout with the levels 0 and 1, a uint8 array of the given shape (ny, nx). The layout
    has a rim of level 0. Its features are large enough for the process to resolve.

    A larger value of ``finer`` makes the features smaller. Successive films of a run use the values 0, 1, 2,
    0, 1, 2 and so on.
    """
    cutoff_per_um = 1 / (printer.resolved_um * (7 - finer))
    inner = tuple(length - 2 * _RIM_PX for length in shape)
    level = random_layout(
        inner, levels=2, cutoff_per_um=cutoff_per_um, pitch_um=printer.pitch_um, seed=rng, passband="round"
    )
    return np.pad(level, _RIM_PX)


def _imaged(mask: Array, printer: FilmPrinter, defocus_um: float) -> Array:
    """Return the intensity of a mask's image behind the lens, averaged over the points of a round light
    source. For a mask that is open everywhere, the intensity is 1.
    """
    fy, fx = np.meshgrid(*(np.fft.fftfreq(n, printer.pitch_um) for n in mask.shape), indexing="ij")
    spectrum, total = np.fft.fft2(mask), np.zeros(mask.shape)
    sides = np.linspace(-1, 1, _SOURCE_POINTS)
    points = [(y, x) for y in sides for x in sides if y * y + x * x <= 1]
    for y, x in printer.source * printer.na / printer.wavelength_um * np.array(points):
        sine2 = printer.wavelength_um**2 * ((fy + y) ** 2 + (fx + x) ** 2)
        through = sine2 <= printer.na**2
        path_um = defocus_um * (np.sqrt(np.where(through, 1 - sine2, 1.0)) - 1)
        waves = through * np.exp(2j * np.pi * path_um / printer.wavelength_um)
        total += np.abs(np.fft.ifft2(spectrum * waves)) ** 2
    return total / len(points)
