"""Check that equal scan ids count as training scans only if the prints are the same."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from examples import own_metric
from litho_data.foundation.errors import InputError
from litho_data.store import open_store
from litho_models.evaluation.evaluate import evaluate
from litho_models.evaluation.results import Evaluation
from litho_models.evaluation.wording import evaluation_verdict
from litho_models.fitting.runs import train
from litho_models.noise.residuals import read_residuals
from litho_models.scoring import metric_registry
from litho_models.scoring.noise_floor import NoiseFloor
from tests.litho_models.prints import make_scans, write_store
from tests.tables import require_tables_equal_record


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    store = write_store(folder / "made.zarr", make_scans(4, size_px=64))
    return store, train(store, "identity", folder / "run"), folder / "run"


# A store built anew has other heights and another hash, but its name shows that the prints are the same.
@pytest.mark.parametrize(("name", "same"), [("made", True), ("other", False)])
def test_equal_ids_in_another_dataset_were_not_used_in_training(trained, tmp_path, name, same):
    _, run, folder = trained
    store = write_store(tmp_path / "anew.zarr", make_scans(4, size_px=64, datum_um=0.02), name=name)
    scored = evaluate(folder / "model", store, tmp_path / "out")
    assert set(run.training_ids) & set(scored.split.scored_ids)
    assert scored.trained_on_scored_scans == (sorted(run.training_ids) if same else [])
    above = {"headline.csv": {"above_floor_nm": ""}}
    require_tables_equal_record(tmp_path / "out", Evaluation.FILE_NAME, above, pivoted=["policies.csv"])
    assert ("not a held-out error" in (tmp_path / "out" / "report.html").read_text()) == same
    assert read_residuals(open_store(store), folder / "model").held_out == (not same)


def test_locked_scans_that_were_trained_on_are_not_called_untouched(tmp_path):
    store = write_store(tmp_path / "made.zarr", make_scans(6, size_px=48))
    run = train(store, "identity", tmp_path / "run", use_lock_box=True)
    scored = evaluate(tmp_path / "run" / "model", store, tmp_path / "out", open_lock_box=True)
    assert scored.split.lock_box
    assert set(scored.split.lock_box) <= set(scored.trained_on_scored_scans) == set(run.training_ids)
    report = (tmp_path / "out" / "report.html").read_text()
    assert f"are scored too: {scored.split.lock_box[0]}." in report
    assert "no model is trained" not in report


@pytest.mark.parametrize("share", [0.5, 1.5])
def test_no_more_than_the_error_can_be_removed(trained, tmp_path, share):
    store, _, folder = trained
    scored = evaluate(folder / "model", store, tmp_path / "out")
    error_nm = scored.scores.mae_datum_free_nm
    floor = NoiseFloor(mae_nm=share * error_nm, rmse_nm=None, kind="measured", source="flat prints")
    text = evaluation_verdict(scored.model_copy(update={"noise_floor": floor}))
    removable = f"{0.5 * error_nm:.2f} nm can still be removed" in text
    assert (removable, "is not smaller than this error" in text) == (share < 1, share > 1)
    assert " -" not in text


def test_a_background_that_is_not_in_the_card_is_refused(trained, tmp_path):
    store, _, folder = trained
    with pytest.raises(InputError, match="background, got 'shared', wanted training, none"):
        evaluate(folder / "model", store, tmp_path / "out", background="shared")
    assert not (tmp_path / "out").exists()


def test_a_run_folder_is_answered_with_the_place_of_its_model(trained, tmp_path):
    store, _, folder = trained
    with pytest.raises(InputError, match=f"use {folder}/model$") as caught:
        evaluate(folder, store, tmp_path / "out")
    assert "\n" not in str(caught.value)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="litho-models freeze"):
        evaluate(tmp_path / "empty", store, tmp_path / "out")


def test_the_example_with_a_metric_of_its_own_has_it_in_result_report_and_tables(
    trained, tmp_path, monkeypatch, capsys
):
    (store, _, folder), out = trained, tmp_path / "out"
    monkeypatch.setattr(metric_registry, "_MEASUREMENTS", [*metric_registry._MEASUREMENTS])
    words = ["own_metric.py", folder / "model", store, "--out", out]
    monkeypatch.setattr("sys.argv", [*map(str, words)])
    own_metric.main()
    key = "off_by_half_a_level_percent"
    found = Evaluation.read(out).scores
    by_scan = [row.metrics[key] for row in found.scans]
    assert 0 < min(by_scan) <= max(by_scan) < 100
    assert found.metrics[key] == pytest.approx(np.mean(by_scan))
    assert f"{found.metrics[key]:.1f} %" in capsys.readouterr().out
    for name, values in (("metrics.csv", [found.metrics[key]]), ("scans.csv", by_scan)):
        with (out / name).open() as file:
            assert [float(row[key]) for row in csv.DictReader(file)] == pytest.approx(values, rel=1e-6)
    assert "off_by_half_a_level is the share" in (out / "report.html").read_text()
