"""The large comparison: its budgets are equal, its designs are found again, its claims about the fab hold."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import torch
from typer.testing import CliRunner

from benchmarks.gap import paper_search
from benchmarks.gap.cost import estimate, read_records, run_trial
from benchmarks.gap.document import NAME, PAGE, RESULT_FILE, RESULTS
from benchmarks.gap.jobs import Job, run_commands
from benchmarks.gap.paper_picture import search_figure
from benchmarks.gap.paper_tables import FAB, MEASURED, NAMES
from benchmarks.gap.plan import ARMS, FROZEN_WITH, PRINT_KNOBS, Effort, model, open_plan
from benchmarks.gap.steps import model_jobs
from benchmarks.gap.tables import as_markdown
from benchmarks.gap.tasks import Task, chosen, tasks
from benchmarks.record import NOT_MEASURED, published
from litho_data.foundation.errors import InputError
from litho_data.foundation.workers import Workers
from litho_data.virtual_fab import KnobSetting, knob_rms_nm
from litho_data.virtual_fab.settings import Printer
from litho_data.virtual_fab.strength import default_fields
from litho_design.cli.app import app
from litho_design.judging.gap import GapEntry, paired_differences, summarise
from litho_design.lenses.settings import lens_settings
from litho_models import save_frozen
from litho_models.models import build_model

TINY = Effort.small(64)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRINT_KNOBS)
def test_every_hidden_effect_is_ten_nanometres(name):
    rms = knob_rms_nm(KnobSetting(name, PRINT_KNOBS[name], 0), default_fields(Printer(), 0), policy="full")
    # Strengths are stated with three digits and were searched to 1 %.
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


def test_a_trial_times_all_that_a_design_does(tmp_path):
    (task,) = (one for one in tasks(tmp_path, TINY, {}, None) if one.name == "hoe")
    run_trial(tmp_path, task, "none")
    record = read_records(tmp_path)["hoe", "none"]
    assert 0 < record["score_s"] < record["beside_s"]
    assert min(record["iteration_s"], record["evaluation_s"], record["print_s"]) > 0


def test_the_estimate_adds_up(tmp_path):
    planned = [task for task in tasks(tmp_path, Effort(), {}, None) if task.name == "lens-direct"]
    cost = {"iteration_s": 2.0, "evaluation_s": 1.0, "print_s": 3.0, "peak_gib": 1.0}
    cost |= {"beside_s": 30.0, "score_s": 4.0}
    records = dict.fromkeys([("direct", arm) for arm in ARMS], cost)
    rows = estimate(records, planned, Effort())
    # Search and polish, evaluations, what is beside it; a print by each arm, a score by each and the fab.
    prints, scores = len(ARMS), len(ARMS) + 1
    n, seeds = planned[0].iterations, planned[0].seeds
    expected = seeds * ((n + 11) * 2.0 + n / 10 * 1.0 + 30.0 + prints * 3.0 + scores * 4.0) / 60
    assert [row["minutes"] for row in rows[1:]] == pytest.approx([expected] * len(ARMS))


def test_the_model_of_a_closed_loop_is_an_arm_of_the_measured_task_only(tmp_path):
    zoo = {name: f"zoo/{name}" for name in ("physics", "fno", "pbl")}
    *others, measured = tasks(tmp_path, TINY, zoo, "loop/model")
    assert dict(measured.models) == {"none": "none", **zoo, "closed-loop": "loop/model"}
    assert all("closed-loop" not in task.models for task in others)
    assert "closed-loop" not in tasks(tmp_path, TINY, zoo, None)[-1].models


def test_a_page_with_some_of_the_tasks_is_not_published(tmp_path):
    options = ["--out", str(tmp_path / "gap"), "--tasks", "hoe", "--publish"]
    command = [sys.executable, "-m", "benchmarks.gap", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "--publish" in done.stderr
    assert not (tmp_path / "gap").exists()


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
    assert "| none | 16.000 → 12.000 ± 0.100 |" in text
    # 6 and 4 dB below the ceiling: the error is 10^(6/20) and 10^(4/20) times as large.
    assert "| 100 % |" in text
    assert "| 58 % |" in text
    assert "pbl is best" in text
    assert "over none +2.000 [-0.500, +4.500], which includes 0" in text


def test_the_page_quotes_the_committed_comparison():
    record = json.loads((RESULTS / RESULT_FILE).read_text("utf-8"))
    assert published(PAGE, NAME) == as_markdown(record)


def test_the_papers_search_and_ours_get_the_same_iterations_arms_and_judges(tmp_path):
    found = {task.name: task for task in paper_search.paper_tasks(tmp_path, TINY)}
    assert len(found) == 12
    for name, task in found.items():
        kind, search, iterations = name.rsplit("-", 2)
        other = found[f"{kind}-{'ours' if search == 'paper' else 'paper'}-{iterations}"]
        assert (task.models, task.judges, task.seeds) == (other.models, other.judges, other.seeds)
        assert task.iterations == int(iterations)
        assert ("--variant" in task.options) == (search == "paper")
        if kind != "hoe":
            # Both see as much of the focal plane.
            view = paper_search.SAME_VIEW[kind.removeprefix("lens-")]
            assert "--window-px" in view
            assert task.options[-len(view) :] == view
        if kind == "lens-computational":
            preset, given = lens_settings("computational", "paper"), " ".join(task.options)
            assert f"imaging.pixel_px={preset.imaging.pixel_px}" in given
            assert f"--object-px {preset.imaging.object_px}" in given
            assert f"--window-px {preset.view.window_px}" in given
        # A third of the iterations three times costs what all of them cost once.
        assert task.iterations * task.seeds == pytest.approx(1000, rel=2e-3)


def test_the_table_of_the_papers_search_says_what_is_not_made_and_who_leads(tmp_path):
    task = next(
        task for task in paper_search.paper_tasks(tmp_path, TINY) if task.name == "lens-direct-paper-333"
    )
    entries = [
        GapEntry(
            arm=arm, seed=seed, judge=judge, self_judged=False, rms_height_gap_um=0.0,
            designed={"cbr": 100.0}, judged={"cbr": 50.0 + seed + (20 if arm == "physics" else 0)},
        )
        for arm in task.models for judge in task.judges for seed in range(task.seeds)
    ]  # fmt: skip
    done = {
        "iterations": 333,
        "seeds": 3,
        "minutes": {"none": 1.2},
        "large_jump_share": {"none": 0.041, "physics": 0.013},
        "height_gap_nm": {"fab": {"none": 274.2, "physics": 141.9}},
        "summary": [item.model_dump() for item in summarise(entries)],
        "paired": [item.model_dump() for item in paired_differences(entries, ["cbr"])],
    }
    text = paper_search.as_markdown({"tasks": {task.name: done}})
    # Student's t of three seeds one apart: 4.30 · 1 / √3 = 2.5. The pairs differ by the same each time.
    assert "| none | fab | not made yet | not made yet | 100 → 51 ± 2 | not made yet |" in text
    assert "paper 333: none 1." in text
    assert "those expected, rms: paper 333: none 4.1 % and 274 nm, physics 1.3 % and 142 nm." in text
    # A task that has not been judged by all yet.
    fab = [item for item in done["summary"] if item["judge"] == "fab"]
    both = {task.name: done, "lens-direct-ours-333": {**done, "summary": fab}}
    assert "| 100 → 51 ± 2 | not made yet |" in paper_search.as_markdown({"tasks": both})
    lead = "physics is best in centre-to-background ratio. Its lead: over none +20 [+20, +20]"
    assert f"paper, 333: Printed by fab, {lead}; over fno" in text
    # Of the many measured printers the next arm only.
    assert f"paper, 333: Printed by measured-pbl, {lead}.\n" in text


def test_the_picture_of_the_papers_search_shows_every_seed():
    tasks = json.loads((RESULTS / paper_search.FILE_NAME).read_text("utf-8"))["tasks"]
    panels = [(name, judge) for name in NAMES.values() for judge in (FAB, *MEASURED)]
    axes = search_figure({"tasks": tasks}).axes
    assert len(axes) == len(panels)
    for (name, judge), panel in zip(panels, axes, strict=True):
        runs = [
            run
            for task, made in tasks.items() if task.startswith(f"{name}-")
            for run in made["of_each_seed"] if run["judge"] == judge
        ]  # fmt: skip
        # Two searches, each with three seeds and one, through four arms.
        assert len(runs) == 2 * (3 + 1) * 4
        shown = {float(x) for line in panel.lines for x in line.get_xdata()}
        assert shown == {run[when] for run in runs for when in ("designed", "judged")}
    lenses = {task: made for task, made in tasks.items() if task.startswith("lens-direct-paper")}
    assert len(search_figure({"tasks": lenses}).axes) == 1 + len(MEASURED)


def test_the_page_quotes_the_papers_search():
    text = published(PAGE, paper_search.NAME)
    file = RESULTS / paper_search.FILE_NAME
    record = json.loads(file.read_text("utf-8")) if file.exists() else None
    assert text == (NOT_MEASURED if record is None else paper_search.as_markdown(record))
