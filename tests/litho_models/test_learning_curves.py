"""Learning curves of the recipes: what is extrapolated of a curve whose law is known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import recipes
from benchmarks.learning_curves import STEPS_PER_EPOCH, curve_table
from litho_data.foundation.errors import InputError
from litho_models.evaluation.fit_cache import FitRecord


def test_a_power_law_goes_on_as_it_is_and_a_flat_curve_stays():
    epochs = np.arange(1, 401)
    falling, flat = 900 * epochs**-0.5, np.full(400, 20.0)
    fit = FitRecord.model_construct(
        model="pbl",
        steps=list(epochs * STEPS_PER_EPOCH),
        training_mae_nm=list(falling),
        validation_mae_datum_free_nm=list(flat),
    )
    rows = [line.split(" | ") for line in curve_table([fit]).splitlines()[2:4]]
    later = np.arange(3201, 4001)
    # Sums over 80 and over 800 epochs of a curve that falls by a tenth differ from its integral by 1e-3.
    assert float(rows[0][-1].split()[0]) == pytest.approx((900 * later**-0.5).mean(), abs=0.06)
    assert rows[0][2] == "45.00 nm, epoch 400"
    assert rows[1][3:] == ["20.00 ± 0.00 nm", "20.00 ± 0.00 nm", "20.0 nm |"]


@pytest.mark.parametrize(
    ("runs", "refused"),
    [("paper-pbl", True), ("paper-physics,paper-pbl,paper-fno", False), ("reduced", False)],
)
def test_runs_of_other_epochs_are_not_shown_side_by_side(runs, refused, monkeypatch):
    def ends_here(*_, **__):
        raise KeyboardInterrupt

    published = recipes.published_runs()
    epochs = published["paper-fno"].fits[0].steps[-1] // STEPS_PER_EPOCH
    monkeypatch.setattr(recipes, "benchmark", ends_here)
    monkeypatch.setattr("sys.argv", ["recipes", "no.zarr", "--runs", runs, "--epochs", str(10 * epochs)])
    with pytest.raises(InputError if refused else KeyboardInterrupt) as said:
        recipes.main()
    assert refused == (f"published runs of {epochs:,} epochs beside it" in str(said.value))
