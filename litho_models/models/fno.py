"""FNO: the Fourier neural operator. Of the simulators in the paper (arXiv:2309.17343), the FNO is the one
without built-in physics; it is learned from data alone.

The model is the two-dimensional operator of Li et al. 2020 (arXiv:2010.08895) with 12 x 12 modes and width
24; see arXiv:2309.17343, appendix "Fourier Neural Operator". The output of each layer is the sum of two
parts: a local convolution, and a product in Fourier space, which acts on the whole layout. The operator
treats the layout as periodic. A mode is defined by its number of periods per layout, so the result depends on
the size of the layout. The variant ``default`` therefore applies the operator to tiles of one size.
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

# Largest allowed number of Fourier weights. The limit prevents a model card from requesting too much memory,
# and is ninety times the number in the paper.
_MOST_MATRIX_ENTRIES = 30_000_000


class FnoConfig(SimulatorConfig):
    layers: int = Field(4, ge=1, le=64)
    # Number of frequencies that are kept along y (for each sign) and along x.
    modes: tuple[PositiveInt, PositiveInt] = (12, 12)
    width: int = Field(24, ge=1, le=1024, description="number of channels of each layer")
    projection_channels: int = Field(
        128, ge=1, le=4096, description="number of hidden channels between the last two layers"
    )
    # The paper uses 1 x 1. Detail that is finer than the kept modes is then mapped pixel by pixel, and its
    # surroundings have no influence on it.
    local_px: int = Field(3, ge=1, le=15, description="side of the local convolution, px; must be odd")
    coordinates: bool = Field(False, description="whether y and x, scaled to 0 ... 1, are further inputs")
    padding_fraction: float = Field(
        0.0,
        ge=0,
        le=1,
        description="width of the zeros added at the bottom and right, relative to the size of the layout",
    )
    padding_px: int = Field(
        0, ge=0, le=4096, description="width of the zeros added at the bottom and right of the layout, px"
    )
    tile_px: int | None = Field(128, ge=8, le=4096, description="side of a tile, px; None: no tiles")
    overlap_px: int = Field(32, ge=0, description="overlap of neighbouring tiles, px; at most half a tile")
    # If True, the network returns the layout before training and learns the difference. The network in the
    # paper starts with random weights.
    starts_as_layout: bool = True

    _PUBLISHED: ClassVar[dict[str, Any]] = {
        "local_px": 1,
        "coordinates": True,
        "tile_px": None,
        "starts_as_layout": False,
    }
    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {
        # The value corresponds to 9 px for the published quadrants of 256 px.
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
    """The Fourier neural operator: H = Q(L₄ ∘ … ∘ L₁(P(M))), where M is the layout and H the printed height.
    A layer is L(v) = gelu(local(v) + spectral(v)), but the last layer has no gelu.

    P maps each pixel to ``width`` channels. With ``coordinates``, P also receives y and x. Q maps the
    channels to a height through one hidden layer. With ``starts_as_layout``, this height is added to M and is
    zero before training. If the configuration has a tile size, ``interior`` treats one tile as periodic and
    returns its height. The heights of all tiles are then blended to the height of the whole layout.
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
        """Return the height of a whole layout or of one tile, µm. Layout and height have shape (batch, 1, ny,
        nx).
        """
        config = self.config
        ny, nx = layout_um.shape[-2:]
        # The input and the output are heights, which need the precision of float32 even if autocast is on.
        # Channels are the last axis, so that sums over channels are matrix products.
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
        """Apply the last two layers, which map features of shape (n, width) to a height of shape (n,)."""
        hidden = functional.gelu(_pointwise(self.hidden, features))
        with torch.autocast(device_type=features.device.type, enabled=False):
            return _pointwise(self.last, hidden.to(self.last.weight.dtype))[:, 0]

    def forward(self, layout_um: Tensor) -> Tensor:
        """Return the height of the whole layout, µm. Layout and height have shape (batch, 1, ny, nx)."""
        return self.inside(layout_um, 0)

    def inside(self, layout_um: Tensor, border_px: int) -> Tensor:
        if self.tile is None:
            return crop_border(self.interior(layout_um), border_px)
        return blend_tiles(self.interior, layout_um, self.tile, border_px)


class PeriodicConvolution(nn.Conv2d):
    """A convolution that treats a field as periodic and returns a field of the same size. Fields have shape
    (batch, ny, nx, channels).
    """

    def forward(self, features: Tensor) -> Tensor:
        if margin := self.kernel_size[0] // 2:
            features = torch.cat([features[:, -margin:], features, features[:, :margin]], dim=1)
            features = torch.cat([features[:, :, -margin:], features, features[:, :, :margin]], dim=2)
        return super().forward(features.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class SpectralConvolution(nn.Module):
    """A convolution that is computed in Fourier space. At each of the lowest frequencies k, the vector v̂(k)
    of the Fourier coefficients of all channels is multiplied by a matrix W(k). The coefficients at all other
    frequencies are set to zero.

    The weights are stored as real numbers, so that they can be saved and converted like any other parameter.
    Their shape is (2, channels in, channels out, modes along y, modes along x, 2). The first axis
    distinguishes the two signs of k_y, and the last axis distinguishes the real and the imaginary part.
    """

    def __init__(self, channels: int, modes: tuple[int, int]):
        super().__init__()
        self.weight = nn.Parameter(torch.rand(2, channels, channels, *modes, 2) / channels**2)

    def forward(self, field: Tensor) -> Tensor:
        """Convolve a field of shape (batch, ny, nx, channels). If the field has fewer frequencies than the
        convolution has modes, only the lowest modes are used.

        The transform is a multiplication by the waves of the few frequencies that are kept, which is cheaper
        than a fast Fourier transform of the field.
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
            # Each frequency along x also represents its negative, except zero and the Nyquist frequency,
            # which equal their negatives.
            shares = (1 + (2 * k_x % nx).sign()).to(field)[:, None] / (ny * nx)
            lines = (waves_y.T @ (shares * mixed).flatten(2)).unflatten(2, (kept_x, -1))
            return parts_x.T @ torch.cat([lines.real, lines.imag], dim=2)


def _waves(frequencies: Tensor, size: int, like: Tensor) -> Tensor:
    """Return the waves exp(2πi k n / N) for the given frequencies k and the pixels n = 0 … N - 1, where N is
    ``size``. The result has shape (frequencies, N) and the precision and device of ``like``.
    """
    # The products k n are whole numbers. The products are first reduced modulo N, so that the angles stay
    # exact for fields of any size.
    turns = torch.outer(frequencies, torch.arange(size)) % size
    angle = (2 * math.pi / size) * turns.double()
    return torch.complex(angle.cos().to(like), angle.sin().to(like))


def _pointwise(convolution: nn.Conv2d, features: Tensor) -> Tensor:
    """Apply a 1 x 1 convolution to features of shape (..., channels)."""
    return functional.linear(features, convolution.weight[:, :, 0, 0], convolution.bias)


def _coordinates(layout: Tensor) -> Tensor:
    """Return the coordinates y and x of each pixel, scaled to 0 ... 1. The result has shape (batch, 2, ny,
    nx).
    """
    y, x = (
        torch.linspace(0, 1, size, device=layout.device, dtype=layout.dtype) for size in layout.shape[-2:]
    )
    grid = torch.stack(torch.meshgrid(y, x, indexing="ij"))
    return grid.expand(layout.shape[0], -1, -1, -1)
