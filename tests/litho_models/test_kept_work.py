"""Check that a repeated call continues earlier work, and that other calls and damaged files are refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from litho_data.foundation.begun import BEGUN
from litho_data.foundation.errors import InputError
from litho_data.store.lock_box import locked_ids
from litho_models.cli.app import app
from litho_models.evaluation.benchmark import benchmark
from litho_models.fitting import TrainingConfig, fit
from litho_models.fitting.checkpoint import CheckpointFolder
from litho_models.fitting.runs import TrainingRun, train
from litho_models.frozen.card import ModelCard
from litho_models.noise.residuals import read_residuals
from litho_models.splits.folds import grouped_folds, plan_folds
from tests.litho_models.prints import make_scans, write_store

pytestmark = pytest.mark.usefixtures("rough_networks")

# The paper's PBL is fitted in steps only. The default PBL also fits networks to pixels, anew in each call.
QUICK = {
    "variant": "paper",
    "steps": 2,
    "rounds": 2,
    "batch": 1,
    "crop_px": 32,
    "nuisance": "offset",
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("data") / "made.zarr", make_scans(4, size_px=48))


@pytest.fixture(scope="module")
def trained(store, tmp_path_factory):
    """Return the training run of a network, and the folder that contains its checkpoint."""
    folder = tmp_path_factory.mktemp("run") / "pbl"
    return train(store, "pbl", folder, settings=QUICK), folder


@pytest.fixture(scope="module")
def scored(store, tmp_path_factory):
    """Return a benchmark of two models, one fitted by Gauss-Newton and one in steps."""
    out = tmp_path_factory.mktemp("benchmark")
    return benchmark(store, out, models=["affine", "pbl"], folds=2, settings=QUICK), out


def test_the_same_run_again_goes_on_where_it_was_and_its_seconds_are_those_of_all_rounds(trained, store):
    run, folder = trained
    again = train(store, "pbl", folder, settings=QUICK)
    assert again.history == run.history
    assert again.seconds == run.seconds == sum(entry.seconds for entry in run.history)


def test_seconds_of_a_killed_fit_hold_those_of_before(tmp_path, monkeypatch):
    class Killed(Exception):
        pass

    save = CheckpointFolder.save

    def save_and_die(self, state):
        # Pretend that the first round took long.
        state.history[0] = state.history[0].model_copy(update={"seconds": 1000.0})
        save(self, state)
        raise Killed

    scans, config = make_scans(4, size_px=64), TrainingConfig(**QUICK)
    monkeypatch.setattr(CheckpointFolder, "save", save_and_die)
    with pytest.raises(Killed):
        fit("pbl", scans, config, checkpoint=tmp_path / "run")
    monkeypatch.undo()
    resumed = fit("pbl", scans, config, checkpoint=tmp_path / "run")
    assert [entry.step for entry in resumed.history] == [1, 2]
    assert resumed.facts.seconds == 1000.0 + resumed.history[1].seconds


@pytest.mark.parametrize(
    ("before", "now", "differs"),
    [
        ("affine", {"model": "linear"}, "model"),
        ("affine", {"settings": {"seed": 1}}, "seed"),
        ("affine", {"use_lock_box": True}, "lock_box"),
        ("pbl", {"model": "affine"}, "model"),
    ],
)
def test_a_folder_keeps_the_run_that_it_holds(before, now, differs, trained, store, tmp_path):
    folder = tmp_path / "run"
    if before == "pbl":
        shutil.copytree(trained[1], folder)
    else:
        train(store, before, folder)
    weights = ModelCard.read(folder / "model").weights_sha256
    with pytest.raises(InputError, match=rf"holds a result with other settings.*{differs}.*--out"):
        train(store, **{"model": before, "out": folder, **now})
    assert ModelCard.read(folder / "model").weights_sha256 == weights
    assert TrainingRun.read(folder).model == before


def test_a_killed_run_keeps_its_folder_from_models_that_leave_no_checkpoint(trained, store, tmp_path):
    shutil.copytree(trained[1] / "checkpoint", tmp_path / "checkpoint")
    facts = {"dataset": trained[0].dataset.model_dump(mode="json"), "model": "pbl"}
    facts["config"] = trained[0].config.model_dump(mode="json")
    (tmp_path / BEGUN).write_text(json.dumps({"record": "run.json", **facts}))
    with pytest.raises(InputError, match="model = 'pbl', but now 'affine'"):
        train(store, "affine", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [BEGUN, "checkpoint"]


def cut_short(file):
    file.write_bytes(file.read_bytes()[:50])


def emptied(file):
    file.write_bytes(b"")


@pytest.mark.parametrize("damage", [cut_short, emptied])
@pytest.mark.parametrize("name", ["state.json", "state.pt"])
def test_a_damaged_checkpoint_is_told_with_its_folder(name, damage, trained, store, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained[1], folder)
    damage(folder / "checkpoint" / name)
    with pytest.raises(InputError, match=f"delete {folder / 'checkpoint'} and run again") as told:
        train(store, "pbl", folder, settings=QUICK)
    assert "\n" not in str(told.value)
    shutil.rmtree(folder / "checkpoint")
    assert train(store, "pbl", folder, settings=QUICK).history[-1].training_mae_nm == pytest.approx(
        trained[0].history[-1].training_mae_nm
    )


@pytest.mark.usefixtures("pageless")
def test_a_damaged_fit_is_told_with_its_folder(scored, store, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(scored[1], out)
    # Remove the result, because a call that names fewer models would not replace it.
    (out / "benchmark.json").unlink()
    folder = next(path for path in (out / "cache").glob("affine-*"))
    for name, damage in (
        ("fit.json", cut_short),
        ("prediction_000.npy", cut_short),
        ("prediction_000.npy", emptied),
        ("prediction_000.npy", Path.unlink),
    ):
        kept = (folder / name).read_bytes()
        damage(folder / name)
        with pytest.raises(InputError, match=f"delete {folder} and run again") as told:
            benchmark(store, out, models=["affine"], folds=2, settings=QUICK)
        assert "\n" not in str(told.value)
        (folder / name).write_bytes(kept)
    shutil.rmtree(folder)
    again = benchmark(store, out, models=["affine"], folds=2, settings=QUICK)
    assert again.scores[0] == scored[0].scores[0]


def test_a_damaged_fit_is_told_where_the_noise_reads_it_too(scored, store, tmp_path):
    from litho_data.store import open_store

    out = tmp_path / "out"
    shutil.copytree(scored[1], out)
    assert read_residuals(open_store(store), out, "affine").held_out
    folder = next(path for path in (out / "cache").glob("affine-*"))
    (folder / "prediction_000.npy").unlink()
    with pytest.raises(InputError, match=f"delete {folder} and run again"):
        read_residuals(open_store(store), out, "affine")


def test_a_result_lists_the_settings_that_a_fit_used(scored):
    settings = json.loads((scored[1] / "benchmark.json").read_text())["training"]
    affine = {"recipe": "fast", "variant": "paper", "seed": 0, "nuisance": "offset"}
    assert settings["affine"] == {**affine, "model": {}, "optimiser": "gauss-newton"}
    assert {**settings["pbl"], **QUICK} == TrainingConfig(**QUICK).model_dump(mode="json")


@pytest.mark.parametrize(("names", "got"), [(",", "none"), ("affine,affine", "affine, affine")])
def test_a_list_of_models_has_names_and_each_once(names, got, store, tmp_path):
    command = ["benchmark", str(store), "--models", names, "--out", str(tmp_path / "out")]
    refused = CliRunner().invoke(app, command).exception
    assert isinstance(refused, InputError)
    assert f"models, got {got}, wanted one or more of identity" in str(refused)
    assert not (tmp_path / "out").exists()


def test_two_scans_have_no_lock_box_to_open_and_one_scan_no_folds():
    two = make_scans(2, size_px=32)
    assert len(plan_folds(two, locked_ids(two), "grouped")) == 2
    with pytest.raises(InputError, match=r"lock box to open, got no locked scans.*at least 3 fields"):
        plan_folds(two, locked_ids(two), "grouped", open_lock_box=True)
    with pytest.raises(InputError, match="got 1, wanted at least 2"):
        grouped_folds(["a"], ["a"], 2)
