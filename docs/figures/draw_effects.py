"""One picture per effect: what it changes in a print, at twice its typical size.

python docs/figures/draw_effects.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from litho_data.layouts import random_layout
from litho_data.reports.pictures import new_figure
from litho_models.effects import CATALOGUE, Effect, FieldContext
from litho_models.effects.chain import EffectChain
from litho_models.models import build_model

OUT = Path(__file__).parent / "effects.jpg"
SIZE_PX, BORDER_PX, PITCH_UM, LEVEL_HEIGHT_UM, LEVELS, COLUMNS = 176, 24, 0.1, 0.1, 13, 5
STRENGTH = 2.0
_LAST_IN_ORDER, _CORNER_UM = 0.5, 8.0


def main() -> None:
    """Draw every effect of the catalogue on one random layout."""
    level = random_layout((SIZE_PX, SIZE_PX), cutoff_per_um=0.5, seed=4)
    layout = torch.from_numpy((level * LEVEL_HEIGHT_UM).astype(np.float32))[None, None]
    # Away from the middle of the write field and late in the order, where place and time show.
    context = FieldContext(
        layout,
        PITCH_UM,
        full_height_um=LEVEL_HEIGHT_UM * (LEVELS - 1),
        slice_um=LEVEL_HEIGHT_UM,
        field_centre_um=(_CORNER_UM, _CORNER_UM),
        field_radius_um=24.0,
        order=_LAST_IN_ORDER,
    )
    base = build_model("physics", pitch_um=PITCH_UM, level_height_um=LEVEL_HEIGHT_UM, levels=LEVELS)
    effects = [effect for effect in CATALOGUE.values() if not effect.per_scan]
    rows = -(-(len(effects) + 1) // COLUMNS)
    # On the page 690 px wide, where ten points then have nine pixels.
    figure = new_figure(2.1 * COLUMNS, 2.3 * rows)
    panels = figure.subplots(rows, COLUMNS).ravel()
    panels[0].imshow(level[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX], cmap="viridis")
    panels[0].set_title("layout", fontsize=10)
    for panel, effect in zip(panels[1:], effects, strict=False):
        change = 1e3 * signature(effect, base, layout, context)
        limit = max(float(np.quantile(np.abs(change), 0.99)), 1e-3)
        panel.imshow(change, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        panel.set_title(f"{effect.name}\n± {limit:.0f} nm", fontsize=10)
    for panel in panels:
        panel.set_axis_off()
    figure.savefig(OUT, dpi=90, pil_kwargs={"quality": 60})


def signature(
    effect: Effect, base: torch.nn.Module, layout: torch.Tensor, context: FieldContext
) -> np.ndarray:
    """Height with the effect minus without (y, x), µm; the border, with nothing beside it, is cut off."""
    trial = effect.with_values(effect.trials[0])
    for name in effect.amplitudes:
        parameter = effect.parameters[name]
        if name in effect.trials[0]:
            wanted = parameter.null + STRENGTH * (parameter.typical - parameter.null)
            trial[name] = min(max(wanted, parameter.lower), parameter.upper)
    with torch.no_grad():
        off, on = (EffectChain(base, effects)(layout, context) for effects in ({}, {effect.name: trial}))
    return (on - off)[0, 0, BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX].numpy()


if __name__ == "__main__":
    main()
