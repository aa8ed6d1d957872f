"""PBL: physics-based learning, the main simulator of the paper. PBL describes the known steps of the process
with formulas and the unknown steps with networks.

PBL is a chain of five steps:

- an optical blur of fixed width;
- a pointwise network for the threshold of the exposure;
- a diffusion blur of learned width;
- a pointwise network for the shrinkage;
- an areawise network (a stack of small convolutions) for everything else.

See arXiv:2309.17343, equation of the chained sub-models and the appendix "More details on the PBL model".
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Self, cast

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from litho_data.foundation.errors import require_known
from litho_models.layers.gaussian import Edge, Support, gaussian_blur, supported_radius_px
from litho_models.layers.pixelwise import PointwiseNet
from litho_models.layers.ranges import Range
from litho_models.models.feature_networks import (
    FeatureNetwork,
    FeatureNetworkConfig,
    ScanAxis,
    ScanAxisConfig,
    Surroundings,
)
from litho_models.models.parts import Part, part_of
from litho_models.simulator import Simulator, SimulatorConfig, Variant, crop_border, scaled_lengths

Channels = Annotated[int, Field(ge=1, le=1024)]


class PblConfig(SimulatorConfig):
    LENGTHS = (
        "sigma_optical_um",
        "sigma_diffusion_max_um",
        "sigma_diffusion_init_um",
    )

    sigma_optical_um: float = Field(0.2, gt=0, description="optical spot, standard deviation, µm")
    illumination: str | None = Field(
        None, description="name of a part of a printer that replaces this spot, such as lens"
    )
    numbers: dict[str, float] = Field(
        {}, description="values of parameters of this part that replace its defaults"
    )
    sigma_diffusion_max_um: float = Field(
        2.5, gt=0, description="upper bound η of the diffusion, standard deviation, µm"
    )
    # The starting width of the diffusion blur exceeds the radius of the areawise network (0.5 µm), because no
    # other step of the chain can learn influences at larger distances.
    sigma_diffusion_init_um: float = Field(
        1.5, gt=0, description="diffusion before training, standard deviation, µm"
    )
    pointwise_channels: tuple[Channels, ...] = Field((128, 64), max_length=16)
    areawise_channels: tuple[Channels, ...] = Field((64, 64, 32, 32), max_length=16)
    leaky_slope: float = Field(0.02, ge=0)
    # If True, the untrained model returns the optically blurred layout, and the networks learn the difference
    # between the print and this blurred layout. The networks in the paper start with random weights.
    starts_as_blur: bool = True
    kernel_support: Support = "four-sigma"
    kernel_cap_px: int | None = Field(
        None, ge=1, description="limit of the kernel radius, px; None: no limit"
    )
    blur_modulus: bool = Field(
        False, description="whether the absolute value is taken after the diffusion blur"
    )
    edge: Edge = "replicate"
    knots: int = Field(
        1025,
        ge=0,
        le=1_000_000,
        description="number of points between which a pointwise network is interpolated; 0: no interpolation",
    )

    # The next three fields are not in the paper.
    transposable: bool = Field(False, description="whether the areawise network treats x and y alike")
    surroundings: FeatureNetworkConfig | None = None
    scan_axis: ScanAxisConfig | None = Field(
        None, description="settings of a network for effects along the lines of a scan"
    )

    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {
        "default": {
            "areawise_channels": (16, 16, 16),
            "transposable": True,
            "surroundings": {},
            "scan_axis": {},
        },
        "paper": {"starts_as_blur": False, "edge": "zero"},
        "authors": {
            "starts_as_blur": False,
            "edge": "zero",
            "leaky_slope": 0.2,
            "sigma_diffusion_init_um": 2.5 / (1 + math.exp(-2.5)),
            "kernel_support": "three-whole-sigma",
            "kernel_cap_px": 50,
            "blur_modulus": True,
        },
    }

    @classmethod
    def of_variant(cls, variant: Variant = "default", **fields: Any) -> Self:
        """Make the configuration of a variant, as ``SimulatorConfig.of_variant`` does, and also scale the
        lengths of the feature networks to the pitch.
        """
        config = super().of_variant(variant, **fields)
        parts = {"surroundings": config.surroundings, "scan_axis": config.scan_axis}
        scaled = {
            name: part.model_copy(update=scaled_lengths(type(part), {}, config.pitch_um))
            for name, part in parts.items()
            if part is not None and not fields.get(name)
        }
        return config.model_copy(update=scaled)

    @property
    def exposing(self) -> Part:
        """Return the part that models the illumination: the Gaussian spot, or the part that the configuration
        names instead.
        """
        return part_of(self.illumination or "spot")

    @property
    def exposing_values(self) -> dict[str, float]:
        """Return the values of the illumination part's parameters, keyed by name."""
        return {name: self.numbers.get(name, own.start) for name, own in self.exposing.numbers.items()}

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        if self.edge == "zero" and (self.surroundings or self.scan_axis):
            raise ValueError("surroundings and scan_axis require edge 'replicate'")
        if self.illumination is not None:
            part = self.exposing
            for name in self.numbers:
                require_known(f"parameter of {part.name}", name, part.numbers)
            if self.edge == "zero":
                raise ValueError("illumination requires edge 'replicate'")
        return self


class Pbl(Simulator):
    """The PBL model: H = g_mismatch(Ĥ · g_shrink(Ĥ * h_diffusion)) with Ĥ = g_thresh(M * h_optical). M is the
    layout, H the printed height, and all heights are in µm.

    With ``starts_as_blur``, each of the three networks learns a difference: g_thresh(I) = I + net(I),
    g_shrink = 1 + net, g_mismatch(H) = H + net(H). The last layers of these networks are zero before
    training.

    The variant ``default`` adds two feature networks to this chain of steps. ``surroundings`` describes how
    the layout within some micrometres of a pixel influences its height. This influence is the same along x
    and y. ``scan_axis`` describes how the height along x influences the measured height. This second
    influence may come from the microscope. ``scan_axis`` takes part in the fit, so that the other networks do
    not learn this influence. ``printer()`` returns the model without ``scan_axis``.
    """

    name = "pbl"
    Config = PblConfig
    config: PblConfig

    def __init__(self, config: PblConfig):
        super().__init__(config)
        slope = config.leaky_slope
        self.thresh = PointwiseNet(config.pointwise_channels, slope, config.knots)
        self.shrink = PointwiseNet(config.pointwise_channels, slope, config.knots)
        self.mismatch = AreawiseNet(config.areawise_channels, slope, config.transposable)
        self.tau = nn.Parameter(self.ranges["tau"].raw(config.sigma_diffusion_init_um))
        if config.starts_as_blur:
            for part in (self.thresh, self.shrink, self.mismatch):
                part.start_at_zero()
        size = config.pitch_um, config.full_height_um
        around, along = config.surroundings, config.scan_axis
        self.surroundings = None if around is None else Surroundings(around, *size)
        self.scan_axis = None if along is None else ScanAxis(along, *size)

    @property
    def feature_networks(self) -> list[FeatureNetwork]:
        """Return the feature networks of the model. ``feature_fields`` returns their input fields in the same
        order.
        """
        return [network for network in (self.surroundings, self.scan_axis) if network is not None]

    def printer(self) -> Pbl:
        return self if self.scan_axis is None else self._without("scan_axis")

    def chain(self) -> Pbl:
        """Return the model without its feature networks. What remains is the chain of steps in the paper."""
        return self._without("surroundings", "scan_axis") if self.feature_networks else self

    def take(self, chain: Simulator) -> None:
        """Copy the weights of the given chain into the chain of this model."""
        self.load_state_dict(self.state_dict() | chain.state_dict())

    def _without(self, *parts: str) -> Pbl:
        smaller = Pbl(self.config.model_copy(update=dict.fromkeys(parts)))
        own = smaller.state_dict()
        smaller.load_state_dict({name: value for name, value in self.state_dict().items() if name in own})
        return smaller.to(self.tau.device).train(self.training)

    @property
    def ranges(self) -> dict[str, Range]:
        return {"tau": Range("sigma_diffusion_um", 0.0, self.config.sigma_diffusion_max_um)}

    @property
    def sigma_diffusion_um(self) -> Tensor:
        """Return the standard deviation of the diffusion blur, η / (1 + exp(-τ)), µm."""
        return self.ranges["tau"].value(self.tau)

    @property
    def reach_px(self) -> int:
        around, along = (0 if part is None else part.reach_px for part in (self.surroundings, self.scan_axis))
        return max(self._chain_px + along, around)

    @property
    def _chain_px(self) -> int:
        return sum(self._radii_px()) + self.mismatch.reach_px

    def interior(self, layout_um: Tensor) -> Tensor:
        height, fields = self.feature_fields(layout_um)
        for network, field in zip(self.feature_networks, fields, strict=True):
            height = height + network(field)
        return height

    def feature_fields(self, layout_um: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return the chain's prediction of the height of the interior. Also return, for each feature network,
        the field from which its features are computed. All are in µm.
        """
        along = 0 if self.scan_axis is None else self.scan_axis.reach_px
        printed = self._chain(crop_border(layout_um, self.reach_px - self._chain_px - along))
        around = self.surroundings
        layouts = [] if around is None else [crop_border(layout_um, self.reach_px - around.reach_px)]
        return crop_border(printed, along), layouts if self.scan_axis is None else [*layouts, printed]

    def forward(self, layout_um: Tensor) -> Tensor:
        """Return the height of the whole layout, µm. Layout and height have shape (batch, 1, ny, nx)."""
        return self._chain(layout_um, "zero") if self.config.edge == "zero" else super().forward(layout_um)

    def _chain(self, layout_um: Tensor, edge: Edge | None = None) -> Tensor:
        """Apply the chain of the paper. If ``edge`` is None, return the height of the interior only.
        Otherwise pad the layout by the rule ``edge`` and return the height of the whole layout.
        """
        optical, diffusion = self._radii_px()
        blur = partial(gaussian_blur, pitch_um=self.pitch_um, edge=edge)
        if self.config.illumination is None:
            exposed = blur(layout_um, self.config.sigma_optical_um, radius_px=optical)
        else:
            exposed = self._exposed(layout_um)
        initial = self._threshold(exposed)
        dose = blur(initial, self.sigma_diffusion_um, radius_px=diffusion)
        if edge is None:
            return self._develop(crop_border(initial, diffusion), dose)
        return self._develop(initial, dose, padding=1)

    def _radii_px(self) -> tuple[int, int]:
        config, diffusion = self.config, float(self.sigma_diffusion_um.detach())
        optical, diffused = (
            supported_radius_px(sigma / self.pitch_um, config.kernel_support, config.kernel_cap_px)
            for sigma in (config.sigma_optical_um, diffusion)
        )
        if config.illumination is not None:
            optical = config.exposing.reach_px(config.exposing_values, self.pitch_um)
        return optical, diffused

    def _exposed(self, layout_um: Tensor) -> Tensor:
        config, full_um = self.config, self.config.full_height_um
        return full_um * config.exposing.apply(layout_um / full_um, config.exposing_values, self.pitch_um)

    def _threshold(self, aerial: Tensor) -> Tensor:
        full = self.config.full_height_um
        change = self.thresh(aerial, 0.0, full) if self.config.knots else self.thresh.exact(aerial)
        return aerial + change if self.config.starts_as_blur else change

    def _develop(self, initial: Tensor, dose: Tensor, padding: int = 0) -> Tensor:
        dose = dose.abs() if self.config.blur_modulus else dose
        remaining = self._shrink_by_table(dose) if self.config.knots else self.shrink.exact(dose)
        product = initial * (1 + remaining) if self.config.starts_as_blur else initial * remaining
        height = self.mismatch(product, padding)
        if not self.config.starts_as_blur:
            return height
        return height + (product if padding else crop_border(product, self.mismatch.reach_px))

    def _shrink_by_table(self, dose: Tensor) -> Tensor:
        # A blur averages, so the dose stays in the range of the blur's input, which is the output of the
        # threshold network. For any layout, the range of this output is the range of the network's values at
        # the knots.
        full = self.config.full_height_um
        knots = torch.linspace(0.0, full, self.config.knots, device=dose.device, dtype=dose.dtype)
        reachable = self.thresh.at_knots(0.0, full).detach()
        reachable = reachable + knots if self.config.starts_as_blur else reachable
        lowest, highest = float(reachable.min()), float(reachable.max())
        if self.config.edge == "zero":
            lowest, highest = min(lowest, 0.0), max(highest, 0.0)
        if self.config.blur_modulus:
            lowest, highest = 0.0, max(abs(lowest), abs(highest))
        if highest - lowest < torch.finfo(dose.dtype).eps * full:
            return self.shrink.exact(dose)
        return self.shrink(dose, lowest, highest)


class AreawiseNet(nn.Module):
    """A stack of 3 x 3 convolutions that maps one field to one field. ``channels`` are the numbers of
    channels between the convolutions. Every convolution except the last is followed by a leaky ReLU.

    With ``transposable``, each kernel is averaged with its transpose, so that the network treats x and y
    alike.
    """

    def __init__(self, channels: tuple[int, ...], leaky_slope: float, transposable: bool = False):
        super().__init__()
        self.transposable = transposable
        widths = (1, *channels, 1)
        convolutions = [nn.Conv2d(inputs, outputs, 3) for inputs, outputs in pairwise(widths)]
        self.hidden = nn.ModuleList(convolutions[:-1])
        self.last = convolutions[-1]
        self.leaky_slope = leaky_slope
        for convolution in convolutions:
            weight = convolution.weight
            weight.data = weight.data.contiguous(memory_format=torch.channels_last)

    @property
    def reach_px(self) -> int:
        return len(self.hidden) + 1

    def forward(self, height_um: Tensor, padding: int = 0) -> Tensor:
        """Apply the network to a height of shape (batch, 1, ny, nx). If ``padding`` is 0, return the height
        of the interior. If ``padding`` is 1, every layer pads its input with zeros, and the height of the
        whole field is returned.
        """
        features = height_um.contiguous(memory_format=torch.channels_last)
        for layer in cast(list[nn.Conv2d], list(self.hidden)):
            features = functional.conv2d(features, self._kernel(layer), layer.bias, padding=padding)
            features = functional.leaky_relu(features, self.leaky_slope, inplace=True)
        # The sum over the channels is a height, which needs the precision of float32, even if the other
        # layers run in bfloat16.
        with torch.autocast(device_type=height_um.device.type, enabled=False):
            return functional.conv2d(
                features.to(self.last.weight.dtype), self._kernel(self.last), self.last.bias, padding=padding
            )

    def _kernel(self, layer: nn.Conv2d) -> Tensor:
        kernel = layer.weight
        return (kernel + kernel.transpose(-1, -2)) / 2 if self.transposable else kernel

    def start_at_zero(self) -> None:
        """Set the last layer to zero, so that the network returns zero before it is trained. The hidden
        layers stay random.
        """
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(cast(Tensor, self.last.bias))
