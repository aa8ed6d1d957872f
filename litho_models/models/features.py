"""Models in which the height is a weighted sum of many features of the layout, such as blurs, slopes and
products of these.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import kernel_radius_px
from litho_models.layers.pixelwise import at_each_pixel
from litho_models.models.baselines import blurred_interior
from litho_models.simulator import Simulator, SimulatorConfig, crop_border

# Below this value, the magnitude of a slope is smoothed, so that the magnitude has a derivative at slope 0. A
# slope here is a height change per µm, divided by the height of the highest level.
_LEAST_SLOPE = 1e-4


class FeaturesConfig(SimulatorConfig):
    LENGTHS = (
        *("sigmas_um", "slope_sigmas_um", "shifts_um", "shift_sigma_um"),
        *("streak_sigmas_um", "steep_sigmas_um", "steep_widths_um"),
    )

    sigmas_um: tuple[float, ...] = Field(
        (0.0, 0.1, 0.2, 0.3, 0.45, 0.65, 1.0, 1.6, 2.5, 4.0),
        min_length=1,
        description="σ of the blurs, µm; 0 stands for the layout itself",
    )
    slope_sigmas_um: tuple[float, ...] = Field(
        (0.15, 0.3, 0.6), min_length=1, description="σ of the blurs whose slopes are features, µm"
    )
    shifts_um: tuple[float, ...] = Field(
        (0.2, 0.5, 1.0), min_length=1, description="displacements of the copies that are features, µm"
    )
    shift_sigma_um: float = Field(0.1, gt=0, description="σ of the blur of the displaced copies, µm")
    streak_sigmas_um: tuple[float, ...] = Field((), description="σ of the blurs along one axis only, µm")
    steep_sigmas_um: tuple[float, ...] = Field((), description="σ of the blurs whose slopes are averaged, µm")
    steep_widths_um: tuple[float, ...] = Field((), description="σ of the windows of these averages, µm")


class OfField(nn.Module, ABC):
    """Base class of all models and networks that compute features of a field. It provides blurs and
    displacements, the receptive radius of these operations, and the standardisation of the inputs of a
    network.
    """

    config: Any
    pitch_um: float
    centre: Tensor
    scale: Tensor

    @property
    @abstractmethod
    def reach_px(self) -> int:
        """Return the receptive radius of the features, in pixels."""

    def _point(self) -> Tensor:
        """Return a field of zeros of the smallest possible size, i.e. a field whose interior is a single
        pixel.
        """
        side = 2 * self.reach_px + 1
        return torch.zeros(1, 1, side, side)

    def _blurred(self, field: Tensor, sigma_um: float, margin_px: int = 0) -> Tensor:
        reach = self.reach_px - margin_px
        return (
            blurred_interior(field, sigma_um, self.pitch_um, reach) if sigma_um else crop_border(field, reach)
        )

    def _steps_px(self) -> list[int]:
        return sorted(max(1, round(shift_um / self.pitch_um)) for shift_um in self.config.shifts_um)

    def _radius(self, *sigmas_um: float) -> int:
        return max((kernel_radius_px(sigma / self.pitch_um) for sigma in sigmas_um), default=0)

    def _register_inputs(self, count: int) -> None:
        self.register_buffer("centre", torch.zeros(count))
        self.register_buffer("scale", torch.ones(count))

    def standardise(self, seen: Sequence[Tensor]) -> None:
        """Set the centre and the scale with which the inputs are standardised. ``seen`` contains one tensor
        for each scan: the inputs at n pixels of the scan, with shape (inputs, n). The centre of an input is
        its mean over all scans, and the scale is its standard deviation within a scan.
        """
        centre = torch.stack([one.mean(dim=1) for one in seen]).mean(dim=0)
        spread = torch.stack([one.var(dim=1, correction=0) for one in seen]).mean(dim=0).sqrt()
        self.centre.copy_(centre)
        self.scale.copy_(torch.where(spread > 1e-6 * spread.max(), spread, 1.0))


class Features(OfField, Simulator):
    """A weighted sum of features of the layout: H = w · φ(M). Before the features are computed, the layout M
    is divided by the height of the highest level.

    The features φ are:

    - blurs, their cubes, and the products of any two blurs;
    - slopes of blurred layouts along y and x, with the magnitudes and products of these slopes;
    - copies of the layout that are displaced up, down, left and right, and the magnitudes of the height
      differences between the layout and these copies;
    - second derivatives of blurred layouts, and products of a blurred layout and its slopes;
    - blurs along one axis;
    - the steepness of the surroundings along each axis.

    The magnitudes of the slopes along x and along y are separate features, because the microscope scans in
    lines along one axis. ``litho_models.fitting.ridge`` finds the weights in closed form.
    """

    name = "features"
    is_linear = True
    Config: ClassVar[type[SimulatorConfig]] = FeaturesConfig
    config: FeaturesConfig

    def __init__(self, config: FeaturesConfig):
        super().__init__(config)
        weights = torch.zeros(sum(map(len, self.features(self._point()))))
        weights[0] = config.full_height_um
        self.weights = nn.Parameter(weights)

    @property
    def reach_px(self) -> int:
        config = self.config
        blurs = self._radius(*config.sigmas_um, *config.slope_sigmas_um, *config.streak_sigmas_um)
        displaced = self._steps_px()[-1] + self._radius(config.shift_sigma_um)
        steep = self._radius(*config.steep_sigmas_um) + self._radius(*config.steep_widths_um)
        return max(blurs + 1, displaced, steep + 1)

    def interior(self, layout_um: Tensor) -> Tensor:
        simple, products = self.features(layout_um)
        pixels = (feature.flatten() for feature in (*simple, *products))
        return at_each_pixel(self._height, *pixels, parameters=self.parameters()).view_as(simple[0])

    def _height(self, *features: Tensor) -> Tensor:
        return self.weights @ self.completed(torch.stack(features))

    def completed(self, features: Tensor) -> Tensor:
        """Return the features φ(M), followed by the features that a subclass computes from them. ``features``
        contains φ(M) at n pixels. The result has shape (weights, n), with one row per weight of the model.
        """
        return features

    def features(self, layout_um: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Return the features φ(M) of the interior (the pixels at least ``reach_px`` from the edge) in two
        lists. The first list contains the simple features, such as blurs, slopes and displaced copies. The
        second list contains products and cubes of these features, magnitudes of gradients, and the constant
        1. Each feature is a map of shape (batch, 1, ny, nx).
        """
        config = self.config
        layout = layout_um / config.full_height_um
        blurs = [self._blurred(layout, sigma) for sigma in config.sigmas_um]
        slopes = [self._slopes(self._blurred(layout, s, margin_px=1)) for s in config.slope_sigmas_um]
        products = [first * second for first, second in combinations_with_replacement(blurs, 2)]
        products += [blur**3 for blur in blurs]
        for height, y, x, size_y, size_x, *_ in slopes:
            products += [y * y, x * x, y * x, *(height * slope for slope in (y, x, size_y, size_x))]
            products.append((y * y + x * x + _LEAST_SLOPE**2).sqrt())
        simple = [*blurs, *(one for group in slopes for one in group), *self._displaced(layout)]
        simple += [*self._streaks(layout), *self._steepness(layout)]
        return simple, [*products, torch.ones_like(blurs[0])]

    def at_pixels(self, layout_um: Tensor, at: Tensor) -> Tensor:
        """Evaluate all features, including those that ``completed`` adds, at n pixels. ``at`` contains the
        flat indices of these pixels in the interior of a layout of shape (1, 1, ny, nx). The result has shape
        (weights, n).
        """
        simple, products = self.features(layout_um)
        return self.completed(torch.stack([feature.reshape(-1)[at] for feature in (*simple, *products)]))

    def _slopes(self, height: Tensor) -> list[Tensor]:
        """Return the height, its slopes per µm, the magnitudes of the slopes, and its second derivatives per
        µm². ``height`` must have a margin of 1 px, which is cropped from the results.
        """
        pitch, inner = self.pitch_um, crop_border(height, 1)
        up, down, left, right = neighbours(height, 1)
        y, x = (down - up) / (2 * pitch), (right - left) / (2 * pitch)
        corners = height[..., 2:, 2:] + height[..., :-2, :-2] - height[..., 2:, :-2] - height[..., :-2, 2:]
        curved = [up + down - 2 * inner, left + right - 2 * inner, corners / 4]
        return [inner, y, x, y.abs(), x.abs(), *(second / pitch**2 for second in curved)]

    def _displaced(self, layout: Tensor) -> list[Tensor]:
        """For each step length, return copies of the layout that are displaced up, down, left and right by
        this length. Also return the magnitudes of the height differences between the layout and each copy,
        and between copies displaced in opposite directions.
        """
        steps, found = self._steps_px(), []
        sharp = self._blurred(layout, self.config.shift_sigma_um, margin_px=steps[-1])
        here = crop_border(sharp, steps[-1])
        for step in steps:
            up, down, left, right = neighbours(crop_border(sharp, steps[-1] - step), step)
            found += [up, down, left, right]
            for before, after in ((up, down), (left, right)):
                found += [(before - here).abs(), (after - here).abs(), (after - before).abs()]
        return found

    def _streaks(self, layout: Tensor) -> list[Tensor]:
        """Return blurs of the layout that are wide along one axis and narrow (standard deviation of one
        pixel) along the other axis. For each width, the blur that is wide along y comes first.
        """
        wide, narrow = self.config.streak_sigmas_um, self.pitch_um
        pairs = [pair for sigma in wide for pair in ((sigma, narrow), (narrow, sigma))]
        return [blurred_interior(layout, pair, self.pitch_um, self.reach_px) for pair in pairs]

    def _steepness(self, layout: Tensor) -> list[Tensor]:
        """Return local means of the magnitude and of the square of the slope along y and along x. The means
        have Gaussian weights, and there is one mean for each width of the weights. A slope here is the height
        change over the distance σ.
        """
        widths, found = self.config.steep_widths_um, []
        margin = self._radius(*widths)
        for sigma in self.config.steep_sigmas_um:
            up, down, left, right = neighbours(self._blurred(layout, sigma, margin_px=margin + 1), 1)
            for across in (down - up, right - left):
                slope = across * (sigma / self.pitch_um / 2)
                sizes = slope.abs(), slope * slope
                found += [blurred_interior(s, w, self.pitch_um, margin) for s in sizes for w in widths]
        return found


class RandomFeaturesConfig(FeaturesConfig):
    shifts_um: tuple[float, ...] = (0.1, 0.2, 0.4, 0.8, 1.6)
    streak_sigmas_um: tuple[float, ...] = (0.3, 0.6, 1.2, 2.5, 4.0)
    steep_sigmas_um: tuple[float, ...] = (0.1, 0.2, 0.4, 0.8)
    steep_widths_um: tuple[float, ...] = (1.0, 2.5)
    units: int = Field(500, ge=1, description="number of random features")
    inputs: int = Field(8, ge=1, description="number of inputs of each random feature")
    seed: int = Field(0, ge=0, description="seed of the random features")


class RandomFeatures(Features):
    """The model ``Features`` with additional features tanh(V z + c). The vector z contains the simple
    features (the first list that ``features`` returns), standardised. V and c are random and are not fitted.

    The model is a network whose hidden layer is not trained (random features, Rahimi and Recht 2008). Each
    random feature depends on ``inputs`` simple features, whereas each product in ``Features`` depends on at
    most two. The weights are still found in closed form.
    """

    name = "random-features"
    Config: ClassVar[type[SimulatorConfig]] = RandomFeaturesConfig
    config: RandomFeaturesConfig
    directions: Tensor
    thresholds: Tensor

    def __init__(self, config: RandomFeaturesConfig):
        super().__init__(config)
        count = len(self.features(self._point())[0])
        random = torch.Generator().manual_seed(config.seed)
        seen = torch.rand(config.units, count, generator=random).argsort(dim=1) < config.inputs
        size = min(config.inputs, count) ** 0.5
        self.register_buffer("directions", torch.randn(config.units, count, generator=random) * seen / size)
        self.register_buffer("thresholds", torch.randn(config.units, generator=random))
        self._register_inputs(count)
        self.weights = nn.Parameter(torch.cat([self.weights.detach(), torch.zeros(config.units)]))

    def completed(self, features: Tensor) -> Tensor:
        standard = (features[: len(self.centre)] - self.centre[:, None]) / self.scale[:, None]
        return torch.cat([features, torch.tanh(self.directions @ standard + self.thresholds[:, None])])


def neighbours(field: Tensor, step: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return four fields. They contain, for each pixel that is at least ``step`` pixels from the edge, the
    values ``step`` pixels above, below, left and right of this pixel.
    """
    inner, far, near = slice(step, -step), slice(2 * step, None), slice(None, -2 * step)
    return field[..., near, inner], field[..., far, inner], field[..., inner, near], field[..., inner, far]
