"""The process window. It describes random deviations of prints from the model's prediction and random
deviations of the optics from the settings. The module also measures the disagreement of several models.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from litho_data.commands.settings import leaves, setting
from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_data.foundation.results import Record
from litho_design.optics import Optics, sampling_limit_um
from litho_design.optics.source import coherent_parts
from litho_design.optics.thin_element import check_incidence

if TYPE_CHECKING:
    from torch import Tensor

_NARROWEST_BLUR_PX = 0.2
# Limits for the scores of a random print, compared with the modelled scores, i.e. the scores of the print
# that the model predicts. The print passes if each score in dB is lower by at most the first value, if every
# other score is at least the second value times the modelled score, and if no error exceeds the modelled
# error divided by the second value.
PASS_DROP_DB, PASS_SHARE = 1.0, 0.9
_UNSEEN_STREAM = 1
# This is (1e-6 µm)^2. It is far below the variance of any height, and it keeps the square root differentiable
# where all models agree.
_SMALLEST_VARIANCE_UM2 = 1e-12
_SPREADS = ("gain_sd", "offset_sd_um", "blur_sd_um", "defocus_sd_um", "wavelength_sd_um")


class ProcessWindow(Record):
    """The standard deviations with which prints and optics vary, and the way in which a search uses them.

    ``gain_sd`` is relative to the printed height. The width of the additional blur has a half-normal
    distribution with the scale ``blur_sd_um``. If ``samples`` is above 0, a search uses this number of draws,
    which are the same in every iteration. The search minimises the mean loss over the worst draws; ``tail``
    is the share of all draws that count as the worst. The default spreads are guesses; replace them with the
    spreads of your printer. In one measured data set, the gain varies by 13 % between write fields, but part
    of this variation comes from the changing scale of the microscope.
    """

    FORMER: ClassVar[frozenset[str]] = frozenset(
        {"risk", "weight", "pass_drop_db", "pass_share", "stitch", "roughness"}
    )

    gain_sd: float = setting(0.03, "Spread of the gain of a print, relative", option="--gain-sd", ge=0, le=1)
    offset_sd_um: float = setting(0.02, "Spread of the offset of a print", unit="µm", ge=0)
    gain_offset_correlation: float = setting(0.0, "Correlation of gain and offset", ge=-1, le=1)
    blur_sd_um: float = setting(
        0.05, "Spread of the additional blur of a print", unit="µm", option="--blur-sd-um", ge=0
    )
    defocus_sd_um: float = setting(
        3.0, "Spread of the distance to the image plane", unit="µm", option="--defocus-sd-um", ge=0
    )
    wavelength_sd_um: float = setting(
        0.0, "Spread of the wavelength", unit="µm", option="--wavelength-sd-um", ge=0
    )
    samples: int = setting(
        0,
        "Number of draws of the process window in the loss; 0 designs for the nominal print only",
        option="--robust-samples",
        ge=0,
    )
    tail: float = setting(
        0.25, "Share of the worst draws, whose mean loss is minimised", option="--risk-tail", gt=0, le=1
    )
    seed: int = setting(0, "Seed of the draws")
    yield_draws: int = setting(100, "Number of random prints for the yield", option="--yield-draws", ge=2)


def _without_idle_defocus(window: ProcessWindow, optics: Optics) -> ProcessWindow:
    """If the light is observed in the far field, return a copy of the window without defocus. In the far
    field, the image always lies in the focal plane, and another focal length would only rescale it.
    """
    far = optics.propagation == "far-field"
    return window.model_copy(update={"defocus_sd_um": 0.0}) if far else window


def spreads(window: ProcessWindow, optics: Optics) -> list[str]:
    """Return a list of texts for reports. Each text states the value and unit of one spread of the window."""
    return [
        f"{leaf.help.removeprefix('Spread of the ')} {leaf.value:g} {leaf.unit}".strip()
        for leaf in leaves(_without_idle_defocus(window, optics))
        if leaf.path in _SPREADS
    ]


@dataclass(frozen=True)
class Draw:
    """One draw of the process window: random changes to a print, and random optics."""

    gain: float
    offset_um: float
    blur_um: float
    optics: Optics

    def apply(self, height_um: Tensor, pitch_um: float) -> Tensor:
        """Return the height, µm, of a print that is changed by this draw. The print is a map of shape
        (size, size), or rings of shape (n,) that begin at the centre.

        A uniform offset of the height changes scores that compare heights, but it changes no image. Rings are
        blurred only along the radius. This is accurate for rings that are far from the centre or much wider
        than the blur.
        """
        changed = height_um * self.gain + self.offset_um
        sigma_px = self.blur_um / pitch_um
        return blurred(changed, sigma_px) if sigma_px >= _NARROWEST_BLUR_PX else changed


def draws(window: ProcessWindow, optics: Optics, count: int, *, unseen: bool = False) -> list[Draw]:
    """Return ``count`` draws of the process window with the seed ``window.seed``. A longer list begins with
    the same draws as a shorter list.

    If ``unseen`` is True, the draws come from a separate random stream. This is needed for the yield, which
    must be measured on draws that no search has used.
    """
    window = _without_idle_defocus(window, optics)
    shared = window.gain_offset_correlation
    seed = [window.seed, _UNSEEN_STREAM] if unseen else window.seed
    # Each draw uses five random numbers. A sixth number would change all existing draws, so a further spread
    # would need its own random stream.
    normal = np.random.default_rng(seed).standard_normal((count, 5)).tolist()
    return [
        Draw(
            gain=1 + window.gain_sd * gain,
            offset_um=window.offset_sd_um * (shared * gain + math.sqrt(1 - shared**2) * offset),
            blur_um=abs(window.blur_sd_um * blur),
            optics=optics.at_wavelength(
                optics.wavelength_um + window.wavelength_sd_um * wavelength
            ).model_copy(update={"distance_um": optics.distance_um + window.defocus_sd_um * defocus}),
        )
        for gain, offset, blur, defocus, wavelength in normal
    ]


def check_draws(window: ProcessWindow, optics: Optics, source: PixelGrid, target: PixelGrid) -> None:
    """Check that light can be propagated for all draws, both those of the search and those of the yield.

    Raises:
        InputError: the distance in a draw is below the sampling limit of the propagator between ``source``
            and ``target``, the wavelength in a draw is not positive, or ``check_incidence`` rejects a
            direction of the light.
    """
    drawn = _all_draws(window, optics)
    lengths_um = [draw.optics.wavelength_um for draw in drawn]
    if min(lengths_um) <= 0:
        raise InputError(
            f"wavelength {optics.wavelength_um:g} µm with a spread of {window.wavelength_sd_um:g} µm",
            got=f"{min(lengths_um):.4g} µm in a draw of the process window",
            wanted="a positive wavelength",
            hint="lower --wavelength-sd-um",
        )
    # The limit on oblique incidence is lowest for the shortest wavelength.
    shortest = min((draw.optics for draw in drawn), key=lambda one: one.wavelength_um)
    for _, part in coherent_parts(shortest, source.size_um[0]):
        check_incidence(source, part)
    limit_um = _limit_um(drawn, optics, source, target)
    nearest_um, wanted = min(draw.optics.distance_um for draw in drawn), f"at least {limit_um:.4g} µm"
    if optics.distance_um < limit_um:
        hint = f"the wavelength is {optics.wavelength_um:g} µm; convert nm to µm" if limit_um > 20 else ""
        raise InputError("propagation distance", got=f"{optics.distance_um:g} µm", wanted=wanted, hint=hint)
    if nearest_um < limit_um:
        calm_um = allowed_defocus_um(window, optics, source, target)
        raise InputError(
            f"distance {optics.distance_um:g} µm with a defocus spread of {window.defocus_sd_um:g} µm",
            got=f"{nearest_um:.4g} µm in a draw of the process window",
            wanted=wanted,
            hint=f"use --defocus-sd-um {calm_um:.2g} or less, or a larger --distance-um",
        )


def allowed_defocus_um(window: ProcessWindow, optics: Optics, source: PixelGrid, target: PixelGrid) -> float:
    """Return the spread of the defocus in ``window``, µm, if light can be propagated for all draws with this
    spread. Otherwise, return the largest spread for which this is possible, rounded down to two digits.
    Return 0 if the distance itself is too small.
    """
    drawn = _all_draws(window, optics)
    limit_um = _limit_um(drawn, optics, source, target)
    nearest_um = min(draw.optics.distance_um for draw in drawn)
    if nearest_um >= limit_um:
        return window.defocus_sd_um
    # In every draw, the displacement of the image plane is proportional to the spread of the defocus.
    share = (optics.distance_um - limit_um) / (optics.distance_um - nearest_um)
    return rounded_down(share * window.defocus_sd_um)


def rounded_down(value: float) -> float:
    """Return a value rounded down to two significant digits, or 0 if it is not positive. A limit that a
    message advises must not be rounded up, because the rounded limit itself must be allowed.
    """
    if value <= 0:
        return 0.0
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / digit) * digit


def _all_draws(window: ProcessWindow, optics: Optics) -> list[Draw]:
    """Return the draws of the search and of the yield."""
    return draws(window, optics, window.samples) + draws(window, optics, window.yield_draws, unseen=True)


def _limit_um(drawn: Sequence[Draw], optics: Optics, source: PixelGrid, target: PixelGrid) -> float:
    """Return the smallest distance, µm, at which light can be propagated for all draws.

    The angular spectrum has no sampling limit, but the distance must be at least the shortest wavelength of
    all draws, so that the image plane lies behind the element.
    """
    lengths_um = [draw.optics.wavelength_um for draw in drawn]
    if optics.propagation != "rayleigh-sommerfeld":
        return min(lengths_um)
    return max(sampling_limit_um(source, target, length) for length in lengths_um)


class Yield(Record):
    """The share of random prints that pass, the 95 % confidence interval of this share (Wilson's method), and
    the names of the scores that decide whether a print passes.
    """

    draws: int
    passed: int
    share: float
    ci95: tuple[float, float]
    figures: list[str]


def measure_yield(
    drawn: Sequence[Mapping[str, float]],
    modelled: Mapping[str, float],
    errors: Collection[str] = (),
) -> Yield:
    """Measure the share of drawn prints that pass.

    A print passes if each of its scores is close enough to the same score of the print that the model
    predicts (see ``PASS_DROP_DB`` and ``PASS_SHARE``).

    Args:
        drawn: scores of each drawn print, keyed by name.
        modelled: the same scores for the print that the model predicts, without random changes.
        errors: names of the scores that are better when lower.
    """
    from scipy.stats import binomtest

    figures = [name for name in drawn[0] if name in modelled]

    def passes(name: str, value: float) -> bool:
        if name in errors:
            return value <= modelled[name] / PASS_SHARE
        if name.endswith("_db"):
            return value >= modelled[name] - PASS_DROP_DB
        return value >= modelled[name] * PASS_SHARE

    passed = sum(all(passes(name, one[name]) for name in figures) for one in drawn)
    interval = binomtest(passed, len(drawn)).proportion_ci(method="wilson")
    return Yield(
        draws=len(drawn), passed=passed, share=passed / len(drawn),
        ci95=(float(interval.low), float(interval.high)), figures=figures,
    )  # fmt: skip


def risk(losses: Tensor, tail: float) -> Tensor:
    """Return the mean of the worst losses. ``tail`` is the share of the losses that count as the worst."""
    worst = max(1, round(tail * losses.numel()))
    return losses.topk(worst).values.mean()


def disagreement_um(heights_um: Tensor, area: Tensor | None = None) -> Tensor:
    """Return the disagreement, µm, of several models about a print. At each point, the standard deviation of
    the heights that the models predict is computed. The disagreement is the rms of this standard deviation
    over the area.

    The result is differentiable. The mean of every print is subtracted first, because a constant height
    causes only a constant phase.

    Args:
        heights_um: prints of one layout by k models, shape (k, ...).
        area: weight of each height, shape (...): for rings, their area in any unit; None if all heights count
            equally, as for pixels.
    """
    flat = heights_um.flatten(1)
    share = flat[0].new_ones(flat[0].shape) if area is None else area.flatten()
    share = share / share.sum()
    free = flat - (flat * share).sum(1, keepdim=True)
    return ((free.var(0, correction=0) * share).sum() + _SMALLEST_VARIANCE_UM2).sqrt()


def measured_window(store: Any, window: ProcessWindow) -> ProcessWindow:
    """Return a copy of ``window`` in which the spreads of gain and offset, and the correlation between the
    two, come from measured prints.

    Each scan is fitted as height = gain * nominal + offset. The spread between scans is an upper bound on the
    spread between prints, because it also contains the changing scale of the microscope and the residual of
    the fit. Scans in the lock box are left out, so that a search never depends on them.

    Args:
        store: a ``litho_data`` store with at least three scans outside its lock box.

    Raises:
        InputError: there are too few scans of layouts that have more than one level.
    """
    locked = store.locked_ids
    fits = []
    for scan in store.scans():
        if scan.id in locked:
            continue
        nominal, height = scan.layout_um[scan.valid], scan.height_um[scan.valid]
        if nominal.std() > 0:
            fits.append(np.polyfit(nominal.astype(float), height.astype(float), 1))
    if len(fits) < 3:
        raise InputError(
            "process window",
            got=f"{len(fits)} scans with structure, not counting {len(locked)} locked scans",
            wanted="at least three",
        )
    gain, offset = np.array(fits).T
    return window.model_copy(
        update={
            "gain_sd": float(gain.std(ddof=1) / gain.mean()),
            "offset_sd_um": float(offset.std(ddof=1)),
            "gain_offset_correlation": float(np.corrcoef(gain, offset)[0, 1]),
        }
    )


def blurred(height: Tensor, sigma_px: float) -> Tensor:
    """Blur the heights of a map or of rings with a Gaussian.

    A map is mirrored at its borders. Rings are mirrored at the centre, and the last ring is repeated outside.
    """
    import torch
    import torch.nn.functional as F

    rings = height.dim() == 1
    half = min(int(4 * sigma_px) + 1, min(height.shape) - 1)
    x = torch.arange(-half, half + 1, dtype=height.dtype, device=height.device)
    kernel = torch.exp(-(x**2) / (2 * sigma_px**2))
    kernel = kernel / kernel.sum()
    if rings:
        padded = torch.cat([height[:half].flip(0), height, height[-1:].expand(half)])
        return F.conv1d(padded[None, None], kernel.view(1, 1, -1))[0, 0]
    padded = F.pad(height[None, None], (half,) * 4, mode="reflect")
    return F.conv2d(F.conv2d(padded, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))[0, 0]
