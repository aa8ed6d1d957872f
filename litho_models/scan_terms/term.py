"""The catalogue of terms that a scan may add to the height of a print.

A term is either a set of smooth maps over the scan (for example datum, gain or bow) or a set of height
offsets, one for every line. This catalogue is used by the benchmark, the training, the noise estimate and the
loop that corrects a model (``litho_models.loop``). ``register_scan_term`` adds a term to the catalogue.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.errors import InputError, require_known

FloatMap = NDArray[np.float64]
LineIndex = NDArray[np.intp]
Terms = frozenset[str]


@dataclass(frozen=True)
class TermPixels:
    """The predicted height of a scan, and the pixels at which terms are evaluated.

    Attributes:
        prediction_um: predicted height, µm, of shape (ny, nx).
        line: index of the scan line of each pixel, of shape (ny, nx). If it is None, the rows of the array
            are the scan lines.
        at: flat indices of the n pixels at which terms are evaluated. If it is None, terms are evaluated at
            all pixels, in order.
    """

    prediction_um: np.ndarray
    line: LineIndex | None = None
    at: np.ndarray | None = None

    @cached_property
    def height(self) -> FloatMap:
        """Return the predicted height at the pixels minus its mean over the whole scan, µm, of shape (n,)."""
        prediction = np.asarray(self.prediction_um, np.float64)
        return self._taken(prediction) - float(prediction.mean())

    @cached_property
    def slopes(self) -> FloatMap:
        """Return the change of the predicted height per pixel along y and along x, µm, of shape (2, n)."""
        return self._taken(np.array(np.gradient(np.asarray(self.prediction_um, np.float64))))

    @cached_property
    def smooth(self) -> FloatMap:
        """Return the five maps of ``smooth_shapes`` at the pixels, of shape (5, n)."""
        return self._taken(smooth_shapes(self.prediction_um.shape))

    @cached_property
    def time(self) -> FloatMap:
        """Return the relative time at which each pixel was scanned, from 0 in the first scan line to 1 in the
        last. The result has shape (n,).
        """
        line = row_index(self.prediction_um.shape) if self.line is None else self.line
        return self._taken(line) / max(int(line.max()), 1)

    def _taken(self, maps: NDArray[Any]) -> FloatMap:
        flat = maps.reshape(*maps.shape[:-2], -1)
        return flat if self.at is None else flat.take(self.at, axis=-1)


@dataclass(frozen=True)
class ScanTerm:
    """One term that a scan adds to the height.

    Attributes:
        name: name of the term in sets of terms.
        effect: name of the effect that the term represents, or None for a term that serves only as a control.
            Several terms may represent the same effect.
        unit: unit of the coefficients: ``µm`` for a height, ``px`` for a displacement, or ``1`` for a
            dimensionless number.
        labels: descriptions of the k maps, one per map. A term of line offsets has a single description.
        maps: function that returns the smooth maps at given pixels, of shape (k, n), or None for line
            offsets. The built-in maps have zero mean over the scan, except the maps of the datum and of
            registration errors.
        lines: function that returns the line index of each pixel, for line offsets only. It is called as
            ``lines(shape, scan_line)`` with the shape of the scan and the index of the scan line of each
            pixel (or None).
        frame: what the lines are called, such as "the scan lines"; for line offsets only.
    """

    name: str
    effect: str | None
    unit: Literal["µm", "1", "px"]
    labels: tuple[str, ...]
    maps: Callable[[TermPixels], FloatMap] | None = None
    lines: Callable[[tuple[int, ...], LineIndex | None], LineIndex] | None = None
    frame: str = ""


def term_maps(pixels: TermPixels, terms: Iterable[str]) -> FloatMap:
    """Return the smooth maps of the named terms at the given pixels, in the order of the catalogue. The
    result has shape (k, n).
    """
    chosen = [term.maps(pixels) for term in chosen_terms(terms) if term.maps is not None]
    return np.concatenate([np.empty((0, len(pixels.height))), *chosen])


def parameter_names(terms: Iterable[str]) -> list[str]:
    """Return the names of the coefficients of the maps that ``term_maps`` returns, in the same order. Each
    name includes the unit in which the coefficient is reported.
    """
    shown = {"µm": " (nm)", "px": " (px)", "1": ""}
    return [
        label + shown[term.unit]
        for term in chosen_terms(terms)
        if term.maps is not None
        for label in term.labels
    ]


def chosen_terms(names: Iterable[str]) -> list[ScanTerm]:
    """Return the terms with these names, in the order of the catalogue.

    Raises:
        InputError: a name is not in the catalogue.
    """
    wanted = set(names)
    for name in sorted(wanted):
        require_known("scan term", name, SCAN_TERMS)
    return [term for name, term in SCAN_TERMS.items() if name in wanted]


def line_terms(names: Iterable[str]) -> list[ScanTerm]:
    """Return those of the named terms that are line offsets."""
    return [term for term in chosen_terms(names) if term.lines is not None]


def terms_of_effect(effect: str) -> Terms:
    """Return the names of the terms that represent an effect. The set is empty if the effect is not a
    per-scan effect.
    """
    return frozenset(term.name for term in SCAN_TERMS.values() if term.effect == effect)


def register_scan_term(term: ScanTerm) -> ScanTerm:
    """Add a term to the catalogue and return it.

    Raises:
        InputError: the name is already taken, or the term has both ``maps`` and ``lines``, or neither.
    """
    if term.name in SCAN_TERMS:
        raise InputError("scan term", got=f"{term.name}, which exists", wanted="a new name")
    if (term.maps is None) == (term.lines is None):
        got, wanted = "both or neither of maps and lines", "exactly one of the two"
        raise InputError(f"scan term {term.name}", got=got, wanted=wanted)
    SCAN_TERMS[term.name] = term
    return term


@lru_cache(maxsize=8)
def smooth_shapes(shape: tuple[int, ...]) -> FloatMap:
    """Return maps of x, y, x², xy and y² over a scan, where x and y run from -1 to 1. The mean of each map is
    subtracted. The result has shape (5, ny, nx) and is read-only.
    """
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    shapes = np.stack([term - term.mean() for term in (x, y, x * x, x * y, y * y)])
    shapes.setflags(write=False)
    return shapes


def row_index(shape: tuple[int, ...]) -> LineIndex:
    """Return the row number of each pixel, as an array of shape (ny, nx)."""
    return np.indices(shape, np.intp)[0]


def _drift(pixels: TermPixels) -> FloatMap:
    """Return one map for each decay time. It shows an exponential creep that starts with the scan."""
    whole = replace(pixels, at=None).time
    return np.stack([np.exp(-pixels.time / d) - np.exp(-whole / d).mean() for d in _CREEP_DECAYS])


def _warp(pixels: TermPixels) -> FloatMap:
    """Return maps of the height changes that an affine error of the registration causes."""
    x, y = pixels.smooth[:2]
    return np.stack([slope * by for slope in pixels.slopes for by in (np.ones_like(x), y, x)])


def _distortion(pixels: TermPixels) -> FloatMap:
    """Return maps of the height changes that a quadratic error of the registration causes. The quadratic
    terms are centred, so that a distortion that all scans share causes no mean shift.
    """
    x, y = pixels.smooth[:2]
    return np.stack([slope * by for slope in pixels.slopes for by in (y * y - 1 / 3, x * y, x * x - 1 / 3)])


# Decay times of the two parts of a creep, relative to the duration of a scan. Creep that is slower than both
# parts cannot be distinguished from the bow and is treated as part of the bow.
_CREEP_DECAYS = (0.05, 0.2)

# The terms are listed in the order in which the loop tests them.
SCAN_TERMS: dict[str, ScanTerm] = {
    term.name: term
    for term in (
        ScanTerm("offset", "datum-offset", "µm", ("offset",), maps=lambda p: np.ones((1, len(p.height)))),
        ScanTerm("gain", "z-gain", "1", ("gain",), maps=lambda p: p.height[None]),
        ScanTerm("bow", "tilt-bow", "µm", ("x", "y", "x²", "xy", "y²"), maps=lambda p: p.smooth),
        ScanTerm(
            "drift",
            "slow-drift",
            "µm",
            tuple(f"creep over {decay:g} of the scan" for decay in _CREEP_DECAYS),
            maps=_drift,
        ),
        ScanTerm(
            "warp",
            "registration-residual",
            "px",
            tuple(f"shift {axis}{by}" for axis in "yx" for by in ("", " by y", " by x")),
            maps=_warp,
        ),
        ScanTerm(
            "distortion",
            "registration-residual",
            "px",
            tuple(f"shift {axis} by {by}" for axis in "yx" for by in ("y² - 1/3", "xy", "x² - 1/3")),
            maps=_distortion,
        ),
        ScanTerm(
            "scan-lines",
            "scan-line-stripes",
            "µm",
            ("offset of a scan line",),
            lines=lambda shape, line: row_index(shape) if line is None else line,
            frame="the scan lines",
        ),
        ScanTerm(
            "layout-rows",
            "line-roughness",
            "µm",
            ("offset of a row",),
            lines=lambda shape, line: row_index(shape),
            frame="the layout's rows",
        ),
        ScanTerm(
            "layout-columns",
            None,
            "µm",
            ("offset of a column",),
            lines=lambda shape, line: row_index(shape[::-1]).T,
            frame="the layout's columns",
        ),
    )
}
