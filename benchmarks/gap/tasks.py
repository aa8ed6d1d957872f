"""Define the tasks of the comparison, with the commands that make their designs and the command that judges
them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.gap.jobs import Job, design_command
from benchmarks.gap.plan import ARMS, Effort, model
from litho_data.foundation.errors import InputError

# The tasks that the fab judges, with the kind of their designs.
KINDS = {"hoe": "hoe", "lens-direct": "direct", "lens-computational": "computational"}
REDUCED = "-reduced"
FAB, MEASURED = "fab", "measured"
ZOO_ARMS = ("none", "physics", "fno", "pbl", "random-features")


@dataclass(frozen=True)
class Task:
    """One task of the comparison: the kind and the options of its designs, the models (arms) by name, the
    judges by name, and the number of seeds.
    """

    name: str
    kind: str
    options: tuple[str, ...]
    models: Mapping[str, str]
    judges: Mapping[str, str]
    seeds: int

    @property
    def part(self) -> str:
        """Return the part of the comparison to which the task belongs. The fab judges the first part, and the
        models of the measured prints judge each other in the second part.
        """
        return FAB if self.judges else MEASURED

    @property
    def iterations(self) -> int:
        """Return the number of iterations of the search for each design."""
        return int(self.options[self.options.index("--iterations") + 1])

    def design(self, out: Path, arm: str, seed: int) -> Job:
        """Return the job that makes one design. Its folder is the one from which ``litho-design compare``
        reads it.
        """
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
        """Return the jobs that make all designs. They are ordered by seed, so that all arms of a seed are
        done before the next seed begins.
        """
        return [self.design(out, arm, seed) for seed in range(self.seeds) for arm in self.models]

    def compare(self, out: Path) -> Job:
        """Return the job that judges the finished designs of the task."""
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


# The comparison does not show the yield of a design, and computing it with many draws would take longer than
# most searches.
_FEW_DRAWS = ("--yield-draws", 10)


def tasks(out: Path, effort: Effort, zoo: Mapping[str, str], corrected: str | None) -> list[Task]:
    """Return the three tasks that the fab judges, the hologram task with the models of the measured prints,
    and the three tasks once more at reduced size.

    Args:
        out: folder of the comparison.
        effort: sizes, distances and numbers of iterations and seeds.
        zoo: folders of the frozen models that come with the package, by name.
        corrected: folder of the frozen model of a closed loop on the measured prints. Without it, this arm is
            left out.
    """
    models = {arm: "none" if arm == "none" else str(model(out, arm)) for arm in ARMS}
    fab = {"fab": str(out / "fab" / "truth")}
    # No virtual fab simulates the measured printer. Therefore, the model of each arm judges the designs of
    # the other arms.
    measured = {arm: zoo.get(arm, "none") for arm in ZOO_ARMS}
    measured |= {} if corrected is None else {"closed-loop": corrected}

    def judged_by_fab(scale: float, seeds: int, suffix: str = "") -> list[Task]:
        return [
            Task(f"{name}{suffix}", kind, _options(effort, kind, scale), models, fab, seeds)
            for name, kind in KINDS.items()
        ]

    return [
        *judged_by_fab(1.0, effort.seeds),
        Task("hoe-measured", "hoe", _options(effort, "hoe"), measured, {}, effort.zoo_seeds),
        *judged_by_fab(effort.reduced_to, effort.reduced_seeds, REDUCED),
    ]


def _options(effort: Effort, kind: str, scale: float = 1.0) -> tuple[str, ...]:
    """Return the options of the commands that make and judge the designs of one kind."""
    iterations = effort.hoe_iterations if kind == "hoe" else effort.lens_iterations
    words = [
        "--size-px", effort.side_px(kind, scale), "--distance-um", effort.distance_um(kind, scale),
        "--iterations", iterations, "--precision", effort.search_precision, *_FEW_DRAWS,
    ]  # fmt: skip
    if kind == "hoe":
        words = ["--target", "text", *words]
    if kind == "computational":
        words += ["--window-px", effort.window_px, "--object-px", effort.object_px]
    return tuple(map(str, words))


def chosen(every: Sequence[Task], names: str | None) -> list[Task]:
    """Return the tasks whose names are listed in ``names``, separated by commas. With None, return all tasks.

    Raises:
        InputError: there is no task of one of the names.
    """
    if names is None:
        return list(every)
    wanted, known = names.split(","), [task.name for task in every]
    if unknown := [name for name in wanted if name not in known]:
        raise InputError("tasks", got=", ".join(unknown), wanted=f"some of {', '.join(known)}")
    return [task for task in every if task.name in wanted]


def require_whole_parts(every: Sequence[Task], todo: Sequence[Task]) -> None:
    """Check that the tasks at full size of each part are all there or none. Only whole parts are published.

    Raises:
        InputError: a task at full size is missing.
    """
    parts = {task.part for task in todo}
    whole = [task for task in every if task.part in parts and not task.name.endswith(REDUCED)]
    if missing := [task.name for task in whole if task not in todo]:
        raise InputError(
            "--publish",
            got=f"--tasks without {', '.join(missing)}",
            wanted="these tasks, too, because the page shows them together",
        )
