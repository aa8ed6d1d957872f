"""Test a user-defined task: the example runs from design to score, and its parts work."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import litho_design
from litho_data.foundation.errors import InputError
from litho_design import Task, compare, design, design_settings, load_design, register_task, score
from litho_design.cli.app import main
from litho_design.judging.gap import GapResult
from litho_design.optics import Optics, RSPropagator, centred_grid
from litho_design.printers.printer import Printer
from litho_design.tasks import task as task_module
from litho_design.tasks.bench import ElementBench

ROOT = Path(__file__).parents[2]
TINY = {
    "layout.size_px": 64,
    "optics.distance_um": 8,
    "search.iterations": 12,
    "search.polish_rounds": 1,
    "window.defocus_sd_um": 0.5,
    "window.yield_draws": 10,
}


@register_task
class Corner(Task):
    """Send light into one corner at two angles of incidence."""

    name = "corner"

    def views(self, optics):
        return [optics.model_copy(update={"incidence_x": sine}) for sine in (0.0, 0.1)]

    def loss(self, seen):
        return 1 - seen[:, :20, :20].sum((1, 2)).min()

    def figures(self, seen):
        return {"worst": float(seen[:, :20, :20].sum((1, 2)).min())}


def test_the_example_designs_compares_exports_and_scores(tmp_path, monkeypatch, capsys):
    """Check that the example has at most fifteen lines, and that it gets a yield and a report as built-in
    tasks do.
    """
    text = (ROOT / "examples" / "own_task.py").read_text("utf-8")
    body = text.split("class ColoursInPlanes")[1].split("def spots")[0].splitlines()
    assert len([line for line in body if line.strip() and '"""' not in line]) <= 15
    out = tmp_path / "rgb"
    # A yield of a hundred prints would take longer than everything else.
    few = {"window.yield_draws": 2}
    monkeypatch.setattr(litho_design, "design_settings", lambda changes: design_settings(changes | few))
    known = dict(task_module._TASKS)
    monkeypatch.setattr(task_module, "_TASKS", known)
    words = ["zoo:physics", "--out", str(out), "--size-px", "64", "--iterations", "6"]
    monkeypatch.setattr(sys, "argv", ["own_task.py", *words])
    runpy.run_path(str(ROOT / "examples" / "own_task.py"), run_name="__main__")
    del known["colours-in-planes"]
    assert "designed with model" in capsys.readouterr().out
    assert list((out / "to-printer").glob("*.png"))
    result = GapResult.read(out)
    assert result.task == "colours-in-planes"
    assert {entry.judge for entry in result.entries} == {"none", "model"}
    place = out / "designs" / "model" / "seed0"
    # Yield and images are written as for holograms and lenses.
    assert "worst_on_spots" in (place / "window.csv").read_text("utf-8")
    assert np.load(place / "image_share.npy").shape == (9, 64, 64)
    with pytest.raises(InputError, match=r"colours-in-planes.*register_task"):
        load_design(place)


def test_the_command_scores_a_design_of_an_own_task(tmp_path, monkeypatch, capsys, refused):
    """Check that ``--plugin`` loads the task. Also check the messages if the option is missing or if the file
    fails.
    """
    file, out = tmp_path / "far_corner.py", tmp_path / "design"
    file.write_text(
        "import litho_design\n@litho_design.register_task\nclass FarCorner(litho_design.Task):\n"
        "    name = 'far-corner'\n"
        "    def loss(self, seen): return 1 - seen[0, 16:, 16:].sum()\n"
        "    def figures(self, seen): return {'corner': float(seen[0, 16:, 16:].sum())}\n"
    )
    known = dict(task_module._TASKS)
    monkeypatch.setattr(task_module, "_TASKS", known)
    exec(compile(file.read_text(), str(file), "exec"), {"__name__": "far_corner"})
    settings = design_settings(
        TINY
        | {"layout.size_px": 32, "search.iterations": 1, "search.polish_rounds": 0, "window.yield_draws": 2}
    )
    made = design(known["far-corner"], "none", out, settings=settings, announce=False)
    del known["far-corner"]
    words = ["score", out, "--judge", "none", "--out", tmp_path / "score"]
    assert "--plugin" in refused(*words)
    failing = tmp_path / "failing.py"
    failing.write_text("1 / 0")
    assert "ZeroDivisionError" in refused(*words, "--plugin", failing)
    monkeypatch.setattr(sys, "argv", ["litho-design", *map(str, words), "--plugin", str(file)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    assert f"corner {made.predicted['corner']:.4f}" in capsys.readouterr().out


def test_search_improves_an_own_loss_and_resumes_only_the_same_task(tmp_path):
    settings = design_settings(TINY)
    made = design(Corner, "none", tmp_path, settings=settings, announce=False)
    assert made.polished_loss == pytest.approx(1 - made.predicted["worst"], abs=1e-5)
    assert made.polished_loss < made.start_loss - 0.1
    flat = made.baselines["no element"]["worst"]
    # A flat plate leaves the light in place or shifts it out of the corner, which has 20 x 20 of 64 x 64
    # pixels.
    assert 0 < flat < 400 / 4096
    assert made.predicted["worst"] > 2 * flat
    judged = score(tmp_path, tmp_path.with_name("s"), judges=["none"]).scores[0]
    assert judged.figures == pytest.approx(made.predicted, rel=1e-5)
    assert design(Corner, "none", tmp_path, settings=settings, announce=False) == made
    other = {"inputs": {"another": np.zeros(3)}}
    with pytest.raises(InputError, match="other settings"):
        design(Corner, "none", tmp_path, settings=settings, announce=False, **other)


def test_robust_and_ensemble_losses_serve_an_own_task(tmp_path, make_printer):
    settings = design_settings(TINY | {"search.iterations": 2, "window.samples": 2, "window.gain_sd": 0.05})
    printers = [make_printer(settings.layout), make_printer(settings.layout, sigma_um=0.3, name="other")]
    made = design(
        Corner, printers[0], tmp_path, settings=settings, judges=printers[1:], robust=True, announce=False
    )
    assert made.width.searched_with == 2
    task = Corner(settings, printers[0], ensemble=printers[1:])
    level = torch.from_numpy(load_design(tmp_path).level.numpy())[None, None].float()
    assert float(task.objective(level)[0]) == pytest.approx(made.polished_loss, rel=1e-4)


def test_an_oblique_wave_goes_where_its_angle_says():
    """Check light at an angle of incidence whose sine is s. The shadow shifts by z tan(asin s) and has the
    phase of a tilted plane wave.
    """
    layout = Printer(None, design_settings(TINY).layout, source="none").layout
    sine, distance_um = 0.3, 10.0
    bench = ElementBench(layout, Optics(distance_um=distance_um, incidence_x=sine))
    seen = bench(torch.zeros(64, 64)).double()
    x = torch.from_numpy(bench.grid.x_um)
    centroid = float((seen.sum(0) * x).sum() / seen.sum())
    straight = ElementBench(layout, Optics(distance_um=distance_um))(torch.zeros(64, 64)).double()
    # The window truncates the shifted square, so compare with the direct sum over a wider window.
    wide = centred_grid((64, 192), 0.1)
    k = 2 * np.pi / 0.6328
    wave = torch.exp(1j * k * sine * x)[None, :].expand(64, 64) / 6.4
    propagate = RSPropagator(centred_grid((64, 64), 0.1), wide, distance_um, 0.6328, dtype=torch.complex128)
    share = propagate(wave.to(torch.complex128)).abs().square() * 0.01
    assert (share[:, 64:128] - seen).abs().max() < 1e-5 * share.max()
    where = float((share.sum(0) * torch.from_numpy(wide.x_um)).sum() / share.sum())
    assert where == pytest.approx(distance_um * np.tan(np.arcsin(sine)), abs=0.3)
    assert centroid > 0.5 > abs(float((straight.sum(0) * x).sum() / straight.sum()))


def test_a_second_task_of_one_name_is_refused():
    with pytest.raises(InputError, match="no other task"):
        register_task(type("Other", (Task,), {"name": "hoe"}))
    with pytest.raises(InputError, match="start"):
        compare(design_settings(TINY | {"search.start": "gs"}), {"none": "none"}, "nowhere", task=Corner)
