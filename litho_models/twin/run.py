"""One run of the loop on a store: record, report, tables and the corrected model in one folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from torch import nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.outputs import require_replaceable_folder
from litho_data.foundation.results import Result
from litho_data.foundation.workers import Workers, kept_open, run_jobs
from litho_data.store import PrintedScan, Store, open_store
from litho_models.effects import get_effect
from litho_models.fitting.runs import level_share, step_share
from litho_models.frozen.files import save_frozen
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.models import build_model
from litho_models.scan_terms.background import learn_background
from litho_models.scan_terms.groups import ALL
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scoring.records import Prediction
from litho_models.simulator import Simulator
from litho_models.splits.folds import GROUPED_FOLDS, Split, grouped_folds, leave_one_print_out
from litho_models.twin.closing import Closed, close, fit_with_measurement, held_out_maps
from litho_models.twin.fits import State, Study, fit_state, prepared_among
from litho_models.twin.judging import judge
from litho_models.twin.model import Twin
from litho_models.twin.record import CloseLoop, ErrorRow, Stage
from litho_models.twin.report import write_report
from litho_models.twin.results import error_rows, record

MODEL_FOLDER, LAWS_FILE, QUESTIONS_FILE = "model", "laws.py", "open_questions.json"
AUTO = "auto"
# Bases that compete where none is asked for, the first one the form of the paper's physics.
BASES = ("physics", "affine-mtf", "blur-table")
_FEWEST_PIXELS = 1024
HeldOut = Literal["folds", "prints"]
# What is made of a closed loop before it is written: its record, and records to be written beside it.
Further = Callable[[Closed, CloseLoop], tuple[CloseLoop, Sequence[Result]]]


def close_store(
    store: str | Path,
    out: str | Path,
    *,
    base: str = AUTO,
    folds: int = GROUPED_FOLDS,
    nested: HeldOut | None = None,
    open_lock_box: bool = False,
    seed: int = 0,
    workers: int = 1,
    dask: str | None = None,
    further: Further | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> CloseLoop:
    """Close the loop on a dataset store and write everything to ``out``, which appears when complete.

    Args:
        store: made by ``litho-data build``.
        base: name of a small model; ``auto``: physics, affine-mtf and blur-table compete.
        folds: of scans; each scan is predicted by fits that have not seen its fold.
        nested: also choose everything anew without each fold, or each print, and judge it there.
        open_lock_box: also score the locked scans.
        seed: of folds, calibration blocks and permutations.
        workers: local processes; ``dask``: address of a Dask scheduler instead.
        further: called before anything is written.
        report: told what happens, a sentence at a time.

    Raises:
        InputError: no store, an unknown base, or too few usable scans.
    """
    require_replaceable_folder(
        out, CloseLoop.FILE_NAME, QUESTIONS_FILE, "report.html", "*.csv", MODEL_FOLDER, LAWS_FILE
    )
    opened = open_store(store)
    scans = [scan for scan in opened.scans() if np.count_nonzero(scan.usable) >= _FEWEST_PIXELS]
    kept = {scan.id for scan in scans}
    dropped = [f"{one}: fewer than {_FEWEST_PIXELS} measured pixels" for one in opened.ids if one not in kept]
    locked = [scan for scan in scans if scan.id in opened.locked_ids]
    development = [scan for scan in scans if scan.id not in opened.locked_ids]
    if len(development) < 2:
        raise InputError(
            "scans to close the loop on", got=f"{len(development)} usable and not locked", wanted="at least 2"
        )
    with kept_open(Workers(workers, dask)) as places:
        study = Study((), dealt(development, folds, seed), seed, places, report)
        name, chosen, others = _bases(base, development, study)
        loop = _Loop(development, chosen, study)
        errors = loop.errors() + loop.errors_by_print()
        left_out = loop.left_out_nm()
        survives = _survives(loop, others)
        often: dict[str, int] = {}
        if nested:
            rows, often = _nested(development, chosen, study, nested)
            errors += rows
        if open_lock_box and locked:
            errors += loop.errors_of(locked, "locked")
    _, measurement = fit_with_measurement(loop.closed.final.twin, loop.closed.original, seed)
    result = record(
        loop.closed,
        errors,
        measurement,
        dataset=opened.dataset_id,
        base_name=name,
        settings={"base": base, "folds": folds, "nested": nested, "open_lock_box": open_lock_box},
        split=Split(kind="grouped", folds=len(set(study.fold_of)), lock_box=opened.locked_ids),
        dropped=dropped,
        left_out_nm=left_out,
        survives=survives,
        chosen=often,
    )
    result, others_of_it = further(loop.closed, result) if further else (result, ())
    with atomic_folder(out) as folder:
        for written in (result, *others_of_it):
            written.write(folder)
        write_report(result, loop.shown(), folder)
        _save_model(loop.closed, result, opened, folder / MODEL_FOLDER)
        if loop.closed.lawful.causes:
            (folder / LAWS_FILE).write_text(laws_file(result), encoding="utf-8")
    return result


def dealt(scans: Sequence[PrintedScan], folds: int, seed: int) -> np.ndarray:
    """Number of the fold that holds out each scan; at most one fold per scan."""
    ids = [scan.id for scan in scans]
    lists = grouped_folds(ids, min(folds, len(ids)), seed)
    fold = {one: number for number, members in enumerate(lists) for one in members}
    return np.array([fold[one] for one in ids])


@dataclass
class _Loop:
    """The loop on the development scans, with the measurement learned once for each fold and model."""

    scans: Sequence[PrintedScan]
    base: nn.Module
    settings: Study
    describe: bool = True

    def __post_init__(self) -> None:
        self.closed = close(
            self.scans, self.settings.fold_of, self.base, self.settings, describe=self.describe
        )
        # With its state, which must outlive its entry: the number of one that is gone may come again.
        self._fitted: dict[int, tuple[State, list[tuple[Twin, MeasurementModel]]]] = {}

    @property
    def stages(self) -> dict[Stage, State]:
        """The models in order, each once."""
        found: dict[Stage, State] = {"base": self.closed.base}
        if self.closed.causes and self.closed.lawful.causes:
            found["causes"] = self.closed.named.state
        return {**found, "all": self.closed.final}

    def errors(self) -> list[ErrorRow]:
        """Errors of all models on the development scans, each predicted without its fold."""
        plain = self.closed.plain
        numbers = len(plain.twin.vector)
        maps = held_out_maps(plain, self.closed.study, self.closed.original)
        rows = self._rows("base", "print alone", maps, (numbers, 0))
        rows += self._rows("base", "published", self._published(plain, maps), (numbers, 5))
        for name, state in self.stages.items():
            self.settings.report("scoring the base" if name == "base" else f"scoring {name}")
            shared = max(learned.numbers for _, learned in self.fitted(state))
            rows += self._rows(name, "shared", self.measured(state), (len(state.twin.vector), shared))
        return rows

    def _rows(
        self, model: Stage, measurement: Any, maps: Sequence[np.ndarray], numbers: tuple[int, int]
    ) -> list[ErrorRow]:
        return error_rows(
            self.scans, maps, model=model, measurement=measurement, held_out="scans", numbers=numbers,
            seed=self.settings.seed,
        )  # fmt: skip

    def fitted(self, state: State) -> list[tuple[Twin, MeasurementModel]]:
        """Printer and measurement fitted without each fold."""
        if id(state) not in self._fitted:
            jobs = [
                (
                    int(fold),
                    state.twin.at(state.per_fold[fold]),
                    [self.closed.original[i] for i in np.flatnonzero(self.settings.fold_of != fold).tolist()],
                    self.settings.seed,
                )
                for fold in self.closed.study.folds
            ]
            done = run_jobs(_fit_fold, jobs, self.settings.workers, name=lambda job: f"fold {job[0]}")
            by_fold = {job[0]: fitted for job, fitted in done}
            self._fitted[id(state)] = state, [by_fold[job[0]] for job in jobs]
        return self._fitted[id(state)][1]

    def measured(self, state: State) -> list[np.ndarray]:
        """The maps that the scans should show, print and measurement learned without their fold."""
        found = []
        for scan, prepared, fold in zip(self.scans, self.closed.original, self.settings.fold_of, strict=True):
            twin, learned = self.fitted(state)[fold]
            found.append(learned.expected_um(scan, twin.placed().height(prepared, int(fold))))
        return found

    def _published(self, state: State, maps: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The maps with the smooth background of the training scans: the published protocol."""
        found, fold_of = list(maps), self.settings.fold_of
        for fold in self.closed.study.folds:
            placed = state.twin.at(state.per_fold[fold]).placed()
            own = np.flatnonzero(fold_of != fold).tolist()
            learned = learn_background(
                [self.scans[i] for i in own],
                [placed.height(self.closed.original[i], int(fold)) for i in own],
            )
            for i in np.flatnonzero(fold_of == fold).tolist():
                found[i] = Prediction.beside(learned, maps[i]).map_um
        return found

    def errors_by_print(self) -> list[ErrorRow]:
        """Errors of the scans of each print by fits without it; what is fitted was chosen with it."""
        prints = [scan.print_id for scan in self.scans]
        if not 1 < len(set(prints)) < len(prints):
            return []
        rows = []
        stages: tuple[tuple[Stage, State], ...] = (("base", self.closed.base), ("all", self.closed.final))
        for name, state in stages:
            self.settings.report(f"leaving out whole prints: {name}")
            jobs = [
                (
                    number,
                    state.twin,
                    [one for one in self.closed.original if one.stored.print_id != out],
                    self.settings.seed,
                )
                for number, out in enumerate(sorted(set(prints)))
            ]
            fitted = {
                job[0]: done
                for job, done in run_jobs(
                    _fit_fold, jobs, self.settings.workers, name=lambda job: f"print {job[0]}"
                )
            }
            maps = []
            for scan, prepared in zip(self.scans, self.closed.original, strict=True):
                twin, learned = fitted[sorted(set(prints)).index(scan.print_id)]
                maps.append(learned.expected_um(scan, twin.placed().height(prepared)))
            shared = max(learned.numbers for _, learned in fitted.values())
            rows += error_rows(
                self.scans, maps, model=name, measurement="shared", held_out="prints",
                numbers=(len(state.twin.vector), shared), seed=self.settings.seed,
            )  # fmt: skip
        return rows

    def left_out_nm(self) -> dict[str, float]:
        """By how much the error grows (k = 1) without each cause or law, the rest fitted again."""
        model = self.closed.final
        if not model.twin.names:
            return {}
        full = self._mae(model)
        found = {}
        for name in model.twin.names:
            self.settings.report(f"leaving out {name}")
            found[name] = self._mae(fit_state(model.twin.without(name), self.closed.study)) - full
        return found

    def _mae(self, state: State) -> float:
        rows = self._rows("all", "shared", self.measured(state), (0, 0))
        return next(row.mae_nm for row in rows if row.policy == "offset")

    def errors_of(self, scans: Sequence[PrintedScan], held_out: Any) -> list[ErrorRow]:
        """Errors of scans that took no part, by the fits to all that did."""
        prepared, rows = prepared_among(scans, self.closed.original), []
        stages: tuple[tuple[Stage, State], ...] = (("base", self.closed.base), ("all", self.closed.final))
        for name, state in stages:
            twin, learned = fit_with_measurement(state.twin, self.closed.original, self.settings.seed)
            placed = twin.placed()
            maps = [
                learned.expected_um(scan, placed.height(one))
                for scan, one in zip(scans, prepared, strict=True)
            ]
            rows += error_rows(
                scans, maps, model=name, measurement="shared", held_out=held_out,
                numbers=(len(twin.vector), learned.numbers), seed=self.settings.seed,
            )  # fmt: skip
        return rows

    def shown(self) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Residual maps (y, x), nm, of all scans before and after, each with its own zero taken out."""
        found = []
        maps = zip(self.scans, self.measured(self.closed.base), self.measured(self.closed.final), strict=True)
        for scan, before, after in maps:
            pair = []
            for own in (before, after):
                left = np.where(scan.usable, 1e3 * (scan.height_um - own), np.nan)
                pair.append(left - np.nanmedian(left))
            found.append((scan.id, pair[0], pair[1]))
        return found


def _fit_fold(job: tuple[int, Twin, Sequence[PreparedScan], int]) -> tuple[Twin, MeasurementModel]:
    _, twin, scans, seed = job
    return fit_with_measurement(twin, scans, seed)


def _bases(
    base: str, scans: Sequence[PrintedScan], study: Study
) -> tuple[str, nn.Module, dict[str, nn.Module]]:
    """The base's name, the base, and the others that compete."""
    built = {name: _built(name, scans) for name in (BASES if base == AUTO else (base,))}
    if len(built) == 1:
        name, only = next(iter(built.items()))
        return name, only, {}
    prepared = prepare_scans(scans)
    plain = replace(study, scans=prepared)
    errors = {}
    for name, one in built.items():
        study.report(f"trying {name} as the base")
        errors[name] = fit_state(Twin.bare(one, prepared[0]), plain).mse_nm2
    best = min(errors, key=lambda name: errors[name])
    return best, built[best], {name: one for name, one in built.items() if name != best}


def _built(name: str, scans: Sequence[PrintedScan]) -> Simulator:
    first = scans[0]
    fields: dict[str, Any] = {"spot": "round"} if name == "physics" else {}
    return build_model(
        name,
        pitch_um=first.pitch_um,
        level_height_um=first.level_height_um,
        levels=first.levels,
        **fields,
    )


def _survives(loop: _Loop, others: Mapping[str, nn.Module]) -> dict[str, list[str]]:
    """For each cause and law, the other bases on which it is confirmed too, all others in place."""
    final, study = loop.closed.final, loop.closed.study
    found: dict[str, list[str]] = {name: [] for name in final.twin.names}
    if not final.twin.names:
        return found
    for base_name, base in others.items():
        loop.settings.report(f"trying what was found on {base_name}")
        bare = fit_state(Twin.bare(base, study.scans[0]), study)
        full = fit_state(final.twin.over(bare.twin.placed().base, study.scans[0]), study)
        for name, by in final.twin.by.items():
            without = fit_state(full.twin.without(name), study)
            if judge(without.freed_nm2, full.freed_nm2, study).passed(grouped=by != ALL):
                found[name].append(base_name)
    return found


def _nested(
    scans: Sequence[PrintedScan], base: nn.Module, study: Study, held_out: HeldOut
) -> tuple[list[ErrorRow], dict[str, int]]:
    """All chosen anew without each fold, or print, and judged there; how often each effect was chosen."""
    ids = [scan.id for scan in scans]
    parts = (
        [[ids[i] for i in np.flatnonzero(study.fold_of == fold).tolist()] for fold in study.folds]
        if held_out == "folds"
        else leave_one_print_out(ids, [scan.print_id for scan in scans])
    )
    rows: list[ErrorRow] = []
    often: dict[str, int] = {}
    for number, out in enumerate(parts, 1):
        study.report(f"choosing without {', '.join(out)} ({number} of {len(parts)})")
        rest = [scan for scan in scans if scan.id not in out]
        inner = replace(study, fold_of=dealt(rest, len(study.folds), study.seed), report=lambda message: None)
        loop = _Loop(rest, base, inner, describe=False)
        for name in loop.closed.final.twin.names:
            often[name] = often.get(name, 0) + 1
        rows += loop.errors_of([scan for scan in scans if scan.id in out], f"nested {held_out}")
    return _joined(rows), often


def _joined(rows: Sequence[ErrorRow]) -> list[ErrorRow]:
    """Rows of the same model and policy over different scans as one, every scan counting alike."""
    from litho_models.scoring.statistics import interval

    by: dict[tuple[Any, ...], list[ErrorRow]] = {}
    for row in rows:
        by.setdefault((row.model, row.measurement, row.policy, row.held_out), []).append(row)
    joined = []
    for own in by.values():
        scans = {name: value for row in own for name, value in row.by_scan_nm.items()}
        weights = [len(row.by_scan_nm) for row in own]
        joined.append(
            own[0].model_copy(
                update={
                    "k": float(np.average([row.k for row in own], weights=weights)),
                    "printer_numbers": max(row.printer_numbers for row in own),
                    "measurement_numbers": max(row.measurement_numbers for row in own),
                    "mae_nm": float(np.mean([*scans.values()])),
                    "mae_ci95_nm": interval([*scans.values()]),
                    "rmse_nm": float(np.sqrt(np.average([row.rmse_nm**2 for row in own], weights=weights))),
                    "by_scan_nm": scans,
                }
            )
        )
    return joined


def laws_file(result: CloseLoop) -> str:
    """A module that registers the laws that were found as effects, at the strengths that they have here."""
    lines = [
        f'"""Laws found on {result.dataset.name}: import this to screen, fit and apply them by name."""',
        "",
        "from dataclasses import replace",
        "",
        "from litho_models.effects import register_effect",
        "from litho_models.effects.laws import LAWS",
    ]
    for one in result.effects:
        if one.knowledge == "law":
            sizes = ", ".join(f"{own.value:.4g} {own.unit}" for own in one.strengths["strength"])
            lines += [
                "",
                f"# {one.title}; strength {sizes}",
                f"register_effect(replace(LAWS[{one.name!r}], name='law-{one.name}', knowledge='cause'))",
            ]
    return "\n".join(lines) + "\n"


def _save_model(closed: Closed, result: CloseLoop, store: Store, folder: Path) -> None:
    """The corrected model of the printer, with the strengths that the latest scan has."""
    twin = closed.final.twin
    base = twin.placed().base
    assert isinstance(base, Simulator)
    latest: PreparedScan = max(closed.study.scans, key=lambda scan: scan.stored.order)
    values = twin.values(twin.labels(latest))
    sides = {"process": "printer", "measurement": "microscope"}
    role = {one.name: one.role for one in result.effects}
    error = result.error("all")
    assert error is not None
    save_frozen(
        base,
        folder,
        name=f"{result.base_model}, loop findings",
        process_effects={name: own for name, own in values.items() if role[name] == "process"},
        measurement_effects={name: own for name, own in values.items() if role[name] == "measurement"},
        undetermined_effects={
            name: own for name, own in values.items() if role[name] not in ("process", "measurement")
        },
        dataset=result.dataset.model_dump(mode="json"),
        attributed={
            one.name: sides[one.role]
            for one in result.effects
            if one.role in sides and get_effect(one.name).role != one.role
        },
        command=result.run.command,
        split={
            **result.split.model_dump(mode="json"),
            "lock_box_files_sha256": sorted(store.files_sha256(result.split.lock_box).values()),
        },
        training_level_share=level_share([scan.stored for scan in closed.original]),
        training_step_share=step_share([scan.stored for scan in closed.original]),
        confusable_sets=[[e.name, *e.confusable_with] for e in result.effects if e.confusable_with],
        metrics=[
            {"name": "mae_datum_free", "value": error.mae_nm, "split": "grouped", "policy": "offset"},
        ],
    )
