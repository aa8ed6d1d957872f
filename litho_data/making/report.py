"""Write the report of a build. It shows the inputs, the results and pictures of the scans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation import Array, atomic_file, table_beside
from litho_data.making.gratings import GratingScan, grating_scans
from litho_data.making.verdict import verdict_of
from litho_data.reports.page import Page
from litho_data.reports.pictures import colour_bar_png, coloured_png, limits, thumbnail
from litho_data.store.read import PrintedScan, Store, open_store

if TYPE_CHECKING:
    import pandas as pd

    from litho_data.making.result import BuildResult

_MAX_SCANS_SHOWN = 48
# Sigma, in px, with which the layout is blurred for pictures of the residual. It is about the width of a
# printed line, and is used only for these pictures.
_BLUR_PX = 3.0
_STAGES = {
    "layout (level)": "viridis",
    "raw ({unit})": "cividis",
    "registered (nm)": "cividis",
    "residual (nm)": "RdBu_r",
}
# Names of the tables that not every report has.
_SOMETIMES = ("findings", "left_out", "warnings", "gratings", "summary", "uncertainty")
# The columns of each table of the report, in order, each with its title and its meaning.
_COLUMNS = table_beside(__file__, "columns.toml")


def write_report(result: BuildResult, store_path: Path, folder: Path) -> Path:
    """Write ``report.html``, ``build.json`` and CSV tables into ``folder``. Return the path of
    ``report.html``.
    """
    store = open_store(store_path)
    # Tables of an earlier build are removed, because this report may not have them.
    for stale in (path for name in _SOMETIMES for path in folder.glob(f"{name}.*")):
        stale.unlink()
    page = Page(
        f"Dataset {store.name}",
        "The raw scans were read, levelled, registered onto their layouts and stored.",
        facts={"dataset": store.sha256},
        words={key: words for table in _COLUMNS.values() for key, words in table.items()},
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
        "The hash of the dataset (below) is computed from the layouts, heights, masks of valid pixels and "
        "transforms of all scans. Building the dataset again gives the same hash."
    )
    assumed = store.manifest["assumptions"]
    page.note(*(f"Assumed, because the card does not say: {assumption}." for assumption in assumed))


def _left_out(page: Page, result: BuildResult) -> None:
    if result.findings:
        page.heading("To do")
        table = [{"scan": one.scan, "what": one.text} for one in result.findings]
        page.table(table, "What to check or fix in the dataset, worst first", "findings.csv")
    apart = {"skipped": result.skipped, "unpaired": result.unpaired}
    rows = [
        {"id": key, "status": how, "reason": reason}
        for how, reasons in apart.items()
        for key, reason in reasons.items()
    ]
    if rows:
        page.heading("Not in the store")
        caption = (
            "Ids that are not in the store, and the reasons. With --strict, a single such id stops the build"
        )
        page.table(rows, caption, "left_out.csv")


def _warnings(page: Page, quality: pd.DataFrame) -> None:
    if "warning" in quality and (warned := quality["warning"].astype(bool)).any():
        page.heading("Passed with a note", folded=True)
        alike = quality[warned].groupby("warning", sort=False)["scan"].agg(", ".join).reset_index()
        page.table(alike, "Scans that are in the store, with a note on each", "warnings.csv")


def _quality(page: Page, quality: pd.DataFrame) -> None:
    shown = quality[[name for name in _COLUMNS["quality"] if name in quality]]
    if len(shown.columns) == 1:
        # Datasets imported from pairs were not registered by a build, so their table would contain only ids.
        return
    page.heading("Quality of every scan, in numbers", folded=True)
    page.table(
        shown,
        "Registration of every scan. The file quality.csv contains further values",
        "summary.csv",
        digits=3,
    )
    if "sigma_nm" in quality:
        page.table(
            quality[list(_COLUMNS["uncertainty"])],
            "Parts of the uncertainty of the heights, each as the root mean square over a scan. The "
            "uncertainty of the scan's offset is not included. If the card has no z calibration, that part "
            "is 0, and the total does not include the error of the z scale",
            "uncertainty.csv",
            digits=2,
        )


def _gratings(page: Page, scans: Sequence[GratingScan]) -> None:
    if scans:
        page.heading("Properties of the microscope from the grating")
        page.table(
            [{name: getattr(one, name) for name in _COLUMNS["grating"]} for one in scans],
            "Scale factors, bow of a scan line and radius of the tip, measured with the known period of the "
            "grating. They are not used to correct other scans",
            "gratings.csv",
            digits=4,
        )


def _pictures(page: Page, store: Store) -> None:
    page.heading("Every scan")
    ids = _shown_ids(store)
    if len(ids) < len(store):
        page.note(f"Of {len(store)} scans, the {len(ids)} that correlate least with their layouts are shown.")
    stages = [_stages(store, scan_id) for scan_id in ids]
    columns, pictures = [], []
    unit = "grey" if store.instrument == "sem" else "nm"
    for (title, colours), images in zip(_STAGES.items(), zip(*stages, strict=True), strict=True):
        low, high = _range(images, symmetric=colours == "RdBu_r")
        columns.append((f"{title.format(unit=unit)}, {low:.4g} … {high:.4g}", colour_bar_png(colours)))
        pictures.append([coloured_png(image, colours, low, high) for image in images])
    caption = (
        "Raw: the scan in its own frame. Registered: the scan on the layout's grid, empty where not "
        "measured. Residual: the registered heights minus the blurred layout, whose gain and offset are "
        "fitted. All pictures in a column have the same colour scale."
    )
    page.gallery(columns, list(zip(ids, zip(*pictures, strict=True), strict=True)), caption)


def _shown_ids(store: Store) -> list[str]:
    if len(store) <= _MAX_SCANS_SHOWN or "ncc_after" not in store.quality:
        return store.ids[:_MAX_SCANS_SHOWN]
    worst = store.quality.sort_values("ncc_after")["scan"].head(_MAX_SCANS_SHOWN)
    return [str(scan_id) for scan_id in worst]


def _stages(store: Store, scan_id: str) -> list[Array]:
    """Return the small pictures of a scan, in the order of ``_STAGES``."""
    scan = store.scan(scan_id)
    images = [scan.mask_level, _raw(store, scan_id), scan.height_um * 1e3, _residual_nm(scan)]
    return [thumbnail(image) for image in images]


def _raw(store: Store, scan_id: str) -> Array:
    """Return the raw heights of a scan in nm, or the grey values of a micrograph."""
    if store.instrument == "sem":
        return store.scan_frame(scan_id, "micrograph").astype(float)
    return store.scan_frame(scan_id, "raw_height_um") * 1e3


def _residual_nm(scan: PrintedScan) -> Array:
    from litho_data.register import predicted_topography

    layout = predicted_topography(scan.mask_level, _BLUR_PX).astype(float)
    design = np.stack([layout, np.ones(scan.shape)], axis=-1)
    response, *_ = np.linalg.lstsq(design[scan.valid], scan.height_um[scan.valid].astype(float), rcond=None)
    return (scan.height_um - design @ response) * 1e3


def _range(images: Sequence[Array], symmetric: bool) -> tuple[float, float]:
    values = np.concatenate([image.ravel() for image in images])
    low, high = limits(values)
    return (-max(-low, high), max(-low, high)) if symmetric else (low, high)
