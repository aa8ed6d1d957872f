"""Measurement: the tip of the microscope, whose flanks touch before its end does."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from litho_models.effects.effect import FieldContext, Parameter, Values, of_microscope

# Cubic interpolation half-way between four neighbours.
_MIDDLE = (-1 / 16, 9 / 16, 9 / 16, -1 / 16)
_SHARPEST_UM = 1e-3
# Of the radius, along the sharper axis of an asymmetric tip.
_SHARPER = 0.25


@of_microscope(
    "tip of finite radius widening tops",
    {
        "radius_um": Parameter("µm", 0.0, 2.0, 0.04),
        "along": Parameter("1", _SHARPER, 1.0, 1.0, "choice"),
        "across": Parameter("1", _SHARPER, 1.0, 1.0, "choice"),
    },
    trials=(
        {"radius_um": 0.04},
        {"radius_um": 0.4},
        {"radius_um": 0.4, "across": _SHARPER},
        {"radius_um": 0.4, "along": _SHARPER},
    ),
    source="dilation by a paraboloid; a worn tip is far blunter than a new one, often along one axis",
    separating="scan again with a new tip, or turned if it is asymmetric; scan a tip characteriser",
    of_tip=True,
)
def tip_dilation(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """max over u of H(x - u) - u² / 2R, the path of a paraboloid; H + R |grad H|² / 2 to first order.

    A tip may be sharper along the scan lines or across them: ``along`` and ``across`` are shares of R.
    """
    radius = values["radius_um"]
    # The formula divides by the radius: a sharper tip is taken in proportion, down to none at all.
    blunt = radius.clamp(min=_SHARPEST_UM)
    # A paraboloid is the sum of two parabolas: the axes take their maxima one after the other.
    across, along = blunt * values["across"], blunt * values["along"]
    columns_done = _dilate_rows(height.transpose(-1, -2), across, context.pitch_um).transpose(-1, -2)
    dilated = _dilate_rows(columns_done, along, context.pitch_um)
    return height + radius / blunt * (dilated - height)


def _dilate_rows(height: Tensor, radius_um: Tensor, pitch_um: float) -> Tensor:
    """Dilation of rows (..., x) by a parabola; the surface is straight between half pixels.

    On a straight piece of slope s the tip touches at the distance R s from its axis, or at the end of
    the piece that is nearest to it.
    """
    half_um, size = pitch_um / 2, height.shape[-1]
    middles = _middles(height)
    # Pieces to the right of each pixel, then of each middle.
    slopes = (middles - height) / half_um, (_next(height) - middles) / half_um
    steepest = max(float(s.detach().abs().max()) for s in slopes)
    reach_px = min(math.ceil(float(radius_um.detach()) * steepest / pitch_um) + 1, size)
    starts = [_continued(part, reach_px, "replicate") for part in (height, middles)]
    rises = [_continued(part, reach_px, "constant") for part in slopes]
    # A maximum changes as the piece does on which it stands: the search needs no gradient, for which every
    # piece would have to be kept.
    with torch.no_grad():
        highest, on = height, torch.zeros_like(height, dtype=torch.int32)
        touches = [radius_um * slope for slope in rises]
        bend = float(-0.5 / radius_um)
        for offset in range(-2 * reach_px, 2 * reach_px):
            away_px, middle = divmod(offset, 2)
            start, slope, touch = (
                part[middle][..., reach_px + away_px :][..., :size] for part in (starts, rises, touches)
            )
            near_um = offset * half_um
            touch = touch.clamp(near_um, near_um + half_um)
            tip = start.add(slope, alpha=-near_um).addcmul_(touch, slope.add(touch, alpha=bend))
            on.masked_fill_(tip > highest, offset)
            highest = torch.maximum(highest, tip)
    piece = on + 2 * (torch.arange(size, device=height.device) + reach_px)
    start, slope = (torch.stack(part, dim=-1).flatten(-2).gather(-1, piece) for part in (starts, rises))
    begins_um = on.to(height.dtype) * half_um
    touch = (radius_um * slope).clamp(begins_um, begins_um + half_um)
    return start + slope * (touch - begins_um) - touch**2 / (2 * radius_um)


def _middles(rows: Tensor) -> Tensor:
    """Values (..., x) half a pixel to the right of each: the cubic through four neighbours."""
    padded = torch.cat([rows[..., :1], rows, rows[..., -1:], rows[..., -1:]], dim=-1)
    middles = padded.unfold(-1, len(_MIDDLE), 1) @ rows.new_tensor(_MIDDLE)
    return torch.cat([middles[..., :-1], rows[..., -1:]], dim=-1)


def _next(rows: Tensor) -> Tensor:
    return torch.cat([rows[..., 1:], rows[..., -1:]], dim=-1)


def _continued(rows: Tensor, by_px: int, mode: str) -> Tensor:
    return functional.pad(rows, (by_px, by_px, 0, 0), mode=mode)
