"""Evaluate one frozen model on a dataset, and write ``evaluation.json`` and a report."""

from pathlib import Path
from typing import Literal

from litho_data.commands.progress import progress
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.run_facts import run_info
from litho_data.store import open_store
from litho_data.store.lock_box import ids_sha256
from litho_models.evaluation.reports import write_evaluation_report
from litho_models.evaluation.results import Evaluation, ModelRecord
from litho_models.frozen.files import load_frozen
from litho_models.frozen.on_store import (
    card_background,
    locked_scans,
    made_of_these_prints,
    predict_frozen,
    trained_ids,
)
from litho_models.scan_terms import NuisanceProtocol, Policy
from litho_models.scan_terms.policies import usual_background, usual_policy
from litho_models.scoring.noise_floor import stated_floor
from litho_models.scoring.records import Prediction
from litho_models.scoring.scores import score_model
from litho_models.splits.folds import ScoredSplit


def evaluate(
    model: str | Path,
    store: str | Path,
    out: str | Path,
    *,
    policy: Policy | None = None,
    background: Literal["training", "none"] | None = None,
    noise: str | Path | None = None,
    extrapolate: bool = False,
    open_lock_box: bool = False,
) -> Evaluation:
    """Score a frozen model on the scans of a store and write the result and its report.

    A scan counts as locked if it is in the lock box of this store, or if it was locked when the model was
    trained. Locked scans are left out if the model was trained on this store, or if scans of this store were
    locked when the model was trained. Otherwise, or with ``open_lock_box``, all scans are scored. The result
    states which scans are locked and whether any of them was scored.

    Args:
        model: folder of a frozen model, or ``zoo:NAME``.
        store: dataset store.
        out: folder for ``evaluation.json``, ``report.html`` and the CSV tables.
        policy: name of a set of nuisance terms, which are fitted to each scan before the datum-free error is
            computed; by default ``offset``, or ``none`` for films.
        background: ``training`` (the default) adds the background in the model's card to the predictions.
            ``none`` (the default for films) adds no background. If the card has no background for fields of
            this size, none is added, and the result states the background ``none``.
        noise: path of the ``noise.json`` of this dataset, or of the folder with this file. The noise floor in
            this file is shown beside the errors.
        extrapolate: also accept layouts with heights outside the calibrated range, which the model's card
            states.
        open_lock_box: also score locked scans that would otherwise be left out.

    Raises:
        InputError: the model or the store cannot be read, their pitch or level height differs, no scan is
            left to score, the noise analysis belongs to another dataset, or the name of the background is
            unknown.
    """
    dataset = open_store(store)
    film = dataset.instrument == "sem"
    policy, added = policy or usual_policy(film), background or usual_background(film)
    require_known("background", added, ("training", "none"))
    floor = stated_floor(dataset.name, noise)
    frozen = load_frozen(model, extrapolate=extrapolate)
    frozen.check_geometry(dataset.pitch_um, dataset.level_height_um)
    subject = {"dataset": {"name": dataset.name}, "model": {"name": frozen.name}}
    with growing_folder(out, Evaluation.FILE_NAME, subject):
        every = dataset.scans()
        locked = locked_scans(frozen.card, dataset)
        locked_too = open_lock_box or not made_of_these_prints(frozen.card, dataset)
        scans = [scan for scan in every if locked_too or scan.id not in locked]
        if not scans:
            raise InputError(f"scans of {store} to score", got="none", wanted="at least one")
        ids = [scan.id for scan in scans]
        learned = card_background(frozen, scans) if added == "training" else None
        predictions = [
            Prediction.beside(learned, scan, predict_frozen(frozen, scan))
            for scan in progress(scans, "predicting")
        ]
        protocol = NuisanceProtocol.of_policy(policy, background="training" if learned else "none")
        result = Evaluation(
            run=run_info([protocol.seed], len(scans)),
            dataset=dataset.dataset_id,
            model=ModelRecord(
                name=frozen.name,
                sha256=frozen.sha256,
                extrapolated=extrapolate,
                parameters=frozen.card["parameters"],
            ),
            split=ScoredSplit(
                kind="given",
                scored_ids=ids,
                scored_ids_sha256=ids_sha256(ids),
                lock_box=locked,
                lock_box_opened=not set(locked).isdisjoint(ids),
            ),
            nuisance=protocol,
            noise_floor=floor,
            trained_on_scored_scans=sorted(trained_ids(frozen.card, dataset) & set(ids)),
            scores=score_model(frozen.name, scans, predictions, protocol),
        )
        write_evaluation_report(result, scans, [prediction.map_um for prediction in predictions], out)
        result.write(out)
    return result
