"""Test the large comparison: equal budgets, reuse of finished designs, and its tables and conclusions."""

from __future__ import annotations

import json
import sys
from itertools import pairwise

import pytest
import torch
from typer.testing import CliRunner

from benchmarks.gap.__main__ import main
from benchmarks.gap.document import PAGE, RESULT_FILE, RESULTS
from benchmarks.gap.jobs import Job, run_commands
from benchmarks.gap.plan import ARMS, FROZEN_WITH, PRINT_KNOBS, Effort, model, open_plan
from benchmarks.gap.steps import model_jobs
from benchmarks.gap.tables import as_markdown
from benchmarks.gap.tasks import FAB, KINDS, MEASURED, REDUCED, Task, chosen, require_whole_parts, tasks
from benchmarks.record import published
from litho_data.foundation.errors import InputError
from litho_data.sharing.workers import Workers
from litho_data.virtual_fab import KnobSetting, knob_rms_nm
from litho_data.virtual_fab.settings import Printer
from litho_data.virtual_fab.strength import default_fields
from litho_design.cli.app import app
from litho_models import save_frozen
from litho_models.models import build_model

TINY = Effort.small(64)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRINT_KNOBS)
def test_every_hidden_effect_has_an_rms_of_ten_nanometres(name):
    rms = knob_rms_nm(KnobSetting(name, PRINT_KNOBS[name], 0), default_fields(Printer(), 0))
    # Strengths were searched to 1 % and are stated with three digits.
    assert rms == pytest.approx(10.0, rel=0.02)


def test_every_arm_has_the_same_budget(tmp_path):
    for task in tasks(tmp_path, Effort(), {}, None):
        settings = set()
        for job in task.designs(tmp_path):
            words = list(job.command)
            for option in ("--model", "--out", "--seed"):
                del words[(at := words.index(option)) : at + 2]
            settings.add(tuple(words))
        assert len(settings) == 1
        assert len(task.designs(tmp_path)) == task.seeds * len(task.models)
        assert task.iterations <= (300 if task.kind == "hoe" else 200)
        assert task.name == "hoe-measured" or tuple(task.models) == ARMS


def test_another_part_of_a_model_is_frozen_from_the_same_run(tmp_path):
    train, freeze, test = model_jobs(tmp_path, TINY)
    assert len(train) == len(ARMS) - 1 - len(FROZEN_WITH)
    assert len(freeze) == len(test) == len(ARMS) - 1
    commands = {job.name: " ".join(job.command) for job in freeze}
    for arm, (name, told) in FROZEN_WITH.items():
        assert commands[f"freeze-{arm}"] == commands[f"freeze-{name}"].replace(
            f"--out {model(tmp_path, name)}", f"{' '.join(told)} --out {model(tmp_path, arm)}"
        )


def test_tasks_are_chosen_by_name(tmp_path):
    every = tasks(tmp_path, TINY, {}, None)
    assert chosen(every, None) == every
    assert [task.name for task in chosen(every, "lens-direct,hoe")] == ["hoe", "lens-direct"]
    with pytest.raises(InputError, match="lens-direct"):
        chosen(every, "lens")


@pytest.mark.parametrize("kind", ["hoe", pytest.param("lens-computational", marks=pytest.mark.long)])
def test_compare_judges_the_designs_that_single_commands_made(tmp_path, kind):
    torch.manual_seed(0)
    folder = save_frozen(build_model("affine"), tmp_path / "affine")
    planned = next(task for task in tasks(tmp_path, TINY, {}, None) if task.name == kind)
    models = {"none": "none", "affine": str(folder)}
    task = Task(planned.name, planned.kind, planned.options, models, {}, seeds=1)

    def call(job: Job) -> None:
        result = CliRunner().invoke(app, list(job.command[1:]), catch_exceptions=False)
        assert result.exit_code == 0, result.output
        assert job.done

    for job in task.designs(tmp_path):
        call(job)
    written = {job.name: job.result.stat().st_mtime_ns for job in task.designs(tmp_path)}
    call(task.compare(tmp_path))
    assert {job.name: job.result.stat().st_mtime_ns for job in task.designs(tmp_path)} == written


def test_a_folder_holds_one_comparison(tmp_path):
    assert open_plan(tmp_path, TINY, None) == open_plan(tmp_path, TINY, None)
    with pytest.raises(InputError, match="other settings"):
        open_plan(tmp_path, Effort(), None)


def test_finished_jobs_are_skipped_and_failed_ones_are_named(tmp_path):
    def job(name, code):
        return Job(name, (sys.executable, "-c", code), tmp_path / name)

    touch = "import pathlib, sys; pathlib.Path({!r}).write_text(sys.argv[0])"
    good = job("good", touch.format(str(tmp_path / "good")))
    run_commands([good], tmp_path / "logs", Workers(2))
    before = good.result.stat().st_mtime_ns
    with pytest.raises(InputError, match="bad"):
        run_commands([good, job("bad", "raise SystemExit(1)")], tmp_path / "logs", Workers(2))
    assert good.result.stat().st_mtime_ns == before
    with pytest.raises(InputError, match="silent"):
        run_commands([job("silent", "")], tmp_path / "logs")


def test_the_model_of_a_closed_loop_is_an_arm_of_the_measured_task_only(tmp_path):
    zoo = {name: f"zoo/{name}" for name in ("physics", "fno", "pbl", "random-features")}
    by_name = {task.name: task.models for task in tasks(tmp_path, TINY, zoo, "loop/model")}
    assert dict(by_name.pop("hoe-measured")) == {"none": "none", **zoo, "closed-loop": "loop/model"}
    assert all("closed-loop" not in models for models in by_name.values())
    assert all("closed-loop" not in task.models for task in tasks(tmp_path, TINY, zoo, None))


def test_a_reduced_task_has_the_same_geometry_and_more_seeds(tmp_path):
    by_name = {task.name: task for task in tasks(tmp_path, Effort(), {}, None)}
    reduced = {name for name in by_name if name.endswith(REDUCED)}
    assert reduced == {f"{name}{REDUCED}" for name in KINDS}
    for name in KINDS:
        full, small = (dict(pairwise(by_name[one].options)) for one in (name, f"{name}{REDUCED}"))
        # The side and the distance become smaller together, so the aperture stays the same.
        for option in ("--size-px", "--distance-um"):
            assert float(small.pop(option)) == float(full.pop(option)) / 4
        assert [word for word in small if word.startswith("--")] == [
            word for word in full if word.startswith("--")
        ]
        assert by_name[f"{name}{REDUCED}"].seeds == 10


def test_a_page_with_some_of_the_tasks_is_not_published(tmp_path, monkeypatch, capsys):
    options = ["--out", str(tmp_path / "gap"), "--tasks", "hoe", "--publish"]
    monkeypatch.setattr(sys, "argv", ["gap", *options])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert "--publish" in capsys.readouterr().err
    assert not (tmp_path / "gap").exists()
    every = tasks(tmp_path, TINY, {}, None)
    for whole in ("hoe,lens-direct,lens-computational", "hoe-measured", None):
        require_whole_parts(every, chosen(every, whole))


def test_the_tables_name_the_winner_and_what_is_undecided():
    def row(arm, designed, judged, half):
        return {
            "task": "hoe", "arm": arm, "judge": "fab", "figure": "si_psnr_db", "seeds": 3,
            "designed": designed, "judged": judged, "low": judged - half, "high": judged + half,
        }  # fmt: skip

    rows = [row("none", 16.0, 12.0, 0.1), row("pbl", 15.0, 14.0, 0.2)]
    rows += [{**item, "figure": name} for item in rows for name in ("ssim", "eff_signal")]
    pair = {"judge": "fab", "figure": "si_psnr_db", "arm": "pbl", "against": "none", "mean": 2.0}
    record = {
        "plan": {"effort": Effort().model_dump(), "print_knobs": PRINT_KNOBS},
        "training_scans": 20,
        "models": {"pbl": {"offset": 20.0, "full": 17.0}},
        "tasks": {
            "hoe": {
                "target": "text", "iterations": 100, "seeds": [0, 1, 2],
                "minutes": {"none": 1.0, "pbl": 9.0}, "paired": [{**pair, "ci95": [-0.5, 4.5]}],
                "ceiling": {"si_psnr_db": 18.0, "ssim": 0.9, "eff_signal": 0.5},
            }
        },
        "summary": rows,
    }  # fmt: skip
    text = as_markdown(record)
    # The locked scans are not used.
    assert "trained on 20 of 24 scans" in text
    assert "| none | 16.000 → 12.000 ± 0.100 |" in text
    # The scores are 6 and 4 dB below the ceiling, so errors are 10^(6/20) and 10^(4/20) times as large.
    assert "| 100 % |" in text
    assert "| 58 % |" in text
    assert "those designed with pbl have the best" in text
    assert "2.000 (-0.500 to 4.500, which includes 0) than without a model" in text
    # A task at reduced size, with more seeds, names the best arm in its place.
    pairs = [{**pair, "mean": 3.0, "ci95": [2.0, 4.0]}]
    record["tasks"]["hoe-reduced"] = {**record["tasks"]["hoe"], "seeds": [*range(10)], "paired": pairs}
    record["summary"] = [*rows, *({**item, "task": "hoe-reduced"} for item in rows)]
    text = as_markdown(record)
    assert "elements 0.25 times as wide and 10 seeds" in text
    assert "3.000 (2.000 to 4.000) than without a model" in text
    assert "includes 0" not in text


@pytest.mark.parametrize("part", [FAB, MEASURED])
def test_the_page_quotes_the_committed_comparison(part):
    record = json.loads((RESULTS / part / RESULT_FILE).read_text("utf-8"))
    assert published(PAGE, f"gap-{part}") == as_markdown(record)
