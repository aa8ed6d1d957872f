"""``litho-models noise``: what no model of the printer can predict, from whatever was measured."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_info
from litho_data.readers import read_scan
from litho_data.store import Store, open_store
from litho_models.frozen.card import DatasetName
from litho_models.noise.bounds import NoiseBound, noise_bounds
from litho_models.noise.calibration import analyse_spread
from litho_models.noise.dose import dose_matrix
from litho_models.noise.report import write_noise_report
from litho_models.noise.residuals import read_residuals
from litho_models.noise.result import NoiseAnalysis, ReferencePrints
from litho_models.noise.staircase import step_print
from litho_models.noise.surface import BACKGROUNDS, SurfaceNoise, print_noise, surface_noise
from litho_models.scoring.noise_floor import NoiseFloor


@dataclass(frozen=True)
class Reference:
    """A scan made to measure the noise: ``use`` is substrate, flat or steps; heights and pitch in µm."""

    id: str
    use: str
    height_um: np.ndarray
    pitch_um: tuple[float, float]


def noise(
    store: str | Path,
    out: str | Path,
    *,
    residuals: Sequence[str | Path] = (),
    model: str | None = None,
    seed: int = 0,
) -> NoiseAnalysis:
    """Analyse the noise of a store; write ``noise.json``, a report and CSV tables.

    Args:
        store: dataset store, with or without scans of use substrate, flat and steps, with or without doses.
        out: result folder.
        residuals: folders of ``litho-models benchmark`` (out of fold), or frozen models (folders,
            ``zoo:NAME``): adds σ(x) and its calibration; several of one kind are taken as an ensemble.
        model: which model of the benchmarks; their best one by default.
        seed: of the pixels drawn.

    Raises:
        InputError: a store or residuals that cannot be read or do not belong together.
    """
    if model is not None and not residuals:
        raise InputError("model", got=f"{model} and no residuals", wanted="a benchmark to choose it from")
    dataset = open_store(store)
    every = dataset.scans()
    locked = dataset.locked_ids
    scans = [scan for scan in every if scan.id not in locked]
    references = store_references(dataset)
    spread = read_residuals(dataset, residuals, model) if residuals else None
    found = reference_prints(references, dataset.level_height_um)
    dose, notes = dose_matrix(every)
    # A dose often has one print, without which it is lost, and no model is judged by the matrix.
    in_matrix = {scan_id for row in dose.rows for scan_id in row.scans} if dose is not None else set()
    if open_for_it := [scan_id for scan_id in locked if scan_id in in_matrix]:
        notes.append(f"Locked, and in the dose matrix only, which judges no model: {', '.join(open_for_it)}.")
    dropped = [
        f"{scan_id}: lock box" + (", in the dose matrix only" if scan_id in in_matrix else "")
        for scan_id in locked
    ]
    bounds = noise_bounds(dataset, scans, seed)
    result = NoiseAnalysis(
        schema="litho-models/noise/1",
        run=run_info([seed], len(scans), dropped),
        dataset=DatasetName(name=dataset.name, sha256=dataset.sha256),
        noise_floor=floor_of(found, bounds),
        references=found,
        dose=dose,
        bounds=bounds,
        spread=analyse_spread(spread, seed) if spread is not None else None,
        notes=[*_notes(found, bounds), *notes],
    )
    result.write(out)
    write_noise_report(result, references, out)
    return result


def noise_of_files(
    out: str | Path,
    *,
    flat: str | Path,
    substrate: str | Path | None = None,
    steps: str | Path | None = None,
    unit: str | None = None,
    size_um: tuple[float, float] | None = None,
    level_height_um: float = 0.1,
) -> NoiseAnalysis:
    """The same from single scans, without a store.

    Args:
        out: result folder.
        flat: scan of a flat print; ``substrate``: of the bare substrate; ``steps``: of a staircase.
        unit, size_um: of the heights and of the field (y, x), where the files state none.
        level_height_um: nominal step of the staircase.

    Raises:
        InputError: a file that cannot be read, or without a known pitch.
    """
    references = []
    for use, file in (("substrate", substrate), ("flat", flat), ("steps", steps)):
        if file is not None:
            scan = read_scan(file, unit=unit, size_um=size_um)
            references.append(Reference(Path(file).stem, use, scan.height_um, scan.require_pitch()))
    found = reference_prints(references, level_height_um)
    result = NoiseAnalysis(
        schema="litho-models/noise/1",
        run=run_info([], len(references)),
        dataset=None,
        noise_floor=floor_of(found, []),
        references=found,
        dose=None,
        bounds=[],
        spread=None,
        notes=["Single scans as read: levelling is an offset or a polynomial of second degree, as stated."],
    )
    result.write(out)
    write_noise_report(result, references, out)
    return result


def store_references(store: Store) -> list[Reference]:
    """The substrate, flat and step scans of a store, levelled, in their own frame."""
    pitches = _recorded_pitches(store)
    return [
        Reference(
            scan_id,
            use,
            store.scan_frame(scan_id, "levelled_height_um"),
            pitches.get(scan_id, (store.pitch_um, store.pitch_um)),
        )
        for scan_id, use in store.references().items()
    ]


def reference_prints(references: Sequence[Reference], level_height_um: float) -> ReferencePrints:
    """Roughness of substrates and flat prints under both backgrounds, the print alone, and the steps."""

    def surfaces(use: str) -> list[SurfaceNoise]:
        return [
            surface_noise(one.id, one.height_um, background)
            for one in references
            if one.use == use
            for background in BACKGROUNDS
        ]

    substrates, flats = surfaces("substrate"), surfaces("flat")
    alone = [
        print_noise(flat, _pooled([s for s in substrates if s.background == flat.background]))
        for flat in flats
        if substrates
    ]
    steps = [
        step_print(one.id, one.height_um, one.pitch_um, level_height_um)
        for one in references
        if one.use == "steps"
    ]
    return ReferencePrints(substrates=substrates, flats=flats, print_noise=alone, steps=steps)


def floor_of(found: ReferencePrints, bounds: Sequence[NoiseBound]) -> NoiseFloor:
    """The floor for ``mae_datum_free`` with policy ``offset``: repeats, a flat print, or a lower bound."""
    for bound in bounds:
        if bound.name.startswith("repeated prints"):
            return NoiseFloor(
                mae_nm=bound.mae_nm,
                rmse_nm=bound.sigma_nm,
                kind="measured",
                source=f"{bound.name}; contains {bound.contains}; lacks {bound.lacks}",
            )
    flats = [flat for flat in found.flats if flat.background == "offset"]
    if flats:
        flat = _pooled(flats)
        return NoiseFloor(
            mae_nm=flat.mae_nm,
            rmse_nm=flat.sigma_nm,
            kind="measured",
            source=f"flat print ({', '.join(one.id for one in flats)}), offset removed, MAE as measured; one "
            "level only: edges and other levels may be rougher",
        )
    lower = [bound for bound in bounds if bound.of == "all" and bound.direction == "lower bound"]
    if lower:
        best = max(lower, key=lambda bound: bound.sigma_nm)
        return NoiseFloor(
            mae_nm=best.mae_nm,
            rmse_nm=best.sigma_nm,
            kind="lower-bound",
            source=f"{best.name}; contains {best.contains}; lacks {best.lacks}",
        )
    return NoiseFloor(mae_nm=None, rmse_nm=None, kind="unknown", source="nothing measured that bounds it")


def _pooled(surfaces: Sequence[SurfaceNoise]) -> SurfaceNoise:
    """Several surfaces of one kind as one: variances and mean absolute deviations averaged."""
    if len(surfaces) == 1:
        return surfaces[0]
    sigma = float(np.sqrt(np.mean([one.sigma_nm**2 for one in surfaces])))
    independent = float(np.sum([one.independent_heights for one in surfaces]))
    return SurfaceNoise(
        id="+".join(one.id for one in surfaces),
        background=surfaces[0].background,
        sigma_nm=sigma,
        sigma_uncertainty_nm=sigma / float(np.sqrt(2 * max(1.0, independent))),
        mae_nm=float(np.mean([one.mae_nm for one in surfaces])),
        gaussian_mae_nm=float(np.mean([one.gaussian_mae_nm for one in surfaces])),
        independent_heights=independent,
        pixels=sum(one.pixels for one in surfaces),
    )


def _recorded_pitches(store: Store) -> dict[str, tuple[float, float]]:
    """Pitch (y, x) of the scans as their reader recorded it, µm."""
    pitches = {}
    for row in store.manifest.get("files", []):
        pitch = json.loads(row["read"] or "{}").get("pitch_um")
        if pitch:
            pitches[row["scan"]] = (float(pitch[0]), float(pitch[1]))
    return pitches


def _notes(found: ReferencePrints, bounds: Sequence[NoiseBound]) -> list[str]:
    notes = []
    if not found.flats and not any(bound.name.startswith("repeated") for bound in bounds):
        notes.append(
            "No flat and no repeated print in the store: the floor is a lower bound and cannot stop a loop. "
            "One flat print and one repeat of any layout would measure it."
        )
    if found.flats and not found.substrates:
        notes.append("No bare substrate: the flat print's roughness includes microscope and substrate.")
    return notes
