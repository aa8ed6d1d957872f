"""Check that effects from a user's file are registered and become candidates like all others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples import own_effect
from litho_data.foundation.errors import InputError
from litho_models.effects import CATALOGUE, get_effect, register_effect
from litho_models.loop.record import CloseLoop
from litho_models.scan_terms import SCAN_TERMS
from tests.litho_models.loop_scans import base_model, planted, search_little
from tests.litho_models.prints import write_store


@pytest.fixture
def catalogues() -> Iterator[None]:
    """Restore the catalogues and their order after each test."""
    before = [(own, dict(own)) for own in (CATALOGUE, SCAN_TERMS)]
    yield
    for own, entries in before:
        own.clear()
        own.update(entries)


@pytest.mark.slow
def test_the_example_finds_the_effects_that_it_registers(
    catalogues: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    random, scans = np.random.default_rng(11), []
    for scan in planted(count=10):
        x = np.linspace(-1, 1, scan.shape[1])[None, :]
        added = 0.03 * random.normal() * x**3 - 0.04 * np.exp(-scan.layout_um / own_effect.SINKING_DEPTH_UM)
        scans.append(replace(scan, height_um=(scan.height_um + added).astype(np.float32)))
    store, out = write_store(tmp_path / "s.zarr", scans), tmp_path / "loop"
    search_little(monkeypatch, ["vignetting", "sinking-layers"])
    monkeypatch.setattr("litho_models.fitting.base_models.build_model", lambda *_, **__: base_model())
    monkeypatch.setattr("sys.argv", ["own_effect.py", str(store), "--out", str(out)])
    own_effect.main()
    said = capsys.readouterr().out
    assert "sinking-layers: explained" in said
    assert "cubic-bow: seen" in said
    (found,) = CloseLoop.read(out).effects
    assert found.name == "sinking-layers"
    assert found.strengths["depth_um"][0].value == pytest.approx(0.04, rel=0.1)


def test_an_effect_of_ones_own_acts_last_in_its_stage_or_where_it_is_told(catalogues: None) -> None:
    model = get_effect("vignetting")
    register_effect(replace(model, name="own-exposure"))
    register_effect(replace(model, name="own-second"), after="interface-offset")
    names = list(CATALOGUE)
    own = names.index("own-exposure")
    assert CATALOGUE[names[own - 1]].stage == "exposure"
    assert not any(CATALOGUE[name].stage == "exposure" for name in names[own + 1 :])
    assert names.index("own-second") == names.index("interface-offset") + 1
    with pytest.raises(InputError, match="exists"):
        register_effect(model)
