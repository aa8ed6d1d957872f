"""The functions behind ``litho-models noise``, which estimate the noise of prints from the available
measurements.
"""

from pathlib import Path

from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_info
from litho_data.readers import read_scan
from litho_data.reports.page import filled
from litho_data.store import open_store
from litho_models.noise.budget import noise_budget
from litho_models.noise.calibration import analyse_spread
from litho_models.noise.dose import dose_matrix
from litho_models.noise.references import (
    Reference,
    reference_prints,
    repeated_prints,
    store_references,
)
from litho_models.noise.report import write_noise_report
from litho_models.noise.residuals import read_residuals
from litho_models.noise.result import NoiseAnalysis, floor_of


def analyse_noise(
    store: str | Path,
    out: str | Path,
    *,
    residuals: str | Path | None = None,
    model: str | None = None,
    seed: int = 0,
) -> NoiseAnalysis:
    """Analyse the noise of the prints in a store. Write ``noise.json``, a report and CSV tables.

    Args:
        store: dataset store. The noise is estimated from its repeated prints and its reference scans (bare
            substrates, flat prints and steps). A dose matrix is made from all scans with a stated dose.
        out: result folder.
        residuals: result folder of ``litho-models benchmark``, or a frozen model (a folder or ``zoo:NAME``).
            With residuals, the analysis also contains the spread σ(x) of the residual at each pixel x, and a
            test of its calibration. If every scan is predicted by a model that was not trained on this scan
            (as in a benchmark), two upper limits of the noise are added (see ``NoiseBudget``).
        model: name of a model in the benchmark; by default the best model.
        seed: seed of the random choice of pixels.

    Raises:
        InputError: the store or the residuals cannot be read or do not belong together, ``model`` is given
            without a benchmark, or there are residuals of fewer than three scans.
    """
    if model is not None and residuals is None:
        raise InputError(
            "name of a model", got=f"{model} without residuals", wanted="a benchmark that contains this model"
        )
    dataset = open_store(store)
    with growing_folder(out, NoiseAnalysis.FILE_NAME, {"dataset": {"name": dataset.name}}):
        every = dataset.scans()
        locked = dataset.locked_ids
        scans = [scan for scan in every if scan.id not in locked]
        references = store_references(dataset)
        spread = None if residuals is None else read_residuals(dataset, residuals, model)
        found = reference_prints(references, dataset.level_height_um)
        dose, notes = dose_matrix(every)
        # The dose matrix also uses locked scans. Their use is harmless, because no model is scored with the
        # matrix, and necessary, because there is often only one print at a dose.
        of_matrix = {scan_id for row in dose.rows for scan_id in row.scans} if dose is not None else set()
        in_matrix = [scan_id for scan_id in locked if scan_id in of_matrix]
        dropped = [
            f"{scan_id}: lock box" + ", used only in the dose matrix" * (scan_id in in_matrix)
            for scan_id in locked
        ]
        repeats = repeated_prints(scans)
        budget = noise_budget(spread, seed) if spread is not None and spread.held_out else None
        limits = filled(
            Path(__file__).with_name("notes.jinja"),
            found=found,
            repeats=repeats,
            budget=budget,
            in_matrix=in_matrix,
        )
        result = NoiseAnalysis(
            run=run_info([seed], len(scans), dropped),
            dataset=dataset.dataset_id,
            noise_floor=floor_of(found, repeats, budget),
            references=found,
            repeats=repeats,
            dose=dose,
            budget=budget,
            spread=analyse_spread(spread, seed) if spread is not None else None,
            notes=[*limits.splitlines(), *notes],
        )
        write_noise_report(result, references, out)
        result.write(out)
    return result


def analyse_noise_of_files(
    out: str | Path,
    *,
    flat: str | Path,
    substrate: str | Path | None = None,
    steps: str | Path | None = None,
    unit: str | None = None,
    size_um: tuple[float, float] | None = None,
    level_height_um: float = 0.1,
) -> NoiseAnalysis:
    """Analyse the noise from the files of single scans, without a store.

    Args:
        out: result folder.
        flat, substrate, steps: scan files of a flat print, of the bare substrate and of a print of steps.
        unit, size_um: unit of the heights, and size of the scan along y and x, µm. Each is needed only if the
            files do not state it.
        level_height_um: nominal height of one step, µm.

    Raises:
        InputError: a file cannot be read, its pitch is not known, or no step is found in the print of steps.
    """
    with growing_folder(out, NoiseAnalysis.FILE_NAME):
        references = []
        for use, file in (("substrate", substrate), ("flat", flat), ("steps", steps)):
            if file is not None:
                scan = read_scan(file, unit=unit, size_um=size_um)
                references.append(Reference(Path(file).stem, use, scan.height_um, scan.require_pitch()))
        found = reference_prints(references, level_height_um)
        result = NoiseAnalysis(
            run=run_info([], len(references)),
            dataset=None,
            noise_floor=floor_of(found, None, None),
            references=found,
            dose=None,
            spread=None,
            notes=[
                "The scans are used as they were read, except that an offset or a second-degree polynomial "
                "is removed where this is stated."
            ],
        )
        write_noise_report(result, references, out)
        result.write(out)
    return result
