"""The usual sets of scan terms by name: for figures, with the record of what was freed; for training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from litho_data.foundation.errors import unknown_name
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.scan_terms.blocks import Blocks
from litho_models.scan_terms.cross_fit import fitted_terms
from litho_models.scan_terms.lines import shrunk_line_offsets
from litho_models.scan_terms.term import TermPixels, Terms, chosen_terms, line_terms, row_index, term_maps

Policy = Literal["none", "offset", "offset-gain", "full", "full+rows"]
BackgroundUse = Literal["none", "training", "shared"]

POLICIES: dict[Policy, Terms] = {
    "none": frozenset(),
    "offset": frozenset({"offset"}),
    "offset-gain": frozenset({"offset", "gain"}),
    "full": frozenset({"offset", "gain", "bow"}),
    "full+rows": frozenset({"offset", "gain", "bow", "layout-rows"}),
}


def policy_terms(policy: str) -> Terms:
    """The terms of a policy.

    Raises:
        InputError: no such policy.
    """
    for known, terms in POLICIES.items():
        if policy == known:
            return terms
    raise unknown_name("nuisance policy", policy, POLICIES)


def usual_policy(film: bool) -> Policy:
    """What scans are freed of unless one says otherwise: films have no zero height to lose."""
    return "none" if film else "offset"


def usual_background(film: bool) -> BackgroundUse:
    """What is added to predictions unless one says otherwise."""
    return "none" if film else "training"


class NuisanceProtocol(Record):
    """What a scan may be freed of before it is scored, and on which pixels that was fitted.

    ``k``: smooth terms per scan; line offsets of ``full+rows`` come on top, by their effective number, which
    depends on the prediction (``PolicyError.k``). ``background``: ``training`` if the smooth background
    learned on the training scans was added to the predictions, ``shared`` if they went through the whole
    measurement model, learned there with the printer; nothing of it is fitted to the scored scan.
    No pixel is left out for lying at the edge of a scan: ``border_px``.
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
        """The standard protocol of a policy."""
        k = float(
            sum(len(term.labels) for term in chosen_terms(policy_terms(policy)) if term.maps is not None)
        )
        return cls(policy=policy, k=k, background=background, **Blocks(seed=seed)._asdict())

    @property
    def blocks(self) -> Blocks:
        """Which pixels are fitted on and which are scored."""
        return Blocks(self.block_px, self.buffer_px, self.line_gap_px, self.seed)


# Their mean over scans belongs to the process: what all scans have of them is no term of single ones.
PINNED: Terms = frozenset({"offset", "gain"})


def training_terms(policy: Policy, free_gain: bool = False) -> Terms:
    """The terms of a policy that are fitted with a model: all, without the gain unless it is free.

    A scan's gain is partly what the layout does to the height over long distances; a model whose
    scans may each choose their gain does not learn that.
    """
    return policy_terms(policy) - (frozenset() if free_gain else {"gain"})


def smooth_training_terms(policy: Policy, free_gain: bool = False) -> Terms:
    """Those without offsets of lines, which average out over a scan and cannot move a small model."""
    terms = training_terms(policy, free_gain)
    return terms - {term.name for term in line_terms(terms)}


def estimate_scan_terms(
    scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], terms: Terms
) -> list[np.ndarray]:
    """What each scan adds to the model's height, float32 (ny, nx) µm, fitted on all its valid pixels.

    For training only: a reported error takes its terms from ``cross_fit``.
    """
    fitted = [
        fitted_terms(scan.height_um, prediction, scan.usable, terms)[0]
        for scan, prediction in zip(scans, predictions_um, strict=True)
    ]
    coefficients = np.array(fitted)
    # The catalogue begins with offset and gain, one map each.
    pinned = len(PINNED & terms)
    coefficients[:, :pinned] -= coefficients[:, :pinned].mean(axis=0)
    maps = []
    for scan, prediction, own in zip(scans, predictions_um, coefficients, strict=True):
        basis = term_maps(TermPixels(prediction), terms).reshape(-1, *scan.shape)
        smooth = np.tensordot(own, basis, axes=1)
        if line_terms(terms):
            rows = row_index(scan.shape)
            residual = np.where(scan.usable, scan.height_um - prediction - smooth, 0.0)
            smooth = smooth + shrunk_line_offsets(residual, scan.usable, rows, Blocks().block_px)[0][rows]
        maps.append(smooth.astype(np.float32))
    return maps
