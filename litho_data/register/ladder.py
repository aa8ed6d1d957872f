"""Which warp the data support: the lowest rung that no higher one beats on held-out blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from litho_data.register.flows import LADDER
from litho_data.register.pyramid import FineFit, project_to_model
from litho_data.register.refine import Refinement, refine, residual_energy, solve_gram

STANDARD_ERRORS = 3.0


def climb(fine: FineFit) -> FineFit:
    """The fit on the lowest rung that no higher rung beats on blocks it was not fitted to.

    Args:
        fine: a converged affine fit; every rung starts from its projection.

    A higher rung is better if its gain on held-out blocks, averaged over the blocks, exceeds three standard
    errors.
    """
    shape = (fine.topography.shape[0], fine.topography.shape[1])
    start = fine.refinement.layout_to_scan
    fits = [
        refine(fine.scan, fine.topography, project_to_model(start, model, shape), model) for model in LADDER
    ]
    energies = [held_out_energy(fit) for fit in fits]
    for rung, energy in enumerate(energies):
        if not any(_pays(energy, higher) for higher in energies[rung + 1 :]):
            break
    return replace(fine, refinement=fits[rung])


def held_out_energy(refinement: Refinement) -> np.ndarray:
    """Residual energy of every block under the fit to the blocks of the other folds, (n,).

    The folds interleave, so each is spread over the whole field.
    """
    blocks = refinement.blocks()
    rows, columns = np.indices(blocks.shape[:2])
    fold = 2 * (rows % 2) + columns % 2
    energy = np.empty(blocks.shape[:2])
    for k in np.unique(fold):
        energy[fold == k] = residual_energy(blocks[fold == k], solve_gram(blocks[fold != k].sum(axis=0)))
    return energy.ravel()


def _pays(low: np.ndarray, high: np.ndarray) -> bool:
    gain = low - high
    return float(gain.mean()) > STANDARD_ERRORS * float(gain.std(ddof=1)) / np.sqrt(len(gain))
