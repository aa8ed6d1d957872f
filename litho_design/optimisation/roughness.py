"""The rough surface of a print as a part of its spread: σ of each level, and its correlation."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.commands.settings import setting
from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM

if TYPE_CHECKING:
    from torch import Tensor


class Roughness(Record):
    """Spread of the surface about the print as modelled; none by default.

    ``sigma_um`` is the standard deviation at a height of 0, 1, 2, … nominal levels, or one number for all;
    between levels it follows a straight line, beyond the last it stays. The surface is Gaussian, and its
    correlation falls exponentially along both axes, to 1/e over ``length_um`` (y, x).
    """

    sigma_um: tuple[float, ...] = setting(
        (), "Spread of the surface at each level, or one for all", unit="µm"
    )
    length_um: tuple[float, float] = setting(
        (0.3, 0.3), "Length over which the surface hangs together, y and x", unit="µm"
    )
    level_height_um: float = setting(0.1, "Nominal height of a level", unit="µm", gt=0)

    def surface_um(self, height_um: Tensor, unit: Tensor) -> Tensor:
        """A surface with the spread that a print of this height has; no gradient runs through the spread.

        Args:
            height_um: the print, (ny, nx).
            unit: ``unit_surface`` of its shape.
        """
        import torch

        sigma = torch.tensor(self.sigma_um, dtype=height_um.dtype, device=height_um.device)
        if sigma.numel() > 1:
            at = (height_um.detach() / self.level_height_um).clamp(0, sigma.numel() - 1)
            below = at.floor().long().clamp(max=sigma.numel() - 2)
            sigma = torch.lerp(sigma[below], sigma[below + 1], at - below)
        return sigma * unit.to(height_um)

    def unit_surface(self, shape: tuple[int, ...], pitch_um: float, seed: list[int]) -> Tensor:
        """A surface of unit variance and this correlation, (ny, nx), float32; the same for the same seed.

        A first-order recursion along each axis, whose correlation is exponential at any pitch.
        """
        import torch
        from scipy.signal import lfilter

        surface = np.random.default_rng(seed).standard_normal(shape)
        for axis, length_um in enumerate(self.length_um):
            kept = math.exp(-pitch_um / length_um) if length_um > 0 else 0.0
            # The first value has the variance that the recursion keeps: no run-in.
            first = np.take(surface, [0], axis)
            surface = math.sqrt(1 - kept**2) * surface
            surface[(slice(None),) * axis + (slice(0, 1),)] = first
            surface = lfilter([1.0], [1.0, -kept], surface, axis=axis)
        return torch.from_numpy(surface.astype(np.float32))


def measured_roughness(path: str | Path, level_height_um: float) -> Roughness:
    """The roughness of measured prints, from the ``noise.json`` of ``litho-models noise --residuals``.

    σ is that of the places where the layout is flat, by level, each scan freed of tilt, gain and lines: an
    upper estimate, as microscope and what the model gets wrong are in it. Levels between measured ones are on
    a straight line, those beyond take the nearest.

    Args:
        path: ``noise.json`` or its folder.
        level_height_um: nominal height of a level of the design.

    Raises:
        InputError: no such file, or one without a budget of the noise.
    """
    file = Path(path)
    file = file / "noise.json" if file.is_dir() else file
    hint = "litho-models noise STORE --residuals BENCHMARK --out DIR"
    try:
        budget = json.loads(file.read_text(encoding="utf-8"))["budget"]
        rows = {row["level"]: row["sigma_nm"] / NM_PER_UM for row in budget["flat_levels"]}
        length_y_um, length_x_um = budget["flat_length_um"]
    except OSError as error:
        raise InputError(
            "roughness", got=f"{file}: {error.strerror}", wanted="a noise.json", hint=hint
        ) from None
    except (ValueError, KeyError, TypeError):
        raise InputError(
            "roughness",
            got=f"{file} without a budget of the noise",
            wanted="a noise.json of today",
            hint=hint,
        ) from None
    levels = np.arange(max(rows) + 1)
    sigma = np.interp(levels, sorted(rows), [rows[level] for level in sorted(rows)])
    return Roughness(
        sigma_um=tuple(sigma.tolist()), length_um=(length_y_um, length_x_um), level_height_um=level_height_um
    )
