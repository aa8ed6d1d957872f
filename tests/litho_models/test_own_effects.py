"""Effects from a file of one's own: registered through public names, they are candidates like the others."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_models.effects import CATALOGUE, get_effect, register_effect
from litho_models.loop.result.record import CloseLoop
from tests.litho_models.loop_scans import printed_scans
from tests.litho_models.prints import write_store

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_effect.py"


def test_the_example_finds_the_effects_that_it_registers(tmp_path) -> None:
    random = np.random.default_rng(11)
    scans = []
    for scan in printed_scans(count=12, size_px=96, noise_um=0.004, seed=21):
        x = np.linspace(-1, 1, scan.shape[1])[None, :]
        added = 0.03 * random.normal() * x**3 - 0.04 * np.exp(-scan.layout_um / 0.2)
        scans.append(replace(scan, height_um=(scan.height_um + added).astype(np.float32)))
    store, out = write_store(tmp_path / "s.zarr", scans), tmp_path / "loop"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(EXAMPLE.parents[1]), *sys.path])}
    said = subprocess.run(
        [sys.executable, str(EXAMPLE), str(store), "--out", str(out)],
        capture_output=True, text=True, check=True, env=environment,
    ).stdout  # fmt: skip
    assert "cubic-bow: explained" in said
    verdicts = {c.name: c.verdict for c in CloseLoop.read(out).candidates}
    assert verdicts["sinking-layers"] in ("explained", "confusable", "traced-to-covariate")
    assert "sinking-layers" not in CATALOGUE


def test_an_effect_of_ones_own_acts_last_in_its_stage_or_where_it_is_told(monkeypatch) -> None:
    monkeypatch.setattr("litho_models.effects.registry.CATALOGUE", dict(CATALOGUE))
    from litho_models.effects import registry

    model = get_effect("vignetting")
    register_effect(replace(model, name="own-exposure"))
    register_effect(replace(model, name="own-second"), after="interface-offset")
    names = list(registry.CATALOGUE)
    own = names.index("own-exposure")
    assert registry.CATALOGUE[names[own - 1]].stage == "exposure"
    assert not any(registry.CATALOGUE[name].stage == "exposure" for name in names[own + 1 :])
    assert names.index("own-second") == names.index("interface-offset") + 1
    with pytest.raises(InputError, match="exists"):
        register_effect(model)
