"""PBL as a first version would write it: what the speed of ours is measured against.

Float32 in NCHW, pointwise networks as 1 x 1 convolutions on every pixel, blurs by complex Fourier
transforms with a kernel made anew in each call, every stage of the size of the field. It computes no
margin around the field, which ours does, so the two agree farther than the receptive radius from the
edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from litho_models.layers.gaussian import kernel_radius_px
from litho_models.models.pbl import Pbl


class PlainPbl(nn.Module):
    """The default variant with a copy of the weights of ``pbl``; layout (b, 1, y, x) µm to height, µm."""

    def __init__(self, pbl: Pbl):
        super().__init__()
        self.config = pbl.config
        slope = pbl.config.leaky_slope
        areawise = [*pbl.mismatch.hidden, pbl.mismatch.last]
        self.thresh = _network(_linears(pbl.thresh), slope, padding=0)
        self.shrink = _network(_linears(pbl.shrink), slope, padding=0)
        self.mismatch = _network([(layer.weight, layer.bias) for layer in areawise], slope, padding=1)
        self.tau = nn.Parameter(pbl.tau.detach().clone())

    def forward(self, layout_um: Tensor) -> Tensor:
        initial = self._blur(
            layout_um,
            torch.tensor(self.config.sigma_optical_um, dtype=torch.float64, device=layout_um.device),
        )
        initial = initial + self.thresh(initial)
        dose = self._blur(initial, self.config.sigma_diffusion_max_um * torch.sigmoid(self.tau))
        product = initial * (1 + self.shrink(dose))
        return product + self.mismatch(product)

    def _blur(self, field: Tensor, sigma_um: Tensor) -> Tensor:
        radius = kernel_radius_px(float(sigma_um.detach()) / self.config.pitch_um)
        x_um = torch.arange(-radius, radius + 1, device=field.device) * self.config.pitch_um
        kernel = torch.exp(-(x_um[:, None] ** 2 + x_um[None, :] ** 2) / (2 * sigma_um**2))
        size = [length + 2 * radius for length in field.shape[-2:]]
        padded = F.pad(field, (radius,) * 4, mode="replicate")
        transfer = torch.fft.fft2(kernel / kernel.sum(), s=size)
        blurred = torch.fft.ifft2(torch.fft.fft2(padded) * transfer).real
        return blurred[..., 2 * radius :, 2 * radius :]


def _linears(net: nn.Module) -> list[tuple[Tensor, Tensor]]:
    return [(m.weight[:, :, None, None], m.bias) for m in net.modules() if isinstance(m, nn.Linear)]


def _network(layers: Sequence[tuple[Tensor, Tensor]], slope: float, padding: int) -> nn.Sequential:
    """Convolutions with copies of the weights, leaky ReLU between them."""
    return nn.Sequential(*list(_with_activations(layers, slope, padding))[:-1])


def _with_activations(
    layers: Iterable[tuple[Tensor, Tensor]], slope: float, padding: int
) -> Iterable[nn.Module]:
    for weight, bias in layers:
        outputs, inputs, size, _ = weight.shape
        convolution = nn.Conv2d(inputs, outputs, size, padding=padding)
        convolution.weight.data = weight.detach().clone(memory_format=torch.contiguous_format)
        convolution.bias = nn.Parameter(bias.detach().clone())
        yield convolution
        yield nn.LeakyReLU(slope)
