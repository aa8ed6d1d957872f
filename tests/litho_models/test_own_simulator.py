"""Check that a user's own model can be trained, frozen and loaded by its name."""

from __future__ import annotations

import pytest

from examples import own_simulator
from litho_data.foundation.errors import InputError
from litho_models import load_frozen, register_simulator
from litho_models.models import MODELS
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
