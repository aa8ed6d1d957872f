"""Test whole design runs: an unchanged model, resuming, the optimum of a small problem, and bad input."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.optics import Optics, RSPropagator, centred_grid, element_field, intensity_share
from litho_design.optimisation import search as search_module
from litho_design.optimisation.budget import Budget
from litho_design.optimisation.parameters import CellMap, make_parametrisation
from litho_design.optimisation.polish import polish_levels
from litho_design.optimisation.search import search_layout
from litho_design.optimisation.settings import SearchSettings
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.tasks import run as tasks_run
from litho_design.tasks.design import Design, read_array
from litho_design.workflows.design import design_hologram
from litho_design.workflows.score import score as score_design

pytestmark = pytest.mark.usefixtures("no_report")


@pytest.fixture
def target():
    return load_target("ring", 128)


@pytest.fixture
def tiny_settings(small_settings):
    """Return settings with a quarter of the pixels, for tests that do not depend on the image."""
    changes = {"layout": LayoutSettings(size_px=64), "optics": Optics(distance_um=12.0)}
    return small_settings.model_copy(update=changes)


@pytest.fixture
def tiny_target():
    return load_target("ring", 64)


def test_a_design_beats_its_start_and_leaves_the_model_alone(tmp_path, small_settings, make_printer, target):
    printer = make_printer(small_settings.layout)
    before = printer.weights_sha256()
    design = design_hologram(target, printer, tmp_path, settings=small_settings, announce=False)
    assert printer.weights_sha256() == before == design.printer.sha256
    assert all(p.grad is None and not p.requires_grad for p in printer.parameters())
    assert design.polished_loss <= design.argmax_loss < 0.5 * design.start_loss
    levels = read_array(tmp_path, "layout_level.npy")
    # Cells of 0.4 µm on a grid of 0.1 µm are 4 x 4 blocks of one level.
    blocks = levels.reshape(32, 4, 32, 4)
    assert (blocks == blocks[:, :1, :, :1]).all()
    assert levels.max() <= 12
    own = score_design(tmp_path, tmp_path / "score", judges=[printer]).scores[0]
    assert not own.independent
    # The same layout and model must give the stored expected height again.
    assert own.figures == pytest.approx(design.predicted, rel=1e-5)
    assert own.rms_height_difference_um == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("parametrisation", ["direct", "gumbel"])
def test_an_interrupted_run_ends_as_if_it_had_never_stopped(
    tmp_path, tiny_settings, make_printer, tiny_target, monkeypatch, parametrisation
):
    search = tiny_settings.search.model_copy(update={"parametrisation": parametrisation})
    settings = tiny_settings.model_copy(update={"search": search})
    whole = design_hologram(
        tiny_target, make_printer(settings.layout), tmp_path / "whole", settings=settings, announce=False
    )
    original, calls = HologramTask.objective, itertools.count()

    def stop_at_25(self, level):
        if next(calls) == 25:
            raise KeyboardInterrupt
        return original(self, level)

    monkeypatch.setattr(HologramTask, "objective", stop_at_25)
    with pytest.raises(KeyboardInterrupt):
        design_hologram(
            tiny_target, make_printer(settings.layout), tmp_path / "cut", settings=settings, announce=False
        )
    monkeypatch.setattr(HologramTask, "objective", original)
    assert (tmp_path / "cut" / "checkpoint.pt").exists()
    assert not (tmp_path / "cut" / "design.json").exists()
    resumed = design_hologram(
        tiny_target, make_printer(settings.layout), tmp_path / "cut", settings=settings, announce=False
    )
    assert resumed.files == whole.files
    assert resumed.predicted == whole.predicted


def test_a_resumed_search_counts_the_time_of_the_interrupted_ones(tmp_path, monkeypatch):
    layout, seconds = LayoutSettings(size_px=16), [0]
    monkeypatch.setattr(search_module, "time", SimpleNamespace(monotonic=lambda: seconds[0]))
    settings = SearchSettings(iterations=30, checkpoint_every=10, evaluate_every=1000)

    def objective(level):
        seconds[0] += 1
        if seconds[0] in (16, 33):
            raise KeyboardInterrupt
        return level.square().mean(), {}

    def run():
        return search_layout(make_parametrisation(layout, settings), objective, settings, folder=tmp_path)

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run()
    # Each objective takes one second, and each step needs one objective. Iteration 0 and the last one are
    # evaluated too. Checkpoints keep 11 s of the first run and 10 s of the second.
    assert run().earlier_seconds == 21


def test_a_damaged_checkpoint_is_refused(tmp_path, tiny_settings, make_printer, tiny_target, monkeypatch):
    def stopped(*given, **named):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("litho_design.tasks.run.polish_levels", stopped)
        with pytest.raises(KeyboardInterrupt):
            design_hologram(tiny_target, make_printer(tiny_settings.layout), tmp_path, settings=tiny_settings)
    (tmp_path / "checkpoint.pt").write_text("half a file")
    with pytest.raises(InputError, match=r"checkpoint\.pt.*damaged.*delete the file"):
        design_hologram(tiny_target, make_printer(tiny_settings.layout), tmp_path, settings=tiny_settings)


def test_a_checkpoint_cut_short_is_damaged_and_one_that_cannot_be_read_is_not(tmp_path):
    layout = LayoutSettings(size_px=16)

    def search():
        settings = SearchSettings(iterations=4, checkpoint_every=2)
        parameters = make_parametrisation(layout, settings)
        return search_layout(parameters, lambda level: (level.square().mean(), {}), settings, folder=tmp_path)

    search()
    checkpoint = tmp_path / "checkpoint.pt"
    whole = checkpoint.read_bytes()
    for kept in (0, 10, len(whole) // 2, len(whole) - 100, len(whole) - 1):
        checkpoint.write_bytes(whole[:kept])
        with pytest.raises(InputError, match="damaged"):
            search()
    checkpoint.unlink()
    checkpoint.mkdir()
    # The message does not advise deleting a file.
    with pytest.raises(IsADirectoryError):
        search()


@pytest.mark.parametrize("where", ["score", "write_design_report"])
def test_a_run_stopped_after_its_arrays_goes_on_without_a_checkpoint(
    tmp_path, tiny_settings, make_printer, tiny_target, monkeypatch, where
):
    """Check a run with fewer iterations than the interval of checkpoints.

    It is stopped after writing the arrays, before writing the record.
    """
    search = tiny_settings.search.model_copy(update={"iterations": 4, "checkpoint_every": 50})
    settings = tiny_settings.model_copy(update={"search": search})

    def stopped(*given, **named):
        raise KeyboardInterrupt

    def design(folder):
        return design_hologram(
            tiny_target, make_printer(settings.layout), folder, settings=settings, announce=False
        )

    with monkeypatch.context() as patch:
        if where == "score":
            patch.setattr(HologramTask, "score", stopped)
        else:
            patch.setattr("litho_design.workflows.design.write_design_report", stopped)
        with pytest.raises(KeyboardInterrupt):
            design(tmp_path / "cut")
    assert (tmp_path / "cut" / "layout_level.npy").exists()
    assert not (tmp_path / "cut" / "design.json").exists()
    assert design(tmp_path / "cut").files == design(tmp_path / "whole").files
    assert not (tmp_path / "cut" / "begun.json").exists()


def test_a_model_that_changes_while_it_prints_is_refused_without_a_design(
    tmp_path, tiny_settings, make_printer, tiny_target
):
    search = tiny_settings.search.model_copy(update={"iterations": 2, "polish_rounds": 0})
    settings = tiny_settings.model_copy(update={"search": search})
    printer = make_printer(settings.layout)
    simulate = printer.simulator.forward

    def forward(layout_um, pitch_um=0.1):
        printer.simulator.kernel += 1e-6
        return simulate(layout_um, pitch_um)

    printer.simulator.forward = forward
    with pytest.raises(InputError, match=r"^model blur, got weights or buffers that changed"):
        design_hologram(tiny_target, printer, tmp_path, settings=settings, announce=False)
    assert not (tmp_path / "design.json").exists()


@pytest.mark.long
def test_a_killed_command_resumes_to_the_same_layout(tmp_path):
    def command(out):
        return [
            *(sys.executable, "-c", "from litho_design.cli.app import main; main()"),
            *("hoe", "--model", "none", "--target", "ring", "--out", str(out)),
            *("--size-px", "128", "--distance-um", "30", "--iterations", "250"),
        ]

    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    cut = subprocess.Popen(command(tmp_path / "cut"), env=environment, stderr=subprocess.DEVNULL)
    checkpoint = tmp_path / "cut" / "checkpoint.pt"
    deadline = time.monotonic() + 60
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    cut.send_signal(signal.SIGKILL)
    cut.wait()
    assert checkpoint.exists()
    told = {
        name: subprocess.run(
            command(tmp_path / name), env=environment, check=True, capture_output=True
        ).stderr
        for name in ("cut", "whole")
    }
    assert b"estimate: 250 iterations" in told["whole"]
    assert b"more iterations" in told["cut"]
    assert Design.read(tmp_path / "cut").files == Design.read(tmp_path / "whole").files


def test_the_estimate_of_a_resumed_run_omits_finished_iterations():
    budget = Budget(seconds_per_iteration=2.0, seconds_per_evaluation=1.0, peak_memory_gib=0.5)
    search = SearchSettings(iterations=100, polish_rounds=5, evaluate_every=10)
    # The 40 iterations and 5 rounds of polish take 2 s each, and the 4 evaluations 1 s each.
    assert "40 more iterations" in budget.sentence(search, done=60)
    assert "about 1.6 min" in budget.sentence(search, done=60)
    assert "100 iterations" in budget.sentence(search)
    # The estimate includes the work after the search, so it is 94 s + 146 s.
    assert "about 4.0 min" in budget.sentence(search, 60, 146.0)


def test_the_estimate_after_a_search_counts_each_draw_and_print(
    tiny_settings, make_printer, tiny_target, monkeypatch
):
    """Check the estimate with a clock that advances by 2 s per print and by 0.5 s per draw of the yield."""
    printer = make_printer(tiny_settings.layout)
    task = HologramTask(tiny_settings, printer, inputs={"target": tiny_target.pixels}, ensemble=[printer])
    now = [0.0]

    def takes(seconds, run):
        def timed(*given):
            now[0] += seconds
            return run(*given)

        return timed

    monkeypatch.setattr(tasks_run, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(Printer, "forward", takes(2.0, Printer.forward))
    monkeypatch.setattr(task, "window_scores", takes(0.5, task.window_scores))
    parameters = task.free_parameters()
    level = parameters.cells(parameters.best_levels())
    draws = tiny_settings.window.yield_draws
    # Two layouts are printed and scored, each by two models.
    after_s = tasks_run._seconds_after(task, level)
    assert after_s == pytest.approx(2 * 2 * 2.0 + (draws + 2 * 2) * 0.5 + tasks_run._PAGE_S)


def test_a_finished_folder_is_reused_and_a_foreign_one_refused(
    tmp_path, tiny_settings, make_printer, tiny_target
):
    search = tiny_settings.search.model_copy(update={"iterations": 2, "polish_rounds": 0})
    settings = tiny_settings.model_copy(update={"search": search})
    printer = make_printer(settings.layout)
    first = design_hologram(tiny_target, printer, tmp_path, settings=settings, announce=False)
    assert design_hologram(tiny_target, printer, tmp_path, settings=settings, announce=False) == first
    other = settings.model_copy(update={"search": search.model_copy(update={"seed": 1})})
    with pytest.raises(InputError, match="other settings"):
        design_hologram(tiny_target, printer, tmp_path, settings=other, announce=False)
    changed = np.load(tmp_path / "layout_level.npy") + 1
    np.save(tmp_path / "layout_level.npy", changed)
    with pytest.raises(InputError, match="changed after the design"):
        score_design(tmp_path, tmp_path / "score", judges=[printer])


def test_a_robust_design_is_not_taken_for_a_plain_one(tmp_path, tiny_settings, make_printer, tiny_target):
    search = tiny_settings.search.model_copy(update={"iterations": 2, "polish_rounds": 0})
    settings = tiny_settings.model_copy(update={"search": search})
    own, judge = make_printer(settings.layout), make_printer(settings.layout, sigma_um=0.3, name="wide")
    given = {"settings": settings, "judges": [judge], "announce": False}
    assert design_hologram(tiny_target, own, tmp_path, **given).width.searched_with == 1
    with pytest.raises(InputError, match=r"other settings \(fingerprint"):
        design_hologram(tiny_target, own, tmp_path, robust=True, **given)


def test_a_judge_with_the_name_of_the_designs_model_does_not_replace_it(
    tiny_settings, make_printer, tiny_target
):
    """Check that the range of the scores does not depend on the names of the models."""
    level = torch.randint(0, 13, (64, 64), generator=torch.Generator().manual_seed(0))
    own = make_printer(tiny_settings.layout)

    def width(name):
        task = HologramTask(tiny_settings, own, inputs={"target": tiny_target.pixels})
        other = make_printer(tiny_settings.layout, sigma_um=0.3, name=name)
        # A model that is given twice counts once.
        task.judges = [other, own]
        return tasks_run.best_layout(task, level)[1]

    apart, same = width("wide"), width("blur")
    assert same.values().tolist() == apart.values().tolist()
    assert same.returned == apart.returned
    assert [*same.level_heights_um] == ["blur", "blur (closed form)"]


def test_the_search_finds_the_true_optimum_of_a_toy():
    # With 2 x 2 cells of 2 x 2 px and 12 levels, all 20736 layouts can be computed by superposing cells.
    layout = LayoutSettings(size_px=4, pitch_um=0.3, cell_um=0.6, levels=12)
    optics = Optics(distance_um=5.0)
    grid = centred_grid((4, 4), 0.3)
    window = centred_grid((12, 12), 0.3)
    signal = torch.zeros(12, 12)
    signal[2:5, 6:10] = 1
    propagate = RSPropagator(grid, window, optics.distance_um, optics.wavelength_um)
    cells = CellMap(layout)

    def objective(level):
        share = intensity_share(propagate(element_field(level[0, 0] * 0.1, grid, optics)), window)
        return 1 - (share * signal).sum(), {}

    shutter = cells(torch.eye(4).reshape(4, 2, 2)).to(torch.complex64) / (4 * 0.3)
    waves = propagate(shutter).flatten(1)[:, signal.flatten() > 0]
    combinations = torch.cartesian_prod(*[torch.arange(12)] * 4)
    phases = torch.polar(torch.ones(()), combinations * (0.2 * torch.pi / optics.wave_height_um))
    efficiency = (phases @ waves).abs().square().sum(1) * 0.3**2
    best = float(efficiency.max())
    assert best > 1.5 * float(efficiency.mean())
    for parametrisation, seed in itertools.product(("direct", "gumbel"), range(3)):
        settings = SearchSettings(iterations=60, parametrisation=parametrisation, seed=seed)
        parameters = make_parametrisation(layout, settings)
        parameters.start_random(seed)
        state = search_layout(parameters, objective, settings)
        levels = state.best_levels
        # The search alone, without polish, comes close from every start.
        assert 1 - state.best_loss >= 0.95 * best
        polished, losses = polish_levels(levels, cells, objective, level_count=12, rounds=10)
        assert losses == sorted(losses, reverse=True)
        index = int((combinations == polished.flatten()).all(1).nonzero())
        # The value from the list and the objective are computed in different ways and must agree.
        assert float(efficiency[index]) == pytest.approx(1 - losses[-1], abs=1e-5)


def test_polish_of_many_cells_never_raises_the_loss(small_settings, make_printer, target):
    task = HologramTask(small_settings, make_printer(small_settings.layout), inputs={"target": target.pixels})
    cells = CellMap(small_settings.layout)
    levels = torch.randint(0, 13, (32, 32), generator=torch.Generator().manual_seed(0))
    polished, losses = polish_levels(levels, cells, task.objective, level_count=13, rounds=15)
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < 0.95 * losses[0]
    assert int(polished.min()) >= 0
    assert int(polished.max()) <= 12
    assert float(task.objective(cells(polished)[None, None].float())[0]) == pytest.approx(
        losses[-1], rel=1e-5
    )


def test_the_printer_none_prints_nominal_heights_and_a_guard_ring_isolates_the_element(
    small_settings, make_printer
):
    layout = small_settings.layout
    level = torch.randint(0, 13, (1, 1, 128, 128)).float()
    assert torch.equal(Printer(None, layout, source="none")(level), level * layout.level_height_um)
    # The block is uniform. Its corner has substrate on two sides, so a quarter of the Gaussian remains.
    block = torch.full((1, 1, 128, 128), 10.0)
    printed = make_printer(layout, sigma_um=0.2, gain=1.0, offset_um=0.0)(block)
    half = float(torch.erf(torch.tensor(0.05 / (0.2 * 2**0.5)))) / 2 + 0.5  # pixel centre is 0.05 µm inside
    assert float(printed[0, 0, 0, 0]) == pytest.approx(half**2, abs=0.01)
    assert float(printed[0, 0, 64, 64]) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: load_target(t, 100), "size of the element"),
        (lambda t: t * 0, "no light"),
        (lambda t: t * 2, r"\[0, 1\]"),
        (lambda t: np.where(t > 0, np.nan, t), r"\[0, 1\]"),
        (lambda t: t * 0 + 1, "100 % of its pixels"),
        (lambda t: t * 0.4, "0 % of its pixels"),
    ],
)
def test_bad_targets_are_refused_before_anything_is_written(tmp_path, small_settings, target, spoil, message):
    printer = Printer(None, small_settings.layout, source="none")
    with pytest.raises(InputError, match=message):
        design_hologram(
            spoil(target.pixels), printer, tmp_path / "out", settings=small_settings, announce=False
        )
    assert not (tmp_path / "out").exists()


def test_a_hologram_smaller_than_the_window_of_its_score_is_refused(small_settings):
    settings = small_settings.model_copy(update={"layout": LayoutSettings(size_px=8)})
    with pytest.raises(InputError, match="at least 11"):
        design_hologram(
            load_target("ring", 8),
            Printer(None, settings.layout, source="none"),
            "nowhere",
            settings=settings,
        )


def test_a_place_that_holds_something_else_is_refused(tmp_path, tiny_settings, make_printer, tiny_target):
    search = tiny_settings.search.model_copy(update={"iterations": 1, "polish_rounds": 0})
    settings = tiny_settings.model_copy(update={"search": search})
    printer = make_printer(settings.layout)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="which is a file"):
        design_hologram(tiny_target, printer, tmp_path / "file", settings=settings, announce=False)
    design_hologram(tiny_target, printer, tmp_path / "design", settings=settings, announce=False)
    report = (tmp_path / "design" / "report.html").read_bytes()
    # Both write a report.html, so the score would replace the report of the design.
    with pytest.raises(InputError, match=r"which holds design\.json"):
        score_design(tmp_path / "design", tmp_path / "design", judges=[printer])
    assert (tmp_path / "design" / "report.html").read_bytes() == report
    score_design(tmp_path / "design", tmp_path / "design" / "score", judges=[printer])
    with pytest.raises(InputError, match=r"which holds score\.json"):
        design_hologram(
            tiny_target, printer, tmp_path / "design" / "score", settings=settings, announce=False
        )
    with pytest.raises(InputError, match="device"):
        score_design(tmp_path / "design", tmp_path / "other", judges=[], device="cuda:99")
