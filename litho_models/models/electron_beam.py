"""``e-beam``: a film written by electrons and etched, composed of parts."""

from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import blur_interior
from litho_models.layers.ranges import Range
from litho_models.models.parts import etch, hill, illuminate, project, spot_radius_px
from litho_models.simulator import Simulator, SimulatorConfig


class ElectronBeamConfig(SimulatorConfig):
    """Which parts there are, where a fit starts, and how far it may go; widths are standard deviations."""

    spots: Literal[1, 2, 3] = Field(2, description="Gaussians of the spot: forward, back, between")
    resist: Literal["threshold", "tanh", "hill"] = Field("hill", description="dose to share of resist")
    diffusion: bool = Field(True, description="whether what the dose made spreads")
    etch_bias: bool = Field(True, description="whether etching moves the edges")
    forward_um: float = Field(0.02, gt=0, description="forward scattering and beam, µm")
    forward_max_um: float = Field(0.1, gt=0, description="its upper bound, µm")
    back_um: float = Field(0.06, gt=0, description="scattering back, µm")
    back_max_um: float = Field(0.25, gt=0, description="its upper bound, µm: of a field some µm wide")
    back_share: float = Field(0.2, gt=0, lt=0.9, description="share of the dose that comes back")
    between_um: float = Field(0.04, gt=0, description="third Gaussian, µm")
    between_share: float = Field(0.1, gt=0, lt=0.9, description="its share")
    threshold: float = Field(0.5, gt=0, lt=1, description="dose that turns the resist, 1: a large area's")
    contrast: float = Field(4.0, gt=0, description="of the resist")
    diffusion_um: float = Field(0.008, gt=0, description="diffusion in the resist, µm")
    diffusion_max_um: float = Field(0.05, gt=0, description="its upper bound, µm")
    bias_max_um: float = Field(0.02, gt=0, description="largest shift of an edge in etching, either way, µm")


class ElectronBeam(Simulator):
    """H = H₀ · etch(G_diffusion * resist(Σ share · G_spot * M / H₀)), see ``parts``.

    With the resist ``threshold`` the etched edge is where the exposure itself crosses the threshold.
    """

    name = "e-beam"
    Config = ElectronBeamConfig
    config: ElectronBeamConfig

    def __init__(self, config: ElectronBeamConfig):
        super().__init__(config)
        for key, own in self.ranges.items():
            start = 0.0 if own.name == "bias_um" else getattr(config, own.name)
            self.register_parameter(key, nn.Parameter(own.raw(start)))

    @property
    def ranges(self) -> dict[str, Range]:
        config = self.config
        found = [Range("forward_um", 0.0, config.forward_max_um), Range("threshold", 0.0, 1.0)]
        if config.spots > 1:
            found += [Range("back_um", 0.0, config.back_max_um), Range("back_share", 0.0, 0.9)]
        if config.spots > 2:
            found += [Range("between_um", 0.0, config.back_max_um), Range("between_share", 0.0, 0.9)]
        if config.resist != "threshold":
            found.append(Range("contrast"))
        if config.diffusion:
            found.append(Range("diffusion_um", 0.0, config.diffusion_max_um))
        if config.etch_bias:
            found.append(Range("bias_um", -config.bias_max_um, config.bias_max_um))
        return {f"raw_{own.name}": own for own in found}

    @property
    def values(self) -> dict[str, Tensor]:
        """The physical values by name."""
        return {own.name: own.value(getattr(self, key)) for key, own in self.ranges.items()}

    @property
    def reach_px(self) -> int:
        return sum(self._radii_px(self.values)) + 1

    def interior(self, layout_um: Tensor) -> Tensor:
        values, pitch_um = self.values, self.pitch_um
        spot_px, diffusion_px = self._radii_px(values)
        threshold = values["threshold"]
        back, between = (values.get(f"{name}_share", torch.zeros(())) for name in ("back", "between"))
        shares = {"forward": (1 - back) * (1 - between), "back": back, "between": (1 - back) * between}
        spots = [(share, values[f"{name}_um"]) for name, share in shares.items() if f"{name}_um" in values]
        dose = illuminate(layout_um / self.config.full_height_um, spots, pitch_um, spot_px)
        if self.config.resist == "hill":
            dose, threshold = hill(dose, values["contrast"], threshold), torch.tensor(0.5)
        elif self.config.resist == "tanh":
            low = project(threshold, values["contrast"], threshold)
            dose, threshold = project(dose, values["contrast"], threshold), low
        if self.config.diffusion:
            dose = blur_interior(dose, values["diffusion_um"] / pitch_um, diffusion_px)
        film = etch(dose, threshold, values.get("bias_um", 0.0), pitch_um)
        return self.config.full_height_um * film

    def _radii_px(self, values: dict[str, Tensor]) -> tuple[int, int]:
        """Reach of the spot and of the diffusion, px."""
        widths = [values[name] for name in ("forward_um", "back_um", "between_um") if name in values]
        spot = max(spot_radius_px(width, self.pitch_um) for width in widths)
        return spot, spot_radius_px(values["diffusion_um"], self.pitch_um) if self.config.diffusion else 0
