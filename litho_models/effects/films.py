"""Effects and laws of films. They move the edges of a written, developed or etched film that is seen from
above. A law is a short formula without a known cause.

Lengths are in pixels of the layout. These pixels are fine enough to resolve the blur of the beam or lens.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from litho_data.foundation import Array
from litho_models.effects.effect import (
    FieldContext,
    Parameter,
    Values,
    of_development,
    of_exposure,
    of_resist,
)
from litho_models.effects.filters import add_blur, add_scattered, add_warp, local_mean
from litho_models.models.parts import etch

# ``_NORMAL_PX``: standard deviation of the blur that is applied before the normals of edges are computed.
# ``_RIM_PX``: standard deviation of the blur that is applied before a sharp edge is located.
# ``_DIFFUSION_REACH_PX``: largest distance to which diffusion reaches.
_NORMAL_PX, _RIM_PX, _DIFFUSION_REACH_PX = 1.0, 1.6, 50.0
# No point on a straight edge is farther than this from the nearest crossing of the edge with the grid of
# pixels.
_BESIDE_PX = 0.75
# A film is flat at all points that are farther than this from its edges.
_FLAT_PX = 1.7


@of_exposure(
    "electrons scattered back from the substrate",
    {
        "weight": Parameter("1", 0.0, 1.5, 0.1),
        "length_px": Parameter("px", 8.0, 280.0, 25.0, "shape", tried=(14.0, 28.0, 56.0, 112.0)),
    },
    of_films=True,
    separating="write one feature alone and inside dense surroundings of three sizes",
)
def electron_backscatter(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Add the dose that the substrate scatters back into the film; see ``add_scattered``.

    This is the second Gaussian of the proximity function (Chang, J. Vac. Sci. Technol. 12, 1271, 1975).
    """
    return add_scattered(layout, values["weight"], values["length_px"], 1.0)


@of_resist(
    "reaction products spreading before the edge forms",
    {"variance_px2": Parameter("px²", 0.0, 150.0, 8.0, tried=(8.0, 45.0))},
    of_films=True,
    separating="write necks and islands of five widths, at two baking times",
)
def resist_diffusion(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Blur the film by a Gaussian of variance s², and place the new edge where the blurred film is
    one half.

    Acid or reactants diffuse in a resist of high contrast, whose threshold is one half.
    """
    full = context.full_height_um

    def edged(variance_px2: Tensor) -> Tensor:
        # A sharp edge does not show where within a pixel it lies. The film is therefore slightly blurred in
        # both cases, with and without diffusion.
        blurred = add_blur(height / full, variance_px2 + _RIM_PX**2, 1.0, _DIFFUSION_REACH_PX)
        return full * etch(functional.pad(blurred, (1,) * 4, mode="replicate"), 0.5, 0.0, 1.0)

    variance = values["variance_px2"]
    return height + edged(variance) - edged(0 * variance)


@of_development(
    "edges shifted in etching or development",
    {"bias_px": Parameter("px", -8.0, 8.0, 1.4, tried=(1.0, -1.0))},
    of_films=True,
    separating="write one layout at five doses; a bias does not depend on the dose",
)
def etch_bias(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Move edges outwards by the bias.

    Lateral etching has a constant rate, which depends neither on the dose nor on the surroundings.
    """
    return _moved(height, values["bias_px"], context)


_AS_LAW: dict[str, Any] = {
    "role": "undetermined",
    "separating": "write straight edges beside bare ground and beside films of three widths, at five doses",
    "knowledge": "law",
}
edge_shift = replace(etch_bias, name="edge-shift", title="edges shifted outwards by a constant", **_AS_LAW)


# If the length were greater than this range allows, the mean would be nearly the same at all edges of a
# field, and the law could not be distinguished from a constant shift.
_DENSITY_PX = Parameter("px", 10.0, 45.0, 25.0, "shape", tried=(15.0, 45.0))


@of_development(
    "edges shifted outwards by 2 M̄ - 1, which is 0 at a straight edge",
    {**etch_bias.parameters, "length_px": _DENSITY_PX},
    of_films=True,
    **_AS_LAW,
)
def edge_shift_by_density(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Move edges outwards by bias · (2 M̄ - 1), where M̄ is the (Gaussian-weighted) fraction of the area near
    the edge that the film covers. If the bias is positive, edges with little film nearby therefore move
    inwards.
    """
    nearby = local_mean(height, values["length_px"], 1.0) / context.full_height_um
    return _moved(height, values["bias_px"] * (2 * nearby[0, 0] - 1), context)


FILM_LAWS = {law.name: law for law in (edge_shift, edge_shift_by_density)}


def _moved(height: Tensor, outwards_px: Tensor, context: FieldContext) -> Tensor:
    """Move the edges of a film outwards along their normals. Films that are narrower than twice an inward
    shift vanish, and so do gaps that are narrower than twice an outward shift. If the shift widens a film or
    gap that was narrower than twice ``_FLAT_PX``, the result is up to 0.8 px too narrow. An edge moves too
    little if its transition from film to gap extends farther than ``_FLAT_PX`` to each side.
    """
    share = height[0, 0].detach() / context.full_height_um
    reach_px = float(outwards_px.detach().abs().max()) + _FLAT_PX + 1
    distance, normal = map(torch.from_numpy, _from_edge(share.double().cpu().numpy(), reach_px))
    distance, normal = distance.to(height), normal.to(height)
    wanted = distance + outwards_px
    # Farther than ``_FLAT_PX`` from its edge, a film is flat. Values are therefore looked up no farther from
    # the edge than necessary, because another edge may lie farther away.
    most = torch.where(wanted * distance > 0, distance.abs().clamp(min=_FLAT_PX), _FLAT_PX)
    flat, farthest = (wanted.abs() - _FLAT_PX).clamp(0, 1), torch.sign(wanted) * most
    # Without a shift, every pixel farther than ``_FLAT_PX`` from its edge lies exactly on the lower or upper
    # limit. The derivative at these pixels is taken for a shift outwards.
    nearer = wanted.clamp(min=-most)
    nearer = torch.where(nearer < most, nearer, most)
    inwards = nearer + flat * (farthest - nearer) - distance
    return add_warp(height, inwards * normal[0], inwards * normal[1], 1.0)


def _from_edge(share: Array, reach_px: float) -> tuple[Array, Array]:
    """Return the signed distance of each pixel from the nearest edge of a film, and for each pixel the unit
    vector along which this distance increases.

    The distance is in px and positive on the film; the array has shape (ny, nx). The unit vectors are an
    array of shape (2, ny, nx). For pixels farther than ``reach_px`` from an edge, the distance is
    ±``reach_px`` and the vector is zero.

    Args:
        share: fraction of each pixel that the film covers, of shape (ny, nx). Edges lie where it is one half.
    """
    points, normals = _crossings(share)
    distance, normal = np.where(share > 0.5, reach_px, -reach_px), np.zeros((2, *share.shape))
    pixels = np.moveaxis(np.indices(share.shape, float), 0, -1)
    away_px, nearest = cKDTree(points).query(pixels, distance_upper_bound=reach_px)
    near = nearest < len(points)
    index = nearest[near]
    away, along = pixels[near] - points[index], normals[index]
    inwards = (away * along).sum(-1)
    # At a corner, the pixel does not lie on the normal through the nearest point of the edge.
    corner = np.linalg.norm(away - inwards[:, None] * along, axis=-1) > _BESIDE_PX
    signed = np.where(share[near] > 0.5, 1, -1) * away_px[near].clip(1e-9)
    distance[near] = np.where(corner, signed, inwards)
    normal[:, near] = np.where(corner, away.T / signed, along.T)
    return distance, normal


def _crossings(share: Array) -> tuple[Array, Array]:
    """Return the points at which the edges of a film cross the lines of the pixel grid, in px, and the unit
    normals at these points, which point into the film. Both arrays have shape (n, 2).
    """
    slopes = np.stack(np.gradient(gaussian_filter(share, _NORMAL_PX)), -1)
    crossed = [np.argwhere(np.diff(share > 0.5, axis=axis)) for axis in (0, 1)]
    pixel = np.concatenate(crossed)
    step = np.repeat(np.eye(2, dtype=int), [len(one) for one in crossed], axis=0)
    here, there = tuple(pixel.T), tuple((pixel + step).T)
    points = pixel + ((0.5 - share[here]) / (share[there] - share[here]))[:, None] * step
    slope = slopes[here] + slopes[there]
    return points, slope / np.linalg.norm(slope, axis=-1, keepdims=True).clip(1e-12)
