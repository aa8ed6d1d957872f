"""Compute the separation of rivals (competing explanations) on planned scans. One rival is refitted to the
prediction of the other. The separation is the remaining difference between the two predictions, relative to
the noise.

The criterion is T-optimality (Atkinson and Fedorov 1975): the distance from the prediction of one model to
the nearest prediction that the other model can make. It is not known which of the two models is true, so the
distance is computed in both directions, and the smaller distance counts (a simple form of the symmetric
criterion of Harman and Müller, arXiv:1709.10320). Datum, tilt, bow, gain and affine registration are fitted
to every scan, so differences of these kinds do not count. The refitted model must stay consistent with
earlier prints and within the ranges of its parameters.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import FieldContext
from litho_models.effects.chain import Fields
from litho_models.fitting.least_squares import Linearised, eliminated_sum, orthonormal, solve_damped
from litho_models.loop.fits import RULES
from litho_models.loop.model import Twin
from litho_models.loop.prepared import ALL_FREE
from litho_models.planning.questions import NoiseSpectrum, Question, inner
from litho_models.scan_terms import TermPixels, term_maps
from litho_models.simulator import Simulator

# The scans of a planned print. All scans of all planned prints have the same shape.
Print = Sequence[FieldContext]
# The names of two rivals. The first is assumed to be true, and the second is refitted to its prediction.
Pair = tuple[str, str]
_DAMPING = 1e-6
_SMALLEST = 1e-12
PLAIN, TURNED = "like the earlier prints", "rotated by 90°"
# Ways to scan a print, in words. For each of them, the facts about the scan that differ from earlier scans.
WAYS: dict[str, dict[str, Any]] = {
    PLAIN: {},
    TURNED: {"quarter_turns": 1},
    "in the other direction": {"backward": True},
    "with a new, sharp tip": {"new_tip": True},
    "with half the pixel size and the same time per pixel": {"pixel_size": 0.5},
}


def planned_scans(
    plain: FieldContext,
    level: np.ndarray | Tensor,
    ways: Iterable[str],
    *,
    at_edge: bool = False,
    order: float = 0.0,
    dose: float = 1.0,
) -> list[FieldContext]:
    """Plan a print and its scans. Return the facts about each scan that models need.

    Args:
        plain: facts that all planned prints share, such as the pitch and the width of the write field.
        level: levels of the layout, of shape (ny, nx). They need not be whole numbers. The scans are
            differentiable with respect to them if they are a tensor.
        ways: the ways in which the print is scanned, one per scan, as keys of ``WAYS``.
        at_edge: whether the print lies in a corner of the write field instead of its centre. It has no effect
            if the width of the write field is not known.
        order: position in the writing order, from -0.5 (first) to 0.5 (last).
        dose: dose relative to earlier prints.
    """
    reach_um = 0.0
    if at_edge and plain.field_radius_um:
        reach_um = plain.field_radius_um - max(level.shape) * plain.pitch_um / 2
    printed = replace(
        plain,
        layout_um=(dose * plain.slice_um * torch.as_tensor(level, dtype=torch.float32))[None, None],
        field_centre_um=(reach_um, reach_um),
        order=order,
        dose=dose,
    )
    return [replace(printed, **WAYS[way]) for way in ways]


def predict(twin: Twin, scan: FieldContext, known: Fields | None = None) -> Tensor:
    """Predict the height that a planned scan would show, µm, of shape (ny, nx). The prediction is
    differentiable with respect to the layout. ``known`` is a cache of intermediate fields of this scan, which
    several models can share.
    """
    chain = twin.chain().requires_grad_(False)
    return chain(scan.layout_um, scan, known, twin.numbers.tobytes())[0, 0]


def linearised(twins: Mapping[str, Twin], scan: FieldContext) -> dict[str, Linearised]:
    """Linearise the prediction of each model for a planned scan at the parameters of the model. The residual
    in each result is the negative of the predicted height. The caller must add the heights to which the model
    is fitted.
    """
    # Models with the same base share its predictions.
    known: Fields = {}
    found = {}
    for name, twin in twins.items():
        steps = twin.steps()
        moved = (twin.at(twin.vector + one) for one in np.diag(steps))
        heights = _stacked([predict(one, scan, known) for one in (twin, *moved)])
        rows = _rows(heights)
        derivatives = (rows[1:] - rows[0]) / steps[:, None]
        found[name] = Linearised(-rows[0], derivatives, _free_basis(heights[0]).T)
    return found


@dataclass(frozen=True)
class Contrast:
    """The difference between the predictions of two rivals on some prints. One rival is assumed to be true,
    and the other is refitted to its prediction.

    ``squares_nm2`` is the squared distance between the two predictions, summed over all pixels and scans of a
    print. ``sd_nm2`` is the standard deviation that noise causes in the difference of the squared errors of
    the two rivals. Both have shape (prints,). ``pixels`` is the number of pixels in all scans of a print.
    """

    squares_nm2: Tensor
    sd_nm2: Tensor
    pixels: int

    @property
    def rms_nm(self) -> float:
        """Return the rms difference between the two predictions over all pixels, nm."""
        return float((self.squares_nm2.mean() / self.pixels).sqrt())

    @property
    def noise_nm(self) -> float:
        """Return the standard deviation per pixel of the noise after projection onto the difference of the
        predictions, nm.
        """
        return float((self.sd_nm2 / (2 * self.squares_nm2.sqrt() + _SMALLEST)).mean())


class Rivalry:
    """The rivals of one question, and their predictions for planned prints.

    Args:
        question: a question with at least two rivals.
        base: the base model of all rivals. Its parameters come first in the field ``vector`` of a rival.
        noise: spectrum of the noise, measured on the residuals of earlier prints.

    Attributes:
        twins: the model of each rival, keyed by the name of the rival. Refits start from these models.
        true: models of the rivals, each of which is in turn assumed to be the true one.
    """

    def __init__(self, question: Question, base: Simulator, noise: NoiseSpectrum):
        self.question = question
        self.noise = noise
        self.true = self.twins = {rival.name: rival.twin(Twin.bare(base)) for rival in question.rivals}

    def drawn(self, random: np.random.Generator) -> Rivalry:
        """Return a copy in which the models that are assumed to be true have random parameters. The
        parameters are drawn from the normal distribution that describes their uncertainty after earlier
        prints.
        """
        other = copy.copy(self)
        other.true = {}
        for rival, (name, twin) in zip(self.question.rivals, self.twins.items(), strict=True):
            moved = random.multivariate_normal(0 * twin.vector, rival.covariance)
            other.true[name] = twin.at(twin.vector + np.clip(moved, *twin.room()))
        return other

    def refitted(
        self,
        prints: Sequence[Print],
        *,
        rounds: int = 1,
        first: Sequence[Mapping[str, Linearised]] | None = None,
    ) -> dict[Pair, Twin]:
        """For each ordered pair of rivals, refit the second model to the prediction of the first model.
        Return the refitted models, keyed by the names of the two rivals.

        Args:
            prints: planned prints. The refit is not differentiable with respect to the levels of these
                prints.
            rounds: number of Gauss-Newton steps. With a single step, the refit is linear.
            first: for each scan of these prints, the result of ``linearised`` for ``twins``, if it has
                already been computed.
        """
        scans = [scan for scans in prints for scan in scans]
        first = first or [linearised(self.twins, scan) for scan in scans]
        shown = {name: _rows(_predicted(twin, prints)) for name, twin in self.true.items()}
        priors = {rival.name: np.array(rival.information) for rival in self.question.rivals}
        found = {}
        for true, other in permutations(self.twins, 2):
            start = twin = self.twins[other]
            for number in range(rounds):
                here = [linearised({other: twin}, scan) for scan in scans] if number else first
                linear = [
                    replace(one[other], residual=one[other].residual + height)
                    for one, height in zip(here, shown[true], strict=True)
                ]
                normal, right, _ = eliminated_sum(linear, RULES.term_weight)
                right = right - priors[other] @ (twin.vector - start.vector)
                step = solve_damped(normal + priors[other], right, _DAMPING, twin.room())
                twin = twin.at(twin.vector + step)
            found[true, other] = twin
        return found

    def contrasts(self, prints: Sequence[Print], refitted: Mapping[Pair, Twin]) -> dict[Pair, Contrast]:
        """Return the contrast of every ordered pair of rivals on the given prints. The argument ``refitted``
        is the result of the method ``refitted`` for these prints. The contrasts are differentiable with
        respect to the levels of the prints.
        """
        shown = {name: _predicted(twin, prints) for name, twin in self.true.items()}
        found = {}
        for (true, other), twin in refitted.items():
            pairs = zip(shown[true], _predicted(twin, prints), strict=True)
            freed = NM_PER_UM * torch.stack([_freed(*pair) for pair in pairs])
            freed = freed.reshape(len(prints), -1, *shown[true].shape[1:])
            # All scans of a print show the same roughness. The difference maps of these scans are therefore
            # added before the noise is computed.
            together = freed.sum(1)
            sd = torch.sqrt(4 * self.noise.variance(together) + _SMALLEST**2)
            found[true, other] = Contrast((freed**2).sum((1, 2, 3)), sd, freed[0].numel())
        return found

    def separations(self, prints: Sequence[Print], refitted: Mapping[Pair, Twin]) -> Tensor:
        """Return the separation of each ordered pair of rivals, i.e. the squared distance between the two
        predictions in units of its standard deviation. The distance varies with the noise and, between
        prints, with the relative standard deviation ``question.spread``. The result has shape (pairs,) and is
        differentiable with respect to the levels of the prints.
        """
        found = []
        for one in self.contrasts(prints, refitted).values():
            variance = (one.sd_nm2**2 + (self.question.spread * one.squares_nm2) ** 2).sum()
            found.append(one.squares_nm2.sum() / torch.sqrt(variance + _SMALLEST**2))
        return torch.stack(found)


def _predicted(twin: Twin, prints: Sequence[Print]) -> Tensor:
    """Predict the height in all scans of the prints, without its border. The result has shape (scans, ny,
    nx).
    """
    return _stacked([predict(twin, scan) for scans in prints for scan in scans])


def _stacked(heights: Sequence[Tensor]) -> Tensor:
    """Stack predictions of shape (ny, nx) without their borders."""
    return torch.stack([height[inner(height.shape)] for height in heights])


def _rows(fields: Tensor) -> np.ndarray:
    return fields.flatten(1).double().numpy()


def _free_basis(prediction_um: Tensor) -> np.ndarray:
    """Return an orthonormal basis of the k terms that are fitted to each scan, at the n pixels of a
    prediction. The result has shape (n, k).
    """
    return orthonormal(term_maps(TermPixels(prediction_um.detach().numpy()), ALL_FREE).T)


def _freed(true_um: Tensor, refitted_um: Tensor) -> Tensor:
    """Project the terms that are fitted to each scan out of the difference between two predictions.

    The terms are computed from the refitted prediction. If the gain term were computed from the true
    prediction, the refitted prediction could shrink to zero.
    """
    basis = torch.from_numpy(_free_basis(refitted_um)).to(true_um)
    flat = (true_um - refitted_um).flatten()
    return flat - basis @ (basis.T @ flat)
