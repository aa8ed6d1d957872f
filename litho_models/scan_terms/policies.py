"""The usual sets of scan terms by name, and the record of what a figure was freed of."""

from __future__ import annotations

from typing import Literal

from litho_data.foundation.errors import unknown_name
from litho_data.foundation.results import Record
from litho_models.scan_terms.blocks import Blocks
from litho_models.scan_terms.term import Terms, chosen_terms

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
