"""Identity: the print is the layout. What every model must beat."""

from __future__ import annotations

from torch import Tensor

from litho_models.simulator import Simulator


class Identity(Simulator):
    """H = M; nothing to fit."""

    name = "identity"

    @property
    def reach_px(self) -> int:
        return 0

    def interior(self, layout_um: Tensor) -> Tensor:
        return layout_um.clone()
