"""How often `litho-models check` alarms on an unchanged printer, and how often it notices a step.

    python -m benchmarks.drift_alarm [--store runs/neural-lithography/store.zarr
        --residuals runs/neural-lithography/leave-one-print-out] [--publish]

Virtual prints: the height gain of every print is drawn with a spread of 1 or 5 %; a Physics model is fitted
to prints of the same fab. 1,000 times, 48 reference prints and three new ones are drawn from 600 prints, and
three more from 200 whose gain is three spreads higher or lower; the first 12 and 24 of the reference are
smaller ones. Fields lie on their layouts (microscope `aligned`), so that nothing is registered. Beside it the
law of the rule for Gaussian figures, in closed form; and the measured prints, each in turn as the new one.
Without ``--store`` the figures of their scans are those of the published record, and only the rule is applied
to them anew. An interrupted run resumes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import nct
from scipy.stats import t as student

from benchmarks.markdown_table import markdown_table
from benchmarks.record import options, origin, publish, write_record
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
from litho_models.monitoring.change_point import chance_to_notice, noticeable_step
from litho_models.monitoring.judging import DEFAULT_RATE, alarms, judge, rates
from litho_models.noise.residuals import read_residuals
from litho_models.scoring.scan_figures import ScanFigures, scan_figures

PAGE = Path(__file__).parents[1] / "docs" / "checking.md"
RESULT = PAGE.parent / "results" / "drift-alarm" / "drift_alarm.json"
SPREADS, REFERENCES, SHIFT_SPREADS, NEW_PRINTS = (0.01, 0.05), (12, 24, 48), 3.0, 3
SETS, PARTS = 1000, 10
# Prints of each part: unchanged, taller and flatter.
COUNTS = {"unchanged": 60, "taller": 10, "flatter": 10}
SIZE_PX, SCANS_PER_PRINT, CALIBRATION_PRINTS = 192, 2, 6
RULE_REFERENCES = (6, 12, 24, 30, 48, 96)
FIRST_SEED = 41_000


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


def virtual_prints(spread: float, part: int, model: FrozenSimulator) -> dict[str, list[dict[str, Any]]]:
    """Scans of some prints as before, some taller and some flatter by ``SHIFT_SPREADS``."""
    seed = FIRST_SEED + 100 * SPREADS.index(spread) + part
    kinds = np.repeat(list(COUNTS), list(COUNTS.values()))
    shift = SHIFT_SPREADS * (1.0 * (kinds == "taller") - 1.0 * (kinds == "flatter"))
    gain = 1 + spread * (np.random.default_rng(seed).normal(size=len(kinds)) + shift)
    made: dict[str, list[dict[str, Any]]] = {kind: [] for kind in COUNTS}
    for row in figures(model, gain, seed):
        made[kinds[int(row.print)]].append(row.model_dump(mode="json") | {"print": f"{part}-{row.print}"})
    return made


def board(spread: float, parts: Sequence[Mapping[str, Sequence[Mapping[str, Any]]]]) -> dict[str, Any]:
    """How often sets drawn from these prints alarm, by the number of reference prints."""
    random = np.random.default_rng([FIRST_SEED, SPREADS.index(spread)])
    prints: dict[str, list[list[ScanFigures]]] = {}
    for kind in COUNTS:
        scans = [ScanFigures.model_validate(row) for part in parts for row in part[kind]]
        names = dict.fromkeys(row.print for row in scans)
        prints[kind] = [[row for row in scans if row.print == name] for name in names]
    counts = {n: {"false_alarms": 0, "noticed": 0} for n in REFERENCES}

    def drawn(kind: str, count: int) -> list[list[ScanFigures]]:
        return [prints[kind][i] for i in random.choice(len(prints[kind]), count, replace=False)]

    for _ in range(SETS):
        same = drawn("unchanged", max(REFERENCES) + NEW_PRINTS)
        reference, new = same[NEW_PRINTS:], same[:NEW_PRINTS]
        moved = drawn(("taller", "flatter")[random.integers(2)], NEW_PRINTS)
        for n, count in counts.items():
            count["false_alarms"] += bool(alarms(_flat(reference[:n]), _flat(new)))
            count["noticed"] += "gain" in alarms(_flat(reference[:n]), _flat(moved))
    gains = np.log([[row.gain for row in scans] for scans in prints["unchanged"]])
    return {
        "prints": {kind: len(own) for kind, own in prints.items()},
        "gain_sd": float(gains.mean(axis=1).std(ddof=1)),
        "scan_sd": float(np.sqrt(gains.var(axis=1, ddof=1).mean())),
        "sets": SETS,
        "references": {str(n): count for n, count in counts.items()},
    }


def _flat(prints: Sequence[Sequence[ScanFigures]]) -> list[ScanFigures]:
    return [row for scans in prints for row in scans]


def rule_on_gaussian_figures(prints: int) -> dict[str, float]:
    """By closed form: chance to notice the step, the most that any test has, and the step of 9 in 10."""
    variances, rate = (np.ones(prints), np.ones(NEW_PRINTS)), rates(DEFAULT_RATE)[0]
    return {
        "reference_prints": prints,
        "noticed": chance_to_notice(SHIFT_SPREADS, *variances, rate),
        "best": best_chance(prints, DEFAULT_RATE),
        "step": noticeable_step(*variances, rate),
    }


def best_chance(prints: int, rate: float) -> float:
    """Chance of the t test of the new prints together, with the whole rate, to notice the step.

    No test does better that knows neither mean nor spread and treats rise and fall alike (the uniformly most
    powerful unbiased one; Lehmann and Romano, Testing Statistical Hypotheses, section 5.3).
    """
    freedom = prints + NEW_PRINTS - 2
    errors = SHIFT_SPREADS / np.sqrt(1 / NEW_PRINTS + 1 / prints)
    return float(nct.sf(student.isf(rate / 2, freedom), freedom, errors))


def measured_figures(store: Path | None, residuals: Path | None, model: str) -> dict[str, Any]:
    """Figures of the measured scans, all predicted by fits that had not seen their print."""
    if store is None or residuals is None:
        known = json.loads(RESULT.read_text(encoding="utf-8"))["measured"]
        return {"model": known["model"], "scans": known["scans"]}
    found = read_residuals(open_store(store), [residuals], model)
    rows = [scan_figures(*pair) for pair in zip(found.scans, found.maps_um, strict=True)]
    return {"model": found.model, "scans": [row.model_dump(mode="json") for row in rows if row is not None]}


def measured_prints(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Each measured print in turn against the others."""
    known = [ScanFigures.model_validate(row) for row in figures["scans"]]
    checks = {}
    for name in dict.fromkeys(row.print for row in known):
        parts = [[row for row in known if (row.print == name) == new] for new in (False, True)]
        checks[name] = [one.model_dump(mode="json") for one in judge(*parts, between=True)]
    return {**figures, "checks": checks}


def texts(record: Mapping[str, Any]) -> dict[str, str]:
    """The text of each mark of the page."""
    return {
        "virtual prints": _virtual_text(record["virtual"]),
        "rule": _rule_text(record["rule"]),
        "measured prints": _measured_text(record["measured"]),
    }


def _virtual_text(virtual: Mapping[str, Mapping[str, Any]]) -> str:
    rows = [
        (
            f"{100 * float(spread):g} %",
            f"{100 * own['gain_sd']:.2f} %",
            prints,
            f"{count['false_alarms']} of {own['sets']:,}",
            f"{count['noticed']} of {own['sets']:,}",
        )
        for spread, own in virtual.items()
        for prints, count in own["references"].items()
    ]
    made = next(iter(virtual.values()))["prints"]
    return markdown_table(
        (
            "planted spread of the gain",
            "as measured",
            "reference prints",
            "false alarms, unchanged",
            "noticed, gain moved by 3 planted spreads",
        ),
        rows,
        f"Sets of {NEW_PRINTS} new prints, drawn from {made['unchanged']} unchanged virtual prints and "
        f"{made['taller']} + {made['flatter']} taller and flatter ones of each spread; {SCANS_PER_PRINT} "
        f"fields of {SIZE_PX} px per print. Rate: {DEFAULT_RATE:g}.",
    )


def _rule_text(rule: Sequence[Mapping[str, Any]]) -> str:
    rows = [
        (
            one["reference_prints"],
            f"{100 * one['noticed']:.1f} %",
            f"{100 * one['best']:.1f} %",
            f"{one['step']:.1f}",
        )
        for one in rule
    ]
    return markdown_table(
        (
            "reference prints",
            "3 spreads noticed within 3 prints",
            "the most that any test has",
            "noticed in 9 of 10 cases, spreads",
        ),
        rows,
        f"Gaussian figures, {NEW_PRINTS} new prints, rate {DEFAULT_RATE:g}; from the noncentral t.",
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
                    f"{one['p']:.2g}",
                    f"{one['alarm_at']:.2g}",
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


def _part(spread: float, number: int) -> str:
    return f"virtual-{spread:g}-{number:02d}"


def _prints_of_cache(cache: Path, spread: float, number: int) -> dict[str, Any]:
    return virtual_prints(spread, number, calibrated_model(cache))


def main() -> None:
    """Run, print, write."""
    parser = options(__doc__, "write the figures into the page")
    parser.add_argument("--store", type=Path, help="measured prints")
    parser.add_argument("--residuals", type=Path, help="their leave-one-print-out benchmark")
    parser.add_argument("--model", default="physics", help="which model of it")
    parser.add_argument("--cache", type=Path, default=Path("runs/drift-alarm"), help="a file per part")
    parser.add_argument("--out", type=Path, default=RESULT, help="JSON file to write")
    given = parser.parse_args()
    parts: dict[str, Callable[[], Any]] = {
        "rule": lambda: [rule_on_gaussian_figures(prints) for prints in RULE_REFERENCES],
        "measured": lambda: measured_prints(measured_figures(given.store, given.residuals, given.model)),
    }
    for spread in SPREADS:
        for number in range(PARTS):
            parts[_part(spread, number)] = partial(_prints_of_cache, given.cache, spread, number)
    made = {}
    for name, make in parts.items():
        file = given.cache / f"{name}.json"
        if not file.exists():
            write_record(file, {"part": make()})
            print(name, flush=True)
        made[name] = json.loads(file.read_text(encoding="utf-8"))["part"]
    record: dict[str, Any] = {
        "schema": "litho-models/drift-alarm/2",
        "rate": DEFAULT_RATE,
        **origin(),
        "rule": made["rule"],
        "virtual": {
            str(spread): board(spread, [made[_part(spread, number)] for number in range(PARTS)])
            for spread in SPREADS
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
