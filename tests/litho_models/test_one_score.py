"""Benchmark and loop are one system: the same fits have the same error in both, to the bit of a float."""

from __future__ import annotations

import pytest

from litho_models.effects import get_effect
from litho_models.evaluation.benchmark import benchmark
from litho_models.loop import LoopConfig, close_loop_on_store
from tests.litho_models.prints import make_scans, write_store

STEPS = 2


@pytest.mark.slow
@pytest.mark.parametrize("base", ["physics", pytest.param("pbl", marks=pytest.mark.long)])
def test_the_loop_starts_where_the_benchmark_ends(base: str, tmp_path, monkeypatch) -> None:
    # What the loop looks for afterwards takes time and changes nothing of its start.
    drift = get_effect("laser-drift")
    monkeypatch.setattr("litho_models.loop.selection.search.screened_effects", lambda tip_radius_um: [drift])
    store = write_store(tmp_path / "s.zarr", make_scans(4, size_px=80, bow_um=0.02))
    settings = {"steps": STEPS} if base == "pbl" else None
    scored = benchmark(store, tmp_path / "b", models=[base], folds=2, settings=settings).scores[0]
    config = LoopConfig(folds=2, loss="absolute", background="training")
    loop = close_loop_on_store(
        store, tmp_path / "l", base=base, config=config, steps=STEPS, cache=tmp_path / "b" / "cache"
    )
    # The same predictions, pixels, terms and background; sums in another order.
    assert loop.before.mae_datum_free_nm == pytest.approx(scored.mae_datum_free_nm, abs=1e-6)
    assert loop.before.rmse_datum_free_nm == pytest.approx(
        (sum(row.rmse_datum_free_nm**2 for row in scored.scans) / len(scored.scans)) ** 0.5, abs=1e-6
    )
    assert loop.before.mae_abs_nm == pytest.approx(scored.mae_abs_nm, abs=1e-6)
    # Not for want of a difference: without the background the same fits have another error.
    bare = {error.policy: error.mae_nm for error in scored.without_background}
    assert abs(bare["offset"] - scored.mae_datum_free_nm) > 0.1
