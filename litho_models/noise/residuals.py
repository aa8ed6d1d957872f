"""Where residuals come from: a benchmark's cache (out of fold) or frozen models; several make an ensemble."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.kinds import Array
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan, Store
from litho_models.frozen import zoo
from litho_models.frozen.card import CARD_FILE
from litho_models.frozen.files import load_frozen
from litho_models.frozen.on_store import card_background, predict_frozen, trained_ids
from litho_models.scan_terms import NuisanceProtocol, cross_fit, policy_terms
from litho_models.scoring.records import Prediction

Predictions = dict[str, list[Array]]


class Residuals(NamedTuple):
    """What a model leaves of each scan: measured minus predicted, nm, NaN where not scored.

    Attributes:
        maps_um: the map that the model, or the mean of its members, expects of each scan, (ny, nx).
        residuals_nm: freed of the terms of ``protocol``.
        disagreement_nm: standard deviation of the members' predictions, None for a single one.
        held_out: whether no member had seen the scan that it predicts.
    """

    model: str
    scans: Sequence[PrintedScan]
    maps_um: Sequence[Array]
    residuals_nm: Sequence[Array]
    disagreement_nm: Sequence[Array] | None
    members: int
    held_out: bool
    protocol: NuisanceProtocol = NuisanceProtocol()


def read_residuals(store: Store, sources: Sequence[str | Path], model: str | None = None) -> Residuals:
    """Measured minus the mean prediction of all members, each scan freed of its nuisances by cross-fitting.

    The protocol is that of the benchmark, or of ``evaluate`` for a frozen model: the same pixels, policy and
    shared background, so that these are the residuals whose mean absolute value is the error stated there.

    Args:
        store: the store that the sources were made from.
        sources: result folders of ``litho-models benchmark``, whose cache holds predictions of scans that
            the fit has not seen, or frozen models (folders, ``zoo:NAME``); not both kinds at once. The lock
            box is left out.
        model: which model of a benchmark; its best one by default.

    Raises:
        InputError: a folder that is neither, one given twice, sources of another dataset or of different
            policies, a ``model`` together with frozen ones, or no scan that all predict.
    """
    folders = [zoo.model_folder(source, other=["the result of a benchmark"]) for source in sources]
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("residuals", got="one source twice", wanted="different members of an ensemble")
    frozen = [(folder / CARD_FILE).exists() for folder in folders]
    if any(frozen) and not all(frozen):
        raise InputError("residuals", got="benchmarks and frozen models", wanted="one kind of source")
    if all(frozen):
        if model is not None:
            raise InputError("model", got=f"{model} and a frozen one", wanted="a benchmark to choose it from")
        name, members, protocol, held_out = _of_frozen(store, folders)
    else:
        name, members, protocol = _of_benchmarks(store, folders, model)
        held_out = True
    scans = [store.scan(scan_id) for scan_id in store.ids if scan_id in members]
    if not scans:
        raise InputError("residuals", got="no scan of the store", wanted="predictions of its scans")
    count = min(len(members[scan.id]) for scan in scans)
    maps = [np.mean(members[scan.id], axis=0) for scan in scans]
    terms = policy_terms(protocol.policy)
    residuals = [
        NM_PER_UM * cross_fit(scan.height_um, expected, scan.valid, terms, protocol.blocks).residual_um
        for scan, expected in zip(scans, maps, strict=True)
    ]
    spread = [NM_PER_UM * disagreement_um(members[scan.id]) for scan in scans] if count > 1 else None
    return Residuals(name, scans, maps, residuals, spread, count, held_out, protocol)


def disagreement_um(predictions_um: Sequence[Array]) -> Array:
    """Standard deviation of the members at each pixel, each freed of its own mean: a datum is arbitrary.

    ``(ny, nx)`` µm, as of a sample (n − 1).
    """
    stack = np.stack([prediction - prediction.mean() for prediction in predictions_um]).astype(np.float64)
    return stack.std(axis=0, ddof=1)


def _of_benchmarks(
    store: Store, folders: Sequence[Path], model: str | None
) -> tuple[str, Predictions, NuisanceProtocol]:
    from litho_models.evaluation.fit_cache import expected
    from litho_models.evaluation.results import Benchmark

    members: Predictions = {}
    chosen = model
    protocols = []
    for folder in folders:
        result = Benchmark.read(folder)
        if result.dataset.sha256 != store.sha256:
            raise InputError(
                f"dataset of {folder}",
                got=f"{result.dataset.name} {result.dataset.sha256[:12]}…",
                wanted=f"{store.name} {store.sha256[:12]}…, the store given",
            )
        names = [score.model for score in result.scores]
        chosen = chosen or min(result.scores, key=lambda score: score.mae_datum_free_nm).model
        require_known(f"model of {folder}", chosen, names)
        allowed = set(result.split.scored_ids) & set(store.ids)
        protocols.append(result.nuisance)
        for fit in (entry for entry in result.fits if entry.model == chosen):
            for scan_id, height_um in _cached(folder, fit.model, fit.key).items():
                if scan_id in allowed:
                    seen = expected(fit, result.nuisance.background, store.scan(scan_id), height_um)
                    members.setdefault(scan_id, []).append(seen.map_um)
    policies = sorted({protocol.policy for protocol in protocols})
    if len(policies) > 1:
        raise InputError("nuisance policies of the benchmarks", got=", ".join(policies), wanted="one")
    return str(chosen), members, protocols[0]


def _cached(folder: Path, model: str, key: str) -> dict[str, Array]:
    from litho_models.evaluation.fit_cache import fit_folder, kept_fit

    cache = fit_folder(folder / "cache", model, key)
    if not cache.exists():
        raise InputError(
            f"cache of {folder}", got=f"no {cache.name}", wanted="the benchmark's own cache folder"
        )
    record, heights = kept_fit(cache)
    return dict(zip(record.held_out_ids, heights, strict=True))


def _of_frozen(store: Store, folders: Sequence[Path]) -> tuple[str, Predictions, NuisanceProtocol, bool]:
    models = [load_frozen(folder) for folder in folders]
    for frozen in models:
        frozen.check_geometry(store.pitch_um, store.level_height_um)
    trained_on = {scan_id for frozen in models for scan_id in trained_ids(frozen, store)}
    scans = [store.scan(scan_id) for scan_id in store.ids if scan_id not in store.locked_ids]
    learned = [card_background(frozen, scans) for frozen in models]
    members = {
        scan.id: [
            Prediction.beside(background, predict_frozen(frozen, scan)).map_um
            for frozen, background in zip(models, learned, strict=True)
        ]
        for scan in scans
    }
    protocol = NuisanceProtocol.of_policy("offset", background="training" if any(learned) else "none")
    name = "+".join(sorted({frozen.name for frozen in models}))
    return name, members, protocol, not trained_on & set(members)
