"""Check that a user's own model can be trained, frozen and loaded by its name."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from examples import own_simulator
from litho_data.foundation import plugins
from litho_data.foundation.errors import InputError
from litho_models import load_frozen, register_simulator
from litho_models.evaluation.fit_cache import fit_or_load
from litho_models.fitting import TrainingConfig
from litho_models.fitting.fit import run_key
from litho_models.models import MODELS, build_model, kernels_part, register_part
from litho_models.models.baselines import Affine
from litho_models.models.parts import PARTS, REGISTERED
from litho_models.simulator import Simulator
from litho_models.splits.folds import Fold
from tests.litho_models.prints import make_scans, write_store


def test_the_example_trains_freezes_and_loads_its_model_by_name(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("litho_models.models.MODELS", known := dict(MODELS))
    store = write_store(tmp_path / "made.zarr", make_scans(3, 96))
    monkeypatch.setattr("sys.argv", ["own_simulator.py", str(store), "--out", str(tmp_path)])
    own_simulator.main()
    assert "two-spots is frozen" in capsys.readouterr().out
    model = load_frozen(tmp_path / "model").simulator
    # The scans were made with a spot of 0.25 µm and saturation, which the model imitates with wider spots.
    narrow = model.ranges["narrow"].value(model.narrow).item()
    assert narrow == pytest.approx(0.25, rel=0.3)
    with pytest.raises(InputError, match="not taken"):
        register_simulator(own_simulator.TwoSpots)
    assert known["two-spots"] is own_simulator.TwoSpots


OWN = """
from litho_models.models import register_simulator
from litho_models.models.baselines import Affine


class Base(Affine):
    def interior(self, layout_um):
        return {}


@register_simulator
class Own(Base):
    name = "own"
"""


def test_a_fit_is_made_again_after_the_code_of_its_model_changed(tmp_path, monkeypatch):
    scans = make_scans(3, 32)
    spreads = []
    for formula in ("self.gain * layout_um", "0 * self.gain * layout_um"):
        monkeypatch.setattr("litho_models.models.MODELS", dict(MODELS))
        (tmp_path / "own_model.py").write_text(OWN.format(formula))
        plugins._import(tmp_path / "own_model.py")
        monkeypatch.delitem(sys.modules, "own_model")
        heights = fit_or_load("own", Fold(0, scans[:2], scans[2:]), TrainingConfig(), tmp_path, False)[1]
        spreads.append(heights[0].std())
    assert spreads[0] > 0.1
    assert spreads[1] == 0
    assert plugins.foreign_sha256(Affine) == ""


def test_a_model_without_a_reach_is_refused_when_it_is_registered(monkeypatch):
    monkeypatch.setattr("litho_models.models.MODELS", known := dict(MODELS))

    class NoReach(Simulator):
        name = "no-reach"

        def interior(self, layout_um):
            return layout_um

    with pytest.raises(InputError, match="simulator no-reach, got no reach_px"):
        register_simulator(NoReach)
    assert "no-reach" not in known


@pytest.mark.parametrize(
    ("reach", "interior", "words"),
    [
        (2, lambda layout: layout, r"got shape \(1, 1, 132, 132\).*reach_px = 2 pixels off each side"),
        (None, lambda layout: layout[..., 1:], r"got shape \(1, 1, 128, 127\), wanted \(1, 1, 128, 128\)"),
        (0, lambda layout: layout.log(), "got NaN or infinity"),
        (0, lambda layout: layout.no_such, "got AttributeError: 'Tensor' object has no attribute 'no_such'"),
        (0, lambda layout: None, "got AttributeError"),
    ],
)
def test_a_model_that_predicts_no_map_of_heights_is_refused_before_it_is_fitted(
    reach, interior, words, monkeypatch
):
    monkeypatch.setattr("litho_models.models.MODELS", dict(MODELS))
    monkeypatch.setattr("litho_models.models._REGISTERED", {})

    class Wrong(Simulator):
        name = "wrong"
        reach_px = reach

        def interior(self, layout_um):
            return interior(layout_um)

    register_simulator(Wrong)
    with pytest.raises(InputError, match=f"prediction of model wrong, {words}"):
        build_model("wrong")


def test_an_own_model_that_is_not_loaded_is_told_from_a_misspelt_one():
    with pytest.raises(InputError, match=r"'my-gain'.*registered first, in a command with --plugin FILE"):
        build_model("my-gain")
    with pytest.raises(InputError, match=r"'physic'.*did you mean physics\?"):
        build_model("physic")


def test_the_key_of_a_fit_covers_the_parts_and_kernels_that_its_model_names(tmp_path, monkeypatch):
    monkeypatch.setattr("litho_models.models.parts.PARTS", known := dict(PARTS))
    monkeypatch.setitem(REGISTERED, "own-lens", "")
    scans, keys = make_scans(1, 32), []
    model = build_model("projection")
    for value in (1, 1, 2):
        np.save(tmp_path / "kernels.npy", np.full((1, 3, 3), value))
        known.pop("own-lens", None)
        register_part(kernels_part("own-lens", tmp_path / "kernels.npy"))
        configs = [TrainingConfig(model=one) for one in ({}, {"parts": ["own-lens", "etch"]})]
        keys.append([run_key(model, scans, config) for config in configs])
    assert keys[0] == keys[1]
    assert [before == after for before, after in zip(keys[0], keys[2], strict=True)] == [True, False]
