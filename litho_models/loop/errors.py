"""Errors of the models of a loop on scans held out from them, the measurement learned with each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from torch import nn

from litho_data.foundation.units import NM_PER_UM
from litho_data.sharing.workers import run_jobs
from litho_data.store import PrintedScan
from litho_models.loop.closing import Closed, fit_with_measurement, held_out_maps
from litho_models.loop.fits import State, Study, fit_state, prepared_among
from litho_models.loop.judging import judge
from litho_models.loop.model import Twin, is_refitted
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import ErrorRow, MeasuredBy, Stage, error_of
from litho_models.scan_terms import POLICIES, Blocks, Policy, cross_fit
from litho_models.scan_terms.background import learn_background
from litho_models.scan_terms.grouped import ALL
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scoring.records import Prediction
from litho_models.scoring.shapes import edges_of_scan
from litho_models.scoring.statistics import interval

REPORTED: tuple[Policy, ...] = ("none", "offset", "full")
# Of the smooth background of the published protocol.
_PUBLISHED_NUMBERS = 5
Maps = list[np.ndarray]


def error_rows(
    scans: Sequence[PrintedScan],
    maps_um: Sequence[np.ndarray],
    *,
    model: Stage,
    measurement: MeasuredBy,
    held_out: Any,
    numbers: tuple[int, int],
    seed: int = 0,
) -> list[ErrorRow]:
    """Errors of maps (y, x) µm under each reported policy; films have no zero of their own to be freed of."""
    rows = []
    for policy in ("none",) if scans[0].seen_by == "sem" else REPORTED:
        fits = [
            cross_fit(scan.height_um, own, scan.usable, POLICIES[policy], Blocks(seed=seed))
            for scan, own in zip(scans, maps_um, strict=True)
        ]
        mae = [NM_PER_UM * float(np.nanmean(np.abs(fit.residual_um))) for fit in fits]
        edges = {
            scan.id: edges_of_scan(scan, own, fit.residual_um).mean_nm or 0.0
            for scan, own, fit in zip(scans, maps_um, fits, strict=True)
            if scan.seen_by == "sem"
        }
        mse = [NM_PER_UM**2 * float(np.nanmean(fit.residual_um**2)) for fit in fits]
        rows.append(
            ErrorRow(
                model=model,
                measurement=measurement,
                policy=policy,
                k=float(np.mean([fit.degrees_of_freedom for fit in fits])),
                held_out=held_out,
                printer_numbers=numbers[0],
                measurement_numbers=numbers[1],
                mae_nm=float(np.mean(mae)),
                mae_ci95_nm=interval(mae),
                rmse_nm=float(np.sqrt(np.mean(mse))),
                by_scan_nm={scan.id: own for scan, own in zip(scans, mae, strict=True)},
                edge_by_scan_nm=edges,
            )
        )
    return rows


class Fit(NamedTuple):
    """Printer and measurement fitted to the same scans."""

    twin: Twin
    measurement: MeasurementModel

    @property
    def numbers(self) -> tuple[int, int]:
        """Fitted numbers of printer and measurement."""
        return len(self.twin.vector), self.measurement.numbers


class HeldOut:
    """The models that a loop has found, each fitted with its measurement to other scans than are scored.

    Args:
        closed: what was found; ``settings``: folds, seed, workers, report.
    """

    def __init__(self, closed: Closed, settings: Study):
        self.closed, self.settings = closed, settings
        self.scans = [one.stored for one in closed.original]
        # With its state, which must outlive its entry: the number of one that is gone may come again.
        self._known: dict[tuple[int, bool], tuple[State, tuple[Maps, tuple[int, int]]]] = {}

    @property
    def stages(self) -> dict[Stage, State]:
        """The models in order, each once."""
        found: dict[Stage, State] = {"base": self.closed.base}
        if self.closed.causes and self.closed.chosen.lawful.causes:
            found["causes"] = self.closed.chosen.named.state
        return {**found, "all": self.closed.final}

    def errors(self) -> list[ErrorRow]:
        """Of all models, scans predicted without their fold; of first and last also without their print."""
        plain, study = self.closed.plain, self.closed.study
        numbers = len(plain.twin.vector)
        maps = held_out_maps(plain, study, self.closed.original)
        rows = self._rows("base", "print alone", "scans", maps, (numbers, 0))
        if not study.of_films:
            published = self._published(plain, maps)
            rows += self._rows("base", "published", "scans", published, (numbers, _PUBLISHED_NUMBERS))
        for name, state in self.stages.items():
            self.settings.report("scoring the base" if name == "base" else f"scoring {name}")
            rows += self._rows(name, "shared", "scans", *self._by_fold(state))
        prints = [scan.print_id for scan in self.scans]
        if 1 < len(set(prints)) < len(prints) and is_refitted(self.closed.base.twin.base):
            for name, state in self._ends():
                self.settings.report(f"leaving out whole prints: {name}")
                jobs = dict.fromkeys(sorted(set(prints)), (state.twin, None))
                rows += self._rows(name, "shared", "prints", *self._without_parts(jobs, prints))
        return rows

    def of_others(self, scans: Sequence[PrintedScan]) -> list[tuple[Stage, Fit, list[np.ndarray]]]:
        """Base and corrected model fitted to all scans that took part, and the maps of scans that did not."""
        prepared, found = prepared_among(scans, self.closed.original), []
        for name, state in self._ends():
            fit = Fit(*fit_with_measurement(state.twin, self.closed.original, self.settings.seed))
            found.append((name, fit, _expected(fit, prepared, None)))
        return found

    def maps_um(self, state: State) -> list[np.ndarray]:
        """The maps (y, x) that the scans should show, print and measurement learned without their fold."""
        return self._by_fold(state)[0]

    def left_out_nm(self) -> dict[str, float]:
        """By how much the error grows (k = 1) without each cause or law, the rest fitted again."""
        model, found = self.closed.final, {}
        whole_nm = self._error_nm(model) if model.twin.names else 0.0
        for name in model.twin.names:
            self.settings.report(f"leaving out {name}")
            found[name] = self._error_nm(model.without(name, self.closed.study)) - whole_nm
        return found

    def residuals(self) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Residual maps (y, x), nm, of all scans before and after, each with its own zero taken out."""
        found = []
        before, after = (self.maps_um(state) for _, state in self._ends())
        for scan, *maps in zip(self.scans, before, after, strict=True):
            left = [np.where(scan.usable, NM_PER_UM * (scan.height_um - own), np.nan) for own in maps]
            found.append((scan.id, left[0] - np.nanmedian(left[0]), left[1] - np.nanmedian(left[1])))
        return found

    def survives_on(self, others: Mapping[str, nn.Module]) -> dict[str, list[str]]:
        """For each cause and law, the other bases on which it is confirmed too, all others in place."""
        final, study = self.closed.final, self.closed.study
        found: dict[str, list[str]] = {name: [] for name in final.twin.names}
        for base_name, base in others.items() if found else ():
            self.settings.report(f"trying what was found on {base_name}")
            bare = fit_state(Twin.bare(base, study.scans[0]), study)
            full = fit_state(final.twin.over(bare.twin.placed().base, study.scans[0]), study)
            for name, by in final.twin.by.items():
                without = full.without(name, study)
                if judge(without.freed_nm2, full.freed_nm2, study).passed(grouped=by != ALL):
                    found[name].append(base_name)
        return found

    def _ends(self) -> tuple[tuple[Stage, State], ...]:
        return ("base", self.closed.base), ("all", self.closed.final)

    def _error_nm(self, state: State) -> float:
        """The leading error: the printer as it stands, the measurement learned again beside it."""
        row = error_of(self._rows("all", "shared", "scans", *self._by_fold(state, refit=False)), "all")
        assert row is not None
        return row.leading_nm

    def _rows(
        self, model: Stage, measurement: MeasuredBy, held_out: Any, maps: Maps, numbers: tuple[int, int]
    ) -> list[ErrorRow]:
        return error_rows(
            self.scans, maps, model=model, measurement=measurement, held_out=held_out, numbers=numbers,
            seed=self.settings.seed,
        )  # fmt: skip

    def _by_fold(self, state: State, refit: bool = True) -> tuple[Maps, tuple[int, int]]:
        key = id(state), refit
        if key not in self._known:
            starts = {fold: (state.twin.at(own), fold) for fold, own in enumerate(state.per_fold)}
            found = self._without_parts(starts, self.settings.fold_of.tolist(), refit)
            self._known[key] = state, found
        return self._known[key][1]

    def _without_parts(
        self, starts: Mapping[Any, tuple[Twin, int | None]], part_of: Sequence[Any], refit: bool = True
    ) -> tuple[Maps, tuple[int, int]]:
        """Maps of all scans by fits without their part, and the most numbers that any of them took.

        Args:
            starts: part to where its fit begins, and the fold that the base must not have seen.
        """
        original, jobs = self.closed.original, []
        for part, (twin, fold) in starts.items():
            rest = [scan for scan, own in zip(original, part_of, strict=True) if own != part]
            jobs.append((part, twin, rest, self.settings.seed, fold, refit))
        done = run_jobs(_fit_part, jobs, self.settings.workers, name=lambda job: f"part {job[0]}")
        fits = {job[0]: fit for job, fit in done}
        maps = [
            _expected(fits[part], [scan], starts[part][1])[0]
            for scan, part in zip(original, part_of, strict=True)
        ]
        return maps, max(fit.numbers for fit in fits.values())

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


def _fit_part(job: tuple[Any, Twin, Sequence[PreparedScan], int, int | None, bool]) -> Fit:
    return Fit(*fit_with_measurement(*job[1:]))


def _expected(fit: Fit, scans: Sequence[PreparedScan], fold: int | None) -> list[np.ndarray]:
    placed = fit.twin.placed()
    return [fit.measurement.expected_um(scan.stored, placed.height(scan, fold)) for scan in scans]
