"""The error that the true models of print and microscope make on the scans that the loop was judged on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from benchmarks.blind_trials.judging import scan_terms
from benchmarks.blind_trials.records import ErrorPair
from litho_data.register.resample import resample_to_layout
from litho_data.store import Store
from litho_data.virtual_fab import Fab, Job, KnobSetting, Microscope, Noise, Printer, Truth, scan_job
from litho_data.virtual_fab.knobs import KnobBoard
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.result.record import CloseLoop
from litho_models.loop.study import DATUM_FREE, names_to_terms, score

# What no model can predict: an offset drawn anew for every line is estimated from the other half of the
# pixels, as the loop does it; rounding cannot be undone, and scars lie where chance put them. The few
# values that other knobs draw per scan could be estimated almost exactly, so the true model knows them.
_UNFORESEEABLE = {"scan-line-stripes", "quantisation", "scars-and-spikes"}


def true_floor(truth: Truth, jobs: Sequence[Job], store: Store, result: CloseLoop) -> ErrorPair:
    """Held-out error of the noise-free scans with every effect in place, nm.

    They are brought onto the layout by the transform (and bend) that the store has for each scan, and
    scored as the loop scores its final model: development scans, same pixels, same terms per scan.
    """
    fab = _without_noise(truth)
    by_id = {job.id: job for job in jobs}
    locked = set(result.split.lock_box)
    scans = [scan for scan in store.scans() if scan.id not in locked]
    predictions = []
    for scan in scans:
        found = scan_job(fab, by_id[scan.id])
        height, valid = resample_to_layout(
            found.noiseless_um,
            scan.scan_to_layout,
            scan.shape,
            scan_pitch_um=(found.frame.pitch_um, found.frame.pitch_um),
            layout_pitch_um=scan.pitch_um,
            bend_um=scan.bend_um,
        )
        predictions.append(np.where(valid, height, np.float32(np.nanmean(height))))
    stripes = any(knob.name == "scan-line-stripes" for knob in truth.knobs)
    terms = DATUM_FREE | names_to_terms(scan_terms(result) + ["scan-line-stripes"] * stripes)
    errors = score(prepare_scans(scans), predictions, terms, result.nuisance.blocks)
    return ErrorPair(mae_nm=errors.mean_mae_nm, rmse_nm=errors.rmse_nm)


def _without_noise(truth: Truth) -> Fab:
    knobs = [KnobSetting(k.name, k.strength, k.seed) for k in truth.knobs if k.name not in _UNFORESEEABLE]
    printer = {f.name: truth.printer[f.name] for f in fields(Printer)}
    printer["levels"] = int(printer["levels"])
    return Fab(
        printer=Printer(**printer),  # type: ignore[arg-type]
        microscope=Microscope(**truth.microscope),
        noise=Noise.off(),
        knobs=KnobBoard(knobs, truth.seed),
        seed=truth.seed,
    )
