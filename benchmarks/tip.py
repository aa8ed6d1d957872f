"""How well `litho-data tip` finds known tips, and which pixels they did not touch.

    python -m benchmarks.tip [--seeds 20] [--out FILE.json] [--publish]

Surfaces of pillars with steep walls, of spikes and of rounded bumps on a grid four times as fine as the scan
are dilated by a paraboloid, sampled and given white noise. SNR is the height of the surface over the noise of
a pixel. --publish also writes the tables into docs/tip.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin
from litho_data.foundation.commands import progress, run_script
from litho_data.tip import tip_certain
from litho_data.tip.radius import peak_radius

PAGE = Path(__file__).parents[1] / "docs" / "tip.md"
RESULT = PAGE.parent / "results" / "tip" / "tip.json"
NAME = "tip.json"
PITCH_UM = (0.1, 0.1)
SIZE_PX = 160
OVER = 4
KINDS = ("pillars", "spikes", "bumps")
# Radius and height, µm: √(2Rh) is 3.5, 5.5, 6.3, 10 and 14 pixels.
TIPS = ((0.06, 1.0), (0.15, 1.0), (0.4, 0.5), (0.5, 1.0), (1.0, 1.0))
SNRS = (200, 50, 20)
SMALLEST_REACH_PX = 5.0
FIRST_SEED = 20431
_INNER = (slice(15, -15),) * 2


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the tables into docs/tip.md", RESULT)
    parser.add_argument("--seeds", type=int, default=20, help="surfaces of each kind and tip")
    arguments = parser.parse_args()
    cases = [(kind, *tip) for kind in KINDS for tip in TIPS]
    record = {
        "schema": "litho-data/benchmark-tip/1",
        **origin(),
        "seeds": arguments.seeds,
        "pitch_um": PITCH_UM[0],
        "size_px": SIZE_PX,
        "cases": [row for case in progress(cases, "tips") for row in measure(*case, arguments.seeds)],
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def measure(kind: str, radius_um: float, height_um: float, seeds: int) -> list[dict[str, Any]]:
    """One row per SNR: ratios of the found radius to the true one, and shares of pixels, over all seeds."""
    rows: list[dict[str, Any]] = [
        {"kind": kind, "radius_um": radius_um, "height_um": height_um, "snr": snr, "estimates": [],
         "bounds": [], "untouched_uncertain": [], "touched_certain": []}
        for snr in SNRS
    ]  # fmt: skip
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        image, touched = print_under_tip(kind, radius_um, height_um, seed=seed)
        untouched = (touched < 0.5)[_INNER]
        for row in rows:
            noisy = image + noise_of_snr(image.shape, height_um, row["snr"], seed)
            found = peak_radius(noisy, PITCH_UM)
            if found.radius_um is not None:
                ratio = round(found.radius_um / radius_um, 4)
                row["bounds" if found.reason else "estimates"].append(ratio)
            certain = tip_certain(noisy, PITCH_UM, radius_um)[_INNER]
            row["touched_certain"].append(round(float(certain[~untouched].mean()), 4))
            # Of a few pixels no share can be told.
            if untouched.sum() >= 100:
                row["untouched_uncertain"].append(round(float((~certain[untouched]).mean()), 4))
    return rows


def print_under_tip(
    kind: str, radius_um: float, height_um: float, seed: int = 11, size_px: int = SIZE_PX
) -> tuple[np.ndarray, np.ndarray]:
    """The image (size, size), µm, under a paraboloid, and per pixel the share that the tip touched."""
    fine_um = PITCH_UM[0] / OVER
    reach = int(np.ceil(np.sqrt(2 * radius_um * height_um) / fine_um)) + 1
    parabola = -((np.arange(-reach, reach + 1) * fine_um) ** 2) / (2 * radius_um)

    def dilated(heights: np.ndarray) -> np.ndarray:
        for line in (parabola[:, None], parabola[None]):
            heights = scipy.ndimage.grey_dilation(heights, size=line.shape, structure=line, mode="nearest")
        return heights

    surface = fine_surface(kind, height_um, seed, size_px)
    image = dilated(surface)
    # A contact between two points of the fine grid leaves the surface by up to fine²/2R there.
    touched = -dilated(-image) - surface < 2 * fine_um**2 / radius_um
    share = touched.reshape(size_px, OVER, size_px, OVER).mean(axis=(1, 3))
    return image[OVER // 2 :: OVER, OVER // 2 :: OVER], share


def fine_surface(kind: str, height_um: float, seed: int, size_px: int = SIZE_PX) -> np.ndarray:
    """Pillars of one height, spikes or bumps of several, µm, OVER times as fine as the scan."""
    rng, size = np.random.default_rng(seed), size_px * OVER
    surface = np.zeros((size, size))
    for _ in range(size_px**2 // 2000):
        y, x = rng.uniform(0, size, 2)
        b, a = rng.uniform(2, 14, 2) * OVER
        if kind == "pillars":
            surface[max(int(y - b / 2), 0) : int(y + b / 2), max(int(x - a / 2), 0) : int(x + a / 2)] = (
                height_um
            )
            continue
        width = b / (12 if kind == "spikes" else 3)
        rows, columns = (np.exp(-((np.arange(size) - at) ** 2) / (2 * width**2)) for at in (y, x))
        np.maximum(surface, rng.uniform(0.4, 1) * height_um * np.outer(rows, columns), out=surface)
    return surface


def noise_of_snr(shape: tuple[int, ...], height_um: float, snr: float, seed: int) -> np.ndarray:
    """White noise, µm."""
    return np.random.default_rng(seed + 1).standard_normal(shape) * height_um / snr


def as_markdown(record: Mapping[str, Any]) -> str:
    """What was found of each tip, all surfaces and seeds together."""
    rows = []
    for radius_um, height_um in TIPS:
        for snr in SNRS:
            cases = [
                case
                for case in record["cases"]
                if (case["radius_um"], case["height_um"], case["snr"]) == (radius_um, height_um, snr)
            ]
            estimates, bounds, uncertain, certain = (
                [value for case in cases for value in case[key]]
                for key in ("estimates", "bounds", "untouched_uncertain", "touched_certain")
            )
            good = sum(abs(ratio - 1) <= 0.1 for ratio in estimates)
            reach_px = np.sqrt(2 * radius_um * height_um) / PITCH_UM[0]
            rows.append(
                (
                    f"{radius_um:g} µm, {reach_px:.1f} px",
                    f"{snr}",
                    f"{good} of {len(estimates)}" if estimates else "none",
                    _range(estimates),
                    f"{sum(ratio >= 1 for ratio in bounds)} of {len(bounds)}" if bounds else "none",
                    _range(bounds),
                    _lowest(uncertain, 0.95),
                    _lowest(certain, 0.8),
                )
            )
    note = (
        f"{record['seeds']} surfaces of each kind ({', '.join(KINDS)}), {SIZE_PX} × {SIZE_PX} pixels of "
        f"{PITCH_UM[0]} µm. Ratios are found over true radius. Pixels: mean and lowest of all scans, and how "
        "many scans miss 95 % and 80 %; under the true radius, in scans with 100 untouched pixels or more."
    )
    heads = (
        "radius, √(2Rh)", "SNR", "estimates within 10 %", "ratio", "bounds not below", "ratio",
        "untouched are uncertain", "touched are certain",
    )  # fmt: skip
    return markdown_table(heads, rows, note)


def _range(ratios: list[float]) -> str:
    return f"{min(ratios):.2f} … {max(ratios):.2f}" if ratios else ""


def _lowest(shares: list[float], wanted: float) -> str:
    if not shares:
        return ""
    missed = sum(share < wanted for share in shares)
    return f"{np.mean(shares):.1%}, {min(shares):.1%}, {missed} of {len(shares)}"


if __name__ == "__main__":
    run_script(main)
