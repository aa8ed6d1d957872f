"""The settings of a relief."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from litho_data.commands.settings import changed, setting
from litho_design.optimisation.settings import DesignSettings, EnsemblePenalty, SearchSettings
from litho_design.printers.layout import LayoutSettings


class ReliefSettings(DesignSettings):
    """All settings of one relief. The wavelength and the distance do not affect the design. The wavelength
    affects only the stroke (height range in waves) in the report.
    """

    layout: LayoutSettings = setting(LayoutSettings(size_px=256, cell_um=0.1), "Layout")
    search: SearchSettings = setting(
        SearchSettings(start="inverse", iterations=60, learning_rate=0.3, polish_rounds=150),
        "Search",
    )
    # The weight is 0, because the loss of a relief already includes the disagreement of the models: it is an
    # expected error.
    ensemble: EnsemblePenalty = setting(EnsemblePenalty(weight=0), "Several models")
    height_um: float = setting(
        0.6,
        "Height of a drawing, or of the brightest value of a picture",
        unit="µm",
        option="--height-um",
        gt=0,
    )
    off_blur_um: float = setting(
        1.0,
        "Standard deviation of the Gaussian that blurs the measured deviation of a first print, if any",
        unit="µm",
        ge=0,
    )


def relief_settings(changes: Mapping[str, Any] | None = None) -> ReliefSettings:
    """Return the settings of a relief, changed by ``changes``, such as ``{"layout.size_px": 512}``.

    Raises:
        InputError: a change names an unknown setting, or gives a setting a value that it does not accept.
    """
    return changed(ReliefSettings(), dict(changes or {}))
