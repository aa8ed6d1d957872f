"""Physics: the parameterised simulator of the paper, five or six values with a meaning each.

Optical blur, normalised tanh projection (Zhou et al. 2014), diffusion blur, dose-dependent
shrinkage, height bias; arXiv:2309.17343, appendix "Parameterized physics model".
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import Edge, blur_interior, gaussian_blur, kernel_radius_px, pad_field
from litho_models.layers.ranges import Range
from litho_models.simulator import Simulator, SimulatorConfig, crop_border

Shrinkage = Literal["fixed-reference", "image-range", "image-maximum"]


class PhysicsConfig(SimulatorConfig):
    """The bare defaults are the form of models frozen before there was a gain; variants set the others."""

    sigma_optical_um: float = Field(0.2, gt=0, description="optical spot, standard deviation, µm")
    sigma_diffusion_max_um: float = Field(2.5, gt=0, description="upper bound of the diffusion, µm")
    # The start matters: from a steep threshold in mid-range a fit ends where the projection is a line.
    sigma_diffusion_init_um: float = Field(1.5, gt=0, description="diffusion before fitting, µm")
    alpha_init: float = Field(1.0, gt=0, description="steepness of the projection")
    eta_init: float = Field(0.1, lt=1, description="threshold of the projection")
    eta_min: float = Field(0.0, le=0, description="lower bound of the threshold")
    kappa_min_init: float = Field(0.5, gt=0, lt=1, description="remaining height at the lowest dose")
    gain_init: float | None = Field(None, gt=0, description="gain before fitting; None: no gain, 1")
    bias_init_um: float = Field(0.0, description="height bias, µm")
    shrinkage: Shrinkage = "fixed-reference"
    edge: Edge = "replicate"

    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {
        "default": {"gain_init": 1.0, "eta_min": -3.0},
        "paper": {"shrinkage": "image-range"},
        "authors": {
            "shrinkage": "image-maximum",
            "edge": "zero",
            "sigma_diffusion_init_um": 2.5 / (1 + math.exp(-2.5)),
            "eta_init": 1 / (1 + math.exp(-0.5)),
            "kappa_min_init": 1 / (1 + math.exp(-0.5)),
        },
    }


class Physics(Simulator):
    """H = g · H₀ · Ĥ · S + b with Ĥ = projection(G_optical * M / H₀) and S from G_diffusion * Ĥ.

    H₀ is the nominal full height, g the gain of ``default``: without it a full level is pinned to H₀ + b.
    Below 0 the threshold lies before the first level, and the projection is the concave part of the tanh
    alone. S = κ + (1 - κ) · u, u the diffused dose on 0 ... 1: against the fixed reference 0 ... 1
    (``default``), the range of the image (``paper``) or its maximum (``authors``). The last two depend on
    the crop.
    """

    name = "physics"
    Config = PhysicsConfig
    config: PhysicsConfig

    def __init__(self, config: PhysicsConfig):
        super().__init__(config)
        self.raw_alpha = nn.Parameter(self.ranges["raw_alpha"].raw(config.alpha_init))
        self.raw_eta = nn.Parameter(self.ranges["raw_eta"].raw(config.eta_init))
        self.raw_kappa_min = nn.Parameter(self.ranges["raw_kappa_min"].raw(config.kappa_min_init))
        self.tau = nn.Parameter(self.ranges["tau"].raw(config.sigma_diffusion_init_um))
        self.bias_um = nn.Parameter(torch.tensor(config.bias_init_um))
        if config.gain_init is not None:
            self.raw_gain = nn.Parameter(self.ranges["raw_gain"].raw(config.gain_init))

    @property
    def ranges(self) -> dict[str, Range]:
        gain = {} if self.config.gain_init is None else {"raw_gain": Range("gain")}
        return {
            "raw_alpha": Range("alpha"),
            "raw_eta": Range("eta", self.config.eta_min, 1.0),
            "raw_kappa_min": Range("kappa_min", 0.0, 1.0),
            "tau": Range("sigma_diffusion_um", 0.0, self.config.sigma_diffusion_max_um),
            **gain,
        }

    @property
    def values(self) -> dict[str, Tensor]:
        """The physical values: alpha, eta, kappa_min, sigma_diffusion_um, bias_um, and the gain if any."""
        ranged = {own.name: own.value(getattr(self, key)) for key, own in self.ranges.items()}
        return {**ranged, "bias_um": self.bias_um}

    @property
    def reach_px(self) -> int | None:
        if self.config.shrinkage != "fixed-reference":
            return None
        return sum(self._radii_px())

    def interior(self, layout_um: Tensor) -> Tensor:
        optical, diffusion = self._radii_px()
        sigma_optical = torch.tensor(self.config.sigma_optical_um / self.pitch_um, device=layout_um.device)
        aerial = blur_interior(layout_um / self.config.full_height_um, sigma_optical, optical)
        initial = self._project(aerial)
        dose = blur_interior(initial, self.values["sigma_diffusion_um"] / self.pitch_um, diffusion)
        return self._develop(crop_border(initial, diffusion), dose)

    def forward(self, layout_um: Tensor) -> Tensor:
        """Height of the whole field, (batch, 1, y, x) µm."""
        config = self.config
        # A continued layout, blurred, is itself continued from the radius of the optical blur on.
        margin = self._radii_px()[0] if config.edge == "replicate" else 0
        relative = pad_field(layout_um, margin, margin) / config.full_height_um
        aerial = gaussian_blur(relative, config.sigma_optical_um, self.pitch_um, edge=config.edge)
        initial = self._project(aerial)
        dose = gaussian_blur(initial, self.values["sigma_diffusion_um"], self.pitch_um, edge=config.edge)
        return self._develop(crop_border(initial, margin), crop_border(dose, margin))

    def _radii_px(self) -> tuple[int, int]:
        diffusion = float(self.values["sigma_diffusion_um"].detach())
        return (
            kernel_radius_px(self.config.sigma_optical_um / self.pitch_um),
            kernel_radius_px(diffusion / self.pitch_um),
        )

    def _project(self, aerial: Tensor) -> Tensor:
        alpha, eta = self.values["alpha"], self.values["eta"]
        low = torch.tanh(alpha * eta)
        return (low + torch.tanh(alpha * (aerial - eta))) / (low + torch.tanh(alpha * (1 - eta)))

    def _develop(self, initial: Tensor, dose: Tensor) -> Tensor:
        if self.config.shrinkage == "image-range":
            lowest, highest = dose.amin((-2, -1), keepdim=True), dose.amax((-2, -1), keepdim=True)
            dose = (dose - lowest) / (highest - lowest).clamp(min=torch.finfo(dose.dtype).eps)
        elif self.config.shrinkage == "image-maximum":
            dose = dose / dose.amax((-2, -1), keepdim=True).clamp(min=torch.finfo(dose.dtype).eps)
        kappa_min = self.values["kappa_min"]
        remaining = kappa_min + (1 - kappa_min) * dose
        height = self.config.full_height_um * initial * remaining
        return self.values.get("gain", 1.0) * height + self.values["bias_um"]
