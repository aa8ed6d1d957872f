"""What is compared: the fab and its hidden effects, the arms, the tasks, and the commands that do it."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from benchmarks.gap.jobs import Job
from litho_data.errors import InputError
from litho_data.results import Record, Result

BIN = Path(sys.executable).parent
ARMS = ("none", "affine", "affine-mtf", "physics", "fno", "pbl")
ZOO_ARMS = ("none", "physics", "fno", "pbl")
# Stated before any design was made, by one rule: each effect of the print changes the training prints by
# 10 nm rms after offset, gain, plane and bow of single scans. The physics model has none of them; two are
# in no catalogue. Those of the microscope are as large as on the measured prints and never reach a design.
PRINT_KNOBS = {
    "write-order-memory": 0.167,
    "slope-thinning-x": 0.346,
    "ghost-spot": 0.0847,
    "edge-bead": 0.107,
}
SCAN_KNOBS = {"scan-line-stripes": 8.0, "tilt-bow": 20.0, "min-to-zero-datum": 1.0}
# The machine is one and the same in training and test prints: its draws have a seed of their own.
_MACHINE_SEED = 0
_FULL_HOE_PX, _FULL_LENS_PX = 1024, 1200


class Effort(Record):
    """How much is printed, trained and designed; every arm of a task gets the same iterations."""

    hoe_px: int = _FULL_HOE_PX
    lens_px: int = _FULL_LENS_PX
    hoe_iterations: int = 80
    lens_iterations: int = 100
    # Of the networks during the search; prints, judges and scores are float32 for every arm.
    search_precision: str = "bfloat16"
    seeds: int = 3
    zoo_seeds: int = 1
    scans: int = 24
    scan_px: int = 512
    training_steps: int = 2000
    window_px: int = 158
    object_px: int = 96

    @classmethod
    def small(cls, size_px: int) -> Effort:
        """All sizes scaled down to elements of ``size_px``, to try the machinery."""
        return cls(
            hoe_px=size_px,
            lens_px=size_px,
            hoe_iterations=6,
            lens_iterations=6,
            seeds=2,
            scans=4,
            scan_px=128,
            training_steps=4,
            window_px=64,
            object_px=32,
        )


class Plan(Result):
    """``plan.json``: what a folder is the comparison of; a folder holds one only."""

    SCHEMA: ClassVar[str] = "litho-design/benchmark-gap-plan/1"
    FILE_NAME: ClassVar[str] = "plan.json"

    schema_: Literal["litho-design/benchmark-gap-plan/1"] = Field(
        default="litho-design/benchmark-gap-plan/1", alias="schema"
    )
    effort: Effort
    print_knobs: dict[str, float] = PRINT_KNOBS
    scan_knobs: dict[str, float] = SCAN_KNOBS
    judge: str | None = None


def open_plan(out: Path, effort: Effort, judge: str | None) -> Plan:
    """Write the plan, or check that the folder holds the same one.

    Raises:
        InputError: the folder holds a comparison of other settings.
    """
    plan = Plan(effort=effort, judge=judge)
    if not (out / Plan.FILE_NAME).exists():
        plan.write(out)
    elif Plan.read(out) != plan:
        raise InputError(
            f"comparison in {out}",
            got="other settings",
            wanted=f"those of its {Plan.FILE_NAME}",
            hint="choose another --out",
        )
    return plan


@dataclass(frozen=True)
class Task:
    """One comparison: the command that makes one design of it, its options, and who takes part."""

    name: str
    kind: str
    options: tuple[str, ...]
    models: Mapping[str, str]
    judges: Mapping[str, str]
    seeds: int

    @property
    def iterations(self) -> int:
        """Iterations of every design."""
        return int(self.options[self.options.index("--iterations") + 1])

    def design(self, out: Path, arm: str, seed: int) -> Job:
        """One design, at the place where ``compare`` looks for it."""
        folder = out / self.name / "designs" / arm / f"seed{seed}"
        words = ["hoe"] if self.kind == "hoe" else ["lens", "--task", self.kind]
        options = [_FOCAL.get(word, word) for word in self.options] if self.kind != "hoe" else self.options
        return Job(
            f"{self.name}/{arm}/seed{seed}",
            design_command(*words, "--model", self.models[arm], *options, "--seed", seed, "--out", folder),
            folder / "design.json",
        )

    def designs(self, out: Path) -> list[Job]:
        """All designs; whoever stops early has all arms of the first seeds."""
        return [self.design(out, arm, seed) for seed in range(self.seeds) for arm in self.models]

    def compare(self, out: Path) -> Job:
        """Judge the finished designs."""
        kind = "hoe" if self.kind == "hoe" else f"lens-{self.kind}"
        models = ",".join(arm if arm == source else f"{arm}={source}" for arm, source in self.models.items())
        judges = [word for name, source in self.judges.items() for word in ("--judge", f"{name}={source}")]
        return Job(
            f"{self.name}/compare",
            design_command(
                "compare", "--task", kind, "--models", models, *judges, *self.options,
                "--seeds", self.seeds, "--out", out / self.name,
            ),
            out / self.name / "gap.json",
        )  # fmt: skip


# ``lens`` calls its distance what it is; ``compare`` has one name for both tasks.
_FOCAL = {"--distance-um": "--focal-length-um"}


def fab_jobs(out: Path, effort: Effort) -> list[list[Job]]:
    """Print and scan training and test fields, build their stores: stages of jobs that may run together."""
    prints = [("fab", effort.scans, 0), ("test-fab", max(2, effort.scans // 4), 1)]
    simulate = [
        Job(
            name,
            _command(
                "litho-data", "simulate", "--out", out / name, "--count", count, "--size", effort.scan_px,
                "--seed", seed, *_knob_options(),
            ),
            out / name / "truth" / "truth.json",
        )
        for name, count, seed in prints
    ]  # fmt: skip
    build = [
        Job(
            f"{name}-store",
            _command("litho-data", "build", out / name / "raw" / "card.toml", "--out", store(out, name)),
            store(out, name),
        )
        for name, _, _ in prints
    ]
    return [simulate, build]


def model_jobs(out: Path, effort: Effort) -> list[list[Job]]:
    """Train, freeze and test every arm; the longest training first."""
    names = [arm for arm in reversed(ARMS) if arm != "none"]
    train = [
        Job(
            f"train-{name}",
            _command(
                "litho-models", "train", store(out, "fab"), "--model", name,
                "--steps", effort.training_steps, "--out", out / "runs" / name,
            ),
            out / "runs" / name / "run.json",
        )
        for name in names
    ]  # fmt: skip
    freeze = [
        Job(
            f"freeze-{name}",
            _command("litho-models", "freeze", out / "runs" / name, "--out", model(out, name)),
            model(out, name) / "card.json",
        )
        for name in names
    ]
    test = [
        Job(
            f"test-{name}",
            _command(
                "litho-models", "evaluate", model(out, name), store(out, "test-fab"),
                "--out", out / "test" / name,
            ),
            out / "test" / name / "evaluation.json",
        )
        for name in names
    ]  # fmt: skip
    return [train, freeze, test]


def tasks(out: Path, effort: Effort, zoo: Mapping[str, str], judge: str | None) -> list[Task]:
    """The three tasks on the fab, and the hologram through models of measured prints.

    Args:
        zoo: name to folder of the frozen models that come with the package.
        judge: a further frozen model of the measured prints, such as a closed loop's; None for none.
    """
    models = {arm: "none" if arm == "none" else str(model(out, arm)) for arm in ARMS}
    fab = {"fab": str(out / "fab" / "truth")}
    hoe = _options(
        "--target", "text", "--size-px", effort.hoe_px,
        "--distance-um", round(300 * effort.hoe_px / _FULL_HOE_PX, 3), "--iterations", effort.hoe_iterations,
        "--start", "gs", "--precision", effort.search_precision,
    )  # fmt: skip
    lens = _options(
        "--size-px", effort.lens_px, "--distance-um", round(400 * effort.lens_px / _FULL_LENS_PX, 3),
        "--iterations", effort.lens_iterations, "--precision", effort.search_precision,
    )  # fmt: skip
    camera = _options("--window-px", effort.window_px, "--object-px", effort.object_px)
    measured = {arm: zoo.get(arm, "none") for arm in ZOO_ARMS}
    further = {} if judge is None else {"closed-loop": judge}
    return [
        Task("hoe", "hoe", hoe, models, fab, effort.seeds),
        Task("lens-direct", "direct", lens, models, fab, effort.seeds),
        Task("lens-computational", "computational", lens + camera, models, fab, effort.seeds),
        Task("hoe-measured", "hoe", hoe, measured, further, effort.zoo_seeds),
    ]


def chosen(every: Sequence[Task], names: str | None) -> list[Task]:
    """The tasks of these names, separated by commas; all if None.

    Raises:
        InputError: a name that no task has.
    """
    if names is None:
        return list(every)
    wanted, known = names.split(","), [task.name for task in every]
    if unknown := [name for name in wanted if name not in known]:
        raise InputError("tasks", got=", ".join(unknown), wanted=f"some of {', '.join(known)}")
    return [task for task in every if task.name in wanted]


def proof_jobs(out: Path, effort: Effort) -> list[Job]:
    """One hologram through PBL with the 1,000 iterations of the paper, and what the fab prints of it."""
    size, distance_um = effort.hoe_px, round(300 * effort.hoe_px / _FULL_HOE_PX, 3)
    folder = out / "proof" / "design"
    design = design_command(
        "hoe", "--model", model(out, "pbl"), "--target", "text", "--size-px", size,
        "--distance-um", distance_um, "--iterations", 1000, "--precision", effort.search_precision,
        "--out", folder,
    )  # fmt: skip
    judge = ("--judge", f"fab={out / 'fab' / 'truth'}")
    score = design_command("score", folder, *judge, "--out", out / "proof" / "score")
    return [
        Job("proof", design, folder / "design.json"),
        Job("proof-score", score, out / "proof" / "score" / "score.json"),
    ]


def store(out: Path, name: str) -> Path:
    """The dataset store of a fab."""
    return out / f"{name}.zarr"


def model(out: Path, name: str) -> Path:
    """The frozen model of an arm."""
    return out / "models" / name


def module_command(*words: object) -> tuple[str, ...]:
    """This benchmark itself as a command."""
    return (sys.executable, "-m", "benchmarks.gap", *map(str, words))


def design_command(*words: object) -> tuple[str, ...]:
    """A command of ``litho-design``."""
    return _command("litho-design", *words)


def _knob_options() -> list[str]:
    settings = [f"{name}={value}@{_MACHINE_SEED}" for name, value in PRINT_KNOBS.items()]
    settings += [f"{name}={value}" for name, value in SCAN_KNOBS.items()]
    return [word for setting in settings for word in ("--knob", setting)]


def _options(*words: object) -> tuple[str, ...]:
    return tuple(map(str, words))


def _command(program: str, *words: object) -> tuple[str, ...]:
    return (str(BIN / program), *map(str, words))
