"""What the comparison will cost: a trial of every task and arm, before it starts, in its own process."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.gap.jobs import Job, module_command
from benchmarks.gap.plan import Effort, trained_as
from benchmarks.gap.tasks import Task
from benchmarks.record import write_record
from litho_models.frozen.card import ModelCard

# A step of training takes about this long on one core (24 fields of 512 x 512 px); the rest is small.
TRAINING_S = {"pbl": 0.45, "fno": 0.6}
_SMALL_MODELS_S = 300.0
_TRIALS = 2
# As ``run_design`` does it: draws of the yield curve; figures and page.
_REPORT_S = 10.0


def trial_job(out: Path, task: Task, arm: str) -> Job:
    """The trial of one arm at one kind of task as a process of its own: peak memories do not mix."""
    words = ("--out", out, "--trial", f"{task.name}/{arm}")
    return Job(f"cost/{task.kind}/{arm}", module_command(*words), _record_file(out, task, arm))


def run_trial(out: Path, task: Task, arm: str) -> None:
    """Time the iterations of one arm at one task, CPU seconds on one thread.

    Weights do not change the time: an untrained model stands for an arm that is not trained yet. What a
    design costs beside its iterations is the same optics for every arm, and is timed with the arm ``none``.
    """
    from litho_design.optimisation.parameters import make_parametrisation

    torch.set_num_threads(1)
    source = task.models[arm]
    if arm != "none" and not (Path(source) / ModelCard.FILE_NAME).exists():
        source = str(_untrained(arm, out / "cost" / "models" / arm))
    design, settings = _task(task, source)
    parameters = make_parametrisation(settings.layout, settings.search, design.cells)
    parameters.start_random(0)
    with design.printer.at_precision(settings.search.precision):
        iteration_s = min(_cpu_s(lambda: _iterate(design, parameters)) for _ in range(_TRIALS))
    level = design.cells(parameters.best_levels())[None, None].float()
    with torch.no_grad():
        record: dict[str, Any] = {
            "kind": task.kind,
            "arm": arm,
            "iteration_s": iteration_s,
            "evaluation_s": _cpu_s(lambda: design.objective(level)),
            "print_s": _cpu_s(lambda: design.printer(level)),
        }
        if arm == "none":
            height = design.printer(level)[0, 0]
            record["score_s"] = _cpu_s(lambda: design.score(height))
            record["beside_s"] = record["score_s"] + _beside_s(design, parameters, height)
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20)
    write_record(_record_file(out, task, arm), record | {"peak_gib": peak_gib})


def _iterate(design: Any, parameters: Any) -> None:
    design.objective(parameters.sample(1.0, True, 0))[0].backward()


def _beside_s(design: Any, parameters: Any, height: torch.Tensor) -> float:
    """Start, reference, yield curve, focus window of a lens, and report of one design."""
    from litho_design.lenses.bench import LensBench
    from litho_design.lenses.focus_window import focus_window

    seconds = _cpu_s(design.free_parameters)
    seconds += _cpu_s(lambda: design.reference_efficiency(height)) + _cpu_s(design.baselines)
    seconds += design.settings.window.yield_draws * _cpu_s(lambda: design.window_scores(height, 1))
    if isinstance(design.bench, LensBench):
        seconds += _cpu_s(lambda: focus_window(design.bench, height))
    return seconds + _REPORT_S


def _cpu_s(run: Callable[[], object]) -> float:
    started = time.process_time()
    run()
    return time.process_time() - started


def estimate(
    records: Mapping[tuple[str, str], Mapping[str, Any]], tasks: Sequence[Task], effort: Effort
) -> list[dict[str, Any]]:
    """Core minutes and peak memory of every part, on one thread."""
    steps = effort.training_steps
    trained = sum(steps * seconds for seconds in TRAINING_S.values()) + _SMALL_MODELS_S
    rows: list[dict[str, Any]] = [{"part": "prints, stores, training", "minutes": trained / 60}]
    for task in tasks:
        iterations = task.iterations
        optics = records[task.kind, "none"]
        judges = len(task.models) + len(task.judges)
        loaded = sum(records[task.kind, arm]["print_s"] for arm in task.models) + judges * optics["score_s"]
        for arm in task.models:
            cost = records[task.kind, arm]
            # The polish costs up to eleven evaluations with gradient more.
            search = (iterations + 11) * cost["iteration_s"] + iterations / 10 * cost["evaluation_s"]
            seconds = search + optics["beside_s"]
            rows.append(
                {
                    "part": f"{task.name}/{arm}",
                    "designs": task.seeds,
                    "iterations": iterations,
                    "iteration_s": cost["iteration_s"],
                    "minutes": task.seeds * (seconds + loaded) / 60,
                    "peak_gib": cost["peak_gib"],
                }
            )
    return rows


def read_records(out: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """All trials in a folder."""
    found = [json.loads(file.read_text(encoding="utf-8")) for file in sorted((out / "cost").glob("*.json"))]
    return {(record["kind"], record["arm"]): record for record in found}


def as_text(rows: Sequence[Mapping[str, Any]], workers: int) -> str:
    """The estimate as lines, with its total in hours."""
    lines = [f"{'part':34}{'designs':>8}{'iterations':>11}{'s/iteration':>12}{'peak GiB':>9}{'core min':>9}"]
    for row in rows:
        lines.append(
            f"{row['part']:34}{row.get('designs', ''):>8}{row.get('iterations', ''):>11}"
            f"{_figure(row.get('iteration_s')):>12}{_figure(row.get('peak_gib')):>9}{row['minutes']:>9.1f}"
        )
    minutes = sum(row["minutes"] for row in rows)
    highest = sorted((row.get("peak_gib", 0.0) for row in rows), reverse=True)[:workers]
    lines.append(
        f"estimate: {minutes / 60:.1f} core hours, about {minutes / 60 / workers:.1f} h with {workers} "
        f"worker(s); at most {sum(highest):.1f} GiB at once"
    )
    return "\n".join(lines)


def _record_file(out: Path, task: Task, arm: str) -> Path:
    return out / "cost" / f"{task.kind}-{arm}.json"


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _untrained(arm: str, folder: Path) -> Path:
    from litho_models import save_frozen
    from litho_models.models import build_model

    torch.manual_seed(0)
    return save_frozen(build_model(trained_as(arm)[0]), folder)


def _task(task: Task, source: str) -> tuple[Any, Any]:
    """The task with its printer, from the options that its commands get."""
    from litho_design.cli.options import option_paths
    from litho_design.holograms.settings import HologramSettings, hologram_settings
    from litho_design.holograms.task import HologramTask
    from litho_design.images.targets import load_target
    from litho_design.lenses.settings import LensSettings, lens_settings
    from litho_design.lenses.task import lens_task
    from litho_design.printers.source import load_printer

    options = dict(zip(task.options[::2], task.options[1::2], strict=True))
    target = options.pop("--target", "")
    paths = option_paths(HologramSettings() if task.kind == "hoe" else LensSettings())
    changes = {paths[name]: value for name, value in options.items()}
    if task.kind == "hoe":
        hologram = hologram_settings(changes=changes)
        wanted = load_target(target, hologram.layout.size_px)
        return HologramTask(hologram, load_printer(source, hologram.layout), wanted), hologram
    lens = lens_settings(task.kind, changes=changes)  # type: ignore[arg-type]
    return lens_task(lens, load_printer(source, lens.layout)), lens
