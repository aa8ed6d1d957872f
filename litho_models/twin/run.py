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
from litho_data.foundation.workers import Workers, kept_open
from litho_data.store import PrintedScan, Store, open_store
from litho_models.effects import get_effect
from litho_models.fitting.runs import level_share, step_share
from litho_models.frozen.files import save_frozen
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.models import build_model
from litho_models.scan_terms.background import learn_background
from litho_models.scan_terms.groups import ALL
from litho_models.scan_terms.measurement import MeasurementModel, learn_measurement
from litho_models.scoring.records import Prediction
from litho_models.simulator import Simulator
from litho_models.splits.folds import GROUPED_FOLDS, Split, grouped_folds, leave_one_print_out
from litho_models.twin.closing import Closed, close
from litho_models.twin.fits import State, Study, fit_state
from litho_models.twin.judging import judge
from litho_models.twin.model import Twin
from litho_models.twin.record import CloseLoop, ErrorRow, Stage
from litho_models.twin.report import write_report
from litho_models.twin.results import error_rows, record

MODEL_FOLDER = "model"
AUTO = "auto"
# Bases that compete where none is asked for, the first one the form of the paper's physics.
BASES = ("physics", "affine-mtf", "blur-table")
_FEWEST_PIXELS = 1024
HeldOut = Literal["folds", "prints"]


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
        report: told what happens, a sentence at a time.

    Raises:
        InputError: no store, an unknown base, or too few usable scans.
    """
    require_replaceable_folder(out, CloseLoop.FILE_NAME, "report.html", "*.csv", MODEL_FOLDER)
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
        errors = loop.errors("scans")
        left_out = loop.left_out_nm()
        survives = _survives(loop, others)
        often: dict[str, int] = {}
        if nested:
            rows, often = _nested(development, chosen, study, nested)
            errors += rows
        if open_lock_box and locked:
            errors += loop.errors_of(locked, "locked")
    measurement = loop.learned_on_all(loop.closed.final)
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
    with atomic_folder(out) as folder:
        result.write(folder)
        write_report(result, loop.shown(), folder)
        _save_model(loop.closed, result, opened, folder / MODEL_FOLDER)
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

    def __post_init__(self) -> None:
        self.closed = close(self.scans, self.settings.fold_of, self.base, self.settings)
        self.study = replace(self.settings, scans=self.closed.original)
        self._measured: dict[int, list[MeasurementModel]] = {}
        self._maps: dict[int, list[list[np.ndarray]]] = {}

    @property
    def stages(self) -> dict[Stage, State]:
        """The models in order, each once."""
        found: dict[Stage, State] = {"base": self.closed.base}
        steps: tuple[tuple[Stage, State], ...] = (
            ("causes", self.closed.named.state),
            ("laws", self.closed.lawful.state),
            ("all", self.closed.final),
        )
        for name, state in steps:
            if name == "all" or not any(state is one for one in (*found.values(), self.closed.final)):
                found[name] = state
        return found

    def errors(self, held_out: str) -> list[ErrorRow]:
        """Errors of all models on the development scans, each predicted without its fold."""
        rows = []
        for name, state in self.stages.items():
            self.settings.report(f"scoring the model with {name}" if name != "base" else "scoring the base")
            plain = self.held_out(state)
            count = len(state.twin.vector)
            if name in ("base", "all"):
                rows += self._rows(name, "print alone", plain, (count, 0), held_out)
                rows += self._rows(name, "published", self._published(state), (count, 5), held_out)
            measured = self.measured(state)
            numbers = max(model.numbers for model in self.models(state))
            rows += self._rows(name, "shared", measured, (count, numbers), held_out)
        return rows

    def _rows(
        self,
        model: Stage,
        measurement: Any,
        maps: Sequence[np.ndarray],
        numbers: tuple[int, int],
        held_out: Any,
    ) -> list[ErrorRow]:
        return error_rows(
            self.scans, maps, model=model, measurement=measurement, held_out=held_out, numbers=numbers,
            seed=self.settings.seed,
        )  # fmt: skip

    def of_folds(self, state: State) -> list[list[np.ndarray]]:
        """By fold, what the fit without it predicts of every scan, (y, x) µm."""
        if id(state) not in self._maps:
            placed = [state.twin.at(vector).placed() for vector in state.per_fold]
            self._maps[id(state)] = [
                [one.height(scan, fold) for scan in self.closed.original] for fold, one in enumerate(placed)
            ]
        return self._maps[id(state)]

    def held_out(self, state: State) -> list[np.ndarray]:
        maps = self.of_folds(state)
        return [maps[fold][at] for at, fold in enumerate(self.study.fold_of)]

    def models(self, state: State) -> list[MeasurementModel]:
        """The measurement learned without each fold."""
        if id(state) not in self._measured:
            maps = self.of_folds(state)
            found = []
            for fold in self.study.folds:
                own = np.flatnonzero(self.study.fold_of != fold)
                found.append(
                    learn_measurement(
                        [self.scans[i] for i in own], [maps[fold][i] for i in own], seed=self.study.seed
                    )
                )
            self._measured[id(state)] = found
        return self._measured[id(state)]

    def measured(self, state: State, learned: Sequence[MeasurementModel] | None = None) -> list[np.ndarray]:
        """The maps that the scans should show, print and measurement learned without their fold."""
        learned = learned or self.models(state)
        return [
            learned[fold].expected_um(scan, own)
            for scan, own, fold in zip(self.scans, self.held_out(state), self.study.fold_of, strict=True)
        ]

    def _published(self, state: State) -> list[np.ndarray]:
        """The maps with the smooth background of the training scans: today's published protocol."""
        maps, found = self.of_folds(state), list(self.held_out(state))
        for fold in self.study.folds:
            own = np.flatnonzero(self.study.fold_of != fold)
            learned = learn_background([self.scans[i] for i in own], [maps[fold][i] for i in own])
            for i in np.flatnonzero(self.study.fold_of == fold):
                found[i] = Prediction.beside(learned, found[i]).map_um
        return found

    def learned_on_all(self, state: State) -> MeasurementModel:
        """The measurement learned on all development scans."""
        placed = state.twin.placed()
        maps = [placed.height(one) for one in self.closed.original]
        return learn_measurement(self.scans, maps, seed=self.study.seed)

    def left_out_nm(self) -> dict[str, float]:
        """By how much the error grows (k = 1) where each effect is left out and the rest fitted again."""
        final = self.closed.final
        if not final.twin.names:
            return {}
        full = self._mae(self.measured(final))
        found = {}
        for name in final.twin.names:
            self.settings.report(f"leaving out {name}")
            without = fit_state(final.twin.without(name), self.closed.study)
            found[name] = self._mae(self.measured(without, self.models(final))) - full
        return found

    def _mae(self, maps: Sequence[np.ndarray]) -> float:
        rows = self._rows("all", "shared", maps, (0, 0), "scans")
        return next(row.mae_nm for row in rows if row.policy == "offset")

    def errors_of(self, scans: Sequence[PrintedScan], held_out: Any) -> list[ErrorRow]:
        """Errors of scans that took no part, by the fits to all that did."""
        prepared, rows = prepare_scans(scans), []
        stages: tuple[tuple[Stage, State], ...] = (("base", self.closed.base), ("all", self.closed.final))
        for name, state in stages:
            placed, learned = state.twin.placed(), self.learned_on_all(state)
            maps = [
                learned.expected_um(scan, placed.height(one))
                for scan, one in zip(scans, prepared, strict=True)
            ]
            rows += error_rows(
                scans, maps, model=name, measurement="shared", held_out=held_out,
                numbers=(len(state.twin.vector), learned.numbers), seed=self.study.seed,
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
    """For each effect, the other bases on which it is confirmed too, all effects in place."""
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
        [[ids[i] for i in np.flatnonzero(study.fold_of == fold)] for fold in study.folds]
        if held_out == "folds"
        else leave_one_print_out(ids, [scan.print_id for scan in scans])
    )
    rows: list[ErrorRow] = []
    often: dict[str, int] = {}
    for number, out in enumerate(parts, 1):
        study.report(f"choosing without {', '.join(out)} ({number} of {len(parts)})")
        rest = [scan for scan in scans if scan.id not in out]
        inner = replace(study, fold_of=dealt(rest, len(study.folds), study.seed), report=lambda message: None)
        loop = _Loop(rest, base, inner)
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


def _save_model(closed: Closed, result: CloseLoop, store: Store, folder: Path) -> None:
    """The corrected model of the printer, with the strengths that the latest scan has."""
    twin = closed.final.twin
    base = twin.placed().base
    assert isinstance(base, Simulator)
    latest: PreparedScan = max(closed.study.scans, key=lambda scan: scan.stored.order)
    values = twin.values(twin.labels(latest))
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
    assert all(get_effect(name) for name in values)
