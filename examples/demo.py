"""Run the whole workflow: prints and scans → dataset → models → closed loop → design → score.

Without ``--dataset``, the virtual fab makes the prints, with two effects of which the demo does not tell the
programs. With ``--dataset neural-lithography``, the measured prints are used. Every step runs one command of
the project and prints it. Steps whose result exists are skipped, so an interrupted demo continues when it is
run again.
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
# Seeds with which the paper's random split into training and test scans is drawn.
PAPER_SEEDS = (0, 1, 2, 3)
# The models that are compared with whole prints held out. The networks are left out, because training them
# once more would double the time of the demo.
BY_PRINT = "identity,affine,affine-mtf,blur-table,linear,features,physics,random-features"


@dataclass(frozen=True)
class Effort:
    """How much the demo trains and designs: enough to show the main steps, or as much as the results in the
    documentation need.
    """

    models: str
    arms: tuple[str, ...]
    folds: int
    element_px: int
    distance_um: int
    iterations: int
    seeds: int


# An element resolves wavelength times distance over side. With 256 px and a distance of 25 µm, this is 0.6
# µm, and the letters of the target have strokes of 0.8 µm.
QUICK = Effort(
    models="identity,affine,blur-table,physics",
    arms=("physics",),
    folds=2,
    element_px=256,
    distance_um=25,
    iterations=50,
    seeds=1,
)
# The settings of the results in docs/results. At 75 µm, the resolution is 1.9 µm, so the letters are blurred.
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
    """One step of the demo. ``command`` is its command line, ``result`` is the file or folder that exists
    once the command has finished, and ``report`` is the page that the command writes, if it writes one.
    """

    title: str
    command: tuple[str, ...]
    result: Path
    report: Path | None = None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--dataset",
        default="",
        help="name of a dataset card in datasets/, such as neural-lithography; by default, the virtual fab",
    )
    parser.add_argument("--out", type=Path, default=Path("runs"), help="folder for all results")
    arguments = parser.parse_args()

    name = arguments.dataset or "demo"
    out = arguments.out / name
    steps = plan(out, arguments.dataset)
    seconds = [run(step, f"[{number}/{len(steps)}]") for number, step in enumerate(steps, 1)]
    answer, page = write_index(out, name, steps, seconds)
    print(f"\n{answer}\ndone in {sum(seconds) / 60:.1f} min; open {page}")


def plan(out: Path, dataset: str) -> list[Step]:
    """Return the steps of the demo in order. Later steps read the results of earlier ones."""
    # This import loads torch. It stands here because worker processes import this module and do not need
    # torch.
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
        # Physics has the same form as the fab's process, and with a single base model the demo takes less
        # than five minutes.
        anew = ["--base", "physics"]
    # Networks are trained in all threads. With two processes, each would have only one thread.
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
    # A virtual printer judges the designs itself, and designs are also made with the corrected model. For the
    # measured printer, the corrected model is the judge.
    judge = ("--judge", f"{FAB}={out / 'fab' / 'truth'}" if not dataset else f"corrected={corrected}")
    arms = effort.arms if dataset else (*effort.arms, CORRECTED)
    models = ",".join(["none", *(f"{name}={out / 'models' / name}" for name in arms)])
    steps.append(Step("Freeze the corrected model", _models("freeze", loop, "--out", corrected), corrected))
    if dataset:
        steps += [
            Step(
                "Design a hologram with the learned model of the printer",
                _design("hoe", "--model", out / "models" / "pbl", *element, "--out", out / "hoe"),
                out / "hoe" / "design.json",
                out / "hoe" / "report.html",
            ),
            Step(
                "Score the hologram with a model that was not used to design it",
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
    """Run one step unless its result exists, and return the time that it took in seconds. A step that fails
    ends the demo.
    """
    print(f"\n{number} {step.title}\n$ {_spell(step.command)}", flush=True)
    if step.result.exists():
        print("  skipped, because its result exists")
        return 0.0
    started = time.monotonic()
    code = call(step.command)
    if code:
        print(f"the demo stops here: the command above ended with exit code {code}", file=sys.stderr)
        raise SystemExit(code)
    return time.monotonic() - started


def call(words: tuple[str, ...]) -> int:
    """Run a command of the project in this process, and return its exit code.

    A separate process would have to import the packages again, which takes some seconds.
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
    """Write a page with the demo's answer and links to all reports. Return the answer and the path of the
    page.
    """
    import pandas as pd

    from examples.demo_story import tell
    from litho_data.reports.page import Page
    from litho_models.loop.record import CloseLoop
    from litho_models.loop.report import said

    page = Page(
        f"litholoop: {name}",
        "From raw scans to a design that was optimised with a learned model of the printer.",
    )
    if (out / "fab").exists():
        answer = tell(page, out)
    else:
        loop = CloseLoop.read(out / "close-loop")
        answer = said("verdict", loop)
        page.verdict(answer)
        rows = {"the base model": loop.error("base"), "what the loop found": loop.error("all")}
        tiles = [
            (f"{row.mae_nm:.2f} nm", f"error with {name} on held-out scans (one offset fitted to each scan)")
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
    page.table(
        table, "A time of 0 s means that an earlier run had already made the result.", "steps.csv", digits=1
    )
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
