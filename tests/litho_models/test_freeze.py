"""Check that frozen models reload unchanged, refuse the layouts of other printers, and run no code when
loaded.
"""

from __future__ import annotations

import json
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from typer.testing import CliRunner

from litho_data.foundation.errors import InputError
from litho_models import load_frozen, save_frozen
from litho_models.cli.app import app
from litho_models.frozen.card import CARD_FILE, ModelCard
from litho_models.frozen.files import README_FILE, WEIGHTS_FILE
from litho_models.frozen.freezing import freeze
from litho_models.models import build_model
from litho_models.scan_terms.background import Background

pytestmark = pytest.mark.numerics


@pytest.fixture
def folder(tmp_path):
    return save_frozen(build_model("physics"), tmp_path / "model")


def edit_card(folder, **changes):
    card = json.loads((folder / CARD_FILE).read_text())
    (folder / CARD_FILE).write_text(json.dumps({**card, **changes}))


def test_the_folder_holds_weights_a_card_and_a_page(folder):
    assert {path.name for path in folder.iterdir()} == {WEIGHTS_FILE, CARD_FILE, README_FILE}
    card = json.loads((folder / CARD_FILE).read_text())
    assert card["schema"] == "litho-models/frozen/1"
    assert card["calibrated_range_um"] == [0.0, pytest.approx(1.2)]
    page = (folder / README_FILE).read_text()
    assert page.startswith("---\nlicense:")
    assert "pipeline_tag: image-to-image" in page


def test_saving_and_loading_again_gives_the_same_weights_and_identity(folder, tmp_path):
    frozen = load_frozen(folder)
    again = save_frozen(frozen.simulator, tmp_path / "again")
    assert (folder / WEIGHTS_FILE).read_bytes() == (again / WEIGHTS_FILE).read_bytes()
    assert load_frozen(again).sha256 == frozen.sha256


def test_values_on_a_bound_are_named_in_card_and_page(tmp_path):
    model = build_model("physics")
    with torch.no_grad():
        model.tau.fill_(9.0)
        model.raw_alpha.fill_(-5.0)
    folder = save_frozen(model, tmp_path / "model")
    assert ModelCard.read(folder).at_bounds == {"alpha": 0.0, "sigma_diffusion_um": 2.5}
    assert "the best values may lie beyond it: alpha (0), sigma_diffusion_um (2.5)." in (
        folder / README_FILE
    ).read_text(encoding="utf-8")


def test_it_stays_frozen(folder):
    frozen = load_frozen(folder).train()
    assert not frozen.training
    layout = torch.full((1, 1, 64, 64), 0.5, requires_grad=True)
    frozen(layout).sum().backward()
    assert layout.grad is not None
    assert all(parameter.grad is None for parameter in frozen.parameters())


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda m: m(torch.zeros(1, 1, 64, 64), pitch_um=0.2), "pitch_um"),
        (lambda m: m(torch.zeros(1, 1, 64, 64), level_height_um=0.2), "level_height_um"),
        (lambda m: m(torch.full((1, 1, 64, 64), 1.3)), "calibrated range"),
        (lambda m: m(torch.full((1, 1, 64, 64), -0.1)), "calibrated range"),
        (lambda m: m(torch.full((1, 1, 64, 64), float("nan"))), "NaN in 4096 of 4096 pixels"),
        (lambda m: m(torch.zeros(64, 64)), "shape"),
        (lambda m: m(torch.zeros(0, 1, 64, 64)), "shape"),
        (lambda m: m(torch.zeros(1, 1, 0, 64)), "shape"),
        (lambda m: m(torch.zeros(1, 1, 64, 64), pitch_um=float("nan")), "pitch_um"),
        (lambda m: m(np.zeros((1, 1, 64, 64), "f4")), "torch.from_numpy"),
    ],
)
def test_it_refuses_in_one_line_what_it_was_not_made_for(folder, call, said):
    with pytest.raises(InputError, match=said) as caught:
        call(load_frozen(folder))
    assert "\n" not in str(caught.value)


def test_extrapolation_has_to_be_asked_for(folder):
    high = torch.full((1, 1, 64, 64), 1.3)
    model = load_frozen(folder, extrapolate=True)
    assert torch.isfinite(model(high)).all()
    high[..., 3, 5] = float("nan")
    with pytest.raises(InputError, match="NaN in 1 of 4096 pixels"):
        model(high)


def truncate(folder):
    data = (folder / WEIGHTS_FILE).read_bytes()
    (folder / WEIGHTS_FILE).write_bytes(data[: len(data) // 2])


def rehash(folder):
    from litho_data.foundation.hashes import file_sha256

    edit_card(folder, weights_sha256=file_sha256(folder / WEIGHTS_FILE))


def truncate_and_rehash(folder):
    truncate(folder)
    rehash(folder)


def foreign_weights(folder):
    save_file({"weight": torch.zeros(3)}, folder / WEIGHTS_FILE)
    rehash(folder)


def pickled_weights(folder):
    (folder / WEIGHTS_FILE).write_bytes(pickle.dumps(_Bomb()))
    rehash(folder)


def changed_weights(change):
    def damage(folder):
        state = load_file(folder / WEIGHTS_FILE)
        save_file({key: change(value) for key, value in state.items()}, folder / WEIGHTS_FILE)
        rehash(folder)

    return damage


def edit_hyper_parameters(folder, **changes):
    edit_card(
        folder,
        hyper_parameters={**json.loads((folder / CARD_FILE).read_text())["hyper_parameters"], **changes},
    )


def with_effect(name, **values):
    return lambda folder: edit_card(folder, process_effects={name: values})


class _Bomb:
    def __reduce__(self):
        return (exec, ("raise SystemExit('code ran on loading')",))


DAMAGE = {
    "no weights": lambda f: (f / WEIGHTS_FILE).unlink(),
    "no card": lambda f: (f / CARD_FILE).unlink(),
    "truncated weights": truncate,
    "truncated weights, hash adjusted": truncate_and_rehash,
    "weights of another model": foreign_weights,
    "a pickle in place of the weights": pickled_weights,
    "card is not JSON": lambda f: (f / CARD_FILE).write_text("{"),
    "card is a list": lambda f: (f / CARD_FILE).write_text("[]"),
    "another schema": lambda f: edit_card(f, schema="litho-models/frozen/99"),
    "unknown field": lambda f: edit_card(f, run_this="os.system"),
    "unknown model": lambda f: edit_card(f, model="os.system"),
    "unknown hyper-parameter": lambda f: edit_card(f, hyper_parameters={"depth": 3}),
    "geometry of another card": lambda f: edit_card(f, pitch_um=0.2),
    "card nested beyond reading": lambda f: (f / CARD_FILE).write_text("[" * 100_000),
    "card nested deeply": lambda f: edit_card(f, training={"scan_ids": [], "deep": nested(400)}),
    "a value nested deeply": lambda f: edit_card(f, name=nested(400)),
    "not a number": lambda f: edit_card(f, pitch_um=float("nan")),
    "not a number among free facts": lambda f: edit_card(f, noise_floor={"mae_nm": float("nan")}),
    "weights that are not numbers": changed_weights(lambda value: value * float("nan")),
    "whole numbers as weights": changed_weights(lambda value: value.long()),
    "weights of another precision": changed_weights(lambda value: value.double()),
    "weights of another shape": changed_weights(lambda value: value.repeat(3)),
    "no list of trained scans": lambda f: edit_card(f, training={"scan_ids": None}),
    "no list of locked scans": lambda f: edit_card(f, split={"lock_box": 7}),
    "no list of locked files": lambda f: edit_card(f, split={"lock_box_files_sha256": [5]}),
    "reversed range": lambda f: edit_card(f, calibrated_range_um=[1.2, 0.0]),
    "range beyond the levels": lambda f: edit_card(f, calibrated_range_um=[-1e9, 1e9]),
    "blur wider than any field": lambda f: edit_hyper_parameters(f, sigma_diffusion_max_um=1e9),
    "start outside its range": lambda f: edit_hyper_parameters(f, sigma_diffusion_init_um=3.0),
    "steepness beyond numbers": lambda f: edit_hyper_parameters(f, alpha_init=1e9),
    "unknown effect": with_effect("nope", a=1.0),
    "effect of the microscope": with_effect("z-gain", gain=0.1),
    "undetermined effect": with_effect("slope-thinning", along_x_um=0.3),
    "unknown parameter of an effect": with_effect("vignetting", zzz=0.1),
    "effect that is not a number": with_effect("vignetting", strength=float("nan")),
    "effect beyond its range": with_effect("vignetting", strength=1e6),
}


def nested(depth):
    """Return a list nested to the given depth."""
    return json.loads("[" * depth + "]" * depth)


@pytest.mark.parametrize("damage", list(DAMAGE))
def test_damaged_or_foreign_files_are_refused_in_one_line(folder, damage):
    DAMAGE[damage](folder)
    with pytest.raises(InputError) as caught:
        load_frozen(folder)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def one_weight_a_little_off(weights):
    state = load_file(weights)
    first = min(state)
    state[first] = state[first] + 1e-6 * (1 + state[first].abs())
    save_file(state, weights)


def lowest_bit_turned(weights):
    data = bytearray(weights.read_bytes())
    data[-4] ^= 1  # lowest byte of the last float32
    weights.write_bytes(data)


def another_fit(weights):
    other = save_frozen(build_model("physics", eta_init=0.2), weights.parent.parent / "other")
    weights.write_bytes((other / WEIGHTS_FILE).read_bytes())


@pytest.mark.parametrize("change", [one_weight_a_little_off, lowest_bit_turned, another_fit])
def test_weights_other_than_those_of_the_card_are_refused(folder, tmp_path, change):
    # The changed weights are finite and have the right shapes and precision. Only their hash is wrong.
    # Copy the weights, because the loaded weights are views of the file.
    before = {key: value.clone() for key, value in load_file(folder / WEIGHTS_FILE).items()}
    change(folder / WEIGHTS_FILE)
    after = load_file(folder / WEIGHTS_FILE)
    assert any(not torch.equal(after[key], before[key]) for key in before)
    for door in (load_frozen, lambda f: freeze(f, tmp_path / "again")):
        with pytest.raises(InputError, match="SHA-256"):
            door(folder)
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("fno", {"width": 10**7}),
        ("fno", {"width": 10**12}),
        ("fno", {"layers": 10**9}),
        ("fno", {"modes": [0, 4]}),
        ("fno", {"tile_px": 10**9}),
        ("fno", {"local_px": 4}),
        ("pbl", {"pointwise_channels": [-1]}),
        ("pbl", {"areawise_channels": [1024] * 100_000}),
        ("pbl", {"knots": 10**12}),
        ("affine-mtf", {"sigmas_um": []}),
        ("blur-table", {"levels": 10**12}),
    ],
)
def test_no_size_in_a_card_takes_memory(tmp_path, name, changes):
    small = {"fno": {"width": 2, "modes": (4, 4), "projection_channels": 2}}.get(name, {})
    folder = save_frozen(build_model(name, **small), tmp_path / "model")
    edit_hyper_parameters(folder, **changes)
    edit_card(folder, **{key: value for key, value in changes.items() if key == "levels"})
    with pytest.raises(InputError) as caught:
        load_frozen(folder)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_what_would_not_load_is_not_saved(tmp_path):
    for effects in ({"nope": {"a": 1.0}}, {"z-gain": {"gain": 0.1}}, {"vignetting": {"strength": 7.0}}):
        with pytest.raises(InputError):
            save_frozen(build_model("physics"), tmp_path / "model", process_effects=effects)
    with pytest.raises(InputError, match="float32"):
        save_frozen(build_model("physics").double(), tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_an_effect_at_its_bound_loads_as_float32_rounds_it(tmp_path):
    for name, values in (("vignetting", {"strength": 0.6}), ("long-range-proximity", {"weight": -0.3})):
        rounded = {key: float(torch.tensor(value)) for key, value in values.items()}
        folder = save_frozen(build_model("physics"), tmp_path / name, process_effects={name: rounded})
        assert load_frozen(folder).card["process_effects"] == {name: rounded}


def test_weights_that_are_not_finite_are_not_saved(tmp_path):
    model = build_model("affine")
    with torch.no_grad():
        model.gain.fill_(float("nan"))
    with pytest.raises(InputError, match="non-finite"):
        save_frozen(model, tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_process_effects_are_part_of_the_model_and_measurement_effects_are_not(tmp_path):
    base = build_model("physics")
    layout = torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(0)) * 1.2
    plain = load_frozen(save_frozen(base, tmp_path / "plain"))
    effects = {"vertical-shrinkage": {"fraction": 0.1}}
    process = load_frozen(save_frozen(base, tmp_path / "process", process_effects=effects))
    measured = load_frozen(save_frozen(base, tmp_path / "measured", measurement_effects=effects))
    # The effect changes H to (1 - fraction) H.
    assert torch.allclose(process(layout), 0.9 * plain(layout), atol=1e-6)
    assert torch.equal(measured(layout), plain(layout))


def test_an_undetermined_effect_is_frozen_under_either_attribution_and_the_card_says_which(tmp_path):
    effects = {"slope-thinning": {"along_x_um": 0.4, "along_y_um": 0.0}}
    source = save_frozen(build_model("physics"), tmp_path / "source", undetermined_effects=effects)
    assert freeze(source, tmp_path / "kept").undetermined_effects == effects
    printed = freeze(source, tmp_path / "printer", "printer")
    measured = freeze(source, tmp_path / "microscope", {"slope-thinning": "microscope"})
    assert (printed.process_effects, measured.measurement_effects) == (effects, effects)
    for card, side in ((printed, "printer"), (measured, "microscope")):
        assert card.undetermined_effects == {}
        assert card.attributed == {"slope-thinning": side}
        page = (tmp_path / side / README_FILE).read_text(encoding="utf-8")
        assert f"when the model was frozen: slope-thinning to the {side}." in page
    # A design includes effects of the printer, but not those of the microscope.
    layout = 0.1 * torch.arange(13.0).repeat_interleave(8).expand(1, 1, 104, 104).contiguous()
    heights = [load_frozen(tmp_path / name)(layout) for name in ("printer", "microscope", "kept")]
    assert torch.equal(heights[1], heights[2])
    assert float((heights[0] - heights[1]).min()) < -0.01
    for wrong in ({"vignetting": "printer"}, {"slope-thinning": "operator"}):
        with pytest.raises(InputError, match=r"wanted slope-thinning|wanted printer or microscope"):
            freeze(source, tmp_path / "wrong", wrong)
    with pytest.raises(InputError, match="has none"):
        freeze(tmp_path / "printer", tmp_path / "again", "microscope")


def test_what_a_model_adds_along_the_scan_lines_is_frozen_under_either_attribution(tmp_path):
    model = build_model("pbl", sigma_diffusion_init_um=0.3)
    with torch.no_grad():
        model.scan_axis.linear.weight.fill_(0.02)
    bow = dict.fromkeys(("x_nm", "y_nm", "xx_nm", "xy_nm", "yy_nm"), 1.0)
    learned = Background(**bow, field_um=(10, 10), scans=1)
    source = save_frozen(model, tmp_path / "source", background=learned, baseline=[{"scan": "S1"}])
    assert "The model also contains `scan-axis`" in (source / README_FILE).read_text(encoding="utf-8")
    cards = {side: freeze(source, tmp_path / side, side) for side in ("printer", "microscope")}
    cards["left"] = freeze(source, tmp_path / "left")
    cards["again"] = freeze(tmp_path / "printer", tmp_path / "again")
    layout = 0.1 * torch.arange(13.0).repeat_interleave(8).expand(1, 1, 104, 104).contiguous()
    heights = {name: load_frozen(tmp_path / name)(layout) for name in ("source", *cards)}
    for name, same in (("printer", "source"), ("again", "source"), ("microscope", "left")):
        assert torch.equal(heights[name], heights[same])
    assert float((heights["source"] - heights["left"]).abs().max()) > 0.01
    assert (cards["left"].undetermined_effects, cards["left"].attributed) == ({"scan-axis": {}}, {})
    assert cards["microscope"].measurement_effects == {"scan-axis": {}}
    # Background and baseline belong to the predictions of the whole model.
    for name, card in cards.items():
        whole = name in ("printer", "again")
        assert (card.background, len(card.baseline)) == (learned if whole else None, int(whole))
    assert "a part for predicting measured maps" in cards["microscope"].limitations[-1]
    assert cards["printer"].process_effects == {}
    assert cards["again"].attributed == {"scan-axis": "printer"}
    with pytest.raises(InputError, match="frozen without this effect"):
        freeze(tmp_path / "left", tmp_path / "wrong", {"scan-axis": "printer"})


def test_a_wrong_attribution_is_refused_in_one_line(folder, tmp_path):
    command = ["freeze", str(folder), "--out", str(tmp_path / "out")]
    for words, said in (
        (["--attribute", "printer", "--attribute", "microscope"], r"EFFECT=microscope"),
        (["--attribute", "slope-thinning=printer"], r"an effect of undetermined role"),
    ):
        refused = CliRunner().invoke(app, command + words).exception
        assert isinstance(refused, InputError)
        assert re.search(said, str(refused))
    assert not (tmp_path / "out").exists()


def test_the_card_is_public_and_validated():
    assert ModelCard.model_json_schema()["additionalProperties"] is False


def test_importing_the_package_does_not_load_torch():
    code = "import sys, litho_models; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
