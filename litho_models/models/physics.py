"""Physics: the parameterised simulator of the paper. The model has few physical values: six by default, five
in the variants ``paper`` and ``authors``, and more if the width of the spot is fitted.

The model is a chain of an optical blur, a threshold with a normalised tanh (projection; Zhou et al. 2014), a
diffusion blur, a shrinkage that depends on the dose, and a height bias. See arXiv:2309.17343, appendix
"Parameterized physics model".
"""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import Edge, Support, gaussian_blur, pad_field, supported_radius_px
from litho_models.layers.ranges import Range
from litho_models.models.parts import project
from litho_models.simulator import Simulator, SimulatorConfig, crop_border

Shrinkage = Literal["fixed-reference", "image-range", "image-maximum"]
Spot = Literal["given", "round", "elliptical"]


class PhysicsConfig(SimulatorConfig):
    """Configuration of the Physics model. The variants replace some of the defaults."""

    LENGTHS = (
        *("sigma_optical_um", "sigma_optical_max_um"),
        *("sigma_diffusion_max_um", "sigma_diffusion_init_um"),
    )

    sigma_optical_um: float = Field(0.2, gt=0, description="optical spot, standard deviation, µm")
    spot: Spot = Field(
        "given",
        description=(
            "whether the width of the spot is given, or fitted as one width (round) or one per axis "
            "(elliptical)"
        ),
    )
    sigma_optical_max_um: float = Field(0.8, gt=0, description="upper bound of a fitted spot, µm")
    sigma_diffusion_max_um: float = Field(
        2.5, gt=0, description="upper bound of the diffusion, standard deviation, µm"
    )
    # The starting values influence the result. A fit that starts from a steep threshold in the middle of the
    # range ends with a nearly linear projection.
    sigma_diffusion_init_um: float = Field(
        1.5, gt=0, description="diffusion before fitting, standard deviation, µm"
    )
    alpha_init: float = Field(1.0, gt=0, description="steepness of the threshold before fitting")
    eta_init: float = Field(0.1, lt=1, description="threshold before fitting")
    eta_min: float = Field(0.0, le=0, description="lower bound of the threshold")
    kappa_min_init: float = Field(
        0.5, gt=0, lt=1, description="share of the height that remains at the lowest dose, before fitting"
    )
    gain_init: float | None = Field(
        None, gt=0, description="gain before fitting; None: the gain is fixed at 1"
    )
    bias_init_um: float = Field(0.0, description="height bias before fitting, µm")
    # Reference height H₀. With the value 1, heights in the equations are in µm. With None, heights are in
    # units of the full height. The paper does not state its reference height.
    reference_height_um: float | None = Field(
        None, gt=0, description="height, µm, that counts as 1; None: the height of the highest level"
    )
    shrinkage: Shrinkage = "fixed-reference"
    kernel_support: Support = "four-sigma"
    kernel_cap_px: int | None = Field(
        None, ge=1, description="limit of the kernel radius, px; None: no limit"
    )
    edge: Edge = "replicate"

    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {
        "default": {"gain_init": 1.0, "eta_min": -3.0},
        "paper": {"reference_height_um": 1.0, "shrinkage": "image-range", "edge": "zero"},
        "authors": {
            "reference_height_um": 1.0,
            "shrinkage": "image-maximum",
            "kernel_support": "three-whole-sigma",
            "kernel_cap_px": 50,
            "edge": "zero",
            "alpha_init": 5.2514,
            "bias_init_um": -0.1374,
            "sigma_diffusion_init_um": 2.5 / (1 + math.exp(-2.5)),
            "eta_init": 1 / (1 + math.exp(-0.5)),
            "kappa_min_init": 1 / (1 + math.exp(-0.5)),
        },
    }


class Physics(Simulator):
    """The Physics model: H = g · H₀ · Ĥ · S + b with Ĥ = projection(G_optical * M / H₀). The shrinkage factor
    S depends on G_diffusion * Ĥ. M is the layout, H the printed height, g a gain and b a height bias.

    In the variant ``default``, H₀ is the nominal height of the highest level, and the gain is fitted. With a
    fixed gain of 1, the highest level would always print at H₀ + b. In the variants ``paper`` and
    ``authors``, H₀ is 1 µm and g is 1. If the threshold is below 0, it lies below the lowest level, and the
    projection uses only the concave part of the tanh.

    The shrinkage factor is S = κ + (1 - κ) · u, where u is the diffused dose scaled to 0 ... 1. The variant
    ``default`` scales the diffused dose by a fixed range. ``paper`` uses the range of the dose over the
    layout, and ``authors`` uses the maximum of the dose over the layout. In ``paper`` and ``authors``, the
    predicted height of a pixel therefore depends on how the layout is cropped.
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
        for key in self._spot_keys:
            self.register_parameter(key, nn.Parameter(self.ranges[key].raw(config.sigma_optical_um)))
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
            **{
                key: Range(key.removeprefix("raw_"), 0.0, self.config.sigma_optical_max_um)
                for key in self._spot_keys
            },
            **gain,
        }

    @property
    def _spot_keys(self) -> tuple[str, ...]:
        keys = {"given": (), "round": ("raw_spot_um",), "elliptical": ("raw_spot_y_um", "raw_spot_x_um")}
        return keys[self.config.spot]

    def _spot_um(self, values: Mapping[str, Tensor]) -> tuple[float | Tensor, float | Tensor]:
        """Return the standard deviation of the spot along y and along x, µm. A value that is not fitted is a
        Python number instead of a tensor.
        """
        keys = self._spot_keys or ("",)
        given = self.config.sigma_optical_um
        widths = [values.get(key.removeprefix("raw_"), given) for key in keys]
        return widths[0], widths[-1]

    @property
    def reach_px(self) -> int | None:
        if self.config.shrinkage != "fixed-reference":
            return None
        return sum(self._radii_px(self.values))

    @property
    def _reference_um(self) -> float:
        return self.config.reference_height_um or self.config.full_height_um

    def interior(self, layout_um: Tensor) -> Tensor:
        return self._printed(layout_um, None)

    def forward(self, layout_um: Tensor) -> Tensor:
        """Return the height of the whole layout, µm. Layout and height have shape (batch, 1, ny, nx)."""
        return self._printed(layout_um, self.config.edge)

    def _printed(self, layout_um: Tensor, edge: Edge | None) -> Tensor:
        """Apply the model. If ``edge`` is None, return the height of the interior only. Otherwise pad the
        layout by the rule ``edge`` and return the height of the whole layout.
        """
        values = self.values
        optical, diffusion = self._radii_px(values)
        # The layout is padded by repeating its outermost pixels. A margin as wide as the radius of the
        # optical blur is enough, because the blurred layout is constant farther outside.
        margin = optical if edge == "replicate" else 0
        relative = pad_field(layout_um, margin, margin) / self._reference_um
        blur = partial(gaussian_blur, pitch_um=self.pitch_um, edge=edge)
        aerial = blur(relative, self._spot_um(values), radius_px=optical)
        initial = project(aerial, values["alpha"], values["eta"])
        dose = blur(initial, values["sigma_diffusion_um"], radius_px=diffusion)
        initial = crop_border(initial, margin if edge else diffusion)
        return self._develop(initial, crop_border(dose, margin), values)

    # The methods below receive the physical values as an argument, so that the values are computed only once
    # per pass. Computing them only once saves time, because every operation is slow in forward-mode
    # differentiation.

    def _radii_px(self, values: Mapping[str, Tensor]) -> tuple[int, int]:
        config, diffusion = self.config, float(values["sigma_diffusion_um"].detach())
        # The widths are rounded to fewer digits, so that rounding errors of float32 cannot change the size of
        # the kernel.
        widths = (torch.as_tensor(sigma).detach() for sigma in self._spot_um(values))
        spot = max(round(float(width), 6) for width in widths)
        optical, diffused = (
            supported_radius_px(sigma / self.pitch_um, config.kernel_support, config.kernel_cap_px)
            for sigma in (spot, diffusion)
        )
        return optical, diffused

    def _develop(self, initial: Tensor, dose: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        if self.config.shrinkage == "image-range":
            lowest, highest = dose.amin((-2, -1), keepdim=True), dose.amax((-2, -1), keepdim=True)
            dose = (dose - lowest) / (highest - lowest).clamp(min=torch.finfo(dose.dtype).eps)
        elif self.config.shrinkage == "image-maximum":
            dose = dose / dose.amax((-2, -1), keepdim=True).clamp(min=torch.finfo(dose.dtype).eps)
        kappa_min = values["kappa_min"]
        remaining = kappa_min + (1 - kappa_min) * dose
        height = self._reference_um * initial * remaining
        return values.get("gain", 1.0) * height + values["bias_um"]
