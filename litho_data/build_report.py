"""The human report of a build: what went in, what came out, and a look at every scan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.files import atomic_file
from litho_data.report import Page, new_figure
from litho_data.store.read import PrintedScan, Store, open_store

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from litho_data.make_store import BuildResult

_SCANS_PER_FIGURE = 6
_MAX_SCANS_SHOWN = 48
_THUMBNAIL_PX = 180
_GAP_PX = 6
# Blur of the layout in the residual: about the width of the printer's line; a look, not a model.
_BLUR_PX = 3.0
_TABLE = {
    "scan": "scan",
    "model": "model",
    "ncc_before": "correlation, centred",
    "ncc_after": "correlation, registered",
    "reprojection_px": "reprojection [px]",
    "tre_median_nm": "held-out error, median [nm]",
    "tre_p95_nm": "held-out error, p95 [nm]",
    "corner_sd_nm": "corner spread [nm]",
    "overlap": "overlap",
    "rotation_deg": "rotation [deg]",
    "singular_min": "scale, least",
    "singular_max": "scale, most",
    "noise_x_nm": "noise along x [nm]",
    "noise_y_nm": "noise along y [nm]",
    "row_step_nm": "row steps [nm]",
    "removed_sd_nm": "levelled away, sd [nm]",
    "warning": "warning",
}


def write_report(result: BuildResult, store_path: Path, folder: Path) -> Path:
    """Write ``report.html``, ``build.json`` and CSV tables into ``folder``; returns the page's path."""
    store = open_store(store_path)
    page = Page(
        f"Dataset {store.name}", "Raw scans read, levelled, registered onto their layouts and stored."
    )
    _summary(page, result, store)
    _left_out(page, result)
    _quality(page, store.quality)
    _pictures(page, store)
    result.write(folder)
    with atomic_file(folder / "quality.csv") as temporary:
        store.quality.to_csv(temporary, index=False)
    return page.write(folder)


def _summary(page: Page, result: BuildResult, store: Store) -> None:
    quality = store.quality
    tiles = [(str(result.n_scans), "scans in the store")]
    if "ncc_after" in quality:
        tiles.append((f"{quality['ncc_after'].median():.3f}", "median correlation of height and layout"))
    if "tre_median_nm" in quality:
        tiles.append((f"{quality['tre_median_nm'].median():.0f} nm", "median held-out registration error"))
    tiles += [(str(len(result.skipped)), "scans skipped"), (f"{result.seconds:.1f} s", "time of the build")]
    page.tiles(tiles)
    page.paragraph(
        f"Pitch {store.pitch_um} µm, level height {store.level_height_um} µm, {store.levels} levels. "
        f"Dataset hash {store.sha256}; it covers layouts, heights, validity and transforms of all scans, "
        "and building again gives the same."
    )
    for assumption in store.manifest["assumptions"]:
        page.note(f"Assumed, because the card does not say: {assumption}.")


def _left_out(page: Page, result: BuildResult) -> None:
    import pandas as pd

    rows = [(one.id, "skipped", one.reason) for one in result.skipped]
    rows += [(one.id, "unpaired", one.reason) for one in result.unpaired]
    if rows:
        page.heading("Not in the store")
        table = pd.DataFrame(rows, columns=["id", "status", "reason"])
        page.table(table, "Ids that are not in the store, and why", "left_out.csv")


def _quality(page: Page, quality: pd.DataFrame) -> None:
    page.heading("Quality of every scan")
    shown = quality[[name for name in _TABLE if name in quality]].rename(columns=_TABLE)
    page.table(
        shown, "Registration and noise of every scan; quality.csv has all figures", "summary.csv", digits=3
    )


def _pictures(page: Page, store: Store) -> None:
    page.heading("Every scan")
    ids = _shown_ids(store)
    if len(ids) < len(store):
        page.note(f"The {len(ids)} scans that correlate least with their layout, of {len(store)}.")
    for start in range(0, len(ids), _SCANS_PER_FIGURE):
        chosen = ids[start : start + _SCANS_PER_FIGURE]
        caption = (
            f"{', '.join(chosen)}. Raw: the scan in its own frame. Registered: on the layout's grid, "
            "white where not measured. Residual: registered height minus the blurred layout, "
            "with the best gain and offset."
        )
        page.figure(_thumbnails(store, chosen), caption)


def _shown_ids(store: Store) -> list[str]:
    if len(store) <= _MAX_SCANS_SHOWN or "ncc_after" not in store.quality:
        return store.ids[:_MAX_SCANS_SHOWN]
    worst = store.quality.sort_values("ncc_after")["scan"].head(_MAX_SCANS_SHOWN)
    return [str(scan_id) for scan_id in worst]


def _thumbnails(store: Store, ids: list[str]) -> Figure:
    """One row per scan, one column per stage, one colour scale per column."""
    scans = [store.scan(scan_id) for scan_id in ids]
    columns = [
        ("layout [level]", [_thumbnail(scan.mask_level) for scan in scans], "viridis"),
        (
            "raw [nm]",
            [_thumbnail(store.scan_frame(scan_id, "raw_height_um")) * 1e3 for scan_id in ids],
            "cividis",
        ),
        ("registered [nm]", [_thumbnail(scan.height_um) * 1e3 for scan in scans], "cividis"),
        ("residual [nm]", [_thumbnail(_residual_nm(scan)) for scan in scans], "RdBu_r"),
    ]
    figure = new_figure(8.6, 2.05 * len(ids) + 0.7)
    for axis, (title, images, colours) in zip(figure.subplots(1, len(columns)), columns, strict=True):
        # One picture per column: an axis for every thumbnail would take matplotlib longer than the build.
        stack, middles = _stacked(images)
        low, high = _range(stack, symmetric=colours == "RdBu_r")
        shown = axis.imshow(stack, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
        axis.set_title(title, fontsize=9)
        axis.set_xticks([])
        axis.set_yticks(middles, ids if title.startswith("layout") else [""] * len(ids), fontsize=8)
        axis.tick_params(length=0)
        axis.set_frame_on(False)
        figure.colorbar(shown, ax=axis, location="bottom", shrink=0.9, pad=0.01).ax.tick_params(labelsize=7)
    return figure


def _stacked(images: list[np.ndarray]) -> tuple[np.ndarray, list[float]]:
    """Images below each other with a gap of NaN, and the row of each one's middle."""
    width = max(image.shape[1] for image in images)
    height = sum(image.shape[0] + _GAP_PX for image in images) - _GAP_PX
    stack, middles, top = np.full((height, width), np.nan, dtype=np.float32), [], 0
    for image in images:
        stack[top : top + image.shape[0], : image.shape[1]] = image
        middles.append(top + image.shape[0] / 2)
        top += image.shape[0] + _GAP_PX
    return stack, middles


def _residual_nm(scan: PrintedScan) -> np.ndarray:
    from litho_data.register import predicted_topography

    layout = predicted_topography(scan.mask_level, _BLUR_PX)
    x, z = layout[scan.valid].astype(np.float64), scan.height_um[scan.valid].astype(np.float64)
    x_mean, z_mean = (float(values.mean()) if values.size else 0.0 for values in (x, z))
    variance = float(((x - x_mean) ** 2).sum())
    gain = float(((x - x_mean) * (z - z_mean)).sum()) / variance if variance > 0 else 0.0
    return (scan.height_um - (z_mean + gain * (layout - x_mean))) * 1e3


def _range(image: np.ndarray, symmetric: bool) -> tuple[float, float]:
    low, high = (float(value) for value in np.nanpercentile(image, [0.5, 99.5]))
    return (-max(-low, high), max(-low, high)) if symmetric else (low, high)


def _thumbnail(image: np.ndarray) -> np.ndarray:
    step = max(1, -(-max(image.shape) // _THUMBNAIL_PX))
    return image[::step, ::step]
