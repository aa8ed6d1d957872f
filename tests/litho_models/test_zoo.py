"""The zoo: what is shipped loads, predicts, refuses what it was not made for, and is made in one call."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from examples.make_zoo import (
    HELD_OUT,
    LARGEST_ZOO_BYTES,
    OUT_OF_FOLD,
    TRAINED_ON,
    differing_metrics,
    make_zoo,
    size_bytes,
)
from litho_data.foundation.errors import InputError
from litho_models import load_frozen, save_frozen
from litho_models.cli.app import app
from litho_models.frozen import zoo
from litho_models.frozen.card import ModelCard
from litho_models.frozen.readme import model_readme
from litho_models.models import build_model
from tests.litho_models.prints import make_scans, write_store

SMALL = {
    "physics": {},
    "pbl": {"pointwise_channels": (8, 4), "areawise_channels": (8, 4)},
    "fno": {"width": 4, "modes": (4, 4), "projection_channels": 8},
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("zoo") / "made.zarr", make_scans(6, size_px=96))


@pytest.fixture(scope="module")
def small_zoo(tmp_path_factory):
    root = tmp_path_factory.mktemp("small")
    for name, fields in SMALL.items():
        save_frozen(build_model(name, **fields), root / name)
    return root


def check_model(name, root):
    """A zoo model loads, predicts finite heights near the nominal ones, and refuses another pitch."""
    frozen = load_frozen(zoo.folder(name, root))
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


@pytest.mark.parametrize("name", zoo.list() or [pytest.param("", marks=pytest.mark.skip("nothing shipped"))])
def test_every_shipped_model_works_and_says_where_it_comes_from(name):
    check_model(name, zoo.ZOO_FOLDER)
    card = ModelCard.read(zoo.folder(name))
    assert card.dataset is not None
    assert card.command.startswith("litho-models train")
    assert card.metrics
    assert (zoo.folder(name) / "README.md").read_text(encoding="utf-8") == model_readme(card)


def test_a_physics_model_frozen_before_there_was_a_gain_prints_as_it_did():
    model = load_frozen("zoo:physics").double()
    assert "gain_init" not in model.card["hyper_parameters"]
    y = torch.arange(120.0)
    wave = torch.sin(y[:, None] / 7) * torch.cos(y[None, :] / 11)
    height = model((torch.floor(6.5 + 6 * wave).double() * 0.1)[None, None], pitch_um=0.1)[0, 0]
    # Heights by the code of before, which in double precision agree to the ten digits given.
    places = ((0, 0), (60, 60), (13, 90), (119, 40))
    before = [0.6176855003, 0.7219032894, 0.4331598336, 0.8068056102]
    assert [float(height[at]) for at in places] == pytest.approx(before, abs=1e-10)


def test_the_shipped_zoo_stays_small():
    assert size_bytes(zoo.ZOO_FOLDER) <= LARGEST_ZOO_BYTES == 8_000_000


def test_the_default_models_fit_into_the_zoo():
    # float32 weights; cards and pages are some kilobytes each.
    weights = sum(4 * build_model(name).parameter_count for name in SMALL)
    assert weights < 0.9 * LARGEST_ZOO_BYTES


@pytest.mark.parametrize("name", list(SMALL))
def test_any_frozen_folder_makes_a_zoo_model(name, small_zoo):
    check_model(name, small_zoo)


def test_an_empty_zoo_lists_nothing_and_says_so(tmp_path):
    assert zoo.list(tmp_path) == []
    assert zoo.list(tmp_path / "absent") == []
    with pytest.raises(InputError, match="make_zoo"):
        zoo.folder("pbl", tmp_path)


def test_unknown_names_and_paths_are_refused(small_zoo):
    assert zoo.list(small_zoo) == ["fno", "pbl", "physics"]
    for name in ("resnet", "../pbl", ""):
        with pytest.raises(InputError, match="fno, pbl, physics"):
            zoo.folder(name, small_zoo)
        with pytest.raises(InputError, match="fno, pbl, physics"):
            load_frozen(f"zoo:{name}")


def test_every_command_that_takes_a_frozen_model_takes_it_from_the_zoo(store, tmp_path):
    from litho_data.store import open_store
    from litho_models.evaluation.results import Evaluation
    from litho_models.frozen.freezing import freeze
    from litho_models.loop.bases import choose_base
    from litho_models.loop.fits import Study
    from litho_models.noise.residuals import read_residuals

    name = zoo.list()[-1]
    named, there = f"zoo:{name}", zoo.folder(name)
    assert zoo.model_folder(named) == zoo.model_folder(str(there)) == there
    command = ["evaluate", named, str(store), "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(app, command, catch_exceptions=False).exit_code == 0
    assert Evaluation.read(tmp_path / "out").model.name == name
    assert freeze(named, tmp_path / "frozen").weights_sha256 == ModelCard.read(there).weights_sha256
    nobody = Study((), np.zeros(0, int))
    assert choose_base(named, open_store(store).scans(), nobody, steps=None, cache=tmp_path).name == name
    assert read_residuals(open_store(store), [named]).model == name
    for wrong, said in (("zoo:resnet", name), (name, f"did you mean {named}")):
        with pytest.raises(InputError, match=said):
            zoo.model_folder(wrong)
    wanted = ", ".join(f"zoo:{one}" for one in zoo.list())
    also = "the result of a benchmark or the folder of a model"
    with pytest.raises(InputError, match=f"wanted {wanted}, {also}$"):
        read_residuals(open_store(store), [tmp_path / "absent"])


def test_listing_the_zoo_loads_no_torch():
    code = "import sys, litho_models; litho_models.zoo.list(); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.long
def test_the_zoo_is_made_in_one_call_and_reproduces_its_cards(store, tmp_path):
    from litho_models.evaluation.benchmark import benchmark

    models = ("physics", "linear")
    scored = benchmark(store, tmp_path / "b", models=models, folds=2, settings={"nuisance": "offset"})
    root = tmp_path / "zoo"
    cards = make_zoo(
        store, tmp_path / "runs", root, models=models, open_lock_box=True, benchmark=tmp_path / "b"
    )
    assert zoo.list(root) == sorted(models)
    for name in models:
        card = cards[name]
        assert {metric.split for metric in card.metrics} == {TRAINED_ON, HELD_OUT, OUT_OF_FOLD}
        assert not set(card.training["scan_ids"]) & set(card.split["lock_box"])
        out_of_fold = next(
            m
            for m in card.metrics
            if (m.split, m.name, m.policy) == (OUT_OF_FOLD, "mae_datum_free", "offset")
        )
        assert out_of_fold.value == next(s for s in scored.scores if s.model == name).mae_datum_free_nm
        # The command names the dataset, no place on a machine.
        assert "/" not in card.command
        assert str(tmp_path) not in json.dumps(card.model_dump(mode="json"))
        assert "mae_datum_free" in (root / name / "README.md").read_text()
    threads = torch.get_num_threads()
    for others in (1, 2):
        torch.set_num_threads(others)
        assert differing_metrics(store, root) == {name: [] for name in sorted(models)}
        assert torch.get_num_threads() == others
    torch.set_num_threads(threads)
    card = ModelCard.read(root / "linear")
    metric = card.metrics[0].model_copy(update={"value": card.metrics[0].value * (1 + 1e-12)})
    card.model_copy(update={"metrics": [metric, *card.metrics[1:]]}).write(root / "linear")
    assert len(differing_metrics(store, root)["linear"]) == 1


def test_the_command_in_the_card_makes_the_same_weights(store, tmp_path):
    import shlex
    import shutil

    from typer.testing import CliRunner

    from litho_models.cli.app import app

    card = make_zoo(store, tmp_path / "runs", tmp_path / "zoo", models=["affine-mtf"])["affine-mtf"]
    shutil.copytree(store, tmp_path / "made.zarr")
    arguments = shlex.split(card.command)[1:]
    arguments = [a.replace("made.zarr", str(tmp_path / "made.zarr")) for a in arguments]
    arguments = [f"--out={tmp_path / 'again'}" if a.startswith("--out=") else a for a in arguments]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    again = ModelCard.read(tmp_path / "again" / "model")
    assert again.weights_sha256 == card.weights_sha256
    assert "not seen" in " ".join(card.limitations)


def test_a_benchmark_of_other_data_is_refused(store, tmp_path):
    from litho_models.evaluation.benchmark import benchmark

    other = write_store(tmp_path / "other.zarr", make_scans(5, size_px=80))
    benchmark(other, tmp_path / "b", models=["identity"], folds=2)
    with pytest.raises(InputError, match="the store given"):
        make_zoo(store, tmp_path / "runs", tmp_path / "zoo", models=["identity"], benchmark=tmp_path / "b")
