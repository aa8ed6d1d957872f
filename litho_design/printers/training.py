"""Compare a layout with the training layouts of a model. The module computes the distance between them, a
penalty for the search, and the expected error of the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ConfigDict, Field

from litho_data.foundation.results import Record
from litho_design.printers.layout import LayoutSettings

if TYPE_CHECKING:
    from torch import Tensor

# A layout is flagged if the distance between its histogram of levels and that of the training layouts exceeds
# this value. Most of the print of such a layout is extrapolated.
_FLAG_DISTANCE = 0.5
# A layout is also flagged if the distance between the histograms of steps exceeds this value, i.e. if more
# than a tenth of the pairs of neighbouring pixels differ. A few edges do not make a layout unusual.
_FLAG_STEPS = 0.1
# A level or step is unusual if it is more frequent than in the training layouts, both by more than this
# factor and by more than this difference of the shares.
ALLOWED_TIMES = 2.0
_ALLOWED_SHARE = 0.005


class OutOfDistribution(Record):
    """The distance of a layout from the model's training layouts.

    The distance consists of two total-variation distances: one between the histograms of levels, and one
    between the histograms of steps. A step is the difference in level between neighbouring pixels.
    ``unusual`` lists the levels and steps that are much more frequent in the layout than in the training
    layouts. ``step_distance`` is None if the model's card has no histogram of steps.
    """

    # Records of earlier versions also contain the scores of a second layout, which is closer to the training
    # layouts. They are ignored.
    model_config = ConfigDict(extra="ignore")

    level_distance: float
    flagged: bool
    extreme_level_share: float
    training_extreme_level_share: float
    step_distance: float | None = None
    unusual: list[str] = Field(default_factory=list)


def out_of_distribution(
    levels: np.ndarray, layout: LayoutSettings, card: Mapping[str, Any]
) -> OutOfDistribution | None:
    """Compare a layout with the histograms in a model's card. ``levels`` has shape (ny, nx).

    Return None if the card has no histogram of levels.
    """
    trained = training_share(card, "training_level_share", layout.levels)
    if trained is None:
        return None
    share = np.bincount(levels.ravel(), minlength=len(trained)) / levels.size
    steps = (np.abs(np.diff(levels.astype(np.int16), axis=axis)).ravel() for axis in (0, 1))
    counts = np.sum([np.bincount(one, minlength=len(trained)) for one in steps], axis=0)
    step_share = counts / max(counts.sum(), 1)
    trained_steps = training_share(card, "training_step_share", layout.levels)
    apart = None if trained_steps is None else _distance(step_share, trained_steps)
    distance, top = _distance(share, trained), layout.levels - 1
    unusual = _excess(share, trained, "levels {}", "of the pixels")
    if trained_steps is not None:
        unusual += _excess(step_share, trained_steps, "steps of {} levels", "of the neighbouring pixels")
    return OutOfDistribution(
        level_distance=distance,
        flagged=distance > _FLAG_DISTANCE or (apart or 0) > _FLAG_STEPS,
        extreme_level_share=float(share[0] + share[top]),
        training_extreme_level_share=float(trained[0] + trained[top]),
        step_distance=apart,
        unusual=unusual,
    )


def outside(level: Tensor, levels: int, card: Mapping[str, Any]) -> Tensor:
    """Return the penalty on a layout whose levels and steps are unlike those in the training layouts. For
    every k, three shares of the layout are computed: the share of the pixels at level k or higher, the share
    of the pixels at lower levels, and the share of the pairs of neighbouring pixels with a step of k or more.
    The limit of each share is twice the same share of the training layouts. The penalty is the sum of the
    amounts by which shares exceed their limits. If the card has no histogram, the penalty is 0. Because these
    shares are cumulative, the penalty has a gradient even at a pixel whose level is several levels above or
    below those in the training layouts.
    """
    total = level.new_zeros(())
    trained, trained_steps = (
        training_share(card, name, levels) for name in ("training_level_share", "training_step_share")
    )
    for place in range(1, levels):
        if trained is not None:
            higher = (level - (place - 1)).clamp(0, 1).mean()
            limit = float(trained[place:].sum())
            total = total + (higher - ALLOWED_TIMES * limit).clamp(min=0)
            total = total + (1 - higher - ALLOWED_TIMES * (1 - limit)).clamp(min=0)
        if trained_steps is not None:
            limit = ALLOWED_TIMES * float(trained_steps[place:].sum())
            down, right = (level.diff(dim=axis).abs() for axis in (-2, -1))
            larger = [(step - (place - 1)).clamp(0, 1).mean() for step in (down, right)]
            total = total + ((larger[0] + larger[1]) / 2 - limit).clamp(min=0)
    return total


def training_share(card: Mapping[str, Any], name: str, levels: int) -> np.ndarray | None:
    """Return the histogram ``name`` from a model's card, scaled to a sum of 1 and extended by zeros to at
    least ``levels`` values. Return None if the card has no such histogram.
    """
    trained = np.asarray(card.get(name) or [], dtype=float)
    if trained.size == 0:
        return None
    return np.pad(trained / trained.sum(), (0, max(0, levels - trained.size)))


def own_error_um(card: Mapping[str, Any], relief_um: float) -> float:
    """Return the rms error, µm, that a model is expected to make on the print of a relief. ``relief_um`` is
    the standard deviation of the heights of this relief, µm.

    Two errors are added in quadrature. The first is the mean error of the prints that the model's card lists;
    it is scaled up if the heights of the relief vary more than the heights of these prints. The second is the
    standard deviation of the gains of these prints (see ``ScanFigures``), multiplied by ``relief_um``. The
    card states mean absolute errors; they are multiplied by sqrt(pi / 2) to obtain rms errors, because errors
    are assumed to be normally distributed. If the card lists no prints, the result is 0.
    """
    prints = card.get("baseline") or []
    if not prints:
        return 0.0
    error_nm, relief_nm, gain = (
        np.array([one[name] for one in prints], float) for name in ("error_nm", "relief_nm", "gain")
    )
    times = max(1.0, 1e3 * relief_um / float(relief_nm.mean()))
    error_um = math.sqrt(math.pi / 2) * 1e-3 * float(error_nm.mean()) * times
    return math.hypot(error_um, float(gain.std()) * relief_um)


def _distance(share: np.ndarray, trained: np.ndarray) -> float:
    return float(np.abs(share - trained).sum()) / 2


def _excess(share: np.ndarray, trained: np.ndarray, what: str, of: str) -> list[str]:
    """Return descriptions of the values that are much more frequent in the histogram ``share`` than in the
    histogram ``trained``. The list is empty if there are none.
    """
    many = np.flatnonzero((share > ALLOWED_TIMES * trained) & (share > trained + _ALLOWED_SHARE))
    if many.size == 0:
        return []
    runs = np.split(many, np.flatnonzero(np.diff(many) > 1) + 1)
    names = ", ".join(f"{run[0]}" if run.size == 1 else f"{run[0]} to {run[-1]}" for run in runs)
    what = what.replace("levels {}", "level {}") if many.size == 1 else what
    here, there = (100 * float(one[many].sum()) for one in (share, trained))
    return [f"{what.format(names)}: {here:.2g} % {of}, {there:.2g} % in the training layouts"]
