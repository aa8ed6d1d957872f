"""Train and score several models on one dataset by cross-validation. All models are scored with the same
protocol.

Every finished fit is cached. If a benchmark is interrupted or extended, only the missing fits are computed.
"""

import time
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from litho_data.commands.progress import progress, say, say_estimate
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.run_facts import run_info
from litho_data.sharing.sending import Known
from litho_data.sharing.workers import Workers, run_jobs
from litho_data.store import open_store
from litho_data.store.again import StoredScans
from litho_data.store.lock_box import ids_sha256
from litho_models.evaluation.fit_cache import FitRecord, expected, fit_or_load
from litho_models.evaluation.reports import write_benchmark_report
from litho_models.evaluation.results import Benchmark
from litho_models.fitting import TrainingConfig
from litho_models.fitting.fit import common_geometry
from litho_models.fitting.runs import training_config
from litho_models.models import build_model, require_models
from litho_models.scan_terms import BackgroundUse, NuisanceProtocol, Policy
from litho_models.scan_terms.policies import usual_background, usual_policy
from litho_models.scoring.noise_floor import estimated_floor, stated_floor
from litho_models.scoring.records import Prediction, paired_scores
from litho_models.scoring.scores import score_model
from litho_models.splits.folds import GROUPED_FOLDS, Fold, ScoredSplit, SplitKind, plan_folds

CACHE_FOLDER = "cache"
BASELINES = ("identity", "affine", "affine-mtf", "blur-table", "linear", "features")
DEFAULT_MODELS = (*BASELINES, "random-features", "physics", "pbl", "fno")


def benchmark(
    store: str | Path,
    out: str | Path,
    *,
    split: SplitKind = "grouped",
    models: Sequence[str] = DEFAULT_MODELS,
    settings: dict[str, Any] | None = None,
    folds: int = GROUPED_FOLDS,
    first_folds: int | None = None,
    policy: Policy | None = None,
    background: BackgroundUse | None = None,
    noise: str | Path | None = None,
    open_lock_box: bool = False,
    seed: int = 0,
    workers: int = 1,
    dask: str | None = None,
) -> Benchmark:
    """Cross-validate ``models``: for each fold, train each model on all other folds and score it on this
    fold. Write ``benchmark.json``, a report and CSV tables.

    Args:
        store: dataset store.
        out: result folder; ``out/cache`` keeps every fit.
        split: ``grouped`` (whole scans are held out), ``leave-one-print-out``, or ``paper`` (a random choice
            of 75 % of the quadrants of all scans for training; the other quadrants are scored). With
            ``paper``, the training set and the test set contain parts of the same scans, so errors are
            underestimated. Use it only for comparison with the paper.
        models: names of the models to compare.
        settings: values for fields of ``TrainingConfig``. They replace the values that the training recipe
            sets.
        folds: number of folds of the split ``grouped``. If the number of printed fields outside the lock box
            is smaller, each of these fields is a fold.
        first_folds: number of folds that are fitted and scored; by default all folds. A smaller number allows
            a quick comparison of seeds or settings.
        policy: name of a set of nuisance terms, which are fitted to each scan before ``mae_datum_free_nm`` is
            computed; by default ``offset``, or ``none`` for films.
        background: ``training``, ``shared`` or ``none``; by default ``training``, or ``none`` for films. With
            ``training``, the smooth background that each fit learns from its training scans is added to its
            predictions. With ``shared``, each fit also learns a measurement model, which is applied to its
            predictions. A measurement model levels whole scans, so ``shared`` cannot be combined with the
            quadrants of ``paper``.
        noise: path of the ``noise.json`` of this dataset, or of the folder with this file. The noise floor in
            this file is shown beside the errors. By default, the noise floor is estimated from the residuals
            of the best model on held-out scans.
        open_lock_box: also train each model on all scans that are not locked, and score it on the locked
            scans.
        seed: seed of the split, of the pixel blocks on which nuisance terms are fitted, and of the training.
        workers: number of local processes that fit and predict. ``dask`` is the address of a Dask scheduler
            that is used instead of local processes.

    Raises:
        InputError: no model is given, or a model is unknown or repeated; the store cannot be read, or is too
            small for the split or the lock box; ``shared`` is combined with ``paper``; ``first_folds``
            exceeds the number of folds; the noise analysis belongs to other data; the cache is damaged; or
            ``out`` holds a benchmark with models or scans that the new benchmark does not contain.
    """
    require_models(models)
    dataset = open_store(store)
    scans = dataset.scans()
    film = dataset.instrument == "sem"
    policy, background = policy or usual_policy(film), background or usual_background(film)
    if (split, background) == ("paper", "shared"):
        # A scan was levelled as a whole, so the levelling of a quadrant depends on pixels outside it.
        raise InputError(
            "background for split paper",
            got="shared",
            wanted="training or none",
            hint="use split grouped, which holds out whole scans",
        )
    given = {"seed": seed, **(settings or {})}
    recipe = given.pop("recipe", "fast")
    floor = stated_floor(dataset.name, noise)
    locked = dataset.locked_ids
    plan = plan_folds(scans, locked, split, folds=folds, seed=seed, open_lock_box=open_lock_box)
    made = sum(not fold.locked for fold in plan)
    if split == "grouped" and made < folds:
        say(f"{made} folds instead of {folds}: one for each printed field that is not locked")
    if first_folds is not None:
        if not 1 <= first_folds <= made:
            raise InputError("first folds", got=first_folds, wanted=f"1 to {made}, the number of folds")
        plan = [fold for fold in plan if fold.locked or fold.number < first_folds]
    open_folds, box = ([fold for fold in plan if fold.locked == last] for last in (False, True))
    scored, boxed = ([scan for fold in part for scan in fold.held_out] for part in (open_folds, box))
    ids = [scan.id for scan in scored]
    facts = {"dataset": {"name": dataset.name}, "split": {"kind": split, "seed": seed}}
    with growing_folder(out, Benchmark.FILE_NAME, facts, holds=CACHE_FOLDER) as begun:
        _require_no_less(begun.folder, models, ids)
        configs = {name: training_config(recipe, name, given, film) for name in models}
        cache = begun.folder / CACHE_FOLDER
        jobs = [
            (name, fold, configs[name], cache, background == "shared") for name in models for fold in plan
        ]
        known = Known(StoredScans.of(dataset, scans).by_id, {scan.id: scan for scan in scans})
        fits = _fit_all(jobs, Workers(workers, dask, known), dataset.name)
        protocol = NuisanceProtocol.of_policy(policy, seed, background)

        def predicted(name: str, folds: Sequence[Fold]) -> list[Prediction]:
            return [
                expected(record, background, scan, height)
                for fold in folds
                for record, heights in [fits[name, fold.number]]
                for scan, height in zip(fold.held_out, heights, strict=True)
            ]

        predictions = {name: predicted(name, open_folds) for name in models}
        scores = [score_model(name, scored, own, protocol) for name, own in predictions.items()]
        maps = {name: [one.map_um for one in own] for name, own in predictions.items()}
        if noise is None:
            best = min(scores, key=lambda entry: entry.leading_nm).model
            floor = estimated_floor(best, scored, maps[best], protocol.blocks, seed)
        result = Benchmark(
            run=run_info([seed], len(scans)),
            dataset=dataset.dataset_id,
            split=ScoredSplit(
                kind=split,
                folds=made,
                seed=seed,
                first_folds=first_folds,
                scored_ids=ids,
                scored_ids_sha256=ids_sha256(ids),
                lock_box=locked,
                lock_box_opened=open_lock_box or split == "paper",
            ),
            nuisance=protocol,
            noise_floor=floor,
            training={
                name: config.used_by(build_model(name, config.variant, **common_geometry(scans)))
                for name, config in configs.items()
            },
            scores=scores,
            locked_scores=[
                score_model(name, boxed, predicted(name, box), protocol) for name in models if boxed
            ],
            paired=[paired_scores(*pair, seed) for pair in combinations(scores, 2)],
            fits=[fits[name, fold.number][0] for name, fold, *_ in jobs],
        )
        write_benchmark_report(result, scored, maps, out)
        result.write(out)
    return result


# The arguments of ``fit_or_load``.
_Job = tuple[str, Fold, TrainingConfig, Path, bool]
_Fits = dict[tuple[str, int], tuple[FitRecord, list[Array]]]


def _fit(job: _Job) -> tuple[FitRecord, list[Array]]:
    return fit_or_load(*job)


def _fit_all(jobs: Sequence[_Job], places: Workers, dataset: str) -> _Fits:
    """Return all fits, keyed by model name and fold number. Each fit comes with the predicted heights of its
    held-out scans.
    """
    fits: _Fits = {}
    done = run_jobs(_fit, jobs, places, name=lambda job: f"{job[0]}, fold {job[1].number}")
    # The models differ too much in training time for one common estimate of the remaining time. The remaining
    # time is therefore estimated for each model separately, unless the fits run in other processes.
    of = len(jobs) if places.elsewhere else 0
    first, rest = jobs[0][1], len({job[1].number for job in jobs}) - 1
    started = time.monotonic()
    for (name, fold, *_), fitted in progress(
        done, f"benchmark of {dataset}", len(jobs), estimate_of=of, at_once=places.processes
    ):
        if fold is first and not of:
            say_estimate(f"{name} on the other {rest} folds", rest * (time.monotonic() - started))
        started = time.monotonic()
        fits[name, fold.number] = fitted
    return fits


def _require_no_less(folder: Path, models: Sequence[str], scored_ids: Sequence[str]) -> None:
    """Raise an InputError if the folder holds a benchmark with models or scans that the new benchmark does
    not contain. Repeating or extending a benchmark is allowed.
    """
    if not (folder / Benchmark.FILE_NAME).exists():
        return
    old = Benchmark.read(folder)
    lost = [score.model for score in old.scores if score.model not in models]
    more = set(old.split.scored_ids) - set(scored_ids)
    held = [f"model {', '.join(lost)}"] * bool(lost) + [f"{len(more)} other scans"] * bool(more)
    if held:
        raise InputError(
            "output",
            got=f"{folder}, which holds a benchmark that also contains {' and '.join(held)}",
            wanted="another folder",
            hint="choose another --out",
        )
