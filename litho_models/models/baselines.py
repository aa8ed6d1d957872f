"""Baselines: simple models, which every other model should surpass. The simplest baseline returns the
unchanged layout. The most complex baseline is a weighted sum of features of the layout. In the formulas, M is
the layout and H the printed height.
"""

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import gaussian_blur, kernel_radius_px
from litho_models.layers.pixelwise import interpolate
from litho_models.layers.ranges import Range
from litho_models.simulator import Simulator, SimulatorConfig, crop_border

_MOST_KNOTS = 33


class Identity(Simulator):
    """The unchanged layout: H = M. The model has no parameters."""

    name = "identity"

    @property
    def reach_px(self) -> int:
        return 0

    def interior(self, layout_um: Tensor) -> Tensor:
        return layout_um.clone()


class Affine(Simulator):
    """A gain and an offset: H = gain · M + offset."""

    name = "affine"
    is_linear = True

    def __init__(self, config: SimulatorConfig):
        super().__init__(config)
        self.gain = nn.Parameter(torch.tensor(1.0))
        self.offset_um = nn.Parameter(torch.tensor(0.0))

    @property
    def reach_px(self) -> int:
        return 0

    def interior(self, layout_um: Tensor) -> Tensor:
        return self.gain * layout_um + self.offset_um


class BlurTableConfig(SimulatorConfig):
    LENGTHS = ("sigma_max_um", "sigma_init_um")

    sigma_max_um: float = Field(1.0, gt=0, description="upper bound of the blur, µm")
    sigma_init_um: float = Field(0.25, gt=0, description="blur before fitting, µm")


class BlurTable(Simulator):
    """A blur followed by a fitted table: H = T(G_σ * M), where G_σ is a Gaussian and * a convolution. T is a
    table of fitted heights at evenly spaced inputs, with linear interpolation between them. The table has as
    many entries as the layout has levels, but at most 33.
    """

    name = "blur-table"
    Config = BlurTableConfig
    config: BlurTableConfig

    def __init__(self, config: BlurTableConfig):
        super().__init__(config)
        self.tau = nn.Parameter(self.ranges["tau"].raw(config.sigma_init_um))
        knots = min(config.levels, _MOST_KNOTS)
        self.table_um = nn.Parameter(torch.arange(knots) * (config.full_height_um / (knots - 1)))

    @property
    def ranges(self) -> dict[str, Range]:
        return {"tau": Range("sigma_um", 0.0, self.config.sigma_max_um)}

    @property
    def sigma_um(self) -> Tensor:
        """Return the standard deviation of the blur, µm, which is between 0 and ``sigma_max_um``."""
        return self.ranges["tau"].value(self.tau)

    @property
    def reach_px(self) -> int:
        return kernel_radius_px(float(self.sigma_um.detach()) / self.pitch_um)

    def interior(self, layout_um: Tensor) -> Tensor:
        dose = gaussian_blur(layout_um, self.sigma_um, self.pitch_um, edge=None, radius_px=self.reach_px)
        return interpolate(dose, self.table_um, 0.0, self.config.full_height_um)


class AffineMtfConfig(SimulatorConfig):
    LENGTHS = ("sigmas_um",)

    sigmas_um: tuple[float, ...] = Field((0.1, 0.2, 0.35, 0.6, 1.0, 1.8), min_length=1)


class AffineMtf(Simulator):
    """A weighted sum of Gaussian blurs: H = offset + Σ_j w_j (G_j * M). Its transfer function is Σ_j w_j
    exp(-2π²σ_j²f²), where f is the spatial frequency, and its gain is Σ_j w_j.
    """

    name = "affine-mtf"
    is_linear = True
    Config = AffineMtfConfig
    config: AffineMtfConfig

    def __init__(self, config: AffineMtfConfig):
        super().__init__(config)
        weights = torch.zeros(len(config.sigmas_um))
        weights[0] = 1.0
        self.weights = nn.Parameter(weights)
        self.offset_um = nn.Parameter(torch.tensor(0.0))

    @property
    def reach_px(self) -> int:
        return kernel_radius_px(max(self.config.sigmas_um) / self.pitch_um)

    def interior(self, layout_um: Tensor) -> Tensor:
        blurred = [
            blurred_interior(layout_um, sigma, self.pitch_um, self.reach_px)
            for sigma in self.config.sigmas_um
        ]
        return self.offset_um + (self.weights * torch.stack(blurred, dim=-1)).sum(dim=-1)


def blurred_interior(
    layout_um: Tensor, sigma_um: float | tuple[float, float], pitch_um: float, reach_px: int
) -> Tensor:
    """Blur a layout and crop ``reach_px`` pixels at each edge. ``sigma_um`` is the standard deviation of the
    blur, or a pair of standard deviations (along y, along x).
    """
    pair = sigma_um if isinstance(sigma_um, tuple) else (sigma_um, sigma_um)
    radii = kernel_radius_px(pair[0] / pitch_um), kernel_radius_px(pair[1] / pitch_um)
    rows, columns = (
        slice(reach_px - radius, length - reach_px + radius)
        for radius, length in zip(radii, layout_um.shape[-2:], strict=True)
    )
    return gaussian_blur(layout_um[..., rows, columns], pair, pitch_um, edge=None, radius_px=radii)


class LinearConfig(SimulatorConfig):
    LENGTHS = ("sigmas_um", "power_sigma_um")

    sigmas_um: tuple[float, ...] = Field((0.1, 0.2, 0.35, 0.6, 1.0, 1.8, 3.0), min_length=1)
    power_sigma_um: float = 0.25
    power_reference_um: float = 0.5


class Linear(Simulator):
    """A weighted sum of features: H = w · φ(M). The features φ are the constant 1, Gaussian blurs of the
    layout, and powers and squared slopes of one additional blur B. The powers are (B - r)², (B - r)³ and
    (B - r)⁴, where r is ``power_reference_um``.

    The slopes along y and along x have separate weights, because the two axes of a print may differ.
    """

    name = "linear"
    is_linear = True
    Config = LinearConfig
    config: LinearConfig

    def __init__(self, config: LinearConfig):
        super().__init__(config)
        weights = torch.zeros(len(config.sigmas_um) + 6)
        weights[0] = 1.0
        self.weights = nn.Parameter(weights)

    @property
    def reach_px(self) -> int:
        return kernel_radius_px(max(self.config.sigmas_um) / self.pitch_um) + 1

    def interior(self, layout_um: Tensor) -> Tensor:
        return (self.weights * self.features(layout_um)).sum(dim=-1)

    def features(self, layout_um: Tensor) -> Tensor:
        """Return the features φ(M) of the interior, with shape (batch, 1, ny, nx, features)."""
        config, reach = self.config, self.reach_px
        blurs = [blurred_interior(layout_um, sigma, self.pitch_um, reach) for sigma in config.sigmas_um]
        wide = blurred_interior(layout_um, config.power_sigma_um, self.pitch_um, reach - 1)
        slope_y = (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]) / (2 * self.pitch_um)
        slope_x = (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2]) / (2 * self.pitch_um)
        centred = crop_border(wide, 1) - config.power_reference_um
        powers = [centred**2, centred**3, centred**4]
        return torch.stack([*blurs, *powers, slope_y**2, slope_x**2, torch.ones_like(centred)], dim=-1)
