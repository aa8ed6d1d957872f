"""The settings of a hologram and their presets, including the choices that the paper leaves open."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from litho_data.commands.settings import setting
from litho_data.foundation.results import Record
from litho_design.optics import Optics
from litho_design.optimisation.settings import (
    PAPER_SEARCH,
    DesignSettings,
    SearchSettings,
    Variant,
    preset,
)
from litho_design.printers.layout import LayoutSettings


class HologramLoss(Record):
    """Settings of the loss of a hologram, which is RMSE(target, image) + efficiency_weight * (1 -
    efficiency).

    If ``signal_window_um`` is above 0, the error is computed only on pixels within this distance of a pixel
    whose target is above zero. Light elsewhere does not change the error (mixed-region amplitude freedom:
    Pasienski and DeMarco 2008, doi:10.1364/OE.16.002176). ``scale`` says how the image is scaled to match the
    target: ``paper`` divides the image by its mean, weighted with the target, and ``least-squares``
    multiplies it by the factor that gives the smallest error. The efficiency is the share of the incident
    power on pixels whose target is above zero.
    """

    scale: Literal["paper", "least-squares"] = setting(
        "paper", "How the image is scaled to match the target", option="--loss-scale"
    )
    efficiency_weight: float = setting(
        0.1, "Weight of the light that misses the target", option="--efficiency-weight", ge=0
    )
    signal_window_um: float = setting(
        0.0, "Distance from the target's light beyond which the loss ignores light; 0 ignores none",
        unit="µm", option="--signal-window-um", ge=0,
    )  # fmt: skip


class HologramSettings(DesignSettings):
    """All settings of one hologram."""

    search: SearchSettings = setting(SearchSettings(start="gs"), "Search")
    loss: HologramLoss = setting(HologramLoss(), "Loss")


def hologram_settings(
    variant: Variant = "default", changes: Mapping[str, Any] | None = None
) -> HologramSettings:
    """Return a preset for a hologram, changed by ``changes``, such as ``{"layout.size_px": 256}``.

    ``paper`` has the settings that the paper states: 13 levels, Gumbel-Softmax at temperature 0.5, a random
    start, and 1000 Adam iterations at a learning rate of 0.1. The sampled level of a cell is the mean of all
    levels, weighted with the sampled probabilities. ``authors`` has the settings of the published code: 12
    levels, temperature 1, a wavelength of 0.633 µm and a refractive index step of 0.545. After more than ten
    iterations without progress, the learning rate is reduced to a tenth. The efficiency term in the code is
    constant, so it is omitted here. docs/from_the_authors_code.md lists the parts of that code that are not
    reproduced. ``default`` searches for one height per cell from a Gerchberg-Saxton start, and then improves
    the printable layout by changing levels by one.

    Args:
        variant: name of the preset. A ``variant`` among the changes overrides it.
        changes: mapping from dotted paths to values, or nested mappings as in a settings file.

    Raises:
        InputError: a change names an unknown setting, or gives a value that the setting does not accept.
    """
    return preset(_preset, variant, changes)


def _preset(variant: Variant) -> HologramSettings:
    if variant == "default":
        return HologramSettings()
    search = PAPER_SEARCH.model_copy(update={"learning_rate": 0.1})
    if variant == "paper":
        return HologramSettings(variant="paper", search=search)
    return HologramSettings(
        variant="authors",
        layout=LayoutSettings(levels=12),
        optics=Optics(wavelength_um=0.633, index_step=0.545),
        search=search.model_copy(
            update={"temperature_start": 1.0, "temperature_end": 1.0}
            | {"rate_schedule": "plateau", "rate_factor": 0.1, "rate_iterations": 10}
        ),
        loss=HologramLoss(efficiency_weight=0.0),
    )
