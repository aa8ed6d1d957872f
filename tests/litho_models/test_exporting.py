"""Check that an exported model predicts the same print, or that the export says why it is impossible."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from litho_data.foundation.errors import InputError
from litho_models import build_model, load_frozen, save_frozen
from litho_models.cli.app import app
from litho_models.frozen.exporting import LARGEST_DIFFERENCE_UM, export_model
from litho_models.frozen.simulator import FrozenSimulator
from tests.tensors import assert_close

SIZE_PX = 48
FEW = {"blurs_um": (0.2,), "slope_blurs_um": (0.1,), "shifts_um": (0.2,), "steep_um": (0.3,)}
SETTINGS = {
    "linear": {"sigmas_um": (0.1, 0.3)},
    # These settings use all operations of the model, with few features. Both networks share the code of blurs
    # and steepness.
    "pbl": {
        "sigma_diffusion_init_um": 0.2,
        "surroundings": FEW,
        "scan_axis": FEW | {"blurs_um": (), "steep_um": ()},
    },
}
# The features of ``linear`` include the blurs of ``affine-mtf``.
CLOSED_FORM = ("identity", "affine", "blur-table", "linear")


def layout(seed: int, size_px: int = SIZE_PX) -> torch.Tensor:
    levels = torch.randint(0, 13, (1, 1, size_px, size_px), generator=torch.Generator().manual_seed(seed))
    return 0.1 * levels.float()


def frozen(name: str, folder: Path) -> FrozenSimulator:
    """Return a model of the zoo, or one with random weights."""
    if name.startswith("zoo:"):
        return load_frozen(name)
    torch.manual_seed(0)
    model = build_model(name, **SETTINGS.get(name, {}))
    for weights in model.parameters():
        weights.data += 0.01 * torch.rand(weights.shape)
    return load_frozen(save_frozen(model, folder / name))


@pytest.mark.parametrize(
    "name",
    [
        *CLOSED_FORM,
        # Physics and PBL are left out: the test below exports them to ONNX, and that export begins with this
        # program.
        *(pytest.param(n, marks=pytest.mark.long) for n in ("pbl", "zoo:pbl", "zoo:fno", "zoo:features")),
    ],
)
def test_a_program_prints_what_the_model_prints(name: str, tmp_path: Path) -> None:
    model = frozen(name, tmp_path)
    assert export_model(model, tmp_path / "model.pt2", SIZE_PX) <= LARGEST_DIFFERENCE_UM
    facts = {"card.json": ""}
    program = torch.export.load(tmp_path / "model.pt2", extra_files=facts).module()
    # This layout was not used for the export.
    assert_close(program(layout(5)), model(layout(5)), atol=LARGEST_DIFFERENCE_UM, rtol=0)
    assert json.loads(facts["card.json"])["pitch_um"] == model.pitch_um


# The other models use the same blurs as Physics.
@pytest.mark.parametrize("name", ["zoo:physics", "pbl", pytest.param("zoo:pbl", marks=pytest.mark.long)])
def test_onnxruntime_prints_the_same(name: str, tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    model = frozen(name, tmp_path)
    export_model(model, tmp_path / "model.onnx", SIZE_PX)
    session = onnxruntime.InferenceSession(tmp_path / "model.onnx", providers=["CPUExecutionProvider"])
    assert [one.name for one in session.get_inputs()] == ["layout_um"]
    (printed,) = session.run(None, {"layout_um": layout(5).numpy()})
    np.testing.assert_allclose(printed, model(layout(5)).numpy(), atol=LARGEST_DIFFERENCE_UM, rtol=0)
    stored = session.get_modelmeta().custom_metadata_map
    assert json.loads(stored["calibrated_range_um"]) == model.card["calibrated_range_um"]


def test_a_model_that_cannot_be_exported_says_why_and_leaves_no_file(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    fno = save_frozen(build_model("fno", layers=1, width=4, modes=(4, 4)), tmp_path / "fno")
    with pytest.raises(InputError, match="complex numbers"):
        export_model(load_frozen(fno), tmp_path / "fno.onnx", SIZE_PX)
    with pytest.raises(InputError, match=r"wanted \.pt2 or \.onnx"):
        export_model(load_frozen(fno), tmp_path / "fno.pth", SIZE_PX)
    assert list(tmp_path.iterdir()) == [fno]


def test_the_command_says_size_and_difference(tmp_path: Path) -> None:
    save_frozen(build_model("affine"), tmp_path / "affine")
    out = tmp_path / "affine.pt2"
    words = ["export", str(tmp_path / "affine"), "--size-px", "64", "--out", str(out)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "64 x 64 px" in done.output
    assert out.exists()
