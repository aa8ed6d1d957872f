"""Write the first scans of a new lab: six prints, each surrounded by bare substrate.

They are rotated, tilted and bowed, and stored in five formats.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile
from scipy import ndimage

from litho_data.readers.gsf import gsf_bytes

PITCH_UM = 0.15
LEVEL_HEIGHT_UM = 0.08
LEVELS = 13
MARGIN_PX = 20
# A store keeps this width of bare substrate around an isolated field.
RIM_PX = 2
JITTER_UM = 0.006
SIDE_PX = 160
MIRRORED = "B2"
IDS = ("A1", "A2", "A3", "B1", "B2", "B3")
_ANGLES_DEG = (0.0, 1.5, -2.5, 4.0, -1.0, 3.0)


def layout_of(scan_id: str, side_px: int = SIDE_PX) -> np.ndarray:
    """Return a layout of random smooth levels with a few blocks, as uint8."""
    rng = np.random.default_rng(IDS.index(scan_id) + 50)
    smooth = ndimage.gaussian_filter(rng.standard_normal((side_px, side_px)), 5.0)
    low, high = np.percentile(smooth, [3, 97])
    level = np.clip((smooth - low) / (high - low) * (LEVELS - 1), 0, LEVELS - 1).round()
    for _ in range(4):
        y, x = rng.integers(5, side_px - 35, 2)
        level[y : y + 25, x : x + 30] = rng.integers(0, LEVELS)
    return level.astype(np.uint8)


def print_of(scan_id: str, side_px: int = SIDE_PX) -> np.ndarray:
    """Return the true heights of a print and of the substrate around it, in µm on the grid of the layout."""
    level = np.pad(layout_of(scan_id, side_px).astype(float) + 2.0, 2 * MARGIN_PX)
    exposed = ndimage.gaussian_filter(level, 1.6)
    return LEVEL_HEIGHT_UM * (exposed + 0.015 * exposed**2)


def scan_of(scan_id: str, side_px: int = SIDE_PX) -> np.ndarray:
    """Return a scan in µm: the rotated print with a tilt, a bow, line offsets and noise."""
    rng = np.random.default_rng(IDS.index(scan_id) + 7)
    truth = print_of(scan_id, side_px)
    if scan_id == MIRRORED:
        truth = truth[:, ::-1]
    height = ndimage.rotate(truth, _ANGLES_DEG[IDS.index(scan_id)], reshape=False, order=3, mode="nearest")
    height = height[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    y, x = (np.linspace(-1, 1, n) for n in height.shape)
    tilt, bow = rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.08, 0.08, 3)
    height = height + tilt[0] * y[:, None] + tilt[1] * x + bow[0] * y[:, None] ** 2 + bow[1] * x**2
    height += bow[2] * np.multiply.outer(y, x) + JITTER_UM * rng.standard_normal((len(y), 1))
    return height + 0.002 * rng.standard_normal(height.shape)


def write_lab(folder: Path, side_px: int = SIDE_PX, ids: tuple[str, ...] = IDS, **changed: str) -> Path:
    """Write layouts, scans, table and card. ``changed`` replaces values of the card by other TOML values."""
    (folder / "layouts").mkdir(parents=True)
    (folder / "scans").mkdir()
    for scan_id in ids:
        tifffile.imwrite(folder / "layouts" / f"{scan_id}.tif", layout_of(scan_id, side_px))
        _write(folder / "scans", scan_id, scan_of(scan_id, side_px))
    size = f"{(side_px + 2 * MARGIN_PX) * PITCH_UM:g}".replace(".", ",")
    rows = {"A1": f"A1;nm;{size};Dimension", "B3": f"B3;m;{size};Cypher"}
    table = ["id;unit;size_um;instrument", *(rows.get(one, f"{one};;;Dimension") for one in ids)]
    (folder / "scans.csv").write_text("\n".join(table))
    says = {
        "pitch_um": str(PITCH_UM),
        "level_height_um": str(LEVEL_HEIGHT_UM),
        "levels": str(LEVELS),
        "more": "",
    } | changed
    (folder / "card.toml").write_text(
        'name = "lab"\n[layout]\nfiles = "layouts/{id}.*"\n'
        + "".join(f"{key} = {says[key]}\n" for key in ("pitch_um", "level_height_um", "levels"))
        + '[scan]\nfiles = ["scans/{id}.*"]\n[ids]\nprint = \'(?P<print>[A-Z])\\d\'\ntable = "scans.csv"\n'
        + '[write]\nsurround = "substrate"\n'
        + says["more"]
    )
    return folder / "card.toml"


def _write(folder: Path, scan_id: str, height_um: np.ndarray) -> None:
    side_m = height_um.shape[0] * PITCH_UM * 1e-6
    if scan_id == "A1":
        np.savetxt(folder / "A1.txt", height_um * 1e3, fmt="%.3f", delimiter="\t")
    elif scan_id == "A2":
        (folder / "A2.gsf").write_bytes(gsf_bytes(height_um, (PITCH_UM, PITCH_UM)))
    elif scan_id in ("A3", "B2"):
        from gwyfile.objects import GwyContainer, GwyDataField, GwySIUnit

        units = {"si_unit_xy": GwySIUnit(unitstr="m"), "si_unit_z": GwySIUnit(unitstr="m")}
        field = GwyDataField(height_um * 1e-6, xreal=side_m, yreal=side_m, **units)
        GwyContainer({"/0/data": field, "/0/data/title": "Height"}).tofile(str(folder / f"{scan_id}.gwy"))
    elif scan_id == "B1":
        side = f"{side_m * 1e6:.6f} µm"
        head = f"# Channel: Height\n# Width: {side}\n# Height: {side}\n# Value units: m\n"
        with (folder / "B1.txt").open("w", encoding="utf-8") as stream:
            stream.write(head)
            np.savetxt(stream, height_um * 1e-6, fmt="%.6e")
    else:
        np.save(folder / "B3.npy", height_um * 1e-6)


def errors_nm(store: object) -> dict[str, float]:
    """Return the mean absolute error of each scan in nm, after the median error is subtracted."""
    found = {}
    for scan in store.scans():  # type: ignore[attr-defined]
        inner = slice(2 * MARGIN_PX, -2 * MARGIN_PX)
        truth = print_of(scan.id, scan.shape[0] - 2 * RIM_PX)[inner, inner]
        field = (slice(RIM_PX, -RIM_PX),) * 2
        off = (scan.height_um[field] - truth)[scan.valid[field]]
        found[scan.id] = float(np.abs(off - np.median(off)).mean() * 1e3)
    return found
