"""FNO: the Fourier neural operator, the paper's learned simulator without physics inside.

arXiv:2309.17343, appendix "Fourier Neural Operator": the two-dimensional operator of Li et al. 2020
(arXiv:2010.08895) with 12 x 12 modes and width 24. A layer adds a product in Fourier space, which sees
the whole image, to a local convolution. It is periodic in the image and its modes count periods per
image, so it answers differently for another image size: ``default`` runs it on tiles of one size.
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

# Ninety times the paper's number, 0.5 GB of weights: a card may not ask more of the machine that loads it.
_MOST_MATRIX_ENTRIES = 30_000_000
_ALL = slice(None)


class FnoConfig(SimulatorConfig):
    layers: int = Field(4, ge=1, le=64)
    # Frequencies kept along y (both signs) and x.
    modes: tuple[PositiveInt, PositiveInt] = (12, 12)
    width: int = Field(24, ge=1, le=1024, description="channels of the layers")
    projection_channels: int = Field(128, ge=1, le=4096, description="hidden channels of the last layers")
    # 1 x 1 in the paper: what the kept modes do not resolve can then only be mapped pixel by pixel.
    local_px: int = Field(3, ge=1, le=15, description="side of the local convolution, odd")
    coordinates: bool = Field(False, description="y and x on 0 ... 1 of the image as further inputs")
    padding_fraction: float = Field(0.0, ge=0, le=1, description="zeros at bottom and right, share of image")
    padding_px: int = Field(0, ge=0, le=4096, description="zeros at bottom and right of an image of any size")
    tile_px: int | None = Field(128, ge=8, le=4096, description="side of a tile; None: the whole image")
    overlap_px: int = Field(32, ge=0, description="blended pixels of neighbouring tiles, at most half a tile")
    # Start as the layout and learn what differs; the paper's network starts at random.
    starts_as_layout: bool = True

    _PUBLISHED: ClassVar[dict[str, Any]] = {
        "local_px": 1,
        "coordinates": True,
        "tile_px": None,
        "starts_as_layout": False,
    }
    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {
        # 9 px of the published quadrants of 256 px.
        "paper": {**_PUBLISHED, "padding_fraction": 9 / 256},
        "authors": {**_PUBLISHED, "padding_px": 9, "width": 12},
    }

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        if self.local_px % 2 == 0:
            raise ValueError("local_px has to be odd")
        if self.layers * self.width**2 * self.modes[0] * self.modes[1] > _MOST_MATRIX_ENTRIES:
            raise ValueError(f"more than {_MOST_MATRIX_ENTRIES:g} entries in layers · width² · modes")
        return self


class Fno(Simulator):
    """H = Q(L₄ ∘ … ∘ L₁(P(M, y, x))) with L(v) = gelu(local(v) + spectral(v)), no gelu after the last.

    P lifts each pixel to ``width`` channels, Q maps them to a height through one hidden layer. With
    ``starts_as_layout`` this is added to M, and is zero at the start. Where the config has a tile,
    ``interior`` is the height of one tile, taken as periodic, and the field is blended from tiles.
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

    def interior(self, layout_um: Tensor, rows: slice = _ALL) -> Tensor:
        """Height of an image taken as a whole, the same size, (batch, 1, y, x) µm, or of some ``rows`` of it.

        All rows pass through every layer but the last; the last one, and what follows, see only ``rows``.
        """
        config = self.config
        ny, nx = layout_um.shape[-2:]
        # Heights need full precision where they enter and leave, also under autocast. Channels last:
        # products over channels and over frequencies are then plain matrix products.
        with torch.autocast(device_type=layout_um.device.type, enabled=False):
            inputs = torch.cat([layout_um, _coordinates(layout_um)], 1) if config.coordinates else layout_um
            features = _pointwise(self.lift, inputs.permute(0, 2, 3, 1))
        padding = [config.padding_px + round(config.padding_fraction * size) for size in (nx, ny)]
        if any(padding):
            features = functional.pad(features, (0, 0, 0, padding[0], 0, padding[1]))
        rows = slice(*rows.indices(ny))
        for number, (spectral, local) in enumerate(zip(self.spectral, self.local, strict=True)):
            last = number == config.layers - 1
            wanted = rows if last else _ALL
            features = spectral(features, local(features, wanted), wanted)
            if not last:
                features = functional.gelu(features)
        features = features[:, :, :nx]
        pixels = features.reshape(-1, config.width)
        parameters = (*self.hidden.parameters(), *self.last.parameters())
        height = at_each_pixel(self._project, pixels, parameters=parameters)
        height = height.reshape(features.shape[:3]).unsqueeze(1)
        return layout_um[..., rows, :] + height if config.starts_as_layout else height

    def _project(self, features: Tensor) -> Tensor:
        """The last layers: a height (n,) from features (n, width)."""
        hidden = functional.gelu(_pointwise(self.hidden, features))
        with torch.autocast(device_type=features.device.type, enabled=False):
            return _pointwise(self.last, hidden.to(self.last.weight.dtype))[:, 0]

    def forward(self, layout_um: Tensor) -> Tensor:
        """Height of the whole field, (batch, 1, y, x) µm."""
        return self.inside(layout_um, 0)

    def inside(self, layout_um: Tensor, border_px: int) -> Tensor:
        if self.tile is None:
            return crop_border(self.interior(layout_um), border_px)
        return blend_tiles(self.interior, layout_um, self.tile, border_px)


class PeriodicConvolution(nn.Conv2d):
    """A convolution of a periodic image, (b, y, x, channels) to the same shape, or to some rows of it."""

    def forward(self, features: Tensor, rows: slice = _ALL) -> Tensor:
        margin = self.kernel_size[0] // 2
        wide = _Continued.apply(features, margin) if margin else features
        start, stop, _ = rows.indices(features.shape[1])
        wide = wide[:, start : stop + 2 * margin]
        return super().forward(wide.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class _Continued(torch.autograd.Function):
    """A periodic image (b, y, x, channels) continued by a margin on all sides.

    PyTorch's own backward pass makes a field of zeros for each of the four slices.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, margin: int) -> Tensor:
        ctx.margin = margin
        batch, ny, nx, channels = features.shape
        wide = features.new_empty(batch, ny + 2 * margin, nx + 2 * margin, channels)
        wide[:, margin:-margin, margin:-margin] = features
        tall = wide[:, margin:-margin]
        tall[:, :, :margin], tall[:, :, -margin:] = features[:, :, -margin:], features[:, :, :margin]
        wide[:, :margin], wide[:, -margin:] = wide[:, -2 * margin : -margin], wide[:, margin : 2 * margin]
        return wide

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        margin: int = ctx.margin
        tall = gradient[:, :, margin:-margin].clone()
        tall[:, :, -margin:] += gradient[:, :, :margin]
        tall[:, :, :margin] += gradient[:, :, -margin:]
        inner = tall[:, margin:-margin]
        inner[:, -margin:] += tall[:, :margin]
        inner[:, :margin] += tall[:, -margin:]
        return inner, None


class SpectralConvolution(nn.Module):
    """A matrix over channels for each of the lowest frequencies: v̂'(k) = W(k) v̂(k), all others zero.

    The weights are real, (sign of k_y, in, out, modes y, modes x, real and imaginary part), so that
    they can be stored and cast like any other parameter.
    """

    def __init__(self, channels: int, modes: tuple[int, int]):
        super().__init__()
        self.weight = nn.Parameter(torch.rand(2, channels, channels, *modes, 2) / channels**2)

    def forward(self, field: Tensor, onto: Tensor, rows: slice = _ALL) -> Tensor:
        """Convolve a field (b, y, x, channels) and add it to ``onto``, of the same shape or some rows of it.

        An image smaller than the modes keeps those it has.

        So few frequencies are kept that products with the matrices of the discrete Fourier transform
        cost less than fast transforms, which compute them all.
        """
        ny, nx, channels = field.shape[1:]
        kept_y = min(self.weight.shape[3], ny // 2)
        kept_x = min(self.weight.shape[4], nx // 2 + 1)
        with torch.autocast(device_type=field.device.type, enabled=False):
            field = field.to(self.weight.dtype)
            cos_y, sin_y = _waves(torch.arange(kept_y + 1), ny, field)
            cos_x, sin_x = _waves(torch.arange(kept_x), nx, field)
            waves_y, waves_x = torch.cat([cos_y, -sin_y]), torch.cat([cos_x, sin_x])

            along_y = waves_y @ field.reshape(-1, ny, nx * channels)
            along_x = waves_x @ along_y.reshape(-1, 2, kept_y + 1, nx, channels)
            cosine, sine = along_x.split(kept_x, dim=-2)
            # The field is real: along y, the sum for -k_y is the conjugate of the one for k_y.
            above = torch.complex(cosine[:, 0] + sine[:, 1], cosine[:, 1] - sine[:, 0])
            below = torch.complex(cosine[:, 0] - sine[:, 1], -cosine[:, 1] - sine[:, 0])
            spectra = torch.stack([above, below])
            mixed = torch.einsum("sbyxi,sioyx->sbyxo", spectra, self._matrices(kept_y, kept_x))

            # Every frequency along x but the first and the last possible one stands for its negative too.
            shares = torch.full((kept_x, 1), 2.0 / (ny * nx), dtype=field.dtype, device=field.device)
            shares[0] /= 2
            if 2 * (kept_x - 1) == nx:
                shares[-1] /= 2
            even, odd = shares * mixed.sum(0), shares * (mixed[0] - mixed[1])
            real = torch.cat([cos_x, -sin_x]).T @ torch.cat([even.real, even.imag], dim=-2)
            imaginary = torch.cat([sin_x, cos_x]).T @ torch.cat([odd.real, odd.imag], dim=-2)
            lines = torch.cat([real, imaginary], dim=1).reshape(-1, 2 * (kept_y + 1), nx * channels)
            back_y = waves_y.T[rows].expand(len(lines), -1, -1)
            onto = onto.to(field.dtype).reshape(*back_y.shape[:2], nx * channels)
            return torch.baddbmm(onto, back_y, lines).reshape(*back_y.shape[:2], nx, channels)

    def _matrices(self, kept_y: int, kept_x: int) -> Tensor:
        """Matrices for k_y and -k_y, k_y from 0 to ``kept_y``, complex (2, in, out, k_y, k_x).

        Two are zero: that for -0, because 0 is kept once, and that for +``kept_y``, which is not kept.
        """
        positive, negative = torch.view_as_complex(self.weight)[..., :kept_x]
        above = functional.pad(positive[:, :, :kept_y], (0, 0, 0, 1))
        # The rows of negative frequencies end with -1.
        below = functional.pad(negative.flip(2)[:, :, :kept_y], (0, 0, 1, 0))
        return torch.stack([above, below])


def _waves(frequencies: Tensor, size: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """cos and sin of 2π k n / N, (frequencies, N), of the dtype and device of ``like``."""
    # The product is reduced to one period as whole numbers: angles stay exact at any size.
    turns = torch.outer(frequencies, torch.arange(size)) % size
    angle = turns.double() * (2 * math.pi / size)
    return angle.cos().to(like), angle.sin().to(like)


def _pointwise(convolution: nn.Conv2d, features: Tensor) -> Tensor:
    """A 1 x 1 convolution with the channels last."""
    return functional.linear(features, convolution.weight[:, :, 0, 0], convolution.bias)


def _coordinates(layout: Tensor) -> Tensor:
    """y and x of each pixel on 0 ... 1, (batch, 2, y, x)."""
    y, x = (
        torch.linspace(0, 1, size, device=layout.device, dtype=layout.dtype) for size in layout.shape[-2:]
    )
    grid = torch.stack(torch.meshgrid(y, x, indexing="ij"))
    return grid.expand(layout.shape[0], -1, -1, -1)
