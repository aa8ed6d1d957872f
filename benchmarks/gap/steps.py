"""Define the jobs that come before the designs: prints are made in the fab, and every arm is trained, frozen
and tested.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.gap.jobs import Job, command
from benchmarks.gap.plan import ARMS, PRINT_KNOBS, SCAN_KNOBS, Effort, model, store, trained_as

# The random properties of the machine have a fixed seed, so that training and test prints come from the same
# machine.
_MACHINE_SEED = 0


def fab_jobs(out: Path, effort: Effort) -> list[list[Job]]:
    """Return the jobs that print and scan the fields, and then those that build their stores. The jobs of
    each of these stages can run in parallel.
    """
    prints = [("fab", effort.scans, 0), ("test-fab", max(2, effort.scans // 4), 1)]
    simulate = [
        Job(
            name,
            command(
                "litho-data", "simulate", "--out", out / name, "--count", count, "--size-px", effort.scan_px,
                "--seed", seed, *_knob_options(),
            ),
            out / name / "truth" / "truth.json",
        )
        for name, count, seed in prints
    ]  # fmt: skip
    build = [
        Job(
            f"{name}-store",
            command("litho-data", "build", out / name / "raw" / "card.toml", "--out", store(out, name)),
            store(out, name),
        )
        for name, _, _ in prints
    ]
    return [simulate, build]


def model_jobs(out: Path, effort: Effort) -> list[list[Job]]:
    """Return the jobs that train, then those that freeze, and then those that test every arm. The jobs of
    each of these stages can run in parallel. The longest training starts first.
    """
    arms = [arm for arm in reversed(ARMS) if arm != "none"]
    trained = {arm: trained_as(arm) for arm in arms}
    train = [
        Job(
            f"train-{name}",
            command(
                "litho-models", "train", store(out, "fab"), "--model", name,
                "--steps", effort.training_steps, "--out", out / "runs" / name,
            ),
            out / "runs" / name / "run.json",
        )
        for name in dict.fromkeys(name for name, _ in trained.values())
    ]  # fmt: skip
    freeze = [
        Job(
            f"freeze-{arm}",
            command("litho-models", "freeze", out / "runs" / name, *told, "--out", model(out, arm)),
            model(out, arm) / "card.json",
        )
        for arm, (name, told) in trained.items()
    ]
    test = [
        Job(
            f"test-{arm}",
            command(
                "litho-models", "evaluate", model(out, arm), store(out, "test-fab"),
                "--out", out / "test" / arm,
            ),
            out / "test" / arm / "evaluation.json",
        )
        for arm in arms
    ]  # fmt: skip
    return [train, freeze, test]


def _knob_options() -> list[str]:
    settings = [f"{name}={value}@{_MACHINE_SEED}" for name, value in PRINT_KNOBS.items()]
    settings += [f"{name}={value}" for name, value in SCAN_KNOBS.items()]
    return [word for setting in settings for word in ("--knob", setting)]
