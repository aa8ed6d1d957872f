"""Does `litho-design correct` bring a print closer to a wanted relief, in a fab that its model does not know?

    python -m benchmarks.relief --out runs/relief [--seeds 3] [--size 256] [--model physics] [--publish]

Every seed is a fab of its own, with the effects of the design gap, which no model has. A model is trained on
24 scans of its prints, reliefs are corrected through it, and the fab prints the layouts without roughness.
The affine correction is the best of 21 gains of the wanted height, by the fab's own prints. An interrupted
run resumes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.gap.plan import PRINT_KNOBS, SCAN_KNOBS
from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, origin, write_record
from litho_data.build.build import build_dataset
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError
from litho_data.virtual_fab import simulate
from litho_data.virtual_fab.truth import Truth
from litho_design import correct
from litho_design.printers.fab import FabSimulator
from litho_design.reliefs.settings import ReliefSettings, relief_settings
from litho_design.reliefs.targets import load_relief
from litho_models import freeze, train

PAGE = Path(__file__).parents[1] / "docs" / "optics.md"
RESULT = PAGE.parent / "results" / "relief" / "relief.json"
NAME = "relief.json"
RELIEFS = ("lens", "blaze", "staircase")
GAINS = np.linspace(0.5, 1.5, 21)
FIRST_SEED = 31
SCANS = 24


def main() -> None:
    """Make what is missing, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the fabs, models and designs")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, default=256, help="side of scans and reliefs, pixels")
    parser.add_argument("--iterations", type=int, default=150, help="of a correction")
    parser.add_argument("--model", default="physics", help="what is trained on the scans")
    parser.add_argument("--publish", action="store_true", help="write record and table into docs")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = relief_settings({"layout.size_px": arguments.size, "search.iterations": arguments.iterations})
    plan = {
        "schema": "litho-design/benchmark-relief/1",
        "model": arguments.model,
        "size_px": arguments.size,
        "height_um": settings.height_um,
        "iterations": arguments.iterations,
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
    fab = smooth_fab(folder / "fab" / "truth")
    rows = []
    for relief in RELIEFS:
        kept = folder / f"{relief}.json"
        if not kept.is_file():
            correct(relief, frozen, folder / relief, settings=settings, announce=False)
            corrected = np.load(folder / relief / "layout_level.npy")
            wanted_um, _ = load_relief(relief, settings.layout, settings.height_um)
            write_record(
                kept, {"relief": relief, "seed": seed} | errors_nm(fab, wanted_um, corrected, settings)
            )
        rows.append(json.loads(kept.read_text(encoding="utf-8")))
    return rows


def smooth_fab(truth: Path) -> FabSimulator:
    """The fab of a truth file, without the roughness of its prints."""
    known = Truth.read(truth)
    return FabSimulator(known.model_copy(update={"noise": dict.fromkeys(known.noise, 0.0)}))


def errors_nm(
    fab: FabSimulator, wanted_um: np.ndarray, corrected: np.ndarray, settings: ReliefSettings
) -> dict[str, float]:
    """Rms error of the print, its offset free: of the correction, of affine ones, and of none."""
    layout = settings.layout

    def error(level: np.ndarray) -> float:
        nominal_um = torch.from_numpy(level.astype(np.float32) * layout.level_height_um)
        print_um = fab(nominal_um[None, None], layout.pitch_um)[0, 0].numpy().astype(np.float64)
        return 1e3 * float((print_um - wanted_um).std())

    # The zero is free: the middle of the relief lies in the middle of the levels.
    middle_um = (float(wanted_um.min()) + float(wanted_um.max())) / 2

    def of_gain(gain: float) -> float:
        level = (layout.levels - 1) / 2 + gain * (wanted_um - middle_um) / layout.level_height_um
        return error(np.clip(np.rint(level), 0, layout.levels - 1))

    affine = [of_gain(float(gain)) for gain in GAINS]
    best = int(np.argmin(affine))
    return {
        "corrected_nm": error(corrected),
        "affine_nm": affine[best],
        "affine_gain": float(GAINS[best]),
        "uncorrected_nm": of_gain(1.0),
    }


def as_markdown(record: Mapping[str, Any]) -> str:
    """One line per relief, seeds side by side."""
    lines = []
    for relief in RELIEFS:
        rows = [row for row in record["rows"] if row["relief"] == relief]
        shown = [", ".join(f"{row[key]:.1f}" for row in rows) for key in
                 ("corrected_nm", "affine_nm", "uncorrected_nm")]  # fmt: skip
        times = ", ".join(f"{row['affine_nm'] / row['corrected_nm']:.1f}" for row in rows)
        lines.append((relief, *shown, times))
    seeds = sorted({row["seed"] for row in record["rows"]})
    note = (
        f"rms error of the print without roughness, its offset free, nm; reliefs {record['height_um']:g} µm "
        f"high on {record['size_px']} px, seeds {', '.join(map(str, seeds))}, {record['model']} trained on "
        f"{record['scans']} scans of each fab, {record['iterations']} iterations."
    )
    heads = ("relief", "corrected", "best affine", "uncorrected", "affine over corrected")
    return markdown_table(heads, lines, note)


if __name__ == "__main__":
    run_script(main)
