"""Run the loop on a dataset store, and write its record, its report with tables, and the corrected model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from litho_data.foundation.begun import whole_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Result
from litho_data.foundation.run_facts import run_info
from litho_data.sharing.workers import Workers, kept_open
from litho_data.store import PrintedScan, Store, open_store
from litho_models.effects import get_effect
from litho_models.fitting.base_models import AUTO
from litho_models.fitting.crops import FEWEST_PIXELS
from litho_models.fitting.runs import level_share, step_share
from litho_models.frozen.card import OUT_OF_FOLD, EffectValues
from litho_models.frozen.files import MODEL_FILES, save_frozen
from litho_models.loop.bases import bases_for
from litho_models.loop.closing import Closed, close
from litho_models.loop.errors import HeldOut, Parts, error_rows, nested_errors
from litho_models.loop.fits import Report, Study
from litho_models.loop.marks import rounding
from litho_models.loop.planting import parse_planted, plant
from litho_models.loop.record import CloseLoop, Decision, ScanFinding
from litho_models.loop.report import write_report
from litho_models.loop.results import record
from litho_models.loop.single_scans import SingleScans
from litho_models.simulator import Simulator
from litho_models.splits.folds import GROUPED_FOLDS, Split

MODEL_FOLDER, QUESTIONS_FILE = "model", "open_questions.json"
# A function that receives a closed loop and its findings about per-scan terms. It returns the loop, which it
# may have changed, the decisions on open questions, and a list of further records to write.
Further = Callable[[Closed, Sequence[ScanFinding]], tuple[Closed, list[Decision], Sequence[Result]]]


def close_loop(
    store: str | Path,
    out: str | Path,
    *,
    base: str = AUTO,
    base_settings: Mapping[str, Any] = {},
    folds: int = GROUPED_FOLDS,
    nested: Parts | None = None,
    inject: Sequence[str] = (),
    open_lock_box: bool = False,
    steps: int | None = None,
    cache: str | Path | None = None,
    seed: int = 0,
    workers: int = 1,
    dask: str | None = None,
    further: Further | None = None,
    decided_by: Sequence[str] = (),
    left_out: Sequence[str] = (),
    report: Report = lambda message: None,
) -> CloseLoop:
    """Close the loop on a dataset store: find the effects that a base model lacks, and write the corrected
    model and the record to the folder ``out``. This folder appears only when the result is complete.

    Args:
        store: folder of a store made by ``litho-data build``.
        out: folder of the result.
        base: the base model to correct: the name of a model, a frozen model (its folder or ``zoo:NAME``), or
            ``auto``, which tries several small models and chooses one of them.
        base_settings: settings of a small base model, such as ``{"spot.sigma_um": 0.3}``.
        folds: number of folds. Each scan is predicted by models that were fitted without the scans of its
            fold.
        nested: if ``folds`` or ``prints``, the loop is repeated for each fold (or print): it runs without
            this fold (or print), and its result is scored on the scans that were left out. The base model is
            not chosen again.
        inject: effects in the form ``NAME=AMOUNT``. Each effect is planted in copies of the scans to test
            whether the loop finds it.
        open_lock_box: whether to score the corrected model also on the locked scans.
        steps: number of optimiser steps if the base is a network; by default the number in its recipe. For
            each fold, a network is trained without the scans of this fold.
        cache: folder in which trained networks are kept; by default a folder beside ``out``.
        seed: seed of the folds, the calibration blocks and the permutations.
        workers: number of local processes.
        dask: address of a Dask scheduler to use instead of local processes.
        further: function that receives the result of the loop and its findings about per-scan terms. It
            returns three values: the result to record, which it may have changed; the decisions on open
            questions; and a list of further records.
        decided_by: hashes of the further stores that the function ``further`` uses. They are recorded in the
            settings.
        left_out: one text for each unused scan of the further stores: the name of the scan and the reason.
        report: function that receives the progress messages.

    Raises:
        InputError: there is no store, the base is unknown, the usable scans show fewer than two printed
            fields, the base is a frozen network that was trained on scans of this store, or ``nested`` is set
            although the loop does not refit the base or although there is only one print.
    """
    wanted = [parse_planted(text) for text in inject]
    opened = open_store(store)
    usable, dropped = measured_scans(opened)
    locked = [scan for scan in usable if scan.id in opened.locked_ids]
    development = [scan for scan in usable if scan.id not in opened.locked_ids]
    if nested == "prints" and len({scan.print_id for scan in development}) < 2:
        raise InputError("--nested prints", got="scans of one print", wanted="scans of at least 2 prints")
    settings = {
        "base": base, "base_settings": dict(base_settings), "folds": folds, "nested": nested,
        "inject": list(inject), "steps": steps,
        "open_lock_box": open_lock_box, "seed": seed, "new_prints": list(decided_by),
    }  # fmt: skip
    facts = {"dataset": opened.dataset_id.model_dump(mode="json"), "settings": settings}
    model_files = (f"{MODEL_FOLDER}/{name}" for name in MODEL_FILES)
    holds = (CloseLoop.FILE_NAME, QUESTIONS_FILE, "report.html", "*.csv", *model_files)
    with (
        whole_folder(out, *holds, record=CloseLoop.FILE_NAME, facts=facts) as folder,
        kept_open(Workers(workers, dask)) as places,
    ):
        study = Study.dealt(development, folds, seed, places, report)
        bases = bases_for(
            base,
            study,
            steps=steps,
            cache=Path(cache or f"{out}-cache"),
            fields=base_settings,
            nested=nested is not None,
            store=opened,
        )
        closed = close(study, bases)
        models = HeldOut(study)
        alone: list[ScanFinding] = []
        if not study.of_films:
            report("looking for terms that differ from scan to scan")
            alone = SingleScans(study, models.maps_um(closed.final)).findings()
            alone += rounding(opened, development)
        closed, decisions, beside = further(closed, alone) if further else (closed, [], ())
        errors, left_out_nm = models.errors(closed), models.left_out_nm(closed)
        if nested:
            chosen = {closed.base_name: bases[closed.base_name]}
            errors += nested_errors(study, nested, partial(close_again, chosen, folds, seed))
        if open_lock_box and locked:
            for stage, predicted in models.of_others(closed, locked).items():
                errors += error_rows(locked, *predicted, seed, model=stage, held_out="locked")
        planted = plant(wanted, closed, partial(close_again, bases, folds, seed))
        result = record(
            closed,
            errors,
            single_scans=alone,
            left_out_nm=left_out_nm,
            run=run_info([seed], len(development), [*dropped, *left_out]),
            dataset=opened.dataset_id,
            measurement=models.fit(closed.final).measurement,
            planted=planted,
            decisions=decisions,
            settings=settings,
            split=Split(kind="grouped", folds=len(study.folds), lock_box=opened.locked_ids),
        )  # fmt: skip
        for written in (result, *beside):
            written.write(folder)
        write_report(result, study.scans, map(models.maps_um, closed.ends.values()), folder)
        save_model(closed, result, opened, folder / MODEL_FOLDER)
    return result


def close_again(
    bases: Mapping[str, nn.Module], folds: int, seed: int, scans: Sequence[PrintedScan]
) -> Closed:
    """Run the search of a loop on other scans, which are divided into at most ``folds`` folds. ``bases`` are
    the base models, keyed by name.
    """
    return close(Study.dealt(scans, folds, seed), bases)


def measured_scans(store: Store) -> tuple[list[PrintedScan], list[str]]:
    """Return two lists: the scans with enough measured pixels, and one text for each scan that has too few.
    The text contains the name of the scan and the reason why it is left out.
    """
    scans = store.scans()
    few = [scan.id for scan in scans if np.count_nonzero(scan.usable) < FEWEST_PIXELS]
    usable = [scan for scan in scans if scan.id not in few]
    return usable, [f"{one}: fewer than {FEWEST_PIXELS} measured pixels" for one in few]


def save_model(closed: Closed, result: CloseLoop, store: Store, folder: Path) -> None:
    """Save the corrected model as a frozen model, i.e. with fixed parameters. If the strength of an effect
    differs by group, it is fixed at its value for the group that contains the latest scan.
    """
    base = closed.final.twin.chain().base
    assert isinstance(base, Simulator)
    latest = max(closed.study.scans, key=lambda scan: scan.order)
    values = closed.final.twin.values(latest)
    sides = {"process": "printer", "measurement": "microscope"}

    def on(*roles: str) -> EffectValues:
        return {one.name: values[one.name] for one in result.effects if one.role in roles}

    error = result.error("all")
    assert error is not None
    save_frozen(
        base,
        folder,
        name=f"{result.base_model}, loop findings",
        process_effects=on("process"),
        measurement_effects=on("measurement"),
        undetermined_effects=on("nuisance", "undetermined"),
        dataset=result.dataset,
        attributed={
            one.name: sides[one.role]
            for one in result.effects
            if one.role in sides and get_effect(one.name).role != one.role
        },
        split={
            **dict(result.split),
            "lock_box_files_sha256": sorted(store.files_sha256(result.split.lock_box).values()),
        },
        training_level_share=level_share(closed.given.scans),
        training_step_share=step_share(closed.given.scans),
        confusable_sets=[[e.name, *e.confusable_with] for e in result.effects if e.confusable_with],
        metrics=[
            {
                "name": "mae_datum_free",
                "value": error.mae_nm,
                "ci95": error.mae_ci95_nm,
                "split": OUT_OF_FOLD,
                "policy": error.policy,
                "background": "shared",
            }
        ],
    )
