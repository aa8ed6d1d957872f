"""Run the whole workflow: prints and scans → dataset → models → closed loop → design → score.

Without ``--dataset`` the virtual fab makes the prints and adds effects that no model contains.
``--dataset neural-lithography`` uses the measured prints. Every step runs one command of the project and
prints this command. A step whose result exists is skipped, so an interrupted demo resumes.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from litho_data.cli.app import main as data
from litho_design.cli import main as design
from litho_models.cli import main as models

PROGRAMS = {"litho-data": data, "litho-models": models, "litho-design": design}
CARDS = Path(__file__).parents[1] / "datasets"
WORKERS = ("--workers", 2)
# Seeds of the random draws of the paper's split.
PAPER_SEEDS = (0, 1, 2, 3)
# The networks are not trained with whole prints left out, because that would double the time of the demo.
BY_PRINT = "identity,affine,affine-mtf,blur-table,linear,features,physics,random-features"


@dataclass(frozen=True)
class Effort:
    """How much the demo trains and designs: enough for the main steps, or as much as the docs need."""

    models: str
    arms: tuple[str, ...]
    folds: int
    element_px: int
    distance_um: int
    iterations: int
    seeds: int


# An element of 256 px resolves wavelength x distance / side: 0.6 µm at a distance of 25 µm. The target's
# letters have strokes of 0.8 µm.
QUICK = Effort(
    models="identity,affine,blur-table,physics",
    arms=("physics",),
    folds=2,
    element_px=256,
    distance_um=25,
    iterations=50,
    seeds=1,
)
# The settings of docs/results. At 75 µm the resolution is 1.9 µm, so the letters are blurred.
MEASURED = Effort(
    models=f"{BY_PRINT},pbl,fno",
    arms=("affine", "physics", "pbl"),
    folds=5,
    element_px=256,
    distance_um=75,
    iterations=100,
    seeds=1,
)


@dataclass(frozen=True)
class Step:
    """One command, the file or folder that exists once the command has finished, and its report."""

    title: str
    command: tuple[str, ...]
    result: Path
    report: Path | None = None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset", default="", help="name of a card in datasets/, e.g. neural-lithography")
    parser.add_argument("--out", type=Path, default=Path("runs"), help="folder for all results")
    arguments = parser.parse_args()

    name = arguments.dataset or "demo"
    out = arguments.out / name
    steps = plan(out, arguments.dataset)
    seconds = [run(step, f"[{number}/{len(steps)}]") for number, step in enumerate(steps, 1)]
    answer, page = write_index(out, name, steps, seconds)
    print(f"\n{answer}\ndone in {sum(seconds) / 60:.1f} min; open {page}")


def plan(out: Path, dataset: str) -> list[Step]:
    """Return the steps in order. Later steps read the results of earlier ones."""
    # Worker processes import this module, so it imports torch only where the demo itself needs it.
    from examples.demo_story import CORRECTED, FAB

    effort = MEASURED if dataset else QUICK
    store, loop = out / "store.zarr", out / "close-loop"
    if dataset:
        card = CARDS / f"{dataset}.toml"
        source = Step("Find or fetch the measured prints", _data("fetch", dataset), out / ".always")
        anew = ["--nested", "prints"]
    else:
        card = out / "fab" / "raw" / "card.toml"
        source = Step(
            "Print and scan in the virtual fab",
            _data("simulate", "--preset", "demo", "--out", card.parents[1]),
            card,
        )
        # Physics contains the process of the fab, and a single base model keeps the demo below five minutes.
        anew = ["--base", "physics"]
    # A network trains in all threads; two processes would leave one to each.
    workers = () if dataset else WORKERS
    steps = [
        source,
        Step(
            "Build the dataset",
            _data("build", card, "--out", store, *WORKERS),
            store,
            out / "store-report" / "report.html",
        ),
        Step(
            "Compare the models on held-out scans",
            _models(
                "benchmark", store, "--models", effort.models,
                "--folds", effort.folds, *workers, "--out", out / "benchmark",
            ),
            out / "benchmark" / "benchmark.json",
            out / "benchmark" / "report.html",
        ),
        Step(
            "Close the loop: what does the model lack?",
            _models("close-loop", store, *anew, *workers, "--out", loop),
            loop / "close_loop.json",
            loop / "report.html",
        ),
    ]  # fmt: skip
    if dataset:
        noise = out / "noise"
        steps += [
            *(
                _paper_split(store, effort.models, out / f"benchmark-paper-{seed}", seed)
                for seed in PAPER_SEEDS
            ),
            Step(
                "Compare the models on whole held-out prints",
                _models(
                    "benchmark", store, "--models", BY_PRINT, "--split", "leave-one-print-out",
                    "--out", out / "leave-one-print-out",
                ),
                out / "leave-one-print-out" / "benchmark.json",
                out / "leave-one-print-out" / "report.html",
            ),
            Step(
                "What no model can predict: the noise",
                _models("noise", store, "--residuals", out / "benchmark", "--out", noise),
                noise / "noise.json",
                noise / "report.html",
            ),
        ]  # fmt: skip
    for model in effort.arms:
        trained, frozen = out / "runs" / model, out / "models" / model
        steps += [
            Step(
                f"Train {model}",
                _models("train", store, "--model", model, "--out", trained),
                frozen,
            ),
            Step(f"Freeze {model}", _models("freeze", trained, "--out", frozen), frozen),
        ]
    corrected = out / "models" / CORRECTED
    element = (
        "--size-px", effort.element_px, "--distance-um", effort.distance_um,
        "--iterations", effort.iterations,
    )  # fmt: skip
    # If the printer is virtual, it is the judge itself, and the corrected model can be one of the arms.
    judge = ("--judge", f"{FAB}={out / 'fab' / 'truth'}" if not dataset else f"corrected={corrected}")
    arms = effort.arms if dataset else (*effort.arms, CORRECTED)
    models = ",".join(["none", *(f"{name}={out / 'models' / name}" for name in arms)])
    steps.append(Step("Freeze the corrected model", _models("freeze", loop, "--out", corrected), corrected))
    if dataset:
        steps += [
            Step(
                "Design a hologram through the learned printer",
                _design("hoe", "--model", out / "models" / "pbl", *element, "--out", out / "hoe"),
                out / "hoe" / "design.json",
                out / "hoe" / "report.html",
            ),
            Step(
                "Score it with a printer that was not used to design it",
                _design("score", out / "hoe", "--judge", f"corrected={corrected}", "--out", out / "score"),
                out / "score" / "score.json",
                out / "score" / "report.html",
            ),
        ]
    steps.append(
        Step(
            "Compare designs made with one model and judged with another",
            _design(
                "compare", "--models", models, *judge, *element,
                "--seeds", effort.seeds, *workers, "--out", out / "compare",
            ),
            out / "compare" / "gap.json",
            out / "compare" / "report.html",
        )
    )  # fmt: skip
    return steps


def run(step: Step, number: str) -> float:
    """Run one step unless its result exists, and return its time in s; a failed step ends the demo."""
    print(f"\n{number} {step.title}\n$ {_spell(step.command)}", flush=True)
    if step.result.exists():
        print("  already done")
        return 0.0
    started = time.monotonic()
    code = call(step.command)
    if code:
        print(f"the demo stops here: the command above ended with exit code {code}", file=sys.stderr)
        raise SystemExit(code)
    return time.monotonic() - started


def call(words: tuple[str, ...]) -> int:
    """Run a command of the project in this process and return its exit code.

    A process of its own would import the packages again, which takes some seconds.
    """
    given, sys.argv = sys.argv, list(words)
    try:
        PROGRAMS[words[0]]()
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    finally:
        sys.argv = given
    return 0


def write_index(out: Path, name: str, steps: list[Step], seconds: list[float]) -> tuple[str, Path]:
    """Write a page with the demo's answer and links to all reports; return the answer and the page's path."""
    import pandas as pd

    from examples.demo_story import tell
    from litho_data.reports.page import Page
    from litho_models.loop.record import CloseLoop
    from litho_models.loop.report import said

    page = Page(
        f"litholoop: {name}", "From raw scans to a design that was optimised through the learned printer."
    )
    if (out / "fab").exists():
        answer = tell(page, out)
    else:
        loop = CloseLoop.read(out / "close-loop")
        answer = said("verdict", loop)
        page.verdict(answer)
        rows = {"the base model": loop.error("base"), "what the loop found": loop.error("all")}
        tiles = [
            (f"{row.mae_nm:.2f} nm", f"error with {name} on held-out scans (one term fitted per scan)")
            for name, row in rows.items()
            if row is not None
        ]
        page.tiles([*tiles, (", ".join(one.name for one in loop.effects) or "none", "found")])
    page.heading("All reports")
    page.links([(os.path.relpath(s.report, out), s.title) for s in steps if s.report])
    page.heading("What was run", folded=True)
    table = pd.DataFrame(
        {"step": [s.title for s in steps], "seconds": seconds, "command": [_spell(s.command) for s in steps]}
    )
    page.table(table, "0 s means that the result existed from an earlier run.", "steps.csv", digits=1)
    return answer, page.write(out, "index.html")


def _spell(command: tuple[str, ...]) -> str:
    return shlex.join(command)


def _paper_split(store: Path, models: str, out: Path, seed: int) -> Step:
    return Step(
        f"Compare the models on the paper's split, random draw {seed}",
        _models(
            "benchmark", store, "--models", models, "--split", "paper", "--seed", seed, "--out", out,
        ),
        out / "benchmark.json",
        out / "report.html",
    )  # fmt: skip


def _data(*words: object) -> tuple[str, ...]:
    return ("litho-data", *map(str, words))


def _models(*words: object) -> tuple[str, ...]:
    return ("litho-models", *map(str, words))


def _design(*words: object) -> tuple[str, ...]:
    return ("litho-design", *map(str, words))


if __name__ == "__main__":
    main()
