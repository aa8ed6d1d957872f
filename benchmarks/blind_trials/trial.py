"""One trial: the fab makes raw files, `build` makes a store, the loop sees the store, the judge the truth."""

from __future__ import annotations

import resource
import shutil
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from benchmarks.blind_trials.judging import judge, named_outside_span, scan_terms, strangers, true_floor
from benchmarks.blind_trials.planting import cause_of, knob_settings, plant, printer_of, trial_jobs
from benchmarks.blind_trials.records import Cost, Draw, ErrorPair, Outcome, Planted, Trial, TrialErrors
from litho_data.build.build import build_dataset
from litho_data.store import open_store
from litho_data.virtual_fab import Truth, simulate
from litho_models.frozen.card import ModelCard
from litho_models.loop.result.record import CloseLoop, TermsError
from litho_models.loop.run import MODEL_FOLDER, close_loop_on_store


def trial_folder(out: Path, number: int) -> Path:
    """Where the loop works on a trial and its result goes."""
    return out / "trials" / f"{number:02d}"


def run_trial(
    draw: Draw,
    out: Path,
    *,
    n_scans: int,
    size_px: int,
    keep_data: bool = False,
    report: Callable[[str], None] = lambda message: None,
) -> Trial:
    """Run and judge one trial; writes ``trials/NN/trial.json`` and the loop's own results beside it.

    The truth lies in another branch, ``truth/NN``, that only the judge opens. An error becomes the
    trial's result and is not raised.

    Args:
        draw: what to plant.
        out: folder of the campaign; n_scans, size_px: scans of a trial and side of their layouts.
        keep_data: keep raw files and store, which the truth file's settings make again.
        report: told what happens, a sentence at a time.
    """
    folder, hidden = trial_folder(out, draw.number), out / "truth" / f"{draw.number:02d}"
    for stale in (folder, hidden):
        shutil.rmtree(stale, ignore_errors=True)
    folder.mkdir(parents=True)
    planted: list[Planted] = []
    try:
        jobs = trial_jobs(draw, n_scans, size_px)
        report("setting the knobs")
        planted = plant(draw, jobs)
        fab = folder / "fab"
        card = simulate(
            fab,
            jobs=jobs,
            seed=draw.seed,
            knobs=knob_settings(planted, draw.seed),
            cause=cause_of(planted, draw.seed),
            printer=printer_of(draw),
            metadata="files-only",
        )
        hidden.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(fab / "truth", hidden)
        store, clock, used_s = folder / "store.zarr", time.perf_counter(), _cpu_s()
        report("building the store")
        built = build_dataset(card, store)
        build_s, clock = time.perf_counter() - clock, time.perf_counter()
        result = close_loop_on_store(store, folder / "loop", base="physics", report=report)
        loop_s, dataset_cpu_s = time.perf_counter() - clock, _cpu_s() - used_s
        exported = [*ModelCard.read(folder / "loop" / MODEL_FOLDER).process_effects]
        report("judging")
        floor = true_floor(Truth.read(hidden), draw, planted, jobs, open_store(store), result)
        cost = Cost(build_s=build_s, loop_s=loop_s, cpu_s=_cpu_s(), dataset_cpu_s=dataset_cpu_s)
        trial = _judged(draw, planted, result, exported, floor, cost)
        skipped = [f"{one.id}: {one.reason}" for one in built.skipped]
        trial = trial.model_copy(update={"dropped": skipped + trial.dropped})
    except Exception as error:
        traceback.print_exc()
        # Results are published: where they were made must not show.
        trial = failed(draw, planted, f"{type(error).__name__}: {error}".replace(str(out), "OUT"))
    if not keep_data:
        made = (folder / "fab", folder / "store.zarr", folder / "store-report")
        for data in (*made, hidden / "prints", hidden / "surfaces"):
            shutil.rmtree(data, ignore_errors=True)
    trial.write(folder)
    return trial


def failed(draw: Draw, planted: list[Planted], reason: str) -> Trial:
    """The result of a trial that did not come to an end."""
    effects = [(one.effect, one.rms_nm) for one in planted] or [(k.name, k.wanted_rms_nm) for k in draw.knobs]
    return Trial(
        draw=draw,
        planted=planted,
        outcomes=[
            Outcome(effect=effect, rms_nm=rms_nm, judgement="failed", loop_says="")
            for effect, rms_nm in effects or [("none", 0.0)]
        ],
        also_named=[],
        named=[],
        scan_terms=[],
        verdict="",
        dropped=[],
        errors=None,
        cost=None,
        failure=" ".join(reason.split()),
    )


def _judged(
    draw: Draw,
    planted: list[Planted],
    result: CloseLoop,
    exported: list[str],
    floor: ErrorPair,
    cost: Cost,
) -> Trial:
    named = named_outside_span(result, exported)
    # The floor has the terms that the loop accepted, and so have the errors beside it.
    accepted = next(row for row in result.equal_terms or [] if row.terms == "accepted")
    return Trial(
        draw=draw,
        planted=planted,
        outcomes=judge(draw.kind, planted, result, exported),
        also_named=strangers(named, planted),
        named=named,
        scan_terms=scan_terms(result),
        verdict=result.verdict,
        dropped=result.run.dropped,
        errors=TrialErrors(before=_pair(accepted.before), after=_pair(accepted.after), floor=floor),
        cost=cost,
        failure="",
    )


def _pair(errors: TermsError) -> ErrorPair:
    return ErrorPair(mae_nm=errors.mae_nm, rmse_nm=errors.rmse_nm)


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
