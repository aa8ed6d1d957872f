"""Check that predictions accept layouts as any kind of array or as a file."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import xarray as xr
from typer.testing import CliRunner

from litho_data import InputError, read_scan
from litho_models import load_frozen, save_frozen, zoo
from litho_models.cli.app import app
from litho_models.models import build_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_frozen(build_model("physics"), tmp_path_factory.mktemp("frozen") / "printer")


@pytest.fixture
def model(folder):
    return load_frozen(folder)


LEVELS = np.random.default_rng(4).integers(0, 13, (2, 3, 40, 52))


def test_every_kind_and_shape_gives_what_forward_gives(model):
    layout = (LEVELS * 0.1).astype(np.float32)
    wanted = model(torch.from_numpy(layout).reshape(6, 1, 40, 52)).reshape(2, 3, 40, 52).numpy()
    # A batch sums in another order than single fields, which changes a few float32 roundings at about 1 µm.
    near = {"rtol": 0, "atol": 2e-6}
    np.testing.assert_allclose(model.predict(layout), wanted, **near)
    np.testing.assert_allclose(model.predict(layout.astype(np.float64))[1, 2], wanted[1, 2], **near)
    np.testing.assert_allclose(model.predict(layout[1, 2]), wanted[1, 2], **near)
    np.testing.assert_allclose(model.predict(torch.from_numpy(layout[0])).numpy(), wanted[0], **near)
    array = xr.DataArray(
        layout[0],
        dims=("scan", "y", "x"),
        coords={"y_um": ("y", 0.1 * np.arange(40)), "x_um": ("x", 3 + 0.1 * np.arange(52))},
        name="layout",
    )
    height = model.predict(array)
    np.testing.assert_allclose(height, wanted[0], **near)
    assert height.dims == array.dims
    assert height.x_um.equals(array.x_um)
    assert (height.name, height.units) == ("height_um", "µm")


def test_gradients_flow_through_a_tensor(model):
    layout = torch.full((30, 30), 0.5, requires_grad=True)
    model.predict(layout).sum().backward()
    assert layout.grad is not None
    assert layout.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        (LEVELS[0, 0], r"wanted heights in µm; multiply levels by 0.1 to get heights"),
        (np.zeros(5, np.float32), r"shape \(5,\)"),
        (np.zeros((0, 5), np.float32), "no empty dimension"),
        ([[0.1]], "got a list"),
        (np.full((30, 30), 1.4), "calibrated range"),
        (xr.DataArray(np.zeros((9, 9)), dims=("x", "y")), "dimensions"),
        (xr.DataArray(np.zeros((9, 9)), dims=("y", "x"), coords={"y_um": ("y", np.arange(9.0))}), "0.1 µm"),
    ],
)
def test_an_invalid_layout_is_refused_in_one_line(model, layout, said):
    with pytest.raises(InputError, match=said):
        model.predict(layout)
    with pytest.raises(InputError, match="pitch_um"):
        model.predict(np.zeros((9, 9)), pitch_um=0.2)


def test_a_file_of_levels_becomes_a_height_map_that_can_be_read_again(folder, model, tmp_path):
    levels, out = LEVELS[1, 1].astype(np.uint8), tmp_path / "height.gsf"
    np.save(tmp_path / "layout.npy", levels)
    command = ["predict", str(folder), str(tmp_path / "layout.npy"), "--out", str(out)]
    said = CliRunner().invoke(app, command, catch_exceptions=False)
    assert said.exit_code == 0
    assert "40 x 52 px" in said.output
    scan = read_scan(out)
    wanted = model.predict(levels * np.float32(0.1))
    # The file has metres in float32, with a relative error of 1e-7.
    np.testing.assert_allclose(scan.height_um, wanted, rtol=0, atol=1e-6)
    assert scan.pitch_um == pytest.approx((0.1, 0.1))


def test_the_zoo_is_listed_and_shown():
    listed = CliRunner().invoke(app, ["zoo", "list"], catch_exceptions=False).output
    assert [line.split()[0] for line in listed.splitlines()] == [f"zoo:{name}" for name in zoo.list()]
    assert "18.83 nm (17.99 … 19.64), 27,049 parameters" in listed
    (best,) = (line for line in listed.splitlines() if "= zoo:best" in line)
    assert best.startswith("zoo:random-features ")
    page = CliRunner().invoke(app, ["zoo", "show", "pbl"], catch_exceptions=False).output
    assert page.startswith("# pbl")
    with pytest.raises(InputError, match="zoo model, got 'nothing'"):
        CliRunner().invoke(app, ["zoo", "show", "nothing"], catch_exceptions=False)
