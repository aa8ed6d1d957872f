"""Draw the documentation's figure of a prediction for a scan that was held out of the fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from litho_data.reports.pictures import new_figure
from litho_data.store import open_store


def draw_prediction(store: Path, benchmark: Path, path: Path, model: str = "pbl") -> None:
    """Draw the layout, the print, its prediction and their difference, for the held-out scan on which the
    model has its median error.
    """
    result = json.loads((benchmark / "benchmark.json").read_text(encoding="utf-8"))
    rows = next(s for s in result["scores"] if s["model"] == model)["scans"]
    errors = [row["mae_datum_free_nm"] for row in rows]
    chosen = rows[int(np.argsort(errors)[len(errors) // 2])]
    scan = next(s for s in open_store(store).scans() if s.id == chosen["scan"])
    prediction = _held_out(benchmark / "cache", model, scan.id)
    difference = 1e3 * np.where(scan.valid, scan.height_um - prediction, np.nan)
    difference -= np.nanmedian(difference)
    measured = np.where(scan.valid, scan.height_um, np.nan)
    # The layout has a colour scale of its own, because a print is lower and has another zero height.
    low, high = np.nanpercentile(measured, (0.1, 99.9))
    printed = float(low), float(high)
    panels: list[tuple[str, np.ndarray, str, tuple[float, float]]] = [
        ("layout (µm)", scan.layout_um, "viridis", (0, 1.2)),
        ("measured (µm)", measured, "viridis", printed),
        (f"{model}, not trained on this scan (µm)", prediction, "viridis", printed),
        ("measured - predicted (nm)", difference, "RdBu_r", (-80, 80)),
    ]
    figure = new_figure(15, 3.9)
    size = [0, scan.shape[1] * scan.pitch_um, scan.shape[0] * scan.pitch_um, 0]
    for axes, (title, values, colours, limits) in zip(figure.subplots(1, 4), panels, strict=True):
        shown = axes.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], extent=size)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("x (µm)")
        figure.colorbar(shown, ax=axes, shrink=0.8)
    figure.suptitle(f"{scan.id}, the median held-out scan: {chosen['mae_datum_free_nm']:.1f} nm", fontsize=11)
    # Lossless formats compress roughness badly.
    figure.savefig(path, dpi=75, pil_kwargs={"quality": 80})


def _held_out(cache: Path, model: str, scan_id: str) -> np.ndarray:
    for record in cache.glob(f"{model}-*/fit.json"):
        ids = json.loads(record.read_text(encoding="utf-8"))["held_out_ids"]
        if scan_id in ids:
            return np.load(record.parent / f"prediction_{ids.index(scan_id):03d}.npy", allow_pickle=False)
    raise FileNotFoundError(f"no held-out prediction of {scan_id} by {model} in {cache}")
