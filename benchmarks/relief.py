"""Does `litho-design correct` bring a print closer to a wanted relief, in a fab that its model does not know?

    python -m benchmarks.relief --out runs/relief [--seeds 3] [--size 256] [--model physics] [--publish]

Every seed is a fab of its own, with the effects of the design gap, which no model has. A model is trained on
24 scans of its prints, reliefs are corrected through it, and the fab prints the layouts without roughness.
The affine correction is the best of 19 gains of the wanted height and 7 zeros, by the fab's own prints. In a
second round the first print is measured, with its roughness, and what it is off from the expectation of the
model, blurred by 1 µm, is taken off the wanted height. An interrupted run resumes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.gap.plan import PRINT_KNOBS, SCAN_KNOBS
from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin, write_record
from litho_data.build.build import build_dataset
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError
from litho_data.virtual_fab import Noise, simulate
from litho_data.virtual_fab.truth import Truth
from litho_design import correct
from litho_design.printers.fab import FabSimulator
from litho_design.reliefs.settings import ReliefSettings, relief_settings
from litho_design.reliefs.targets import load_relief, print_off_um
from litho_design.tasks.design import HEIGHT_FILE, LEVELS_FILE, read_array
from litho_models import freeze, train

PAGE = Path(__file__).parents[1] / "docs" / "optics.md"
RESULT = PAGE.parent / "results" / "relief" / "relief.json"
NAME = "relief.json"
RELIEFS = ("lens", "blaze", "staircase")
GAINS, ZEROS = np.linspace(0.6, 2.4, 19), range(-3, 4)
FIRST_SEED = 31
SCANS = 24
COLUMNS = {
    "uncorrected_nm": "uncorrected",
    "affine_nm": "best affine",
    "corrected_nm": "corrected",
    "second_nm": "second round",
    "expected_nm": "corrected, as the model expects",
    "unprintable_nm": "levels of any height, as the model expects",
}


def main() -> None:
    """Make what is missing, print, write."""
    parser = options(__doc__, "write record and table into docs")
    parser.add_argument("--out", type=Path, required=True, help="folder of the fabs, models and designs")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, default=256, help="side of scans and reliefs, pixels")
    parser.add_argument("--model", default="physics", help="what is trained on the scans")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = relief_settings({"layout.size_px": arguments.size})
    plan = {
        "schema": "litho-design/benchmark-relief/1",
        "model": arguments.model,
        "size_px": arguments.size,
        "height_um": settings.height_um,
        "iterations": settings.search.iterations,
        "polish_rounds": settings.search.polish_rounds,
        "scans": SCANS,
    }
    _require_same(arguments.out / "plan.json", plan)
    rows = [
        row
        for seed in range(FIRST_SEED, FIRST_SEED + arguments.seeds)
        for row in of_seed(arguments.out / str(seed), seed, arguments.model, settings)
    ]
    record = {**plan, **origin(), "rows": rows}
    out = RESULT if arguments.publish else arguments.out / NAME
    conclude(record, as_markdown(record), out, PAGE, NAME, published=arguments.publish)


def _require_same(path: Path, plan: Mapping[str, Any]) -> None:
    """Write the plan, or refuse a folder that holds another one."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_record(path, plan)
    elif json.loads(path.read_text(encoding="utf-8")) != plan:
        raise InputError(
            f"output {path.parent}", got="a benchmark with other settings", wanted="a new folder"
        )


def of_seed(folder: Path, seed: int, model: str, settings: ReliefSettings) -> list[dict[str, Any]]:
    """One fab: its scans, its model, and one row per relief; what lies in ``folder`` is not made again."""
    size_px, store, frozen = settings.layout.size_px, folder / "prints.zarr", folder / "model"
    if not store.exists():
        knobs = [f"{name}={value}" for name, value in (PRINT_KNOBS | SCAN_KNOBS).items()]
        card = simulate(folder / "fab", count=SCANS, size_px=size_px, seed=seed, knobs=knobs)
        build_dataset(card, store)
    if not (frozen / "card.json").exists():
        train(store, model, folder / "run", settings={"seed": seed})
        freeze(folder / "run", frozen)
    truth = Truth.read(folder / "fab" / "truth")
    rough = FabSimulator(truth)
    smooth = FabSimulator(truth.model_copy(update={"noise": Noise.off()}))
    rows = []
    for relief in RELIEFS:
        kept = folder / f"{relief}.json"
        if not kept.is_file():
            wanted_um, _ = load_relief(relief, settings.layout, settings.height_um)
            first, level, expected_um = _corrected(wanted_um, frozen, folder / relief, settings)
            blur_px = settings.off_blur_um / settings.layout.pitch_um
            again = wanted_um - print_off_um(_print_um(rough, level, settings), expected_um, blur_px)
            _, second, _ = _corrected(again, frozen, folder / f"{relief}-again", settings)
            found = errors_nm(smooth, wanted_um, level, settings)
            found["second_nm"] = _error_nm(smooth, wanted_um, second, settings)
            write_record(kept, {"relief": relief, "seed": seed, **found, **first})
        rows.append(json.loads(kept.read_text(encoding="utf-8")))
    return rows


def errors_nm(
    fab: FabSimulator, wanted_um: np.ndarray, corrected: np.ndarray, settings: ReliefSettings
) -> dict[str, float]:
    """Rms error of the print, its offset free: of the correction, of affine ones, and of none."""
    layout = settings.layout
    # The zero is free: from the middle of the relief in the middle of the levels to three levels off.
    middle_um = (float(wanted_um.min()) + float(wanted_um.max())) / 2

    def affine(gain: float, zero: int) -> float:
        level = (layout.levels - 1) / 2 + zero + gain * (wanted_um - middle_um) / layout.level_height_um
        return _error_nm(fab, wanted_um, np.clip(np.rint(level), 0, layout.levels - 1), settings)

    best = min((affine(gain, zero), gain, zero) for gain in GAINS.tolist() for zero in ZEROS)
    return {
        "corrected_nm": _error_nm(fab, wanted_um, corrected, settings),
        "affine_nm": best[0],
        "affine_gain": best[1],
        "affine_zero_levels": best[2],
        "uncorrected_nm": affine(1.0, 0),
    }


def _corrected(
    wanted_um: np.ndarray, frozen: Path, out: Path, settings: ReliefSettings
) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """Errors that the model expects of the correction and of levels of any height, its levels, its print."""
    made = correct(wanted_um, frozen, out, settings=settings, announce=False)
    free = (made.baselines or {})["free levels"]
    errors = {"expected_nm": made.predicted["rms_nm"], "unprintable_nm": free["rms_nm"]}
    return errors, read_array(out, LEVELS_FILE), read_array(out, HEIGHT_FILE)


def _print_um(fab: FabSimulator, level: np.ndarray, settings: ReliefSettings) -> np.ndarray:
    nominal_um = torch.from_numpy(level.astype(np.float32) * settings.layout.level_height_um)
    printed: np.ndarray = fab(nominal_um[None, None], settings.layout.pitch_um)[0, 0].numpy()
    return printed.astype(np.float64)


def _error_nm(fab: FabSimulator, wanted_um: np.ndarray, level: np.ndarray, settings: ReliefSettings) -> float:
    return 1e3 * float((_print_um(fab, level, settings) - wanted_um).std())


def as_markdown(record: Mapping[str, Any]) -> str:
    """One line per relief, seeds side by side."""
    lines = []
    for relief in RELIEFS:
        rows = [row for row in record["rows"] if row["relief"] == relief]
        shown = [", ".join(f"{row[key]:.1f}" for row in rows) for key in COLUMNS]
        times = [
            ", ".join(f"{row['affine_nm'] / row[key]:.1f}" for row in rows)
            for key in ("corrected_nm", "second_nm")
        ]
        lines.append((relief, *shown, *times))
    seeds = sorted({row["seed"] for row in record["rows"]})
    note = (
        f"rms error of the print without roughness, its offset free, nm; reliefs {record['height_um']:g} µm "
        f"high on {record['size_px']} px. Seeds {', '.join(map(str, seeds))}, in this order; each "
        f"{record['model']} was trained on {record['scans']} scans of its fab. {record['iterations']} "
        f"iterations, {record['polish_rounds']} rounds of polish. The last two columns: how many times lower "
        "the error is."
    )
    heads = ("relief", *COLUMNS.values(), "affine over corrected", "affine over second round")
    return markdown_table(heads, lines, note)


if __name__ == "__main__":
    run_script(main)
