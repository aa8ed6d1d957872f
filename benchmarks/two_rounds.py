"""Run two rounds of prints in the virtual fab. The second round is planned to decide questions that the first
round left open.

    python -m benchmarks.two_rounds --out runs/two-rounds [--trials 48] [--seed 20271] [--knobs …] [--publish]

Each trial has a fab of its own, in which one knob is set (the planted cause). Its effect is 12 to 30 nm rms.
Knobs and sizes are drawn from the seed before anything is run. In the first round, the closed loop is run on
14 scans of random layouts. To answer the questions that it leaves open, four prints are planned and printed
in the same fab. As a control, the same number of prints with random layouts is made and scanned in the same
ways.

An answer is right if only the planted cause remains and is attributed to the right machine (printer or
microscope). Trials whose first round leaves no question that scans can decide have no answers. Every seed has
a result file and a table of its own. An interrupted run continues when it is run again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from scipy.stats import binomtest

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, kept, options, origin, place_for
from litho_data.commands.progress import run_script
from litho_data.making.build import build_dataset
from litho_data.store import open_store
from litho_data.virtual_fab import KNOBS, simulate, simulate_plan, strength_for_rms
from litho_models.loop.closing import Closed
from litho_models.loop.record import Decision, ScanFinding
from litho_models.loop.run import close_loop
from litho_models.planning.open_questions import open_questions
from litho_models.planning.questions import OpenQuestions
from litho_models.planning.record import PlannedQuestion
from litho_models.planning.rounds import MICROSCOPE, PRINTER, decide
from litho_models.planning.run import next_print

PAGE = Path(__file__).parents[1] / "docs" / "next_print.md"
RESULTS = PAGE.parent / "results" / "two-rounds"
DEALT = (
    "slope-thinning-x",
    "feedback-lag",
    "galvo-lag",
    "scan-line-stripes",
    "elliptical-psf",
    "tip-dilation",
    "slope-thinning-y",
    "line-roughness",
    "diffusion-blur",
    "slope-thinning",
)
# These trials test what new prints can decide, and not how good the base model is. Therefore, the base model
# has the same form as the printer of the fab.
BASE = "physics"
SCANS, PRINTS = 14, 4
RMS_NM = (12.0, 30.0)
# Ranges of the predicted power into which questions are grouped in the table.
POWERS = ((0.0, 0.2), (0.2, 0.95), (0.95, 1.01))
Arm = Literal["optimised", "random"]
ARMS: tuple[Arm, ...] = get_args(Arm)


def main() -> None:
    """Run the trials that have no result yet, write the record of all trials, and print the table."""
    parser = options(__doc__, "write the table into docs/next_print.md")
    parser.add_argument("--out", type=Path, required=True, help="folder of the trials")
    parser.add_argument("--trials", type=int, default=48)
    parser.add_argument("--seed", type=int, default=20271, help="seed of all random draws")
    parser.add_argument(
        "--knobs", nargs="+", choices=KNOBS, default=DEALT, help="knobs that the trials plant, in turn"
    )
    parser.add_argument(
        "--rms-nm",
        nargs=2,
        type=float,
        default=RMS_NM,
        help="smallest and largest effect of a knob, in nm rms",
    )
    parser.add_argument(
        "--arms", nargs="+", choices=ARMS, default=ARMS, help="kinds of layouts printed in the second round"
    )
    parser.add_argument("--size", type=int, default=192, help="side of each layout in pixels")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trials = []
    for draw in draws(arguments.trials, arguments.seed, arguments.knobs, arguments.rms_nm):
        size, arms = arguments.size, arguments.arms
        folder = place_for(arguments.out, f"{draw['number']:02d}", draw=draw, size_px=size, arms=arms)
        trials.append(kept(folder / "trial.json", partial(run_trial, draw, folder, size, arms, print)))
        print(line_of(trials[-1]), flush=True)
    record = {**origin(), "seed": arguments.seed, "size_px": arguments.size, "trials": trials}
    out = (RESULTS if arguments.publish else arguments.out) / f"{arguments.seed}.json"
    conclude(record, summary(trials), out, PAGE, f"two-rounds-{arguments.seed}", published=arguments.publish)


def draws(
    count: int, seed: int, knobs: Sequence[str] = DEALT, rms_nm: Sequence[float] = RMS_NM
) -> list[dict[str, Any]]:
    """Draw the knob, the size of its effect and the seed of each trial. The trials take the knobs in turn,
    and the sizes are distributed log-uniformly.
    """
    random = np.random.default_rng([seed, 17])
    return [
        {
            "number": number,
            "knob": knobs[number % len(knobs)],
            "rms_nm": float(np.exp(random.uniform(*np.log(rms_nm)))),
            "seed": int(random.integers(1, 2**20)),
        }
        for number in range(count)
    ]


def run_trial(
    draw: dict[str, Any],
    folder: Path,
    size_px: int,
    arms: Sequence[Arm],
    report: Callable[[str], None],
) -> dict[str, Any]:
    """Run both rounds of one trial, and return its record. The second round is run once for each kind of
    layout in ``arms``.
    """
    report(f"trial {draw['number']}: {draw['knob']}")
    found = strength_for_rms(draw["knob"], draw["rms_nm"], seed=draw["seed"])
    card = simulate(folder / "fab", count=SCANS, size_px=size_px, seed=draw["seed"], knobs=[found.setting])
    build_dataset(card, folder / "first.zarr")
    asked: list[tuple[Closed, OpenQuestions]] = []

    dataset = open_store(folder / "first.zarr").dataset_id

    def ask(
        closed: Closed, single_scans: Sequence[ScanFinding]
    ) -> tuple[Closed, list[Decision], list[OpenQuestions]]:
        asked.append((closed, open_questions(closed, dataset, single_scans)))
        return closed, [], [asked[-1][1]]

    result = close_loop(folder / "first.zarr", folder / "loop", base=BASE, further=ask)
    answers: dict[str, Any] = {}
    for arm in arms:
        plan = next_print(
            folder / "loop",
            folder / f"plan-{arm}",
            prints=PRINTS,
            field_um=size_px / 10,
            layouts=arm,
            report=report,
        )
        if plan is None or not any(q.kind != "fact" for q in plan.questions):
            continue
        printed = simulate_plan(
            folder / f"plan-{arm}", folder / "fab", folder / f"fab-{arm}", seed=draw["seed"] + 1
        )
        build_dataset(printed, folder / f"{arm}.zarr")
        store = open_store(folder / f"{arm}.zarr")
        planned = {q.name: q for q in plan.questions}
        answers[arm] = [
            judged(one, planned[one.question], draw["knob"]) for one in decide(*asked[0], store.scans())
        ]
    return {
        **draw,
        "strength": found.setting.strength,
        "reached_rms_nm": found.rms_nm,
        "named": [one.name for one in result.effects],
        "answers": answers,
    }


def judged(decision: Decision, planned: PlannedQuestion, knob: str) -> dict[str, Any]:
    """Return the record of one decision, with the power that the plan predicted for it, and whether the
    decision is right or wrong.
    """
    truth = KNOBS[knob]
    owner = MICROSCOPE if truth.role == "measurement" else PRINTER
    asked = {truth.effect, f"{truth.effect} as {owner}'s", owner} & set(decision.declared)
    return {
        "question": decision.question,
        "kind": decision.kind,
        "declared": decision.declared,
        "left": decision.left,
        "verdict": decision.verdict,
        "evidence": decision.evidence,
        "power": planned.power[PRINTS - 1],
        "status": planned.status,
        # A question about terms of single scans does not count. The fab's default noise contains such terms
        # in every trial, whatever is planted.
        "counts": bool(asked) and decision.kind != "per-scan",
        "right": decision.verdict == "decided" and set(decision.left) == asked,
        "wrong": decision.verdict == "decided"
        and set(decision.left) != asked
        and (bool(asked) or decision.kind in ("set", "suspects")),
    }


def line_of(trial: dict[str, Any]) -> str:
    """Return one trial as one line of text."""
    told = [
        f"{arm}: {one['question']} [{', '.join(one['declared'])}] -> {one['verdict']} {one['left']}, "
        f"power {one['power']:.2f}"
        for arm, answers in trial["answers"].items()
        for one in answers
        if one["counts"]
    ]
    return (
        f"{trial['number']:2d} {trial['knob']} {trial['rms_nm']:.0f} nm: {'; '.join(told) or 'no question'}"
    )


def summary(trials: list[dict[str, Any]]) -> str:
    """Return a table that says how many questions were decided correctly, by the kind of layouts and the
    predicted power.
    """
    rows = []
    for arm in (one for one in ARMS if any(one in trial["answers"] for trial in trials)):
        every = [one for trial in trials for one in trial["answers"].get(arm, [])]
        asked = [one for one in every if one["counts"]]
        stray = sum(one["wrong"] for one in every if not one["counts"])
        for low, high in POWERS:
            some = [one for one in asked if low <= one["power"] < high]
            right = sum(one["right"] for one in some)
            rows.append(
                (
                    arm,
                    f"{low:g} and more" if high > 1 else f"{low:g} to {high:g}",
                    str(len(some)),
                    f"{np.mean([one['power'] for one in some]):.2f}" if some else "–",
                    _reached(right, len(some)),
                    str(sum(one["wrong"] for one in some)),
                    str(sum(one["status"] == "no experiment separates" for one in some)),
                )
            )
        rows.append((arm, "questions about other causes", "–", "–", "–", str(stray), "–"))
    with_question = sum(any(one["counts"] for one in t["answers"].get("optimised", [])) for t in trials)
    return markdown_table(
        (
            "layouts of the second round",
            "predicted power",
            "questions",
            "mean predicted power",
            "decided correctly",
            "decided wrongly",
            "declared not separable",
        ),
        rows,
        f"In {with_question} of the {len(trials)} trials, the first round left a question about the hidden "
        f"cause. The predicted power is the power of {PRINTS} prints. Brackets contain 95 % Wilson intervals "
        "of the share decided correctly. For the questions in the last column, the plan stated before "
        "printing that no experiment separates the answers.",
        "With the optimised layouts, the questions about each hidden cause were decided correctly in this "
        f"many trials: {_by_knob(trials)}.",
    )


def _by_knob(trials: list[dict[str, Any]]) -> str:
    told = []
    for knob in dict.fromkeys(trial["knob"] for trial in trials):
        every = [one for t in trials if t["knob"] == knob for one in t["answers"].get("optimised", [])]
        asked = [one for one in every if one["counts"]]
        told.append(f"`{knob}` {sum(one['right'] for one in asked)} of {len(asked)}")
    return ", ".join(told)


def _reached(right: int, count: int) -> str:
    if not count:
        return "–"
    interval = binomtest(right, count).proportion_ci(method="wilson")
    return f"{right} of {count} ({interval.low:.2f} … {interval.high:.2f})"


if __name__ == "__main__":
    run_script(main)
