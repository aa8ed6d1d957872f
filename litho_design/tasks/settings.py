"""All settings of a design, by preset: what the paper leaves open is written down here."""

from __future__ import annotations

from typing import Literal

from litho_data.foundation.results import Record
from litho_design.judging.metrics import CameraView
from litho_design.lens.bench import ImagingSettings, LensView
from litho_design.optics import Optics
from litho_design.optimisation.optimise import SearchSettings
from litho_design.optimisation.parametrise import LayoutSettings
from litho_design.optimisation.robust import ProcessWindow
from litho_design.printers.ensemble import EnsemblePenalty
from litho_design.tasks.hologram import HologramLoss

Variant = Literal["default", "paper", "authors"]


class HoeSettings(Record):
    """All settings of one holographic design."""

    variant: Variant = "default"
    layout: LayoutSettings = LayoutSettings()
    optics: Optics = Optics()
    search: SearchSettings = SearchSettings()
    loss: HologramLoss = HologramLoss()
    window: ProcessWindow = ProcessWindow()
    ensemble: EnsemblePenalty = EnsemblePenalty()
    camera: CameraView = CameraView()


def hoe_preset(variant: Variant) -> HoeSettings:
    """Settings of the hologram by name.

    ``paper``: as printed (13 levels, Gumbel-Softmax at temperature 0.5, random start, 1000 Adam
    iterations at 0.1, expected levels). ``authors``: as in the published code (12 levels,
    temperature 1, wavelength 0.633 and index step 0.545; its efficiency term is constant and
    therefore left out; its truncated, half-pixel-shifted kernel is not reproduced). ``default``:
    one height per cell with straight-through rounding, and a polish of the printable layout.
    """
    if variant == "default":
        return HoeSettings()
    search = SearchSettings(
        parametrisation="gumbel",
        start="random",
        iterations=1000,
        learning_rate=0.1,
        temperature_start=0.5,
        temperature_end=0.5,
        hard_from=1.0,
        keep="last",
        polish_rounds=0,
    )
    if variant == "paper":
        return HoeSettings(variant="paper", search=search)
    return HoeSettings(
        variant="authors",
        layout=LayoutSettings(levels=12),
        optics=Optics(wavelength_um=0.633, index_step=0.545),
        search=search.model_copy(update={"temperature_start": 1.0, "temperature_end": 1.0}),
        loss=HologramLoss(efficiency_weight=0.0),
    )


class LensSettings(Record):
    """All settings of one lens."""

    variant: Variant = "default"
    task: Literal["direct", "computational"] = "direct"
    layout: LayoutSettings = LayoutSettings(size_px=1200, cell_um=0.1, symmetry="radial")
    optics: Optics = Optics(distance_um=400.0)
    search: SearchSettings = SearchSettings(
        start="fresnel", start_jitter_levels=0.3, iterations=200, learning_rate=0.3
    )
    view: LensView = LensView(path="radial")
    imaging: ImagingSettings = ImagingSettings()
    window: ProcessWindow = ProcessWindow()
    ensemble: EnsemblePenalty = EnsemblePenalty()


def lens_preset(variant: Variant, task: Literal["direct", "computational"]) -> LensSettings:
    """Settings of the lens by name; 120 µm, focal length 400 µm, rings of 0.1 µm.

    ``paper``: 13 levels, Gumbel-Softmax at temperature 0.5, 1000 AdamW iterations at 3, square
    aperture; its rings are those of the published code, the text does not say. ``authors``: 12
    levels, temperature 1, 2000 iterations at 1, their wavelength and index step. ``default``: a
    circular aperture, the Fresnel phase as start, and the ring path in the search.
    """
    if variant == "default":
        return LensSettings(task=task)
    search = SearchSettings(
        parametrisation="gumbel",
        start="random",
        optimiser="adamw",
        iterations=1000,
        learning_rate=3.0,
        temperature_start=0.5,
        temperature_end=0.5,
        hard_from=1.0,
        keep="last",
        polish_rounds=0,
    )
    square = LensView(aperture="square", path="plane")
    if variant == "paper":
        return LensSettings(variant="paper", task=task, search=search, view=square)
    return LensSettings(
        variant="authors",
        task=task,
        layout=LayoutSettings(size_px=1200, cell_um=0.1, symmetry="radial", levels=12),
        optics=Optics(wavelength_um=0.633, index_step=0.545, distance_um=400.0),
        search=search.model_copy(
            update={
                "iterations": 2000, "learning_rate": 1.0, "temperature_start": 1.0, "temperature_end": 1.0
            }
        ),
        view=square,
    )  # fmt: skip
