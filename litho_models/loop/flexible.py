"""A network as base model: one per fold, taken as trained, corrected by what the stiff model found.

A network absorbs effects into its weights, so candidates are screened on the stiff model; here each
effect found there must also lower the network's held-out error, otherwise the network carries it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from torch import Tensor, nn

from litho_data.store.read import PrintedScan
from litho_models.effects.chain import EffectChain
from litho_models.loop.parameters import effect_slots
from litho_models.loop.prepared import Field
from litho_models.loop.scoring import Terms
from litho_models.loop.selection.contest import Entrant, judged
from litho_models.loop.selection.search import Search
from litho_models.loop.state import State, fit_state

Trainer = Callable[[Sequence[PrintedScan]], nn.Module]


class FoldedBase(nn.Module):
    """One trained model per fold; each scan is predicted by the one that has not seen it.

    Args:
        models: by fold; ``fold_of``: scan id to fold; ``common``: for every other scan.
    """

    def __init__(self, models: Sequence[nn.Module], fold_of: Mapping[str, int], common: nn.Module):
        super().__init__()
        self.models = nn.ModuleList(models)
        self.common = common
        self.fold_of = dict(fold_of)
        self._current: int | None = None
        self.eval().requires_grad_(False)

    def select(self, scan_id: str) -> None:
        """Predict as for this scan from now on."""
        self._current = self.fold_of.get(scan_id)

    def forward(self, layout_um: Tensor) -> Tensor:
        """Height (b, 1, y, x), µm, by the selected model."""
        return (self.common if self._current is None else self.models[self._current])(layout_um)


def train_folds(fields: Sequence[Field], fold_of: np.ndarray, trainer: Trainer) -> FoldedBase:
    """Train once without each fold and once on all development scans."""
    models = [
        trainer([f.scan for f, own in zip(fields, fold_of, strict=True) if own != fold])
        for fold in range(int(fold_of.max()) + 1)
    ]
    assigned = {field.id: int(fold) for field, fold in zip(fields, fold_of, strict=True)}
    return FoldedBase(models, assigned, trainer([field.scan for field in fields]))


def same_for_all(model: nn.Module, fields: Sequence[Field]) -> FoldedBase:
    """A model trained elsewhere, on scans that nobody here knows."""
    return FoldedBase([model], {field.id: 0 for field in fields}, model)


def carry_over(
    found: Search,
    base: FoldedBase,
    fields: Sequence[Field],
    fold_of: np.ndarray,
    terms: Terms,
    *,
    floor_nm2: float,
    seed: int,
    report: Callable[[str], None],
) -> tuple[State, Search]:
    """Try the effects found on the stiff model on the network; returns its bare state and the search."""
    guide = found.state.fits.chain
    geometry = {"full_height_um": guide.full_height_um, "pitch_um": guide.pitch_um}
    bare = fit_state(EffectChain(base, {}, **geometry), fields, fold_of)
    carried = Search(
        bare, first=found.first, last=found.last, failures=dict(found.failures), dropped=dict(found.dropped)
    )
    for entry in found.added:
        name = entry.effect.name
        report(f"trying {name} on the network")
        slots, common = effect_slots(guide), found.state.fits.common
        values = guide.values()[name] | {
            parameter: float(common[slot]) for (owner, parameter), slot in slots.items() if owner == name
        }
        chain = carried.state.fits.chain
        extended = fit_state(chain.with_effects({**chain.values(), name: values}), fields, fold_of)
        entrant = Entrant(found.first[name], extended)
        added = judged(
            carried.state, entrant, entry.confusable_with, fields, terms, floor_nm2=floor_nm2, seed=seed
        )
        if added.confirmation.passed:
            carried.state = extended
            # It was screened where the stiff model chose it, after the effects added before it.
            carried.added.append(replace(added, p_screen=entry.p_screen))
        else:
            reason = added.confirmation.reason
            carried.absorbed[name] = f"confirmed on the stiff model, not on this one: {reason}"
    return bare, carried
