"""Registration of prints with defects and of scans that creep, whose warps are known; and of measured scans.

    python -m benchmarks.registration [--seeds 3] [--store STORE.zarr] [--publish]

Every phantom is registered as a build does it, and once more by the straight fit alone, which knows of
neither. --store compares the held-out block error of measured scans with that before defects and creep were
looked for, docs/results/registration/before_defects.csv. --publish also writes the tables into
docs/registration.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter, map_coordinates

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin
from benchmarks.register_phantoms import (
    PITCH_UM,
    random_layout,
    scan_of,
    true_scan_to_layout,
    warp_about_centre,
)
from litho_data.foundation.commands import progress, run_script
from litho_data.register import Registration, apply_transform, register_scan
from litho_data.store import open_store

PAGE = Path(__file__).parents[1] / "docs" / "registration.md"
RESULT = PAGE.parent / "results" / "registration" / "registration.json"
BEFORE = PAGE.parent / "results" / "registration" / "before_defects.csv"
NAME = "registration.json"
SHAPE, SCAN_SHAPE = (384, 384), (440, 440)
SNR = 10
FIRST_SEED = 40
BARE_UM = 0.005
CREEP_UM = (0.5, 1.0, 1.5)
# Time constant of the scanner's settling, as a share of the scan.
SETTLING = {"settling within a quarter of the scan": 0.25, "within a tenth": 0.1}
Seen = Callable[[np.ndarray], np.ndarray]


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the tables into docs/registration.md", RESULT)
    parser.add_argument("--seeds", type=int, default=3, help="phantoms of each kind")
    parser.add_argument("--store", type=Path, help="the measured prints, by litho-data build")
    arguments = parser.parse_args()
    cases = [(name, FIRST_SEED + n) for name in ("clean", *DEFECTS) for n in range(arguments.seeds)]
    creeps = [(name, creep_um) for name in SETTLING for creep_um in CREEP_UM]
    record = {
        "schema": "litho-data/benchmark-registration/1",
        **origin(),
        "shape_px": SHAPE,
        "snr": SNR,
        "defects": [of_defect(*case) for case in progress(cases, "prints with defects")],
        "creep": [of_creep(*case) for case in progress(creeps, "scans that creep")],
        "measured": None if arguments.store is None else of_store(arguments.store),
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def of_defect(name: str, seed: int) -> dict[str, Any]:
    """Errors of one phantom with a defect, px rms: as a build registers it, and by the straight fit alone."""
    layout, warp = print_of(seed)
    scan = scan_of(layout, warp, SCAN_SHAPE, snr=SNR, seed=seed)
    if name in DEFECTS:
        scan = DEFECTS[name](scan, np.random.default_rng(seed))
    found = register(scan, layout)
    return {
        "what": name,
        "seed": seed,
        "passed": found.quality.passed,
        "error_px": rms_error_px(found, warp),
        "straight_px": rms_error_px(register_straight(scan, layout), warp),
        "defect_share": found.quality.defect_share,
    }


def of_creep(name: str, creep_um: float) -> dict[str, Any]:
    """The same for a scan whose lines are displaced."""
    layout, warp = print_of(FIRST_SEED)
    scan, seen = creeping(layout, warp, creep_um, slow=1, constant=SETTLING[name])
    found = register(scan, layout)
    return {
        "what": name,
        "creep_um": creep_um,
        "passed": found.quality.passed,
        "model": found.quality.model,
        "error_px": rms_error_px(found, warp, seen),
        "straight_px": rms_error_px(register_straight(scan, layout), warp, seen),
        "reported": "creep along the slow axis" in found.quality.warning,
    }


def of_store(path: Path) -> dict[str, Any]:
    """Held-out block error of measured scans, px, before and after."""
    store = open_store(path)
    before = pd.read_csv(BEFORE).set_index("scan")["tre_median_px"]
    after = store.quality.set_index("scan")["tre_median_px"]
    return {
        "dataset_sha256": store.sha256,
        "scans": {name: [float(before[name]), float(after[name])] for name in before.index},
    }


def register(scan: np.ndarray, layout: np.ndarray, **options: Any) -> Registration:
    """A phantom as a build registers it."""
    return register_scan(scan, layout, scan_pitch_um=(PITCH_UM,) * 2, layout_pitch_um=PITCH_UM, **options)


def register_straight(scan: np.ndarray, layout: np.ndarray) -> Registration:
    """By an affine to all pixels: no defects, no creep, no bend."""
    home = "litho_data.register.scan"
    with (
        patch(f"{home}.refine_around_defects", lambda fine, *_: (fine, None)),
        patch(f"{home}.BENDABLE", ()),
    ):
        return register(scan, layout)


def print_of(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A layout, and where it lies in its scan."""
    layout = random_layout(SHAPE, seed, blob_px=7.0)
    warp = warp_about_centre(
        SHAPE, rotation_deg=0.6, scale=(1.015, 0.99), shift_px=(3.3, -2.2), margin_px=(28.0, 28.0)
    )
    return layout, warp


def rms_error_px(found: Registration, warp: np.ndarray, seen: Seen | None = None) -> float:
    """Over the layout, 8 px from its border; ``seen`` takes true points of the scan to where they appear."""
    truth = true_scan_to_layout(warp, "identity", SCAN_SHAPE)
    y, x = np.meshgrid(*(np.linspace(8, n - 8, 33) for n in SHAPE), indexing="ij")
    points_um = PITCH_UM * np.stack([x.ravel(), y.ravel()], axis=1)
    on_scan = apply_transform(np.linalg.inv(truth), points_um)
    at = on_scan if seen is None else seen(on_scan)
    at = at if found.bend_um is None else found.bend_um.straighten(at)
    error_um = apply_transform(found.scan_to_layout, at) - points_um
    return float(np.sqrt((error_um**2).sum(axis=1).mean()) / PITCH_UM)


def dust(scan: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Eight particles of 0.5 to 1.6 µm radius, 1 to 4 µm high."""
    y, x = np.mgrid[: scan.shape[0], : scan.shape[1]]
    for _ in range(8):
        middle, radius = rng.uniform(0.08, 0.92, 2) * scan.shape, rng.uniform(5, 16)
        cap = np.clip(1 - ((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / radius**2, 0, 1) ** 0.5
        scan = scan + rng.uniform(1, 4) * cap
    return scan


def missing_corner(scan: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Bare substrate over a share of both sides of the print."""
    scan, side = scan.copy(), 28 + round(share * SHAPE[0])
    scan[:side, :side] = BARE_UM * rng.standard_normal((side, side))
    return scan


def delaminated(scan: np.ndarray, rng: np.random.Generator, lift_um: float) -> np.ndarray:
    """A tenth of the print lifted, or gone."""
    smooth = gaussian_filter(rng.standard_normal(scan.shape), 25)
    off = smooth > np.quantile(smooth, 0.9)
    return np.where(off, scan + lift_um if lift_um else BARE_UM * rng.standard_normal(scan.shape), scan)


DEFECTS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "dust of 8 particles": dust,
    "corner missing, 10 % of both sides": lambda scan, rng: missing_corner(scan, rng, 0.1),
    "corner missing, 20 %": lambda scan, rng: missing_corner(scan, rng, 0.2),
    "corner missing, 33 %": lambda scan, rng: missing_corner(scan, rng, 0.33),
    "a tenth gone": lambda scan, rng: delaminated(scan, rng, 0.0),
    "a tenth lifted by 0.6 µm": lambda scan, rng: delaminated(scan, rng, 0.6),
}


def creeping(
    layout: np.ndarray, warp: np.ndarray, creep_um: float, slow: int, constant: float = 0.25
) -> tuple[np.ndarray, Seen]:
    """A scan whose scanner settles with a time constant, and where its true points appear (µm)."""
    place = np.arange(SCAN_SHAPE[0])
    settling_px = creep_um / PITCH_UM * np.exp(-place / (constant * SCAN_SHAPE[0]))
    amount = (1.0, 0.4)  # along x and y
    y, x = np.mgrid[: SCAN_SHAPE[0], : SCAN_SHAPE[1]].astype(float)
    along = np.interp(y if slow else x, place, settling_px)
    whole = scan_of(layout, warp, SCAN_SHAPE)
    scan = map_coordinates(whole, (y - amount[1] * along, x - amount[0] * along), order=5)

    def seen(points_um: np.ndarray) -> np.ndarray:
        true = points_um / PITCH_UM - 0.5
        at = true.copy()
        for _ in range(50):
            shift = np.interp(at[:, slow], place, settling_px)
            at = true + np.stack([amount[0] * shift, amount[1] * shift], axis=1)
        return (at + 0.5) * PITCH_UM

    noise = np.random.default_rng(0).standard_normal(scan.shape) / SNR
    return scan + scan.std() * noise, seen


def as_markdown(record: Mapping[str, Any]) -> str:
    """Two tables of phantoms, and of measured scans the changes."""
    rows: list[tuple[str, ...]] = []
    for name in ("clean", *DEFECTS):
        own = [case for case in record["defects"] if case["what"] == name]
        named = sum(case["defect_share"] > 0 for case in own)
        rows.append((name, _span(own, "straight_px"), _span(own, "error_px"), f"{named} of {len(own)}"))
    ny, nx = record["shape_px"]
    note = f"Phantoms of {ny} × {nx} px, SNR {record['snr']}, no NaN; rms error of the warp over the field."
    heads = ("print", "straight fit alone, px", "as registered, px", "defects named in")
    text = markdown_table(heads, rows, note)
    rows = []
    for creep_um in CREEP_UM:
        by_name = {case["what"]: case for case in record["creep"] if case["creep_um"] == creep_um}
        own = [by_name[name] for name in SETTLING]
        errors = [f"{case['straight_px']:.2f} → {case['error_px']:.2f}" for case in own]
        reported = sum(case["reported"] for case in by_name.values())
        rows.append((f"{creep_um:g}", *errors, f"{reported} of {len(by_name)}"))
    note = "Creep along x, 0.4 of it along y, the same phantoms; straight fit alone → as registered, px."
    text += "\n\n" + markdown_table(("creep, µm", *SETTLING, "reported"), rows, note)
    if record["measured"]:
        pairs = np.array(list(record["measured"]["scans"].values()))
        change, (before, after) = pairs[:, 1] - pairs[:, 0], np.median(pairs, axis=0)
        text += (
            f"\n\nOn the {len(pairs)} measured scans, dataset `{record['measured']['dataset_sha256'][:8]}…`, "
            f"the error on held-out blocks changes by {change.min():+.4f} to {change.max():+.4f} px; its "
            f"median is {before:.3f} px before and {after:.3f} px after."
        )
    return text


def _span(cases: list[dict[str, Any]], key: str) -> str:
    values = [case[key] for case in cases]
    return f"{min(values):.3f}–{max(values):.3f}"


if __name__ == "__main__":
    run_script(main)
