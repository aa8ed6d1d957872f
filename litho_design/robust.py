"""Process window: how a design fares when the print and the bench are not exactly as modelled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from litho_data.results import Record
from litho_design.optics import Optics
from litho_design.parametrise import LayoutSettings

_NARROWEST_BLUR_PX = 0.2


class ProcessWindow(Record):
    """Spread of print and bench, and how a search weighs it.

    ``gain_sd`` is relative to the printed height, ``blur_sd_um`` the scale of a half-normal extra
    blur. A search with ``samples`` above 0 minimises mean + weight * sd of the loss over as many
    draws (``mean-sd``), or the mean of the worst ``tail`` share of them (``cvar``); the draws are
    the same in every iteration. The defaults are a guess to be replaced by figures of the own
    printer: the fields of one measured data set spread by a few per cent in gain.
    """

    gain_sd: float = Field(default=0.03, ge=0)
    offset_sd_um: float = Field(default=0.02, ge=0)
    blur_sd_um: float = Field(default=0.05, ge=0)
    defocus_sd_um: float = Field(default=3.0, ge=0)
    wavelength_sd_um: float = Field(default=0.0, ge=0)
    samples: int = Field(default=0, ge=0)
    risk: Literal["mean-sd", "cvar"] = "cvar"
    weight: float = Field(default=1.0, ge=0)
    tail: float = Field(default=0.25, gt=0, le=1)
    seed: int = 0


@dataclass(frozen=True)
class Draw:
    """One print on one bench."""

    gain: float
    offset_um: float
    blur_um: float
    optics: Optics

    def apply(self, height_um: Tensor, layout: LayoutSettings) -> Tensor:
        """The height (size, size), µm, as this draw prints it.

        A uniform offset is a uniform phase and changes no image; it is kept for scores of heights.
        """
        changed = height_um * self.gain + self.offset_um
        sigma_px = self.blur_um / layout.pitch_um
        return changed if sigma_px < _NARROWEST_BLUR_PX else _blur(changed, sigma_px)


def draws(window: ProcessWindow, optics: Optics, count: int) -> list[Draw]:
    """``count`` draws from ``window.seed``; the first ``k`` of a longer list are those of a shorter one."""
    normal = np.random.default_rng(window.seed).standard_normal((count, 5)).tolist()
    return [
        Draw(
            gain=1 + window.gain_sd * gain,
            offset_um=window.offset_sd_um * offset,
            blur_um=abs(window.blur_sd_um * blur),
            optics=optics.model_copy(
                update={
                    "distance_um": optics.distance_um + window.defocus_sd_um * defocus,
                    "wavelength_um": optics.wavelength_um + window.wavelength_sd_um * wavelength,
                }
            ),
        )
        for gain, offset, blur, defocus, wavelength in normal
    ]


def risk(losses: Tensor, window: ProcessWindow) -> Tensor:
    """One figure of many losses: mean + weight * sd, or the mean of the worst share."""
    if window.risk == "mean-sd":
        return losses.mean() + window.weight * losses.std(correction=0)
    worst = max(1, round(window.tail * losses.numel()))
    return losses.topk(worst).values.mean()


def _blur(image: Tensor, sigma_px: float) -> Tensor:
    """Gaussian blur with mirrored borders."""
    half = int(4 * sigma_px) + 1
    x = torch.arange(-half, half + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-(x**2) / (2 * sigma_px**2))
    kernel = kernel / kernel.sum()
    padded = torch.nn.functional.pad(image[None, None], (half,) * 4, mode="reflect")
    rows = torch.nn.functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return torch.nn.functional.conv2d(rows, kernel.view(1, 1, -1, 1))[0, 0]
