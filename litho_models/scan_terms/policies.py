"""The usual sets of scan terms (policies) for scoring and for training, and the record of how a score was
computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from litho_data.foundation.errors import require_known
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.scan_terms.blocks import Blocks
from litho_models.scan_terms.cross_fit import fitted_terms
from litho_models.scan_terms.lines import shrunk_line_offsets
from litho_models.scan_terms.term import TermPixels, Terms, line_terms, parameter_names, row_index, term_maps

Policy = Literal["none", "offset", "offset-gain", "full", "full+rows"]
BackgroundUse = Literal["none", "training", "shared"]

POLICIES: dict[Policy, Terms] = {
    "none": frozenset(),
    "offset": frozenset({"offset"}),
    "offset-gain": frozenset({"offset", "gain"}),
    "full": frozenset({"offset", "gain", "bow"}),
    "full+rows": frozenset({"offset", "gain", "bow", "layout-rows"}),
}


def policy_terms(policy: Policy) -> Terms:
    """Return the scan terms of a policy, i.e. of a named set of terms that are fitted to each scan.

    Raises:
        InputError: there is no policy with this name.
    """
    require_known("nuisance policy", policy, POLICIES)
    return POLICIES[policy]


def usual_policy(film: bool) -> Policy:
    """Return the default policy. It is ``offset``, which fits the datum of each scan, or ``none`` for films,
    which have no datum.
    """
    return "none" if film else "offset"


def usual_background(film: bool) -> BackgroundUse:
    """Return which background is added to predictions by default. It is the background of the training scans;
    for films, there is none.
    """
    return "none" if film else "training"


class NuisanceProtocol(Record):
    """The terms that are subtracted from scans before scoring, and the pixels to which they are fitted.

    ``k`` is the number of smooth terms per scan. It does not include the line offsets of policy
    ``full+rows``. ``PolicyError.k`` also includes their effective number, which depends on the prediction.
    ``background`` is ``training`` if the scored predictions include the smooth background of the training
    scans, ``shared`` if they include the whole measurement model, and ``none`` if they include neither. No
    part of the background is fitted to the scored scan. ``border_px`` is the number of pixels that are left
    out at the edge of a scan; it is always zero. The other fields are explained at ``Blocks``.
    """

    policy: Policy = "offset"
    k: float = 1.0
    block_px: int = Blocks().block_px
    buffer_px: int = Blocks().buffer_px
    line_gap_px: int = Blocks().line_gap_px
    border_px: Literal[0] = 0
    seed: int = 0
    background: BackgroundUse = "none"

    @classmethod
    def of_policy(cls, policy: Policy, seed: int = 0, background: BackgroundUse = "none") -> NuisanceProtocol:
        """Return the protocol of a policy, with the standard blocks."""
        k = float(len(parameter_names(policy_terms(policy))))
        return cls(policy=policy, k=k, seed=seed, background=background)

    @property
    def blocks(self) -> Blocks:
        """Return the rule by which pixels are divided into fitted and scored pixels."""
        return Blocks(self.block_px, self.buffer_px, self.line_gap_px, self.seed)


# For these terms, the mean over all scans is attributed to the process and not to single scans. This mean
# therefore stays in the process model and is not subtracted.
PINNED: Terms = frozenset({"offset", "gain"})


def training_terms(policy: Policy) -> Terms:
    """Return the terms that are fitted to each scan while a model is trained. They are all terms of the
    policy except the gain.

    Part of the gain of a scan is a long-range effect of the layout. A model cannot learn this effect if the
    gain of every scan is free.
    """
    return policy_terms(policy) - {"gain"}


def smooth_training_terms(policy: Policy) -> Terms:
    """Return ``training_terms`` without the line offsets. Line offsets average out over a scan and hardly
    change a small model.
    """
    terms = training_terms(policy)
    return terms - {term.name for term in line_terms(terms)}


def estimate_scan_terms(
    scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], terms: Terms
) -> list[np.ndarray]:
    """From all valid pixels of each scan, estimate the terms that the scan adds to the height that a model
    predicts. Return the sum of the terms, µm, as a float32 map of shape (ny, nx) for each scan. The means
    of offset and gain over all scans are not part of this sum, because they are attributed to the process.

    Use these maps only for training. For errors that are reported, use ``cross_fit``, which fits the terms to
    pixels that are not scored.
    """
    fits = [
        fitted_terms(scan.height_um, prediction, scan.usable, terms)
        for scan, prediction in zip(scans, predictions_um, strict=True)
    ]
    # Offset and gain are the first terms of the catalogue and have one map each, so their coefficients come
    # first.
    pinned = PINNED & terms
    means = np.mean([coefficients[: len(pinned)] for coefficients, _ in fits], axis=0)
    maps = []
    for scan, prediction, (_, own) in zip(scans, predictions_um, fits, strict=True):
        added = own - (means @ term_maps(TermPixels(prediction), pinned)).reshape(scan.shape)
        if line_terms(terms):
            rows, residual = row_index(scan.shape), scan.height_um - prediction - added
            added += shrunk_line_offsets(residual, scan.usable, rows, Blocks().block_px)[0][rows]
        maps.append(added.astype(np.float32))
    return maps
