"""FNO: the Fourier neural operator, the paper's learned simulator that contains no physics.

The model is the two-dimensional operator of Li et al. 2020 (arXiv:2010.08895) with 12 x 12 modes and width
24; see arXiv:2309.17343, appendix "Fourier Neural Operator". The output of each layer is the sum of a local
convolution and a product in Fourier space, which acts on the whole image. The operator treats the image as
periodic. A mode is defined by its number of periods per image, so the result depends on the image size. The
variant ``default`` therefore runs the operator on tiles of one size.
"""

import math
from typing import Any, ClassVar, Self

import torch
from pydantic import Field, PositiveInt, model_validator
from torch import Tensor, nn
from torch.nn import functional

from litho_models.layers.pixelwise import at_each_pixel
from litho_models.prediction.tiles import blend_tiles
from litho_models.simulator import Simulator, SimulatorConfig, Tile, crop_border

# Largest number of weights that a card may request: ninety times the number in the paper, 0.5 GB.
_MOST_MATRIX_ENTRIES = 30_000_000


class FnoConfig(SimulatorConfig):
    layers: int = Field(4, ge=1, le=64)
    # Frequencies kept along y (both signs) and x.
    modes: tuple[PositiveInt, PositiveInt] = (12, 12)
    width: int = Field(24, ge=1, le=1024, description="channels of the layers")
    projection_channels: int = Field(128, ge=1, le=4096, description="hidden channels of the last layers")
    # The paper uses 1 x 1. Detail finer than the kept modes is then mapped only pixel by pixel.
    local_px: int = Field(3, ge=1, le=15, description="side of the local convolution, odd")
    coordinates: bool = Field(False, description="use y and x, scaled to 0 ... 1, as further inputs")
    padding_fraction: float = Field(
        0.0, ge=0, le=1, description="width of the zeros added at the bottom and right, relative to the size"
    )
    padding_px: int = Field(
        0, ge=0, le=4096, description="width of the zeros added at the bottom and right of every image"
    )
    tile_px: int | None = Field(128, ge=8, le=4096, description="side of a tile; None: the whole image")
    overlap_px: int = Field(32, ge=0, description="overlap of blended tiles, at most half a tile")
    # Before training, the network returns the layout; it learns the difference. The paper's network starts
    # with random weights.
    starts_as_layout: bool = True

    _PUBLISHED: ClassVar[dict[str, Any]] = {
        "local_px": 1,
        "coordinates": True,
        "tile_px": None,
        "starts_as_layout": False,
    }
    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {
        # This is 9 px for the published quadrants of 256 px.
        "paper": {**_PUBLISHED, "padding_fraction": 9 / 256},
        "authors": {**_PUBLISHED, "padding_px": 9, "width": 12},
    }

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        if self.local_px % 2 == 0:
            raise ValueError("local_px must be odd")
        if self.layers * self.width**2 * self.modes[0] * self.modes[1] > _MOST_MATRIX_ENTRIES:
            raise ValueError(f"layers · width² · modes must be at most {_MOST_MATRIX_ENTRIES:g}")
        return self


class Fno(Simulator):
    """H = Q(L₄ ∘ … ∘ L₁(P(M, y, x))) with L(v) = gelu(local(v) + spectral(v)), but without gelu in the last
    layer.

    P lifts each pixel to ``width`` channels, and Q maps them to a height through one hidden layer. With
    ``starts_as_layout``, this height is added to M, and it is zero before training. If the config has a tile,
    ``interior`` returns the height of one tile, which is treated as periodic. The height of the whole field
    is then blended from tiles.
    """

    name = "fno"
    Config = FnoConfig
    config: FnoConfig

    def __init__(self, config: FnoConfig):
        super().__init__(config)
        width, local = config.width, config.local_px
        self.lift = nn.Conv2d(3 if config.coordinates else 1, width, 1)
        self.spectral = nn.ModuleList(SpectralConvolution(width, config.modes) for _ in range(config.layers))
        self.local = nn.ModuleList(PeriodicConvolution(width, width, local) for _ in range(config.layers))
        self.hidden = nn.Conv2d(width, config.projection_channels, 1)
        self.last = nn.Conv2d(config.projection_channels, 1, 1)
        if config.starts_as_layout:
            nn.init.zeros_(self.last.weight)
            if self.last.bias is not None:
                nn.init.zeros_(self.last.bias)

    @property
    def reach_px(self) -> None:
        return None

    @property
    def tile(self) -> Tile | None:
        size = self.config.tile_px
        return None if size is None else Tile(size, self.config.overlap_px)

    def interior(self, layout_um: Tensor) -> Tensor:
        """Return the height of a whole image, (batch, 1, y, x) µm, with the size of the image."""
        config = self.config
        ny, nx = layout_um.shape[-2:]
        # Heights need full precision at the input and the output, even under autocast. Channels are the last
        # axis, so that products over channels are matrix products.
        with torch.autocast(device_type=layout_um.device.type, enabled=False):
            inputs = torch.cat([layout_um, _coordinates(layout_um)], 1) if config.coordinates else layout_um
            features = _pointwise(self.lift, inputs.permute(0, 2, 3, 1))
        padding = [config.padding_px + round(config.padding_fraction * size) for size in (nx, ny)]
        features = functional.pad(features, (0, 0, 0, padding[0], 0, padding[1]))
        for number, (spectral, local) in enumerate(zip(self.spectral, self.local, strict=True)):
            features = spectral(features) + local(features)
            if number < config.layers - 1:
                features = functional.gelu(features)
        features = features[:, :ny, :nx]
        parameters = (*self.hidden.parameters(), *self.last.parameters())
        height = at_each_pixel(self._project, features.reshape(-1, config.width), parameters=parameters)
        height = height.reshape(layout_um.shape)
        return layout_um + height if config.starts_as_layout else height

    def _project(self, features: Tensor) -> Tensor:
        """Apply the last layers, which map features (n, width) to a height (n,)."""
        hidden = functional.gelu(_pointwise(self.hidden, features))
        with torch.autocast(device_type=features.device.type, enabled=False):
            return _pointwise(self.last, hidden.to(self.last.weight.dtype))[:, 0]

    def forward(self, layout_um: Tensor) -> Tensor:
        """Return the height of the whole field, (batch, 1, y, x) µm."""
        return self.inside(layout_um, 0)

    def inside(self, layout_um: Tensor, border_px: int) -> Tensor:
        if self.tile is None:
            return crop_border(self.interior(layout_um), border_px)
        return blend_tiles(self.interior, layout_um, self.tile, border_px)


class PeriodicConvolution(nn.Conv2d):
    """A convolution of a periodic image (b, y, x, channels) that keeps its shape."""

    def forward(self, features: Tensor) -> Tensor:
        if margin := self.kernel_size[0] // 2:
            features = torch.cat([features[:, -margin:], features, features[:, :margin]], dim=1)
            features = torch.cat([features[:, :, -margin:], features, features[:, :, :margin]], dim=2)
        return super().forward(features.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class SpectralConvolution(nn.Module):
    """A product v̂'(k) = W(k) v̂(k) with a matrix over channels at each of the lowest frequencies; other
    frequencies are set to zero.

    The weights are real, with shape (sign of k_y, in, out, modes y, modes x, real and imaginary part), so
    that they can be stored and cast like any other parameter.
    """

    def __init__(self, channels: int, modes: tuple[int, int]):
        super().__init__()
        self.weight = nn.Parameter(torch.rand(2, channels, channels, *modes, 2) / channels**2)

    def forward(self, field: Tensor) -> Tensor:
        """Convolve a field (b, y, x, channels). A small image, which has fewer frequencies than there are
        modes, uses only some modes.

        Only a few frequencies are kept, so products with their waves are cheaper than fast Fourier
        transforms.
        """
        ny, nx = field.shape[1:3]
        modes_y, modes_x = self.weight.shape[3:5]
        kept_y, kept_x = min(modes_y, ny // 2), min(modes_x, nx // 2 + 1)
        with torch.autocast(device_type=field.device.type, enabled=False):
            field = field.to(self.weight.dtype)
            k_y, k_x = torch.arange(-kept_y, kept_y), torch.arange(kept_x)
            waves_y, waves_x = _waves(k_y, ny, field), _waves(k_x, nx, field)
            parts_x = torch.cat([waves_x.real, -waves_x.imag])
            positive, negative = torch.view_as_complex(self.weight)[..., :kept_x]
            matrices = torch.cat([negative[:, :, modes_y - kept_y :], positive[:, :, :kept_y]], dim=2)
            along_x = torch.complex(*(parts_x @ field).chunk(2, dim=2))
            spectra = (waves_y.conj() @ along_x.flatten(2)).unflatten(2, (kept_x, -1))
            mixed = torch.einsum("byxi,ioyx->byxo", spectra, matrices)
            # Each frequency along x also stands for its negative, unless the two are equal.
            shares = (1 + (2 * k_x % nx).sign()).to(field)[:, None] / (ny * nx)
            lines = (waves_y.T @ (shares * mixed).flatten(2)).unflatten(2, (kept_x, -1))
            return parts_x.T @ torch.cat([lines.real, lines.imag], dim=2)


def _waves(frequencies: Tensor, size: int, like: Tensor) -> Tensor:
    """Return exp(2πi k n / N), (frequencies, N), with the precision and on the device of ``like``."""
    # Whole numbers are reduced to one period first, so the angles stay exact at any size.
    turns = torch.outer(frequencies, torch.arange(size)) % size
    angle = (2 * math.pi / size) * turns.double()
    return torch.complex(angle.cos().to(like), angle.sin().to(like))


def _pointwise(convolution: nn.Conv2d, features: Tensor) -> Tensor:
    """Apply a 1 x 1 convolution to features whose channels are the last axis."""
    return functional.linear(features, convolution.weight[:, :, 0, 0], convolution.bias)


def _coordinates(layout: Tensor) -> Tensor:
    """Return the coordinates y and x of each pixel on 0 ... 1, (batch, 2, y, x)."""
    y, x = (
        torch.linspace(0, 1, size, device=layout.device, dtype=layout.dtype) for size in layout.shape[-2:]
    )
    grid = torch.stack(torch.meshgrid(y, x, indexing="ij"))
    return grid.expand(layout.shape[0], -1, -1, -1)
