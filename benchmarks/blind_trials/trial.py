"""One trial: the fab makes raw files, `build` makes a store, the loop sees the store, the judge the truth."""

from __future__ import annotations

import resource
import shutil
import traceback
from collections.abc import Callable
from pathlib import Path

from benchmarks.blind_trials.judging import bias_of, false_names, found_by, judge, true_floor
from benchmarks.blind_trials.measured import inject, measured_jobs, middle
from benchmarks.blind_trials.planting import plant, trial_jobs, write_raw
from benchmarks.blind_trials.records import Draw, Draws, Outcome, Planted, Trial, TrialErrors
from litho_data.foundation.errors import InputError
from litho_data.making.build import build_dataset
from litho_data.store import open_store
from litho_models.loop.run import close_loop


def trial_folder(out: Path, number: int) -> Path:
    """Where the loop works on a trial and its result goes."""
    return out / "trials" / f"{number:02d}"


def run_trial(
    draw: Draw,
    draws: Draws,
    out: Path,
    *,
    measured: Path | None = None,
    keep_data: bool = False,
    report: Callable[[str], None] = lambda message: None,
) -> Trial:
    """Run and judge one trial; writes ``trials/NN/trial.json`` and the loop's own results beside it.

    The loop is given the store alone. An error becomes the trial's result and is not raised.

    Args:
        draw: what to plant; ``draws``: the board that it belongs to.
        out: folder of the board.
        measured: store of measured prints, for trials on those.
        keep_data: keep raw files and store, which the draw makes again.
        report: told what happens, a sentence at a time.
    """
    folder = trial_folder(out, draw.number)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    planted: list[Planted] = []
    try:
        report("setting the strengths")
        store = folder / "store.zarr"
        if draw.kind == "measured":
            if measured is None:
                raise InputError("store of measured prints", got="none", wanted="--measured STORE")
            opened = open_store(measured)
            jobs = measured_jobs(opened)
            planted = plant(draw, middle(jobs, draws.size_px))
            started_s = _cpu_s()
            inject(opened, store, draw, planted, jobs)
        else:
            jobs = trial_jobs(draw, draws.n_scans, draws.size_px)
            planted = plant(draw, jobs)
            card = write_raw(draw, planted, jobs, folder / "raw")
            started_s = _cpu_s()
            build_dataset(card, store)
        result = close_loop(store, folder / "loop", base=draws.base, report=report)
        used_s = _cpu_s() - started_s
        report("judging")
        locked = set(result.split.lock_box)
        scans = [scan for scan in open_store(store).scans() if scan.id not in locked]
        before, after = result.error("base"), result.error("all")
        assert before is not None
        assert after is not None
        floor = (
            None if draw.kind == "measured" else true_floor(draw, planted, jobs, scans, result.run.seeds[0])
        )
        trial = Trial(
            draw=draw,
            planted=planted,
            outcomes=judge(draw, planted, result, jobs, scans),
            false_names=false_names(planted, result),
            found=found_by(result),
            verdict=result.verdict,
            base_model=result.base_model,
            errors=TrialErrors(before_nm=before.mae_nm, after_nm=after.mae_nm, floor_nm=floor),
            bias=bias_of(draw, result),
            dataset_cpu_s=used_s,
        )
    except Exception as error:
        traceback.print_exc()
        # Results are published: where they were made must not show.
        trial = failed(draw, f"{type(error).__name__}: {error}".replace(str(out), "OUT"), planted)
    if not keep_data:
        for data in ("raw", "store.zarr", "store-report"):
            shutil.rmtree(folder / data, ignore_errors=True)
    trial.write(folder)
    return trial


def failed(draw: Draw, reason: str, planted: list[Planted] | None = None) -> Trial:
    """The result of a trial that did not come to an end."""
    names = [one.name for one in draw.causes] or ["none"]
    return Trial(
        draw=draw,
        planted=planted or [],
        outcomes=[Outcome(name=name, verdict="failed") for name in names],
        failure=" ".join(reason.split()),
    )


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
