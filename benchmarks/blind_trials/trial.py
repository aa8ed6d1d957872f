"""Run one trial: the fab makes scans, a store is built from them, the loop is run on the store, and its
findings are judged.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from benchmarks.blind_trials.measured import inject, measured_jobs, middle
from litho_data.foundation.errors import InputError
from litho_data.making.build import build_dataset
from litho_data.store import open_store
from litho_models.boards.board import TRIALS, cpu_s, name_of
from litho_models.boards.judging import broken, judged
from litho_models.boards.own_loop import answer_of
from litho_models.boards.planting import plant, trial_jobs, write_raw
from litho_models.boards.records import Draw, Draws, Planted, Trial
from litho_models.loop.run import close_loop


def trial_folder(out: Path, draw: Draw) -> Path:
    """Return the folder of a trial, which contains its result and the loop's files."""
    return out / TRIALS / name_of(draw)


def run_trial(
    draw: Draw,
    draws: Draws,
    out: Path,
    *,
    measured: Path | None = None,
    keep_data: bool = False,
    report: Callable[[str], None] = lambda message: None,
) -> Trial:
    """Run and judge one trial. Write its record ``trial.json`` into the folder of the trial, beside the
    results of the loop, and return it.

    The loop receives only the store. An error is not raised, but recorded as the result of the trial.

    Args:
        draw: the effects to plant.
        draws: the settings of the board to which the trial belongs.
        out: folder of the board.
        measured: store of measured prints, which is needed for trials on measured prints.
        keep_data: whether to keep the raw files and the store of the trial. They can be made again from the
            draw.
        report: function that is called with a message at each stage of the trial.
    """
    folder = trial_folder(out, draw)
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
            planted = plant(draw, middle(jobs, draws.size_px), draws.base)
            started_s = cpu_s()
            inject(opened, store, draw, planted, jobs)
        else:
            jobs = trial_jobs(draw, draws.n_scans, draws.size_px)
            planted = plant(draw, jobs, draws.base)
            card = write_raw(draw, planted, jobs, folder / "raw")
            started_s = cpu_s()
            build_dataset(card, store)
        result = close_loop(store, folder / "loop", base=draws.base, report=report)
        used_s = cpu_s() - started_s
        report("judging")
        trial = judged(draw, planted, answer_of(result), jobs, open_store(store), used_s).model_copy(
            update={"verdict": result.verdict, "base_model": result.base_model}
        )
    except Exception as error:
        trial = broken(draw, error, planted, {out: "OUT"})
    if not keep_data:
        for data in ("raw", "store.zarr", "store-report"):
            shutil.rmtree(folder / data, ignore_errors=True)
    trial.write(folder)
    return trial
