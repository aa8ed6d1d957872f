"""Check that one call makes the zoo's cards, numbers and weights from the table of the benchmark."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest
import torch
from typer.testing import CliRunner

from benchmarks.measured import FOLDER, in_table
from benchmarks.zoo import LARGEST_ZOO_BYTES, card_metrics, make_zoo, size_bytes
from litho_data import build_dataset
from litho_data.cards.fetch import find_card
from litho_data.foundation.errors import InputError
from litho_data.store import open_store
from litho_models import load_frozen, save_frozen
from litho_models.cli.app import app
from litho_models.evaluation.results import Benchmark
from litho_models.fitting.runs import TrainingRun
from litho_models.frozen import zoo
from litho_models.frozen.card import OUT_OF_FOLD, TRAINED_ON, ModelCard
from litho_models.frozen.on_store import predict_frozen
from litho_models.models import build_model
from litho_models.scoring.printer_state import scan_figures
from tests.litho_models.prints import make_scans, write_store

SMALL = {
    "physics": {},
    "pbl": {"pointwise_channels": (8, 4), "areawise_channels": (8, 4)},
    "fno": {"width": 4, "modes": (4, 4), "projection_channels": 8},
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("zoo") / "made.zarr", make_scans(6, size_px=48))


@pytest.fixture(scope="module")
def _small_zoo(tmp_path_factory):
    root = tmp_path_factory.mktemp("small")
    for name, fields in SMALL.items():
        save_frozen(build_model(name, **fields), root / name)
    return root


@pytest.fixture
def small_zoo(_small_zoo, monkeypatch):
    monkeypatch.setattr(zoo, "ZOO_FOLDER", _small_zoo)


def check_model(name):
    """Check that a zoo model loads, predicts plausible heights, and refuses another pitch."""
    frozen = load_frozen(zoo.folder(name))
    assert frozen.name == name
    layout = torch.full((1, 1, 90, 110), 0.6, requires_grad=True)
    height = frozen(layout, pitch_um=0.1)
    assert height.shape == layout.shape
    assert height.isfinite().all()
    assert 0.2 < float(height.detach().mean()) < 1.0
    height.sum().backward()
    assert layout.grad.isfinite().all()
    for wrong in ({"pitch_um": 0.2}, {"level_height_um": 0.05}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            frozen(layout, **wrong)
    with pytest.raises(InputError, match="calibrated range"):
        frozen(layout + 5.0)


@pytest.fixture(scope="module")
def table():
    return Benchmark.model_validate(in_table(FOLDER))


@pytest.mark.parametrize("name", zoo.list())
def test_every_shipped_model_works_and_says_where_it_comes_from(name):
    check_model(name)
    card = ModelCard.read(zoo.folder(name))
    assert card.command == f"litho-models train neural-lithography.zarr --model={name} --out={name}"
    page = (zoo.folder(name) / "README.md").read_text(encoding="utf-8")
    assert page == card.page
    # The held-out error comes before everything else on the page.
    assert page.index(card.held_out.text) < page.index("## Use")


def test_the_zoo_is_the_table(table):
    rows = {row.model: row for row in table.scores}
    assert zoo.list() == sorted(rows)
    numbers = {fit.model: fit.parameters for fit in table.fits}
    for name, row in rows.items():
        card = ModelCard.read(zoo.folder(name))
        assert card.dataset == table.dataset
        assert card.parameters == numbers[name]
        assert [m for m in card.metrics if m.split == OUT_OF_FOLD] == card_metrics(row, OUT_OF_FOLD)
        own = table.training[name]
        assert {key: card.training[key] for key in own if key != "optimiser"} == {
            key: value for key, value in own.items() if key != "optimiser"
        }
        assert set(card.training["scan_ids"]) == set(table.split.scored_ids)
        assert set(card.split["lock_box"]) == set(table.split.lock_box)
    best = min(rows.values(), key=lambda row: row.mae_datum_free_nm).model
    assert zoo.folder("best") == zoo.folder(best)
    assert load_frozen("zoo:best").name == best


@pytest.fixture(scope="module")
def measured_scan(measured_prints, tmp_path_factory):
    """Return one scan that the zoo was trained on."""
    folder = tmp_path_factory.mktemp("one")
    for name in ("afm_ug/FOV12.txt", "mask_ug/FOV12.tif"):
        (folder / name).parent.mkdir()
        shutil.copy(measured_prints / name, folder / name)
    build_dataset(find_card("neural-lithography"), folder / "one.zarr", data_dir=folder)
    return open_store(folder / "one.zarr").scan("FOV12")


@pytest.mark.measured
@pytest.mark.parametrize("name", zoo.list())
def test_the_weights_have_the_error_in_their_card(name, measured_scan):
    model = load_frozen(f"zoo:{name}")
    stated = next(row for row in model.card["baseline"] if row["scan"] == measured_scan.id)
    found = scan_figures(measured_scan, predict_frozen(model, measured_scan))
    # Another order of sums changes heights by some 1e-6 µm. The errors of other models differ by over 0.1 nm.
    assert found.error_nm == pytest.approx(stated["error_nm"], abs=0.01)
    assert found.gain == pytest.approx(stated["gain"], abs=1e-4)


def test_the_shipped_zoo_stays_small():
    assert size_bytes(zoo.ZOO_FOLDER) <= LARGEST_ZOO_BYTES == 10_000_000


@pytest.mark.parametrize("name", list(SMALL))
def test_any_frozen_folder_makes_a_zoo_model(name, small_zoo):
    check_model(name)


def test_an_empty_zoo_lists_nothing_and_says_so(tmp_path, monkeypatch):
    for root in (tmp_path, tmp_path / "absent"):
        monkeypatch.setattr(zoo, "ZOO_FOLDER", root)
        assert zoo.list() == []
        for name in ("pbl", "best"):
            with pytest.raises(InputError, match="make zoo"):
                zoo.folder(name)


def test_unknown_names_and_paths_are_refused(small_zoo):
    assert zoo.list() == ["fno", "pbl", "physics"]
    for name in ("resnet", "../pbl", ""):
        with pytest.raises(InputError, match="fno, pbl, physics, best"):
            zoo.folder(name)
        with pytest.raises(InputError, match="fno, pbl, physics, best"):
            load_frozen(f"zoo:{name}")


def test_every_command_that_takes_a_frozen_model_takes_it_from_the_zoo(store, tmp_path):
    from litho_data.store import open_store
    from litho_models.evaluation.results import Evaluation
    from litho_models.frozen.freezing import freeze
    from litho_models.loop.bases import bases_for
    from litho_models.loop.fits import Study
    from litho_models.noise.residuals import read_residuals

    name = zoo.list()[0]
    named, there = f"zoo:{name}", zoo.folder(name)
    assert zoo.model_folder(named) == zoo.model_folder(str(there)) == there
    command = ["evaluate", named, str(store), "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(app, command, catch_exceptions=False).exit_code == 0
    assert Evaluation.read(tmp_path / "out").model.name == name
    assert freeze(named, tmp_path / "frozen").weights_sha256 == ModelCard.read(there).weights_sha256
    assert [*bases_for(named, Study.dealt(open_store(store).scans(), 2), cache=tmp_path)] == [name]
    assert read_residuals(open_store(store), named).model == name
    for wrong, said in (("zoo:resnet", name), (name, f"did you mean {named}")):
        with pytest.raises(InputError, match=said):
            zoo.model_folder(wrong)
    wanted = ", ".join(f"zoo:{one}" for one in zoo.list())
    also = "the result of a benchmark or the folder of a model"
    with pytest.raises(InputError, match=f"wanted {wanted}, {also}$"):
        read_residuals(open_store(store), tmp_path / "absent")


def test_listing_the_zoo_loads_no_torch():
    code = "import sys, litho_models; litho_models.zoo.list(); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.fixture(scope="module")
def made(store, tmp_path_factory):
    """Return a table of two models, the folder in use, and the cards of the zoo that is made from the
    table.
    """
    from litho_models.evaluation.benchmark import benchmark

    folder = tmp_path_factory.mktemp("made")
    scored = benchmark(store, folder / "b", models=("identity", "affine"), folds=2)
    return scored, folder, make_zoo(store, folder / "runs", scored, folder / "zoo")


def test_the_zoo_is_made_of_a_table_in_one_call(made, store):
    scored, folder, cards = made
    assert sorted(one.name for one in (folder / "zoo").iterdir()) == sorted(cards) == ["affine", "identity"]
    for row in scored.scores:
        card = ModelCard.read(folder / "zoo" / row.model)
        assert card == cards[row.model]
        assert {metric.split for metric in card.metrics} == {OUT_OF_FOLD, TRAINED_ON}
        (known,) = (own for own in row.by_policy if own.policy == "offset")
        assert (card.held_out.value, card.held_out.ci95) == (known.mae_nm, row.mae_datum_free_ci95_nm)
        # The leading error is computed from the same residuals, but the mean is rounded differently.
        assert known.mae_nm == pytest.approx(row.mae_datum_free_nm, rel=1e-12)
        assert not set(card.training["scan_ids"]) & set(card.split["lock_box"])
        # The card names the dataset, but contains no local path.
        assert str(folder) not in card.model_dump_json()
    before = (folder / "zoo" / "affine" / "model.safetensors").read_bytes()
    make_zoo(store, folder / "runs", scored, folder / "zoo", models=["affine"])
    assert (folder / "zoo" / "affine" / "model.safetensors").read_bytes() == before


def test_a_model_of_other_settings_than_the_tables_is_refused(made, store):
    scored, folder, _ = made
    other = scored.model_copy(update={"training": {"affine": {**scored.training["affine"], "seed": 7}}})
    with pytest.raises(InputError, match="seed of affine, got 0, wanted 7"):
        make_zoo(store, folder / "runs", other, folder / "other", models=["affine"])


def test_a_model_of_another_store_than_the_tables_is_refused(made, store, tmp_path):
    scored, folder, _ = made
    run = TrainingRun.read(folder / "runs" / "affine")
    other = run.dataset.model_copy(update={"sha256": "other"})
    run.model_copy(update={"dataset": other}).write(tmp_path / "affine")
    with pytest.raises(InputError, match="dataset of affine, got other"):
        make_zoo(store, tmp_path, scored, tmp_path / "zoo", models=["affine"])


def test_the_command_in_the_card_makes_the_same_weights(made, store, tmp_path):
    import shlex

    _, folder, cards = made
    shutil.copytree(store, tmp_path / "made.zarr")
    arguments = [
        word.replace("made.zarr", str(tmp_path / "made.zarr")).replace("=affine", f"={tmp_path / 'again'}")
        if word.startswith("--out") or word.endswith(".zarr")
        else word
        for word in shlex.split(cards["affine"].command)[1:]
    ]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    again = load_frozen(tmp_path / "again" / "model").state_dict()
    for name, value in load_frozen(folder / "zoo" / "affine").state_dict().items():
        assert torch.allclose(again[name], value, rtol=1e-5, atol=1e-7), name


def test_a_table_of_other_data_is_refused(table, store, tmp_path):
    with pytest.raises(InputError, match="the given store"):
        make_zoo(store, tmp_path / "runs", table, tmp_path / "zoo", models=["affine"])
