"""Compute the residuals of a model on the scans of a store. The predictions come either from the cache of a
benchmark, which contains predictions of held-out scans, or from a frozen model.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.kinds import Array
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan, Store
from litho_models.evaluation.fit_cache import expected, fit_folder, kept_fit
from litho_models.evaluation.results import Benchmark
from litho_models.frozen import zoo
from litho_models.frozen.card import CARD_FILE
from litho_models.frozen.files import load_frozen
from litho_models.frozen.on_store import card_background, locked_scans, predict_frozen, trained_ids
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scan_terms.policies import usual_background, usual_policy
from litho_models.scoring.metrics import residual_um
from litho_models.scoring.records import Prediction
from litho_models.scoring.statistics import Interval, pixel_interval


class Residuals(NamedTuple):
    """The residuals of a model on each scan. A residual is the measured height minus the predicted height.

    Attributes:
        maps_um: height maps that the model predicts, µm, one of shape (ny, nx) for each scan.
        residuals_nm: residuals of each scan, nm, after the terms of ``protocol`` are removed, one map of
            shape (ny, nx) for each scan. The maps are NaN at pixels that are not scored.
        held_out: True if every scan is predicted by a model that was not trained on it.
    """

    model: str
    scans: Sequence[PrintedScan]
    maps_um: Sequence[Array]
    residuals_nm: Sequence[Array]
    held_out: bool
    protocol: NuisanceProtocol = NuisanceProtocol()


class Pool(NamedTuple):
    """Some pixels of several scans, treated as one list of n pixels. ``used`` contains one mask of shape (ny,
    nx) for each scan. The mask is True at the pixels in the list.
    """

    scans: Sequence[PrintedScan]
    used: Sequence[Array]

    def of(self, maps: Sequence[Array]) -> Array:
        """Return the values of ``maps`` at these pixels. ``maps`` contains one map for each scan. The result
        has shape (n,).
        """
        return np.concatenate([field[use] for field, use in zip(maps, self.used, strict=True)])

    def interval(self, values: Array, mine: Array) -> Interval:
        """Return the confidence interval of the mean of ``values`` over the pixels at which ``mine`` is True.
        The interval comes from resampling prints. Both arrays have shape (n,).
        """
        owner = np.repeat(np.arange(len(self.scans)), [int(use.sum()) for use in self.used])
        return pixel_interval(values[mine], owner[mine], [scan.print_id for scan in self.scans])


def read_residuals(store: Store, source: str | Path, model: str | None = None) -> Residuals:
    """Return the residuals (measured minus predicted height) of each scan, after the per-scan terms are
    removed. The terms are fitted to pixels other than those from which they are removed.

    The scored pixels, the policy and the background are the same as in the benchmark or, for a frozen model,
    as in ``evaluate``. The mean absolute value of the residuals is therefore the error that the benchmark or
    ``evaluate`` reports.

    Args:
        store: dataset store of the benchmark, or store with the scans to which the frozen model is applied.
        source: a frozen model (a folder or ``zoo:NAME``), or the result folder of ``litho-models benchmark``,
            whose cache contains predictions of held-out scans. Scans are left out if the store locks them or
            if they were locked when the frozen model was trained.
        model: name of a model in the benchmark; by default the model with the smallest datum-free error.

    Raises:
        InputError: the folder contains neither a frozen model nor a benchmark; the benchmark belongs to
            another dataset or its cache is missing; ``model`` is unknown, or is given together with a frozen
            model; or there are no predictions for scans of the store.
    """
    folder = zoo.model_folder(source, other=["the result of a benchmark"])
    if not (folder / CARD_FILE).exists():
        name, maps, protocol = _of_benchmark(store, folder, model)
        held_out = True
    elif model is None:
        name, maps, protocol, held_out = _of_frozen(store, folder)
    else:
        raise InputError(
            "name of a model",
            got=f"{model} together with a frozen model",
            wanted="a benchmark that contains this model, or no name",
        )
    scans = [store.scan(scan_id) for scan_id in store.ids if scan_id in maps]
    if not scans:
        raise InputError("residuals", got="none for scans of the store", wanted="predictions of its scans")
    found = [maps[scan.id] for scan in scans]
    residuals = [NM_PER_UM * residual_um(scan, own, protocol) for scan, own in zip(scans, found, strict=True)]
    return Residuals(name, scans, found, residuals, held_out, protocol)


def _of_benchmark(
    store: Store, folder: Path, model: str | None
) -> tuple[str, dict[str, Array], NuisanceProtocol]:
    result = Benchmark.read(folder)
    if result.dataset.sha256 != store.sha256:
        raise InputError(
            f"dataset of {folder}",
            got=f"{result.dataset.name} {result.dataset.sha256[:12]}…",
            wanted=f"{store.name} {store.sha256[:12]}…, the store given",
        )
    chosen = model or min(result.scores, key=lambda score: score.mae_datum_free_nm).model
    require_known(f"model of {folder}", chosen, [score.model for score in result.scores])
    maps = {}
    for fit in (entry for entry in result.fits if entry.model == chosen):
        cache = fit_folder(folder / "cache", fit.model, fit.key)
        if not cache.exists():
            raise InputError(
                f"cache of {folder}",
                got=f"no {cache.name}",
                wanted="the cache folder that the benchmark wrote",
            )
        record, heights = kept_fit(cache)
        for scan_id, height_um in zip(record.held_out_ids, heights, strict=True):
            if scan_id in result.split.scored_ids and scan_id in store.ids:
                own = expected(fit, result.nuisance.background, store.scan(scan_id), height_um)
                maps[scan_id] = own.map_um
    return chosen, maps, result.nuisance


def _of_frozen(store: Store, folder: Path) -> tuple[str, dict[str, Array], NuisanceProtocol, bool]:
    frozen = load_frozen(folder)
    frozen.check_geometry(store.pitch_um, store.level_height_um)
    film = store.instrument == "sem"
    locked = locked_scans(frozen.card, store)
    scans = [store.scan(scan_id) for scan_id in store.ids if scan_id not in locked]
    learned = card_background(frozen, scans) if usual_background(film) == "training" else None
    predictions = {scan.id: Prediction.beside(learned, scan, predict_frozen(frozen, scan)) for scan in scans}
    maps = {scan: prediction.map_um for scan, prediction in predictions.items()}
    protocol = NuisanceProtocol.of_policy(usual_policy(film), background="training" if learned else "none")
    return frozen.name, maps, protocol, not trained_ids(frozen.card, store) & set(maps)
