"""Make the base models (models of the printer without effects) that the loop may correct: either the model
that the user asked for, or several small models.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torch import nn

from litho_data.foundation import InputError
from litho_data.store import PrintedScan, Store
from litho_models.fitting import Fitted, TrainingConfig, fit_in_cache
from litho_models.fitting.base_models import AUTO, base_models
from litho_models.fitting.fit import common_geometry
from litho_models.frozen import zoo
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_simulator
from litho_models.frozen.on_store import trained_ids
from litho_models.loop.fits import Study
from litho_models.loop.model import FoldedBase, is_refitted
from litho_models.models import MODELS
from litho_models.simulator import is_small


def bases_for(
    base: str,
    study: Study,
    *,
    steps: int | None = None,
    cache: Path,
    fields: Mapping[str, Any] = {},
    nested: bool = False,
    store: Store | None = None,
) -> Mapping[str, nn.Module]:
    """Return the base models that the loop may correct, keyed by name. If the base is a network, it is
    trained once for each fold, without the scans of this fold.

    Args:
        base: name of a model; a frozen (saved and no longer trained) model, given by its folder or as
            ``zoo:NAME``; or ``auto`` for several small models, from which the loop chooses one.
        study: the scans with their folds, the seed and the workers.
        steps: number of optimiser steps for a network. If it is None, the number in the training recipe of
            the network is used.
        cache: folder in which trained networks are kept.
        fields: settings of a small model, keyed by name, such as ``{"spot.sigma_um": 0.3}``.
        nested: whether all choices will be repeated without some of the scans. This needs a base that is
            refitted.
        store: the store of the scans. A frozen model that is not refitted must not have been trained on
            scans of this store.

    Raises:
        InputError: the base is unknown, its pitch differs from that of the scans, it was trained on scans of
            ``store``, settings are given for a base that is not a small model, or ``nested`` is set for a
            base that is not refitted.
    """
    scan = study.scans[0]
    bases: Mapping[str, nn.Module]
    if base == AUTO or base in MODELS:
        bases = base_models(base, common_geometry([scan]), {} if base == AUTO else fields)
    else:
        bases = _frozen(base, scan.pitch_um, store)
    small = all(map(is_small, bases.values()))
    if fields and not (small and base in MODELS):
        raise InputError(
            f"settings of {base}", got=", ".join(fields), wanted="no settings, or the name of a small model"
        )
    # This is checked before a network is trained, which takes long.
    if nested and not all(map(is_refitted, bases.values())):
        raise InputError(
            f"--nested with {base}", got="a base that is not refitted", wanted="the name of a small model"
        )
    if small or base not in MODELS:
        return bases
    given: dict[str, Any] = {} if steps is None else {"steps": steps}
    recipe = TrainingConfig.of_recipe("fast", base, film=study.of_films, seed=study.seed, **given)
    return {base: train_folds(study, partial(fit_in_cache, base, config=recipe, cache=cache))}


def _frozen(base: str, pitch_um: float, store: Store | None) -> dict[str, nn.Module]:
    folder = zoo.model_folder(base, other=[AUTO, *MODELS])
    card = ModelCard.read(folder)
    if abs(card.pitch_um - pitch_um) > 1e-9:
        wanted = f"{pitch_um:g} µm, the pitch of the scans"
        raise InputError(f"pitch of {base}", got=f"{card.pitch_um:g} µm", wanted=wanted)
    model = load_simulator(folder, card)
    if store is not None and not is_refitted(model) and trained_ids(card.model_dump(), store):
        raise InputError(
            f"base {base}",
            got="a model that was trained on scans of this store, so no scan is held out",
            wanted="a model of other prints",
            hint="give the name of a model, such as pbl, to train it without each fold",
        )
    return {card.name: model}


def train_folds(study: Study, trainer: Callable[[Sequence[PrintedScan]], Fitted]) -> FoldedBase:
    """Train one model for each fold on the scans outside this fold, and one model on all scans.

    Args:
        study: the scans with their folds, and the workers.
        trainer: function that trains a model on the scans that it receives. It must be picklable, because it
            is sent to other processes.
    """
    # The last model is trained on all scans.
    jobs = [partial(trainer, known) for known in (*study.others, study.scans)]
    trained = study.run(jobs, "training the base model")
    fold_of = dict(zip((scan.id for scan in study.scans), study.fold_of.tolist(), strict=True))
    return FoldedBase([one.model for one in trained], fold_of)
