"""The speed benchmarks compare like with like, and their page quotes what was measured."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from benchmarks import speed
from benchmarks.plain_pbl import PlainPbl
from benchmarks.record import NOT_MEASURED, published
from benchmarks.side_by_side import _MATRIX, PAGE, RESULTS, as_markdown, relative_percent
from benchmarks.speed import COMPARISONS, areawise_gflop, gradient_gflop, random_layout
from litho_models.frozen.files import save_frozen
from litho_models.models import build_model
from litho_models.simulator import crop_border

pytestmark = pytest.mark.numerics

# What the plain version has: the chain alone.
CHAIN = {"surroundings": None, "scan_axis": None, "transposable": False}


def make_pbl(**fields):
    torch.manual_seed(0)
    model = build_model(
        "pbl",
        pointwise_channels=(16, 8),
        areawise_channels=(8, 8),
        sigma_diffusion_init_um=0.3,
        **CHAIN,
        **fields,
    )
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


@pytest.mark.parametrize("device", ["", "_gpu"])
@pytest.mark.parametrize("task", COMPARISONS)
def test_the_page_quotes_the_committed_measurement(task, device):
    name = task + device
    text = published(PAGE, name)
    record = RESULTS / f"{name}.json"
    if not record.exists():
        assert text == NOT_MEASURED
        return
    assert text == as_markdown(json.loads(record.read_text(encoding="utf-8")))


def test_the_plain_model_is_the_same_function_with_the_same_gradients():
    # Without knots ours is exact too.
    ours = make_pbl(knots=0)
    plain = PlainPbl(ours)
    layout_um = random_layout(ours.config, 3 * ours.reach_px + 20)
    weight = torch.zeros_like(layout_um)
    weight[..., ours.reach_px : -ours.reach_px, ours.reach_px : -ours.reach_px] = 1
    heights, gradients = [], []
    for model in (ours, plain):
        given = layout_um.clone().requires_grad_()
        height = model(given)
        (weight * height.square()).sum().backward()
        heights.append(crop_border(height.detach(), ours.reach_px))
        gradients.append([given.grad, model.tau.grad, next(model.mismatch.parameters()).grad])
    # Fourier transforms and sums in float32: some 1e-6 of heights of 1 µm.
    assert torch.allclose(*heights, rtol=0, atol=1e-5)
    for a, b in zip(*gradients, strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-4


def test_the_work_of_the_published_network_is_counted():
    # 9 · (64 + 64·64 + 64·32 + 32·32 + 32) multiply-adds per pixel.
    config = build_model("pbl", "paper").config
    assert areawise_gflop(config, 1_000_000) == pytest.approx(2 * 9 * 7264 / 1000)
    assert gradient_gflop(config, "mixed", 10) == {
        "float32": areawise_gflop(config, 100),
        "bfloat16": areawise_gflop(config, 100),
    }


def test_relative_differences_are_of_root_mean_squares():
    assert relative_percent(np.array([0.3, -0.3]), np.array([3.0, 3.0])) == pytest.approx(10)


@pytest.mark.long
@pytest.mark.parametrize(("task", "size_px"), [("train_step", 128), ("predict", 160), ("hoe_iteration", 160)])
def test_each_benchmark_measures_all_its_sides(task, size_px, tmp_path, monkeypatch):
    model = save_frozen(make_pbl(), tmp_path / "pbl")
    out = tmp_path / "out.json"
    # Without a bfloat16 unit one product of the usual size takes minutes.
    monkeypatch.setitem(_MATRIX, "cpu", 128)
    options = ["--model", str(model), "--size-px", str(size_px), "--repeats", "1", "--threads", "1"]
    monkeypatch.setattr("sys.argv", ["speed", task, *options, "--out", str(out)])
    speed.main()
    record = json.loads(out.read_text())
    rows = {row["side"]: row for row in record["sides"]}
    assert tuple(rows) == COMPARISONS[task].sides
    assert rows["plain"]["faster"] == 1
    for row in rows.values():
        assert 0 < row["best_s"] <= row["median_s"]
        assert 0 < row["peak_gib"] < 4
    # Knots resolve a network of this size to some hundredths of a nanometre.
    assert 0 < rows["float32"]["largest_difference_nm"] < 0.1
    assert rows["bfloat16"]["largest_difference_nm"] > rows["float32"]["largest_difference_nm"]
