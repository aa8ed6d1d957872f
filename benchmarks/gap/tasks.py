"""What is designed: the tasks, the commands that make their designs, and the one that judges them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.gap.jobs import Job, design_command
from benchmarks.gap.plan import ARMS, Effort, model
from litho_data.foundation.errors import InputError

ZOO_ARMS = ("none", "physics", "fno", "pbl")


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
        return Job(
            f"{self.name}/{arm}/seed{seed}",
            design_command(
                *words, "--model", self.models[arm], *self.options, "--seed", seed, "--out", folder
            ),
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


# The comparison shows no yield, which would take longer than the search of most arms.
_FEW_DRAWS = ("--yield-draws", 10)


def tasks(out: Path, effort: Effort, zoo: Mapping[str, str], corrected: str | None) -> list[Task]:
    """The three tasks on the fab, and the hologram through models of measured prints.

    Args:
        zoo: name to folder of the frozen models that come with the package.
        corrected: the model that a closed loop on the measured prints ended with; None for none.
    """
    models = {arm: "none" if arm == "none" else str(model(out, arm)) for arm in ARMS}
    fab = {"fab": str(out / "fab" / "truth")}
    hoe = task_options(
        "--target", "text", "--size-px", effort.hoe_px,
        "--distance-um", effort.hoe_distance_um, "--iterations", effort.hoe_iterations,
        "--precision", effort.search_precision, *_FEW_DRAWS,
    )  # fmt: skip
    lens = task_options(
        "--size-px", effort.lens_px, "--distance-um", effort.lens_distance_um,
        "--iterations", effort.lens_iterations, "--precision", effort.search_precision, *_FEW_DRAWS,
    )  # fmt: skip
    camera = task_options("--window-px", effort.window_px, "--object-px", effort.object_px)
    # No fab knows the measured printer: every arm's model judges the others' designs.
    measured = {arm: zoo.get(arm, "none") for arm in ZOO_ARMS}
    measured |= {} if corrected is None else {"closed-loop": corrected}
    return [
        Task("hoe", "hoe", hoe, models, fab, effort.seeds),
        Task("lens-direct", "direct", lens, models, fab, effort.seeds),
        Task("lens-computational", "computational", lens + camera, models, fab, effort.seeds),
        Task("hoe-measured", "hoe", hoe, measured, {}, effort.zoo_seeds),
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


def task_options(*words: object) -> tuple[str, ...]:
    """Options of a command, in words."""
    return tuple(map(str, words))
