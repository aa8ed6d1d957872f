"""Measure how often the closed loop finds a false cause. Its data are prints that its own base model
simulates, plus noise.

    python -m benchmarks.null_calibration [--stores 40] [--workers 2] [--publish]

Each store contains 12 scans of random layouts. They are printed by a Physics model whose values differ from
those at which the loop starts. The noise is stationary and Gaussian, with a standard deviation of 16 nm. Its
spectrum, which includes lines along x, is that of a flat print in the virtual fab. Each scan also has a datum
and a tilt of its own. The right result is to find nothing, so every cause or law that is found is a false
positive. An interrupted run continues when it is run again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.record import conclude, options, origin, write_record
from litho_data.commands.progress import run_script
from litho_data.layouts import random_layout
from litho_data.sharing.workers import ONE_THREAD, Workers, run_jobs
from litho_data.store import PrintedScan
from litho_data.virtual_fab.random_curves import line_roughness
from litho_models.loop.closing import close
from litho_models.loop.fits import Study
from litho_models.models import build_model

PAGE = Path(__file__).parents[1] / "docs" / "closing_the_loop.md"
RESULT = PAGE.parent / "results" / "null-calibration" / "null_calibration.json"
NAME = "null_calibration.json"
SCANS, SIZE_PX, PITCH_UM, LEVELS, LEVEL_HEIGHT_UM = 12, 192, 0.1, 13, 0.1
ROUGHNESS_UM, DATUM_SD_UM, TILT_SD_UM = 0.016, 0.03, 0.005
# The rate of false positives that the loop claims. A number of false positives contradicts this rate if so
# many or more have a probability of at most UNLIKELY.
RATE, UNLIKELY = 0.05, 0.025
FOLDS, FIRST_SEED = 5, 7000


def main() -> None:
    """Run the loop on the stores that have no result yet, write the record, and print the result."""
    parser = options(__doc__, "write the result into docs/closing_the_loop.md", RESULT)
    parser.add_argument("--stores", type=int, default=40, help="number of stores")
    parser.add_argument("--workers", type=int, default=2, help="number of local processes")
    parser.add_argument(
        "--dask", help="address of a Dask scheduler, whose workers are used in place of local processes"
    )
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path("runs/null-calibration"),
        help="folder with a result file for each store",
    )
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one is not None:
        write_record(_file(arguments.cache, arguments.one), calibrate_one(arguments.one))
        return
    record = {
        "schema": "litho-models/null-calibration/2",
        "scans": SCANS,
        "size_px": SIZE_PX,
        "noise": f"Gaussian, {1000 * ROUGHNESS_UM:g} nm, spectrum of a flat print of the virtual fab",
        **origin(),
        "stores": _run_all(arguments.cache, arguments.stores, Workers(arguments.workers, arguments.dask)),
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def calibrate_one(seed: int) -> dict[str, Any]:
    """Run the loop on one store. Return the causes that it finds, and the rms error in nm before and after
    it.
    """
    base = build_model("physics", pitch_um=PITCH_UM, level_height_um=LEVEL_HEIGHT_UM, levels=LEVELS)
    closed = close(Study.dealt(null_scans(seed), FOLDS), {"physics": base})
    return {
        "seed": seed,
        "found": [cause.name for cause in closed.traced],
        "rmse_before_nm": round(closed.base.mse_nm2**0.5, 3),
        "rmse_after_nm": round(closed.final.mse_nm2**0.5, 3),
    }


def null_scans(seed: int) -> list[PrintedScan]:
    """Return the scans of one store: prints simulated by a Physics model, plus noise and no other effect."""
    rng = np.random.default_rng(seed)
    model = build_model(
        "physics",
        pitch_um=PITCH_UM,
        level_height_um=LEVEL_HEIGHT_UM,
        levels=LEVELS,
        sigma_diffusion_init_um=0.4,
        alpha_init=1.5,
        eta_init=0.3,
    )
    shape = (SIZE_PX, SIZE_PX)
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    scans = []
    for number in range(SCANS):
        level = random_layout(shape, levels=LEVELS, cutoff_per_um=(0.25, 0.5)[number % 2], seed=rng)
        layout_um = torch.from_numpy(level.astype(np.float32) * np.float32(LEVEL_HEIGHT_UM))
        with torch.no_grad():
            clean = model(layout_um[None, None])[0, 0].numpy()
        rough = ROUGHNESS_UM * line_roughness(shape, PITCH_UM, rng)
        scan = DATUM_SD_UM * rng.normal() + TILT_SD_UM * (rng.normal() * x + rng.normal() * y)
        scans.append(
            PrintedScan(
                id=f"S{number:02d}",
                print_id=str(number // 4),
                order=number,
                mask_level=level,
                height_um=(clean + rough + scan).astype(np.float32),
                valid=np.ones(shape, bool),
                pitch_um=PITCH_UM,
                level_height_um=LEVEL_HEIGHT_UM,
                levels=LEVELS,
                scan_to_layout=np.eye(3),
            )
        )
    return scans


def as_markdown(record: Mapping[str, Any]) -> str:
    """Return the result as text, which names every false positive."""
    stores: Sequence[Mapping[str, Any]] = record["stores"]
    false = [store for store in stores if store["found"]]
    named = "; ".join(f"seed {s['seed']}: {', '.join(s['found'])}" for s in false)
    return (
        f"The loop was run on {len(stores)} stores, each with {record['scans']} scans of {record['size_px']} "
        f"px. The noise is: {record['noise']}. **{len(false)}** of the stores gave a false positive; up to "
        f"{most_at_the_rate(len(stores))} would be consistent with a rate of {100 * RATE:g} %."
        f"{' False positives: ' + named + '.' if named else ''}"
    )


def most_at_the_rate(stores: int) -> int:
    """Return the largest number of false positives in ``stores`` stores that is consistent with a rate of 5
    %.
    """
    from scipy.stats import binom

    return max(count for count in range(stores + 1) if binom.sf(count - 1, stores, RATE) > UNLIKELY)


def _run_all(cache: Path, count: int, workers: Workers) -> list[dict[str, Any]]:
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    missing = [seed for seed in seeds if not _file(cache, seed).exists()]
    jobs = [(cache, seed) for seed in missing]
    for place, ((_, seed), _) in enumerate(run_jobs(_run_apart, jobs, workers, apart=True), 1):
        print(f"[{place}/{len(missing)}] seed {seed}", flush=True)
    return [json.loads(_file(cache, seed).read_text(encoding="utf-8")) for seed in seeds]


def _run_apart(job: tuple[Path, int]) -> None:
    cache, seed = job
    command = [sys.executable, "-m", "benchmarks.null_calibration", "--cache", str(cache), "--one", str(seed)]
    subprocess.run(command, env=os.environ | ONE_THREAD, check=True)


def _file(cache: Path, seed: int) -> Path:
    return cache / f"{seed}.json"


if __name__ == "__main__":
    run_script(main)
