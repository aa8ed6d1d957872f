"""How often `litho-models check` alarms on an unchanged printer, and how often it notices a step.

    python -m benchmarks.drift_alarm --store runs/neural-lithography/store.zarr
        --residuals runs/neural-lithography/leave-one-print-out [--publish]

Virtual prints: the height gain of every print is drawn with a spread of 1 or 5 %; a Physics model is fitted
to prints of the same fab. Each reference of 48 prints is compared with ten sets of three new prints, as
before, and with ten whose gain is three spreads higher or lower; its first 12 and 24 prints are smaller
references.
Fields lie on their layouts (microscope `aligned`), so that nothing is registered. Beside it the same rule on
Gaussian figures, many times; and the measured prints, each in turn as the new one. An interrupted run
resumes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from benchmarks.markdown_table import markdown_table
from benchmarks.record import NOT_MEASURED, options, origin, publish, write_record
from litho_data.foundation.commands import run_script
from litho_data.store import PrintedScan, open_store
from litho_data.virtual_fab.canvas import Canvas
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.printer import Cause, Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer
from litho_models.fitting import TrainingConfig, fit_with_record
from litho_models.frozen.files import load_frozen, save_frozen
from litho_models.frozen.on_store import predict_frozen
from litho_models.frozen.simulator import FrozenSimulator
from litho_models.monitoring.change_point import Series, comparisons, step_statistics
from litho_models.monitoring.judging import DEFAULT_RATE, alarms, judge
from litho_models.monitoring.prints import FIGURES
from litho_models.noise.residuals import read_residuals
from litho_models.scoring.scan_figures import ScanFigures, scan_figures

PAGE = Path(__file__).parents[1] / "docs" / "checking.md"
RESULT = PAGE.parent / "results" / "drift-alarm" / "drift_alarm.json"
SPREADS, REFERENCES, SHIFT_SPREADS, NEW_PRINTS = (0.01, 0.05), (12, 24, 48), 3.0, 3
STORES, SETS = 10, 10
SIZE_PX, SCANS_PER_PRINT, CALIBRATION_PRINTS = 192, 2, 6
DRAWS, RULE_REFERENCES = 100_000, (6, 12, 24, 48, 96)
FIRST_SEED = 30_000


class PrintGain(Cause):
    """Every print has its own height gain."""

    def __init__(self, gain: np.ndarray):
        self.gain = gain

    def on_surface(self, surface_um: np.ndarray, canvas: Canvas, job: Job) -> np.ndarray:
        """The surface, taller or flatter as a whole."""
        return surface_um * self.gain[job.index // SCANS_PER_PRINT]


def printed_scans(gain: np.ndarray, seed: int) -> list[PrintedScan]:
    """``SCANS_PER_PRINT`` fields of each print, one print per gain; the rest follows from the seed."""
    printer, noise = Printer(), Noise()
    fab = Fab(printer, Microscope.aligned(), noise, KnobBoard([], seed), seed, PrintGain(gain))
    plan = Plan(len(gain) * SCANS_PER_PRINT, (SIZE_PX, SIZE_PX), SCANS_PER_PRINT)
    scans = []
    for job in random_jobs(plan, printer, seed):
        made = scan_job(fab, job)
        margin = (made.height_um.shape[0] - SIZE_PX) // 2
        inside = slice(margin, margin + SIZE_PX)
        scans.append(
            PrintedScan(
                id=job.id,
                print_id=f"{job.index // SCANS_PER_PRINT:02d}",
                order=job.index,
                mask_level=job.level,
                height_um=made.height_um[inside, inside].astype(np.float32),
                valid=np.ones(job.level.shape, bool),
                pitch_um=printer.pitch_um,
                level_height_um=printer.level_height_um,
                levels=printer.levels,
                scan_to_layout=np.eye(3),
            )
        )
    return scans


def calibrated_model(cache: Path) -> FrozenSimulator:
    """Physics, fitted to prints of gain 1; made once."""
    if not (cache / "model").exists():
        scans = printed_scans(np.ones(CALIBRATION_PRINTS), FIRST_SEED - 1)
        fitted = fit_with_record("physics", scans, TrainingConfig.of_recipe("fast", "physics")).model
        save_frozen(fitted, cache / "model")
    return load_frozen(cache / "model")


def figures(model: FrozenSimulator, gain: np.ndarray, seed: int) -> list[ScanFigures]:
    """Print, scan, predict and measure."""
    rows = [scan_figures(scan, predict_frozen(model, scan)) for scan in printed_scans(gain, seed)]
    return [row for row in rows if row is not None]


def virtual_sets(spread: float, store: int, model: FrozenSimulator) -> list[dict[str, Any]]:
    """Every new set of one reference: which figures alarmed, by the number of reference prints."""
    seed = FIRST_SEED + 10_000 * SPREADS.index(spread) + 100 * store
    random = np.random.default_rng(seed)
    reference = figures(model, 1 + spread * random.normal(size=max(REFERENCES)), seed)
    board = []
    for number in range(2 * SETS):
        shift = 0.0 if number < SETS else spread * SHIFT_SPREADS * random.choice([-1, 1])
        gain = 1 + spread * random.normal(size=NEW_PRINTS) + shift
        new = figures(model, gain, seed + 1 + number)
        noticed = {}
        for prints in REFERENCES:
            part = [row for row in reference if int(row.print) < prints]
            found = alarms(part, new)
            noticed[str(prints)] = [name for name, step in found.items() if step is not None]
        board.append({"seed": seed + 1 + number, "shift": float(shift), "alarms": noticed})
    return board


def rule_on_gaussian_figures(prints: int) -> dict[str, Any]:
    """Share of alarms of one figure without and with the step, and of either of two figures without."""
    random = np.random.default_rng([FIRST_SEED, prints])
    draws = random.normal(size=(DRAWS, prints)), random.normal(size=(DRAWS, NEW_PRINTS))
    limit = student.isf(
        DEFAULT_RATE / len(FIGURES) / comparisons(NEW_PRINTS) / 2, prints + np.arange(NEW_PRINTS) - 1
    )
    shares = []
    for step in (0.0, SHIFT_SPREADS):
        series = Series(draws[0], draws[1] + step, np.ones(prints), np.ones(NEW_PRINTS))
        largest = np.nanmax(np.abs(step_statistics(series)[1]), axis=1)
        shares.append(float((largest >= limit[:, None]).any(axis=0).mean()))
    return {
        "reference_prints": prints,
        "false_alarms": 1 - (1 - shares[0]) ** len(FIGURES),
        "noticed": shares[1],
    }


def measured_prints(store: Path, residuals: Path, model: str) -> dict[str, Any]:
    """Each measured print in turn against the others, all predicted by fits that had not seen them."""
    found = read_residuals(open_store(store), [residuals], model)
    rows = [scan_figures(*pair) for pair in zip(found.scans, found.maps_um, strict=True)]
    known = [row for row in rows if row is not None]
    checks = {}
    for name in dict.fromkeys(row.print for row in known):
        parts = [[row for row in known if (row.print == name) == new] for new in (False, True)]
        checks[name] = [one.model_dump(mode="json") for one in judge(*parts, between=True)]
    return {"model": found.model, "scans": [row.model_dump(mode="json") for row in known], "checks": checks}


def texts(record: Mapping[str, Any]) -> dict[str, str]:
    """The text of each mark of the page."""
    return {
        "virtual prints": _virtual_text(record),
        "rule": _rule_text(record["rule"]),
        "measured prints": _measured_text(record["measured"]),
    }


def _virtual_text(record: Mapping[str, Any]) -> str:
    rows = []
    if not all(record["virtual"].values()):
        return NOT_MEASURED
    references = len(next(iter(record["virtual"].values()))) // (2 * SETS)
    for spread, board in record["virtual"].items():
        for prints in map(str, REFERENCES):
            same = [one["alarms"][prints] for one in board if not one["shift"]]
            moved = [one["alarms"][prints] for one in board if one["shift"]]
            rows.append(
                (
                    f"{100 * float(spread):g} %",
                    prints,
                    f"{sum(map(bool, same))} of {len(same)}",
                    f"{sum('gain' in names for names in moved)} of {len(moved)}",
                )
            )
    return markdown_table(
        ("spread of the gain", "reference prints", "alarms, unchanged", "noticed, gain moved by 3 spreads"),
        rows,
        f"Virtual prints, {SCANS_PER_PRINT} fields of {SIZE_PX} px each; sets of {NEW_PRINTS} new prints, "
        f"{SETS} unchanged and {SETS} moved beside each of {references} references. Rate: {DEFAULT_RATE:g}. "
        "The smaller references are the first prints of the larger ones.",
    )


def _rule_text(rule: Sequence[Mapping[str, Any]]) -> str:
    rows = [
        (one["reference_prints"], f"{100 * one['false_alarms']:.2f} %", f"{100 * one['noticed']:.1f} %")
        for one in rule
    ]
    return markdown_table(
        ("reference prints", "false alarms, two figures", "3 spreads noticed within 3 prints"),
        rows,
        f"Gaussian figures, {DRAWS:,} sets of {NEW_PRINTS} new prints each, rate {DEFAULT_RATE:g}.",
    )


def _measured_text(measured: Mapping[str, Any]) -> str:
    rows = []
    for name, checks in measured["checks"].items():
        for one in checks:
            alarm = one["alarm"]
            step = "–" if alarm is None else f"{100 * alarm['step']:+.1f} %"
            noticeable = one["noticeable_step"]
            rows.append(
                (
                    name,
                    one["name"],
                    f"{100 * one['spread']:.1f} %",
                    f"{one['smallest_p']:.2g}",
                    f"{one['threshold_p']:.2g}",
                    step,
                    "–" if noticeable is None else f"{100 * noticeable:.0f} %",
                )
            )
    prints = len(measured["checks"])
    return markdown_table(
        ("new print", "figure", "spread of the others", "p", "alarm at", "step", "would be noticed"),
        rows,
        f"{len(measured['scans'])} development scans of {prints} measured prints, each print against the "
        f"other {prints - 1}; all predicted by fits of `{measured['model']}` without their print.",
    )


def _part(spread: float, store: int) -> str:
    return f"virtual-{spread:g}-{store:02d}"


def _sets_of_cache(cache: Path, spread: float, store: int) -> list[dict[str, Any]]:
    return virtual_sets(spread, store, calibrated_model(cache))


def main() -> None:
    """Run, print, write."""
    parser = options(__doc__, "write the figures into the page")
    parser.add_argument("--store", type=Path, required=True, help="measured prints")
    parser.add_argument("--residuals", type=Path, required=True, help="their leave-one-print-out benchmark")
    parser.add_argument("--model", default="physics", help="which model of it")
    parser.add_argument("--cache", type=Path, default=Path("runs/drift-alarm"), help="a file per part")
    parser.add_argument(
        "--parts", type=int, help="make so many missing parts and stop; what is complete is written"
    )
    parser.add_argument("--out", type=Path, default=RESULT, help="JSON file to write")
    given = parser.parse_args()
    parts: dict[str, Callable[[], Any]] = {
        "rule": lambda: [rule_on_gaussian_figures(prints) for prints in RULE_REFERENCES],
        "measured": lambda: measured_prints(given.store, given.residuals, given.model),
    }
    for store in range(STORES):
        for spread in SPREADS:
            parts[_part(spread, store)] = partial(_sets_of_cache, given.cache, spread, store)
    missing = [name for name in parts if not (given.cache / f"{name}.json").exists()]
    for name in missing[: given.parts]:
        write_record(given.cache / f"{name}.json", {"part": parts[name]()})
        print(name, flush=True)
    made = {
        name: json.loads(file.read_text(encoding="utf-8"))["part"]
        for name in parts
        if (file := given.cache / f"{name}.json").exists()
    }
    if not {"rule", "measured"} <= made.keys():
        return
    done = [store for store in range(STORES) if all(_part(spread, store) in made for spread in SPREADS)]
    record: dict[str, Any] = {
        "schema": "litho-models/drift-alarm/1",
        "rate": DEFAULT_RATE,
        **origin(),
        "rule": made["rule"],
        "virtual": {
            str(spread): [one for store in done for one in made[_part(spread, store)]] for spread in SPREADS
        },
        "measured": made["measured"],
    }
    write_record(given.out, record)
    for mark, text in texts(record).items():
        print(text)
        if given.publish:
            publish(PAGE, mark, text)


if __name__ == "__main__":
    run_script(main)
