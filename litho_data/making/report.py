"""The report of a build: what went in, what came out, and pictures of every scan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.files import atomic_file
from litho_data.foundation.kinds import Array
from litho_data.making.gratings import GratingScan, grating_scans
from litho_data.making.verdict import verdict_of
from litho_data.reports.page import Page
from litho_data.reports.pictures import colour_bar_png, coloured_png, thumbnail
from litho_data.store.read import PrintedScan, Store, open_store

if TYPE_CHECKING:
    import pandas as pd

    from litho_data.making.result import BuildResult

_MAX_SCANS_SHOWN = 48
# Blur of the layout in the residual: about the width of the printer's line. For pictures only, no model.
_BLUR_PX = 3.0
_STAGES = {
    "layout (level)": "viridis",
    "raw (nm; grey of a micrograph)": "cividis",
    "registered (nm)": "cividis",
    "residual (nm)": "RdBu_r",
}
_TABLE: dict[str, tuple[str, str]] = {
    "scan": ("scan", ""),
    "model": ("transform", "kind of transform from scan to layout"),
    "ncc_before": ("correlation, centred", "of height and layout, the scan laid in the middle of its layout"),
    "ncc_after": ("correlation, registered", "the same where registration put the scan"),
    "reprojection_px": (
        "reprojection (px)",
        "rms distance of matching details that the first fit used",
    ),
    "tre_median_nm": (
        "held-out error, median (nm)",
        "distance of details that were kept out of the fit: half of them are closer",
    ),
    "tre_p95_nm": ("held-out error, p95 (nm)", "the same: 95 % of them are closer"),
    "corner_sd_nm": (
        "corner spread (nm)",
        "standard deviation of the least certain corner when blocks of the scan are drawn anew",
    ),
    "overlap": ("overlap", "share of the layout with a measured height"),
    "bend_um": ("bend (µm)", "how far the scan is bent at most"),
    "rotation_deg": ("rotation (°)", "angle of the scan on its layout, in its middle"),
    "singular_min": ("scale, smallest", "stretch of the scan along the direction with the least; 1 is none"),
    "singular_max": ("scale, largest", "stretch along the direction with the most"),
    "removed_sd_nm": (
        "removed by levelling, sd (nm)",
        "standard deviation of the surface that levelling removed",
    ),
}
_BUDGET: dict[str, tuple[str, str]] = {
    "scan": ("scan", ""),
    "sigma_nm": ("all (nm)", "the parts to the right, added in squares"),
    "sigma_pixel_nm": ("pixel noise (nm)", "noise of single pixels"),
    "sigma_line_nm": ("line noise (nm)", "what scan lines lie too high or too low"),
    "sigma_resampling_nm": ("resampling (nm)", "what the interpolation onto the layout's grid may be off"),
    "sigma_registration_nm": (
        "registration (nm)",
        "the slope of the print times the uncertainty of its place",
    ),
    "sigma_levelling_nm": ("levelling (nm)", "what the removed surface may be off"),
    "sigma_calibration_nm": ("z calibration (nm)", "height times the uncertainty of the z scale in the card"),
}
_GRATING: dict[str, tuple[str, str]] = {
    "id": ("scan", ""),
    "scale_x": ("scale along x", "what a stated length has to be multiplied by to be true"),
    "scale_x_sd": ("its uncertainty", "standard uncertainty, with that of the period"),
    "scale_y": ("scale along y", "the same across the lines"),
    "scale_y_sd": ("its uncertainty, y", "standard uncertainty, with that of the period"),
    "bow_um": ("bow of a line (µm)", "how far the middle of a line lies too far, against its ends"),
    "bow_sd_um": ("its uncertainty (µm)", "standard uncertainty, from the scatter along the line"),
    "tip_at_most_um": ("tip radius, at most (µm)", "the most that the radius of the tip's end can be"),
    "problem": ("not measured", "why the grating does not show its figures"),
}


def write_report(result: BuildResult, store_path: Path, folder: Path) -> Path:
    """Write ``report.html``, ``build.json`` and CSV tables into ``folder``; returns the page's path."""
    store = open_store(store_path)
    page = Page(
        f"Dataset {store.name}",
        "Raw scans read, levelled, registered onto their layouts and stored.",
        facts={"dataset": store.sha256},
        words=_TABLE | _BUDGET | _GRATING,
    )
    _summary(page, result, store)
    _left_out(page, result)
    _pictures(page, store)
    _warnings(page, store.quality)
    _gratings(page, grating_scans(store))
    _quality(page, store.quality)
    result.write(folder)
    with atomic_file(folder / "quality.csv") as temporary:
        store.quality.to_csv(temporary, index=False)
    return page.write(folder)


def _summary(page: Page, result: BuildResult, store: Store) -> None:
    quality = store.quality
    page.verdict(verdict_of(result.findings, result.n_scans))
    tiles = [(str(result.n_scans), "scans in the store")]
    if "ncc_after" in quality:
        tiles.append((f"{quality['ncc_after'].median():.3f}", "median correlation of height and layout"))
    if "tre_median_nm" in quality:
        tiles.append((f"{quality['tre_median_nm'].median():.0f} nm", "median held-out registration error"))
    tiles.append((f"{result.seconds:.1f} s", "time of the build"))
    page.tiles(tiles)
    page.paragraph(
        f"Pitch {store.pitch_um} µm, level height {store.level_height_um} µm, {store.levels} levels. "
        "The hash of the dataset, below, covers layouts, heights, validity and transforms of all scans; "
        "building again gives the same."
    )
    assumed = store.manifest["assumptions"]
    page.note(*(f"Assumed, because the card does not say: {assumption}." for assumption in assumed))


def _left_out(page: Page, result: BuildResult) -> None:
    if result.findings:
        page.heading("To do")
        table = [{"scan": one.scan, "what": one.text} for one in result.findings]
        page.table(table, "What speaks against the dataset, worst first", "findings.csv")
    apart = {"skipped": result.skipped, "unpaired": result.unpaired}
    rows = [{"id": one.id, "status": how, "reason": one.reason} for how, ids in apart.items() for one in ids]
    if rows:
        page.heading("Not in the store")
        caption = "Ids that are not in the store, and why; `--strict` refuses to build without them"
        page.table(rows, caption, "left_out.csv")


def _warnings(page: Page, quality: pd.DataFrame) -> None:
    if "warning" in quality and (warned := quality["warning"].astype(bool)).any():
        page.heading("Passed with a note", folded=True)
        alike = quality[warned].groupby("warning", sort=False)["scan"].agg(", ".join).reset_index()
        page.table(alike, "What to know about these scans", "warnings.csv")


def _quality(page: Page, quality: pd.DataFrame) -> None:
    page.heading("Quality of every scan, in numbers", folded=True)
    shown = quality[[name for name in _TABLE if name in quality]]
    page.table(
        shown, "Registration and noise of every scan; quality.csv has all figures", "summary.csv", digits=3
    )
    if "sigma_nm" in quality:
        page.table(
            quality[list(_BUDGET)],
            "What the uncertainty of the heights is made of: root mean square over a scan, its offset "
            "aside. z calibration is 0 if the card has none: the error of the z scale is then not contained",
            "uncertainty.csv",
            digits=2,
        )


def _gratings(page: Page, scans: Sequence[GratingScan]) -> None:
    if scans:
        page.heading("What the grating says about the microscope")
        page.table(
            [{name: getattr(one, name) for name in _GRATING} for one in scans],
            "Scales, unevenness of a line and tip, from the known period of the grating; no other scan is "
            "corrected by them",
            "gratings.csv",
            digits=4,
        )


def _pictures(page: Page, store: Store) -> None:
    page.heading("Every scan")
    ids = _shown_ids(store)
    if len(ids) < len(store):
        page.note(f"The {len(ids)} scans with the lowest correlation with their layout, of {len(store)}.")
    stages = [_stages(store, scan_id) for scan_id in ids]
    columns, pictures = [], []
    for (title, colours), images in zip(_STAGES.items(), zip(*stages, strict=True), strict=True):
        low, high = _range(images, symmetric=colours == "RdBu_r")
        columns.append((f"{title}, {low:.4g} … {high:.4g}", colour_bar_png(colours)))
        pictures.append([coloured_png(image, colours, low, high) for image in images])
    caption = (
        "Raw: the scan in its own frame. Registered: on the layout's grid, empty where not measured. "
        "Residual: registered height minus the blurred layout, with the best gain and offset. "
        "One colour scale per column."
    )
    page.gallery(columns, list(zip(ids, zip(*pictures, strict=True), strict=True)), caption)


def _shown_ids(store: Store) -> list[str]:
    if len(store) <= _MAX_SCANS_SHOWN or "ncc_after" not in store.quality:
        return store.ids[:_MAX_SCANS_SHOWN]
    worst = store.quality.sort_values("ncc_after")["scan"].head(_MAX_SCANS_SHOWN)
    return [str(scan_id) for scan_id in worst]


def _stages(store: Store, scan_id: str) -> list[Array]:
    """Thumbnails of a scan, in the order of ``_STAGES``."""
    scan = store.scan(scan_id)
    images = [scan.mask_level, _raw(store, scan_id), scan.height_um * 1e3, _residual_nm(scan)]
    return [thumbnail(image) for image in images]


def _raw(store: Store, scan_id: str) -> Array:
    """Heights in nm or, of a micrograph, grey values."""
    if store.instrument == "sem":
        return store.scan_frame(scan_id, "micrograph").astype(float)
    return store.scan_frame(scan_id, "raw_height_um") * 1e3


def _residual_nm(scan: PrintedScan) -> Array:
    from litho_data.register import predicted_topography

    layout = predicted_topography(scan.mask_level, _BLUR_PX)
    x, z = layout[scan.valid].astype(float), scan.height_um[scan.valid].astype(float)
    x_mean, z_mean = (float(values.mean()) if values.size else 0.0 for values in (x, z))
    variance = float(((x - x_mean) ** 2).sum())
    gain = float(((x - x_mean) * (z - z_mean)).sum()) / variance if variance > 0 else 0.0
    return (scan.height_um - (z_mean + gain * (layout - x_mean))) * 1e3


def _range(images: Sequence[Array], symmetric: bool) -> tuple[float, float]:
    values = np.concatenate([image.ravel() for image in images])
    low, high = (float(value) for value in np.nanpercentile(values, [0.5, 99.5]))
    return (-max(-low, high), max(-low, high)) if symmetric else (low, high)
