"""One run of the loop on a store: result, report, tables and the corrected model in one folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from litho_data.build.gratings import grating_scans
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.outputs import require_replaceable_folder, require_same_settings
from litho_data.foundation.workers import Workers, kept_open
from litho_data.store import PrintedScan, Store, open_store
from litho_data.store.again import StoredScans
from litho_models.effects import get_effect
from litho_models.fitting import TrainingConfig, fit_in_cache
from litho_models.fitting.runs import level_share, step_share
from litho_models.frozen import zoo
from litho_models.frozen.files import save_frozen
from litho_models.loop.close import close_loop
from litho_models.loop.findings import LoopConfig, LoopFindings, corrected_chain, loop_config
from litho_models.loop.folded_base import Trainer
from litho_models.loop.open_questions import open_questions
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.report.page import write_report
from litho_models.loop.result.exporting import exported_effects, write_measurement_model
from litho_models.loop.result.questions import OpenQuestions
from litho_models.loop.result.record import CloseLoop
from litho_models.loop.result.summary import summarise
from litho_models.loop.second_round import decide, with_decisions
from litho_models.loop.single_scans.observed import rounding_step_um
from litho_models.models import MODELS, build_model
from litho_models.simulator import Simulator, is_small

MODEL_FOLDER, MEASUREMENT_FILE = "model", "measurement_model.json"


def close_loop_on_store(
    store: str | Path,
    out: str | Path,
    *,
    new_prints: Sequence[str | Path] = (),
    base: str = "physics",
    config: LoopConfig | None = None,
    steps: int | None = None,
    cache: str | Path | None = None,
    workers: int = 1,
    dask: str | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> CloseLoop:
    """Close the loop on a dataset store and write everything to ``out``, which appears when complete.

    Args:
        store: a store made by ``litho-data build``.
        new_prints: further stores of the same printer. Names and sets are found on the first store and
            declared; the new prints then decide between them, see ``second_round``.
        base: name of a model, or a frozen one (its folder, ``zoo:NAME``).
        config: settings; ``report`` is told what happens, a sentence at a time.
        steps: optimiser steps of a base that is trained per fold; the recipe's by default.
        cache: folder where such trainings, and the parts of a nested selection, are kept and continued, by
            default beside ``out``; that of a benchmark with the same folds and settings spares its trainings.
        workers: local processes; ``dask``: address of a Dask scheduler instead. They train the base of each
            fold, fit candidates, and make the selections of a nested one.

    Raises:
        InputError: no store, no such base, a base of another pitch, too few usable scans, further stores of
            another printer or with a turned scan whose card does not say so, or a folder with a loop of
            other settings.
    """
    require_replaceable_folder(
        out,
        CloseLoop.FILE_NAME,
        OpenQuestions.FILE_NAME,
        "report.html",
        "*.csv",
        MODEL_FOLDER,
        MEASUREMENT_FILE,
    )
    opened = open_store(store)
    further = [open_store(path) for path in new_prints]
    new = [scan for one in further for scan in _new_scans(opened, one)]
    simulator, name = _base_model(base, opened)
    config = loop_config(config)
    settings = config.model_dump(mode="json")
    settings |= {"steps": steps, "new_prints": [one.sha256 for one in further]}
    facts = {"dataset": opened.dataset_id.model_dump(mode="json"), "base_model": name, "settings": settings}
    require_same_settings(out, CloseLoop.FILE_NAME, facts)
    scans = opened.scans()
    usable = [scan for scan in scans if np.count_nonzero(scan.usable) >= 1024]
    kept = {scan.id for scan in usable}
    dropped = [f"{scan.id}: fewer than 1024 measured pixels" for scan in scans if scan.id not in kept]
    trainer, kept_in = None, Path(cache or f"{out}-cache")
    if base in MODELS and not is_small(simulator):
        trainer = _trainer(base, config, steps, kept_in)
    with kept_open(Workers(workers, dask)) as places:
        findings = close_loop(
            usable,
            simulator,
            config,
            trainer=trainer,
            rounding_um=_rounding_um(opened, usable),
            lock_box=opened.locked_ids,
            cache=kept_in,
            workers=places,
            stored=StoredScans.of(opened, usable),
            report=report,
        )
    result = summarise(findings, dataset=opened.dataset_id, base_name=name, dropped=dropped)
    result = result.model_copy(update={"settings": settings})
    shares = level_share([scan.stored for scan in findings.development])
    questions = open_questions(findings, result, shares, report)
    if new:
        gratings = [scan for one in further for scan in grating_scans(one)]
        decisions = decide(findings, questions, prepare_scans(new), report, gratings)
        result = with_decisions(result, decisions)
    with atomic_folder(out) as folder:
        result.write(folder)
        questions.write(folder)
        write_report(findings, result, folder)
        _save_process_model(findings, result, opened, folder / MODEL_FOLDER)
        write_measurement_model(findings, result, folder / MEASUREMENT_FILE)
    return result


def _new_scans(first: Store, store: Store) -> list[PrintedScan]:
    """The scans of a further store, checked to be of the same printer and turned as their card says."""
    for name in ("pitch_um", "level_height_um", "levels"):
        if getattr(store, name) != getattr(first, name):
            raise InputError(
                f"{name} of {store.path}",
                got=getattr(store, name),
                wanted=f"{getattr(first, name)}, as before",
            )
    planned = store.manifest.get("card", {}).get("plan", {}).get("dataset_sha256")
    if planned is not None and planned != first.sha256:
        raise InputError(
            f"prints of {store.path}",
            got=f"a plan for dataset {planned[:12]}…",
            wanted=f"a plan for {first.path}, {first.sha256[:12]}…",
            hint="they were printed for another printer's questions",
        )
    scans = store.scans()
    for scan in scans:
        stated = round((scan.turned_deg or 0.0) / 90)
        # From which side a print was turned is a convention; that it was turned shows in its registration.
        if (stated - scan.quarter_turns) % 2:
            raise InputError(
                f"scan {scan.id} of {store.path}",
                got=f"turned by {90 * scan.quarter_turns}° on its layout, {90 * stated}° in its card",
                wanted="what the scan shows",
                hint="add the column turned_deg to the table of the card, and build again",
            )
    return scans


def parse_priors(text: str | None) -> tuple[str, ...]:
    """Effect names from a comma-separated list or from a file with one name per line (# starts a comment).

    Raises:
        InputError: a name that is not in the catalogue.
    """
    if not text:
        return ()
    if Path(text).is_file():
        lines = Path(text).read_text(encoding="utf-8").splitlines()
        names: Sequence[str] = [line.split("#")[0].strip() for line in lines]
    else:
        names = [part.strip() for part in text.split(",")]
    return tuple(get_effect(name).name for name in names if name)


def _rounding_um(store: Store, scans: Sequence[PrintedScan]) -> dict[str, float] | None:
    """Step of the heights in the raw file of each scan; None where the store has no raw files."""
    try:
        return {scan.id: rounding_step_um(store.scan_frame(scan.id, "raw_height_um")) for scan in scans}
    except InputError:
        return None


def _trained(base: str, settings: TrainingConfig, cache: Path, scans: Sequence[PrintedScan]) -> nn.Module:
    return fit_in_cache(base, scans, settings, cache).model


def _trainer(base: str, config: LoopConfig, steps: int | None, cache: Path) -> Trainer:
    given: dict[str, Any] = {} if steps is None else {"steps": steps}
    given |= {"seed": config.seed, "weights": config.weights}
    settings = TrainingConfig.of_recipe("fast", base, **given)
    return partial(_trained, base, settings, cache)


def _base_model(base: str, store: Store) -> tuple[Simulator, str]:
    if base in MODELS:
        model = build_model(
            base, pitch_um=store.pitch_um, level_height_um=store.level_height_um, levels=store.levels
        )
        return model, base
    folder = zoo.model_folder(base, other=MODELS)
    from litho_models.frozen.card import ModelCard
    from litho_models.frozen.files import load_simulator

    card = ModelCard.read(folder)
    if abs(card.pitch_um - store.pitch_um) > 1e-9:
        raise InputError(f"pitch of {base}", got=f"{card.pitch_um:g} µm", wanted=f"{store.pitch_um:g} µm")
    return load_simulator(folder, card), card.name


def _attributed(result: CloseLoop) -> dict[str, str]:
    """Whose an effect is where new prints have decided, and not the catalogue."""
    sides = {"process": "printer", "measurement": "microscope"}
    return {
        effect.name: sides[effect.role]
        for effect in result.effects
        if effect.role in sides
        and not get_effect(effect.name).per_scan
        and get_effect(effect.name).role != effect.role
    }


def _save_process_model(findings: LoopFindings, result: CloseLoop, store: Store, folder: Path) -> None:
    chain = corrected_chain(findings)
    groups = exported_effects(chain, result)
    assert isinstance(chain.base, Simulator)
    save_frozen(
        chain.base,
        folder,
        name=f"{result.base_model}, loop findings",
        process_effects=groups["process"],
        measurement_effects=groups["measurement"],
        undetermined_effects=groups["undetermined"],
        attributed=_attributed(result),
        dataset=result.dataset.model_dump(mode="json"),
        command=result.run.command,
        split={
            **result.split.model_dump(mode="json"),
            "lock_box_files_sha256": sorted(store.files_sha256(findings.lock_box).values()),
        },
        nuisance=result.nuisance.model_dump(mode="json"),
        noise_floor=result.noise_floor.model_dump(mode="json"),
        training_level_share=level_share([scan.stored for scan in findings.development]),
        training_step_share=step_share([scan.stored for scan in findings.development]),
        confusable_sets=[[e.name, *e.confusable_with] for e in result.effects if e.confusable_with],
        unexplained_fraction=result.shares.unexplained_structured,
        metrics=[
            {"name": f"mae_{kind}", "value": value, "split": "grouped", "policy": policy}
            for kind, value, policy in (
                ("abs", result.after.mae_abs_nm, "none"),
                ("datum_free", result.after.mae_datum_free_nm, "offset"),
            )
        ],
    )
