"""Compute the errors of the models of a loop on held-out scans. Each of these models describes the printer,
and a measurement model (of the microscope) is fitted together with it.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np

from litho_data.foundation import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.fitting.least_squares import fit_least_squares
from litho_models.loop.closing import Closed
from litho_models.loop.fits import RULES, State, Study, TwinProblem
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.loop.record import ErrorRow, Stage
from litho_models.scan_terms import Blocks, Policy
from litho_models.scan_terms.background import learn_background
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scan_terms.measurement_fit import learn_measurement
from litho_models.scoring.noise_floor import freed_by_policy
from litho_models.scoring.shapes import edges_of_scan
from litho_models.scoring.statistics import interval

REPORTED: tuple[Policy, ...] = ("none", "offset", "full")
Maps = list[np.ndarray]
# Predicted maps of several scans, and the numbers of fitted parameters of the printer model and of the
# measurement model.
Predicted = tuple[Maps, tuple[int, int]]
# The parts of a study that are left out one after the other.
Parts = Literal["folds", "prints"]


class Fit(NamedTuple):
    """A model of the printer and a measurement model, fitted to the same scans."""

    twin: Twin
    measurement: MeasurementModel

    def expected_um(self, scan: PreparedScan) -> np.ndarray:
        """Return the map that a scan is expected to show, µm, of shape (ny, nx)."""
        return self.measurement.expected_um(scan, self.twin.height(scan))


def fit_with_measurement(twin: Twin, scans: Sequence[PreparedScan], seed: int, refit: bool = True) -> Fit:
    """Fit a measurement model, then the model of the printer, and then the coefficients of the measurement
    model again, all to the same scans.

    Args:
        twin: the model of the printer. Its parameters are the starting values of the fit.
        scans: the original scans.
        seed: seed for learning the measurement model.
        refit: whether to fit the model of the printer after the first fit of the measurement model. If not,
            the measurement model is fitted only once.
    """
    maps = [*map(twin.height, scans)]
    measurement = learn_measurement(scans, maps, seed=seed)
    if refit and len(twin.vector):
        freed = map(measurement.freed, scans, maps)
        # The number of a scan determines which quadrant its window covers. With consecutive numbers, the
        # windows are distributed evenly over the quadrants.
        windows = [replace(scan, number=at).window for at, scan in enumerate(freed)]
        twin = twin.at(fit_least_squares(TwinProblem(twin, windows), twin.vector, RULES).vector)
        measurement = learn_measurement(scans, [*map(twin.height, scans)], seed=seed, like=measurement)
    # Strengths of groups to which none of these scans belongs were not fitted here. Their values may be from
    # the scans that are left out, so they are removed.
    return Fit(twin.known_from(scans), measurement)


def error_rows(
    scans: Sequence[PrintedScan],
    maps_um: Sequence[np.ndarray],
    numbers: tuple[int, int],
    seed: int = 0,
    **terms: Any,
) -> list[ErrorRow]:
    """Return the errors of predicted maps, one row per policy. A policy is a set of terms that are fitted to
    each scan and subtracted before the error is computed. For films, the only policy has no such terms.

    Args:
        scans: the scans.
        maps_um: maps that the scans are expected to show, one per scan, µm, of shape (ny, nx).
        numbers: numbers of fitted parameters of the printer model and of the measurement model.
        seed: seed of the calibration blocks.
        terms: the fields ``model``, ``measurement`` and ``held_out`` of ``ErrorRow``. The last two have
            defaults.
    """
    rows, ids = [], [scan.id for scan in scans]
    films = scans[0].seen_by == "sem"
    freed = freed_by_policy(scans, maps_um, Blocks(seed=seed), ("none",) if films else REPORTED)
    for policy, fits in freed.items():
        left_um = [fit.residual_um for fit in fits]
        mae_nm = [NM_PER_UM * float(np.nanmean(np.abs(left))) for left in left_um]
        mse_um2 = [np.nanmean(left**2) for left in left_um]
        edges = map(edges_of_scan, scans, maps_um, left_um) if films else ()
        rows.append(
            ErrorRow(
                **terms,
                policy=policy,
                k=float(np.mean([fit.degrees_of_freedom for fit in fits])),
                printer_numbers=numbers[0],
                measurement_numbers=numbers[1],
                mae_nm=float(np.mean(mae_nm)),
                mae_ci95_nm=interval(mae_nm),
                rmse_nm=NM_PER_UM * float(np.sqrt(np.mean(mse_um2))),
                by_scan_nm=dict(zip(ids, mae_nm, strict=True)),
                edge_by_scan_nm={name: one.mean_nm for name, one in zip(ids, edges, strict=films)},
            )
        )
    return rows


def parted(study: Study, by: Parts) -> Study:
    """Return the study with its own folds (``folds``), or with one fold per print (``prints``)."""
    if by == "folds":
        return study
    _, number = np.unique([scan.print_id for scan in study.scans], return_inverse=True)
    return replace(study, fold_of=number)


class HeldOut:
    """Predict each scan of a study. For this prediction, a model of the printer and a measurement model are
    fitted again to other scans of the study.

    Args:
        study: the original scans with their folds.
    """

    def __init__(self, study: Study):
        self.study = study
        self._rows = partial(error_rows, study.scans, seed=study.seed)
        self._by_fold = cache(self._predicted)
        # The fit of a model to all scans of the study.
        self.fit = cache(lambda state: fit_with_measurement(state.twin, study.scans, study.seed))

    def errors(self, closed: Closed) -> list[ErrorRow]:
        """Return the errors of three models of a loop: the base model, the base model with the causes, and
        the corrected model.

        Each scan is predicted by a fit to the scans outside its fold. The base model with the causes is
        listed only if it differs from both other models. If the base is refitted and prints were scanned
        several times, the base model and the corrected model are scored a second time. In this second score,
        each scan is predicted by a fit that leaves out all scans of the same print.
        """
        study, plain, causes = self.study, closed.plain, closed.named.state
        maps, numbers = plain.maps_um(study.scans), len(plain.twin.vector)
        rows = self._rows(maps, (numbers, 0), model="base", measurement="print alone")
        if not study.of_films:
            # A smooth background has five coefficients.
            maps = [*map(np.add, maps, self._backgrounds_um(plain))]
            rows += self._rows(maps, (numbers, 5), model="base", measurement="published")
        for name, state in {"base": closed.base, "causes": causes, **closed.ends}.items():
            if name != "causes" or causes not in closed.ends.values():
                study.report(f"scoring the model: {name}")
                rows += self._rows(*self._by_fold(state), model=name)
        prints = len(parted(study, "prints").folds)
        if 1 < prints < len(study.scans) and closed.base.twin.own:
            for name, state in closed.ends.items():
                study.report(f"leaving out whole prints: {name}")
                rows += self._rows(*self._predicted(state, by="prints"), model=name, held_out="prints")
        return rows

    def maps_um(self, state: State) -> Maps:
        """Predict the map that each scan is expected to show, µm, of shape (ny, nx). For each scan, the
        models of the printer and of the measurement are fitted without the scans of its fold.
        """
        return self._by_fold(state)[0]

    def of_others(self, closed: Closed, scans: Sequence[PrintedScan]) -> dict[Stage, Predicted]:
        """Predict scans that do not belong to the study, with the base model and with the corrected model.
        Both models are fitted to all scans of the study. The result is keyed by the stage of the loop.
        """
        prepared, found = prepare_scans(scans, self.study.scans), dict[Stage, Predicted]()
        for stage, state in closed.ends.items():
            fit = self.fit(state)
            numbers = len(fit.twin.vector), fit.measurement.numbers
            found[stage] = [*map(fit.expected_um, prepared)], numbers
        return found

    def left_out_nm(self, closed: Closed) -> dict[str, float]:
        """Return the increase of the headline error (see ``ErrorRow.is_headline``), nm, when an effect is
        removed from the corrected model and the model is refitted. The result is keyed by the name of the
        effect.

        After this refit, the measurement model is fitted again, while the parameters of the printer model are
        held fixed.
        """

        @cache
        def error_nm(state: State) -> float:
            rows = self._rows(*self._by_fold(state, refit=False), model="all")
            return next(row.leading_nm for row in rows if row.is_headline)

        found, model = {}, closed.final
        for name in model.twin.names:
            self.study.report(f"leaving out {name}")
            found[name] = error_nm(model.without(name)) - error_nm(model)
        return found

    def _predicted(self, state: State, refit: bool = True, by: Parts = "folds") -> Predicted:
        """Predict each scan by a fit to the scans outside its fold (or to the scans of all other prints).
        Return the predicted maps, and two numbers of parameters: those of the printer model, and those of the
        measurement model in the fit where they are largest.

        Args:
            state: the model from which the fits start.
            refit: whether the model of the printer is fitted again.
            by: whether folds or prints are left out.
        """
        study = parted(self.study, by)
        starts = state.per_fold if by == "folds" else [state.twin] * len(study.folds)
        jobs = [
            partial(fit_with_measurement, twin, known, study.seed, refit)
            for twin, known in zip(starts, study.others, strict=True)
        ]
        fits = study.run(jobs, "predicting held-out scans")
        maps = [fits[at].expected_um(one) for one, at in zip(study.scans, study.fold_of, strict=True)]
        return maps, (len(state.twin.vector), max(fit.measurement.numbers for fit in fits))

    def _backgrounds_um(self, plain: State) -> Maps:
        """Return the smooth background on each scan, µm, of shape (ny, nx). It is learned from the scans of
        the other folds, as in the benchmark.
        """
        study = self.study
        learned = [
            learn_background(known, [*map(twin.height, known)])
            for twin, known in zip(plain.per_fold, study.others, strict=True)
        ]
        return [learned[at].of_scan(scan) for scan, at in zip(study.scans, study.fold_of, strict=True)]


def nested_errors(
    study: Study, nested: Parts, close_again: Callable[[Sequence[PrintedScan]], Closed]
) -> list[ErrorRow]:
    """Repeat the loop for each fold (or print), with the chosen base model: run it without this fold (or
    print), and score its result on the scans that were left out. Return the errors on all scans.
    """
    scans, parts = study.scans, parted(study, nested)
    jobs = [
        partial(_of_left_out, close_again, [scans[i] for i in rest], [scans[i] for i in own])
        for rest, own in parts.folds
    ]
    predicted = study.run(jobs, "repeating all choices")
    rows = []
    for stage in predicted[0]:
        maps, numbers = zip(*(one[stage] for one in predicted), strict=True)
        following = [*map(iter, maps)]
        every = [next(following[at]) for at in parts.fold_of]
        rows += error_rows(scans, every, max(numbers), study.seed, model=stage, held_out=f"nested {nested}")
    return rows


def _of_left_out(
    close_again: Callable[[Sequence[PrintedScan]], Closed],
    known: Sequence[PrintedScan],
    left_out: Sequence[PrintedScan],
) -> dict[Stage, Predicted]:
    closed = close_again(known)
    return HeldOut(closed.given).of_others(closed, left_out)
