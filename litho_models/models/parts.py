"""Parts from which modular models of printers are assembled. A part contains a function that turns one field,
such as a pattern, into the next field, such as a dose. It also contains the parameters of this function and a
reference for its formula.

Fields have shape (batch, 1, ny, nx). Their values are relative to the full dose or to the full height. The
field that a part returns may be cropped on each side by the receptive radius of the part.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError, damaged, require_known
from litho_data.foundation.hashes import file_sha256, record_sha256
from litho_data.foundation.plugins import foreign_sha256
from litho_data.readers.registry import require_file
from litho_models.layers.gaussian import gaussian_blur, kernel_radius_px
from litho_models.layers.ranges import Range
from litho_models.models.hopkins import Optics, imaged_inside, intensity, kernel_reach_px, spectra_of
from litho_models.simulator import crop_border

# If the resist changes by less than this between neighbouring pixels, there is no edge between them.
FLATTEST = 5e-3
# By default, the upper limit of a length parameter is this multiple of its starting value.
_WIDEST = 5.0
_BIAS_PX = 5.0
_CORNERS = 20.0
# The values of a part's parameters by name. Fitted values are tensors; other values are Python numbers.
Values = Mapping[str, Any]
Apply = Callable[[Tensor, Values, float], Tensor]


@dataclass(frozen=True)
class Number:
    """One parameter of a part.

    Attributes:
        start: starting value; ``unit``: unit of the parameter, or ``1`` if it has none.
        lower, upper: range of the parameter. If ``upper`` is None and the parameter is a length in µm, its
            upper limit is five times its starting value. If ``upper`` is None and the parameter has another
            unit, it has no upper limit.
        fitted: whether the parameter is fitted; otherwise it keeps its value.
    """

    start: float
    unit: str = "1"
    lower: float = 0.0
    upper: float | None = None
    fitted: bool = True

    def range_at(self, name: str, start: float) -> Range:
        """Return the range of the parameter in a fit that begins at ``start``."""
        upper = self.upper if self.upper is not None else _WIDEST * start if self.unit == "µm" else math.inf
        return Range(name, self.lower, upper)


@dataclass(frozen=True)
class Part:
    """A part of a model. It describes one stage of the printing process.

    Attributes:
        numbers: parameters of the part by name; ``source``: reference for the formula.
        data_sha256: hash of the file from which the part was made; empty if there is no such file.
        apply: function of (field, values of the parameters, pitch in µm) that returns the next field.
    """

    name: str
    numbers: Mapping[str, Number]
    apply: Apply
    source: str
    reach_px: Callable[[Values, float], int] = field(default=lambda values, pitch_um: 0)
    data_sha256: str = ""


def spot_radius_px(sigma_um: Tensor | float, pitch_um: float) -> int:
    """Return the radius of a Gaussian spot in pixels."""
    # The width is rounded to fewer digits, so that rounding errors of float32 cannot change the size of the
    # kernel.
    return kernel_radius_px(round(float(torch.as_tensor(sigma_um).detach()), 6) / pitch_um)


def illuminate(
    pattern: Tensor, spots: Sequence[tuple[Tensor | float, Tensor]], pitch_um: float, reach_px: int
) -> Tensor:
    """Expose a pattern with a spot that is a sum of Gaussians: Σ share · G_sigma. Return the dose, cropped by
    ``reach_px`` pixels on each side.

    The first Gaussian describes light or a fine beam. A second, wide Gaussian describes backscattered
    electrons (Chang, J. Vac. Sci. Technol. 12, 1271 (1975)). An optional third Gaussian has a width between
    those of the first two.

    Args:
        pattern: pattern to write, whose pixel pitch is ``pitch_um``, µm; ``spots``: share and standard
            deviation (µm) of each Gaussian.
        reach_px: width of the cropped border; at least the radius of the widest Gaussian.
    """
    total = torch.zeros(())
    for share, sigma_um in spots:
        radius = spot_radius_px(sigma_um, pitch_um)
        seen = crop_border(pattern, reach_px - radius)
        total = total + share * gaussian_blur(seen, sigma_um, pitch_um, edge=None, radius_px=radius)
    return total


def project(exposure: Tensor, steepness: Tensor, threshold: Tensor) -> Tensor:
    """Apply the response of a resist to the exposure. The response is a smooth threshold that maps 0 to 0 and
    1 to 1 (Wang et al. 2011, doi:10.1007/s00158-010-0602-y).
    """
    low = torch.tanh(steepness * threshold)
    return (low + torch.tanh(steepness * (exposure - threshold))) / (
        low + torch.tanh(steepness * (1 - threshold))
    )


def hill(exposure: Tensor, contrast: Tensor, threshold: Tensor) -> Tensor:
    """Return the share of the resist that a dose E converts: E^γ / (E^γ + η^γ), where γ is the contrast and η
    the threshold. If the dose equals the threshold, one half of the resist is converted.
    """
    turned = exposure.clamp(min=1e-6) ** contrast
    return turned / (turned + threshold**contrast)


def contrast_curve(exposure: Tensor, contrast: Tensor, clearing: Tensor) -> Tensor:
    """Return the depth that is developed after a dose E, as a share of the full depth: 1 + γ log₁₀(E / E₀),
    where γ is the contrast and E₀ the clearing dose. The share is limited to 0 ... 1. The corners of the
    curve at both limits are rounded, so that the curve is differentiable.
    """
    depth = 1 + contrast * torch.log10(exposure.clamp(min=1e-6) / clearing)
    return (functional.softplus(_CORNERS * depth) - functional.softplus(_CORNERS * (depth - 1))) / _CORNERS


def etch(resist: Tensor, threshold: Tensor | float, bias_um: Tensor | float, pitch_um: float) -> Tensor:
    """Return the share of each pixel's area that an etched film covers. The film remains where the resist
    exceeds the threshold. The result is cropped by one pixel on each side.

    The edge of the film is the line on which the resist crosses the threshold, moved outward by the bias. A
    pixel that the edge crosses is partly covered. The distance of a pixel from the edge is (resist -
    threshold) / |∇ resist| + bias, and the coverage is a sigmoid of this distance. The sigmoid is about one
    pixel wide.
    """
    slope_y = (resist[..., 2:, 1:-1] - resist[..., :-2, 1:-1]) / 2
    slope_x = (resist[..., 1:-1, 2:] - resist[..., 1:-1, :-2]) / 2
    slope = torch.sqrt(slope_y**2 + slope_x**2 + FLATTEST**2)
    return torch.sigmoid(4 * ((crop_border(resist, 1) - threshold) / slope + bias_um / pitch_um))


def _spots(values: Values) -> list[tuple[Tensor | float, Tensor]]:
    """Return the share and the standard deviation, µm, of each of the one to three Gaussians of a spot."""
    back, between = values.get("back_share", 0.0), values.get("between_share", 0.0)
    shares = {"sigma_um": (1 - back) * (1 - between), "back_um": back, "between_um": (1 - back) * between}
    return [(share, values[name]) for name, share in shares.items() if name in values]


def _spot_reach_px(values: Values, pitch_um: float) -> int:
    return max(spot_radius_px(sigma_um, pitch_um) for _, sigma_um in _spots(values))


def _by_spots(pattern: Tensor, values: Values, pitch_um: float) -> Tensor:
    return illuminate(pattern, _spots(values), pitch_um, _spot_reach_px(values, pitch_um))


def _diffuse(resist: Tensor, values: Values, pitch_um: float) -> Tensor:
    sigma_um = values["sigma_um"]
    radius = spot_radius_px(sigma_um, pitch_um)
    return gaussian_blur(resist, sigma_um, pitch_um, edge=None, radius_px=radius)


def _optics(values: Values) -> Optics:
    return Optics(**{**values, "kernels": int(values["kernels"])})


def _shrink(resist: Tensor, values: Values, pitch_um: float) -> Tensor:
    remaining = values["kappa_min"] + (1 - values["kappa_min"]) * _diffuse(resist, values, pitch_um)
    return crop_border(resist, spot_radius_px(values["sigma_um"], pitch_um)) * remaining


def kernels_part(name: str, file: str | Path) -> Part:
    """Make a part that images a mask M with coherent kernels h_k, which are read from an NPY file. The image
    is the intensity Σ_k |h_k * M|², scaled so that an open mask has intensity 1.

    Args:
        name: name of the part.
        file: NPY file with a real or complex array of shape (kernels, size, size), sampled at the pitch of
            the layout. The size is odd, and the middle pixel is the origin.

    Raises:
        InputError: the file does not exist, or its array has another shape or type.
    """
    with damaged(f"kernels {file}"):
        kernels = np.load(require_file(file), allow_pickle=False)
        size_px = kernels.shape[-1]
        odd = kernels.ndim == 3 and kernels.shape[1] == size_px and size_px % 2
        if not odd or not np.isfinite(kernels).all():
            got = f"{kernels.dtype} {kernels.shape}"
            raise InputError(
                f"kernels {file}",
                got=got,
                wanted="finite numbers of shape (kernels, size, size), with an odd size",
            )
    spectra = lru_cache(maxsize=2)(partial(spectra_of, kernels))

    def apply(pattern: Tensor, values: Values, pitch_um: float) -> Tensor:
        return imaged_inside(pattern, spectra(*pattern.shape[-2:]), size_px // 2)

    return Part(name, {}, apply, Path(file).name, lambda *_: size_px // 2, file_sha256(file))


_SIGMA = {"sigma_um": Number(0.2, "µm")}
_BACK = {"back_um": Number(0.6, "µm"), "back_share": Number(0.2, upper=0.9)}
_BETWEEN = {"between_um": Number(0.4, "µm"), "between_share": Number(0.1, upper=0.9)}
_THRESHOLD = {"threshold": Number(0.5, upper=1.0)}
_CONTRAST = {"contrast": Number(4.0), **_THRESHOLD}
_STATED = {
    "wavelength_um": Number(0.365, "µm", fitted=False),
    "na": Number(0.5, upper=1.0, fitted=False),
    "outer": Number(0.6, upper=3.0, fitted=False),
    "inner": Number(0.0, upper=3.0, fitted=False),
    "defocus_um": Number(0.0, "µm", -100.0, 100.0, fitted=False),
    "kernels": Number(12, upper=400, fitted=False),
}
_CHANG = "sum of Gaussians: Chang, J. Vac. Sci. Technol. 12, 1271 (1975)"


def _illumination(name: str, numbers: Mapping[str, Number]) -> Part:
    return Part(name, numbers, _by_spots, _CHANG, _spot_reach_px)


PARTS = {
    part.name: part
    for part in (
        _illumination("spot", _SIGMA),
        _illumination("two-spots", {**_SIGMA, **_BACK}),
        _illumination("three-spots", {**_SIGMA, **_BACK, **_BETWEEN}),
        Part(
            "lens",
            _STATED,
            lambda pattern, values, pitch: intensity(pattern, _optics(values), pitch),
            "partially coherent imaging: Hopkins, Proc. R. Soc. A 217, 408 (1953)",
            lambda values, pitch: kernel_reach_px(_optics(values), pitch),
        ),
        Part(
            "tanh",
            _CONTRAST,
            lambda dose, values, pitch: project(dose, values["contrast"], values["threshold"]),
            "projection of Wang et al. 2011, doi:10.1007/s00158-010-0602-y",
        ),
        Part(
            "hill",
            _CONTRAST,
            lambda dose, values, pitch: hill(dose, values["contrast"], values["threshold"]),
            "Hill curve: the share of resist that a dose converts, one half at the threshold",
        ),
        Part(
            "contrast-curve",
            {"contrast": Number(1.5), "clearing": Number(0.9, upper=3.0)},
            lambda dose, values, pitch: contrast_curve(dose, values["contrast"], values["clearing"]),
            "depth proportional to the logarithm of the dose: Mack, Fundamental Principles of Optical "
            "Lithography, 2007",
        ),
        Part(
            "inverted",
            {},
            lambda resist, values, pitch: 1 - resist,
            "a positive resist remains where a negative one is removed; an imprint inverts its master",
        ),
        Part(
            "diffusion",
            {"sigma_um": Number(0.1, "µm")},
            _diffuse,
            "Gaussian spread of the reaction products",
            lambda values, pitch: spot_radius_px(values["sigma_um"], pitch),
        ),
        Part(
            "shrinkage",
            {"sigma_um": Number(1.5, "µm"), "kappa_min": Number(0.5, upper=1.0)},
            _shrink,
            "the resist shrinks more where less is exposed nearby: arXiv:2309.17343, parameterized physics "
            "model",
            lambda values, pitch: spot_radius_px(values["sigma_um"], pitch),
        ),
        Part(
            "etch",
            {**_THRESHOLD, "bias_px": Number(0.0, "px", -_BIAS_PX, _BIAS_PX)},
            lambda resist, values, pitch: etch(resist, values["threshold"], values["bias_px"], 1.0),
            "the film remains under the resist, and its edge is moved by a bias",
            lambda values, pitch: 1,
        ),
        Part(
            "transfer",
            {"selectivity": Number(1.0)},
            lambda resist, values, pitch: values["selectivity"] * resist,
            "directional etching: the etched relief is proportional to the relief of the resist",
        ),
    )
}
# Maps the name of each registered part to the hash of its parameters, its data and its source.
REGISTERED: dict[str, str] = {}


def register_part(part: Part) -> Part:
    """Register a part. Models in this Python process can then use its name in their setting ``parts``.

    Raises:
        InputError: the name of the part is already taken.
    """
    if part.name in PARTS:
        raise InputError("part to register", got=part.name, wanted="a name that is not taken")
    PARTS[part.name] = part
    sources = foreign_sha256(part.apply), foreign_sha256(part.reach_px)
    REGISTERED[part.name] = record_sha256([repr(part.numbers), part.data_sha256, *sources])
    return part


def part_of(name: str) -> Part:
    """Return the part with this name.

    Raises:
        InputError: no part has this name.
    """
    require_known("part of a printer", name, PARTS)
    return PARTS[name]
