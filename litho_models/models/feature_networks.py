"""Networks that compute a contribution to the height of each pixel. Their inputs are features without
parameters, which describe either the layout around the pixel or the printed height along x.

The features do not change during a fit, so they are computed only once, and the networks are fitted to single
pixels (``litho_models.fitting.pixels``) instead of crops. A fit to pixels takes seconds, and a training on
crops takes minutes.
"""

from abc import abstractmethod
from itertools import pairwise
from typing import ClassVar

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from litho_models.layers.pixelwise import at_each_pixel
from litho_models.models.baselines import blurred_interior
from litho_models.models.features import OfField, neighbours
from litho_models.simulator import crop_border

# Below this value, the magnitude of a slope is smoothed, so that the magnitude has a derivative at slope 0. A
# slope here is the height change over the distance σ, divided by the height of the highest level. The value
# corresponds to a height change of about 2 nm.
_LEAST_SLOPE = 2e-3

Widths = tuple[float, ...]


class FeatureNetworkConfig(BaseModel):
    """Settings of a feature network: the widths and displacements of its features, µm, and the numbers of its
    hidden units.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    LENGTHS: ClassVar[tuple[str, ...]] = ("blurs_um", "slope_blurs_um", "shifts_um", "steep_um")

    hidden: tuple[int, ...] = Field(
        (48, 32), min_length=1, max_length=8, description="number of units of each hidden layer"
    )
    blurs_um: Widths = Field((0.1, 0.2, 0.3, 0.45, 0.65, 1.0, 1.6, 2.5), description="σ")
    slope_blurs_um: Widths = Field(
        (0.15, 0.3, 0.6), min_length=1, description="σ of the blurs whose slopes are features"
    )
    shifts_um: Widths = Field(
        (0.2, 0.5, 1.0), min_length=1, description="displacements of the copies that are features"
    )
    steep_um: Widths = Field(
        (0.4, 1.0, 2.0), description="σ of the windows over which the steepness is averaged"
    )


class ScanAxisConfig(FeatureNetworkConfig):
    hidden: tuple[int, ...] = (32, 16)
    blurs_um: Widths = (0.3,)
    slope_blurs_um: Widths = (0.1, 0.3)
    shifts_um: Widths = (0.1, 0.2, 0.4, 0.8, 1.6)


class FeatureNetwork(OfField):
    """A network that computes a contribution to the height, µm, from the features of each pixel. The
    contribution is the sum of two parts: a linear function of the features, and the output of hidden layers.
    Before training, both parts are zero.
    """

    # Whether the network may add a constant height.
    has_constant: ClassVar[bool] = True

    def __init__(self, config: FeatureNetworkConfig, pitch_um: float, full_height_um: float):
        super().__init__()
        self.config, self.pitch_um, self.full_height_um = config, pitch_um, full_height_um
        count = self.feature_count = len(self.features(self._point()))
        self._register_inputs(count)
        self.linear = nn.Linear(count, 1, bias=self.has_constant)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise((count, *config.hidden)):
            layers += [nn.Linear(inputs, outputs), nn.SiLU()]
        last = nn.Linear(config.hidden[-1], 1, bias=False)
        self.layers = nn.Sequential(*layers, last)
        for weight in (*self.linear.parameters(), last.weight):
            nn.init.zeros_(weight)

    @abstractmethod
    def features(self, field_um: Tensor) -> list[Tensor]:
        """Compute the features of a field of shape (batch, 1, ny, nx). Each feature is a map of the interior,
        of shape (batch, 1, ny - 2r, nx - 2r), where r is ``reach_px``.
        """

    @property
    def reach_px(self) -> int:
        config = self.config
        steep = 1 + self._radius(config.slope_blurs_um[0]) + self._radius(*config.steep_um)
        slopes = 1 + self._radius(*config.slope_blurs_um)
        return max(self._radius(*config.blurs_um), slopes, self._steps_px()[-1], steep)

    def forward(self, field_um: Tensor) -> Tensor:
        """Return the contribution of the network to the height of the interior, µm. The result has shape
        (batch, 1, ny - 2r, nx - 2r), where r is ``reach_px``.
        """
        features = self.features(field_um)
        with torch.autocast(device_type=field_um.device.type, enabled=False):
            pixels = (feature.flatten() for feature in features)
            added = at_each_pixel(self._at_pixels, *pixels, parameters=self.parameters())
            return added.view_as(features[0])

    def _at_pixels(self, *features: Tensor) -> Tensor:
        return self.at_pixels(torch.stack(features))

    def at_pixels(self, features: Tensor) -> Tensor:
        """Compute the contribution to the height, µm, at n pixels. ``features`` has shape (features, n), and
        the result has shape (n,).
        """
        first, *later = self.layers
        assert isinstance(first, nn.Linear)
        # The inputs are not standardised. Instead, the weights that multiply the inputs are changed
        # accordingly, which saves a pass over the pixels.
        weight = torch.cat([self.linear.weight, first.weight]) / self.scale
        straight = self.linear.bias if self.has_constant else self.scale.new_zeros(1)
        bias = torch.cat([straight, first.bias]) - weight @ self.centre
        total, hidden = torch.addmm(bias[:, None], weight, features).tensor_split((1,))
        for layer in later:
            hidden = _across(layer, hidden) if isinstance(layer, nn.Linear) else layer(hidden)
        return (total + hidden)[0]

    @abstractmethod
    def _slope(self, height: Tensor, sigma_um: float) -> tuple[Tensor, Tensor]:
        """Return the slope times σ and the curvature times σ². ``height`` must have a margin of 1 px, which
        is cropped from the results.
        """

    def _steepness(self, field: Tensor) -> list[Tensor]:
        """Return local means of the magnitude of the slope and of the squared slope. The means have Gaussian
        weights, and there is one mean for each width of the weights.
        """
        sigma, widths = self.config.slope_blurs_um[0], self.config.steep_um
        margin = self._radius(*widths)
        slope, _ = self._slope(self._blurred(field, sigma, margin_px=margin + 1), sigma)
        sizes = slope.abs(), slope * slope
        return [blurred_interior(size, width, self.pitch_um, margin) for size in sizes for width in widths]


class Surroundings(FeatureNetwork):
    """A network whose inputs are features of the layout near a pixel: blurs, slopes, displaced copies of the
    layout, and the mean steepness. The features do not distinguish between x and y.
    """

    def features(self, field_um: Tensor) -> list[Tensor]:
        config, field, reach = self.config, field_um / self.full_height_um, self.reach_px
        found = [crop_border(field, reach), *(self._blurred(field, sigma) for sigma in config.blurs_um)]
        for sigma in config.slope_blurs_um:
            found += self._slope(self._blurred(field, sigma, margin_px=1), sigma)
        steps = self._steps_px()
        sharp = self._blurred(field, config.slope_blurs_um[0], margin_px=steps[-1])
        for step in steps:
            around = crop_border(sharp, steps[-1] - step)
            here = crop_border(around, step)
            sides = neighbours(around, step)
            found.append(sum(sides[1:], sides[0]))
            found.append(sum(((side - here).abs() for side in sides), torch.zeros_like(here)))
            found.append((sides[1] - sides[0]).abs() + (sides[3] - sides[2]).abs())
        return found + self._steepness(field)

    def _slope(self, height: Tensor, sigma_um: float) -> tuple[Tensor, Tensor]:
        """Return the magnitude of the slope times σ, and the curvature times σ²."""
        up, down, left, right = neighbours(height, 1)
        per_px = sigma_um / self.pitch_um
        y, x = (down - up) * (per_px / 2), (right - left) * (per_px / 2)
        curvature = (up + down + left + right - 4 * crop_border(height, 1)) * per_px**2
        return (y * y + x * x + _LEAST_SLOPE**2).sqrt(), curvature


class ScanAxis(FeatureNetwork):
    """A network whose inputs are features of the printed height along x: slopes, steps, and the mean
    steepness. The microscope scans its lines along x.

    All features are 0 where the print does not change along x, so the network adds nothing there.
    """

    has_constant = False

    def at_pixels(self, features: Tensor) -> Tensor:
        return super().at_pixels(features) - super().at_pixels(torch.zeros_like(features[:, :1]))

    def features(self, field_um: Tensor) -> list[Tensor]:
        config, field, reach = self.config, field_um / self.full_height_um, self.reach_px
        here = crop_border(field, reach)
        found = [
            blurred_interior(field, (0.0, sigma), self.pitch_um, reach) - here for sigma in config.blurs_um
        ]
        for sigma in config.slope_blurs_um:
            slope, curved = self._slope(self._blurred(field, sigma, margin_px=1), sigma)
            found += [slope, slope.abs(), curved]
        for step in self._steps_px():
            _, _, left, right = neighbours(crop_border(field, reach - step), step)
            before, after = left - here, right - here
            found += [before, after, before.abs(), after.abs(), (right - left).abs()]
        return found + self._steepness(field)

    def _slope(self, height: Tensor, sigma_um: float) -> tuple[Tensor, Tensor]:
        """Return the slope along x times σ, and the curvature along x times σ²."""
        _, _, left, right = neighbours(height, 1)
        per_px = sigma_um / self.pitch_um
        return (right - left) * (per_px / 2), (left + right - 2 * crop_border(height, 1)) * per_px**2


def _across(layer: nn.Linear, values: Tensor) -> Tensor:
    """Apply a linear layer at each of n pixels. ``values`` has shape (inputs, n), and the result has shape
    (outputs, n).
    """
    if layer.bias is None:
        return layer.weight @ values
    return torch.addmm(layer.bias[:, None], layer.weight, values)
