"""Check that fits recover known printers despite scan terms, and that a killed run can be continued."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_models.fitting import TrainingConfig, fit, small_models
from litho_models.fitting import stochastic as network
from litho_models.fitting.checkpoint import CheckpointFolder, TrainingState
from litho_models.fitting.config import FAST_CHAIN, FAST_STEPS, PAPER_LEARNING_RATE
from litho_models.fitting.crops import Window, cut, plan_batch
from litho_models.fitting.small_models import fit_small_model
from litho_models.fitting.stochastic import learning_rate, train_network
from litho_models.layers.ranges import FLAT_FROM
from litho_models.models import build_model
from litho_models.models.pbl import Pbl
from litho_models.prediction.tiles import predict_scan
from litho_models.scan_terms.policies import estimate_scan_terms, training_terms
from tests.litho_models.prints import BLUR_UM, make_scan, make_scans, printed_height_um, write_store
from tests.tensors import assert_close

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("rough_networks")]

QUICK = {"steps": 6, "rounds": 3, "batch": 2, "crop_px": 32, "precision": "32-true"}
CHANNELS = {"pointwise_channels": (8, 4), "areawise_channels": (8, 4)}
FEW = {"blurs_um": (0.2,), "slope_blurs_um": (0.2,), "shifts_um": (0.2,), "steep_um": (0.4,)}
SMALL_NETS = {**CHANNELS, "sigma_diffusion_init_um": 0.3, "surroundings": FEW, "scan_axis": FEW}


def error_nm(model, scan) -> float:
    truth = printed_height_um(scan.layout_um)
    return 1000 * float(np.abs(predict_scan(model, scan) - truth).mean())


def test_gauss_newton_recovers_an_affine_printer_exactly():
    scans = make_scans(4, noise_um=0.0, datum_um=0.0)
    exact = [replace(scan, height_um=(0.8 * scan.layout_um - 0.05).astype(np.float32)) for scan in scans]
    model = build_model("affine")
    fit_small_model(model, exact, "none")
    # Heights in float32 have errors of 6e-8 µm.
    assert float(model.gain.detach()) == pytest.approx(0.8, abs=1e-5)
    assert float(model.offset_um.detach()) == pytest.approx(-0.05, abs=1e-5)


def test_blur_table_finds_the_blur_and_the_saturation_through_datum_and_bow():
    scans = make_scans(4, size_px=96, bow_um=0.03)
    model = fit("blur-table", scans, TrainingConfig(nuisance="full")).model
    assert float(model.sigma_um.detach()) == pytest.approx(BLUR_UM, abs=0.01)
    # Score an unseen scan without noise or datum. The table's chords of 0.1 µm have errors of 0.5 nm.
    assert error_nm(model, make_scan(20, noise_um=0.0, datum_um=0.0)) < 1.0


def test_ignoring_the_datum_costs_what_freeing_it_saves():
    scans = make_scans(5, size_px=96, datum_um=0.04)
    free = fit("linear", scans, TrainingConfig(nuisance="offset")).model
    blind = fit("linear", scans, TrainingConfig(nuisance="none")).model
    unseen = make_scan(20, noise_um=0.0, datum_um=0.0)
    # Five datums of ±40 nm have a mean of +8 nm, which the fit with free datums takes as its offset.
    assert error_nm(free, unseen) == pytest.approx(8.0, abs=2.0)
    assert error_nm(blind, unseen) > error_nm(free, unseen)


@pytest.mark.parametrize("name", ["affine-mtf", "linear"])
def test_small_models_come_close_to_the_printer(name):
    model = fit(name, make_scans(4, size_px=96), TrainingConfig(nuisance="offset")).model
    unseen = make_scan(20, noise_um=0.0, datum_um=0.0)
    start = error_nm(build_model(name), unseen)
    assert error_nm(model, unseen) < 0.35 * start


def test_physics_recovers_a_printer_of_its_own_kind():
    printer = build_model(
        "physics",
        alpha_init=2.0,
        eta_init=0.3,
        kappa_min_init=0.6,
        sigma_diffusion_init_um=0.4,
        gain_init=0.7,
        bias_init_um=0.02,
    )
    model = fit("physics", printed_by(printer, 2), TrainingConfig(nuisance="offset")).model
    unseen = make_scan(20)
    difference = predict_scan(model, unseen) - predict_scan(printer, unseen)
    # With noise of 4 nm, 9,000 pixels determine six parameters to well below 1 nm of height.
    assert 1000 * np.abs(difference).mean() < 1.0
    assert model.at_bounds == {}


@pytest.mark.long
def test_a_fit_stops_at_a_bound_and_names_it():
    printer = build_model("physics", sigma_diffusion_init_um=0.6, kappa_min_init=0.5)
    narrow = {"sigma_diffusion_max_um": 0.2, "sigma_diffusion_init_um": 0.1}
    fitted = fit("physics", printed_by(printer), TrainingConfig(nuisance="offset", model=narrow))
    assert fitted.model.at_bounds == {"sigma_diffusion_um": 0.2}
    # The raw parameter stays in the range where the value still depends on it.
    assert abs(float(fitted.model.tau.detach())) == pytest.approx(FLAT_FROM)


def printed_by(printer, count=4):
    """Return scans of prints by a model, with datums of zero mean and noise of 4 nm."""
    scans = []
    for scan in make_scans(count, size_px=96):
        noise = np.random.default_rng(scan.order).normal(0, 0.004, scan.shape)
        height = predict_scan(printer, scan) + 0.03 * (-1) ** scan.order + noise
        scans.append(replace(scan, height_um=height.astype(np.float32)))
    return scans


def test_training_nuisances_are_pinned_to_the_process():
    scans = make_scans(4, noise_um=0.0, datum_um=0.03, bow_um=0.02)
    predictions = [printed_height_um(scan.layout_um) for scan in scans]
    maps = estimate_scan_terms(scans, predictions, training_terms("full"))
    assert abs(np.mean([m.mean() for m in maps])) < 1e-6
    for scan, prediction, nuisance in zip(scans, predictions, maps, strict=True):
        rest = scan.height_um - prediction - nuisance
        # The only errors are due to rounding in float32.
        assert np.abs(rest).max() < 1e-6


def test_a_network_learns_what_the_physics_of_its_start_lacks():
    scans = make_scans(4, size_px=96)
    config = TrainingConfig(
        **{**QUICK, "steps": 60, "learning_rate": 5e-3, "nuisance": "offset", "validation_scans": 0}
    )
    fitted = fit("pbl", scans, config)
    unseen = make_scan(20, noise_um=0.0, datum_um=0.0)
    start = error_nm(build_model("pbl", **SMALL_NETS), unseen)
    assert error_nm(fitted.model, unseen) < 0.5 * start
    assert fitted.history[-1].training_mae_nm < fitted.history[0].training_mae_nm


@pytest.fixture(scope="module")
def quick_run(tmp_path_factory):
    """Return scans, the folder with the checkpoint of a small PBL trained on them, and this fit."""
    scans, folder = make_scans(4, size_px=48), tmp_path_factory.mktemp("run")
    return scans, folder, fit("pbl", scans, TrainingConfig(**QUICK, model=SMALL_NETS), checkpoint=folder)


def test_same_seed_same_weights_other_seed_other_weights(quick_run):
    scans, _, whole = quick_run
    again = [fit("pbl", scans, TrainingConfig(**QUICK, seed=seed, model=SMALL_NETS)) for seed in (0, 1)]
    states = [torch.cat([p.flatten() for p in run.model.parameters()]) for run in (whole, *again)]
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])


def test_a_killed_run_ends_where_an_unbroken_one_does(quick_run, tmp_path, monkeypatch):
    scans, _, whole = quick_run
    config = TrainingConfig(**QUICK, model=SMALL_NETS)

    class Killed(Exception):
        pass

    save = CheckpointFolder.save

    def save_and_die(self, state):
        save(self, state)
        if state.step == 4:
            raise Killed

    monkeypatch.setattr(CheckpointFolder, "save", save_and_die)
    with pytest.raises(Killed):
        fit("pbl", scans, config, checkpoint=tmp_path / "run")
    monkeypatch.undo()
    resumed = fit("pbl", scans, config, checkpoint=tmp_path / "run")
    for (name, a), (_, b) in zip(
        whole.model.state_dict().items(), resumed.model.state_dict().items(), strict=True
    ):
        assert torch.equal(a, b), name
    assert [r.training_mae_nm for r in whole.history] == [r.training_mae_nm for r in resumed.history]


def with_one_pixel(scan, **arrays):
    """Return a copy of the scan in which one pixel of each given array is changed."""
    changed = {name: getattr(scan, name).copy() for name in arrays}
    for name, value in arrays.items():
        changed[name][3, 5] = value
    return replace(scan, **changed)


ANOTHER_RUN = {
    "another model": lambda scans: ("fno", scans, {}, {"width": 4, "modes": (4, 4)}),
    "another seed": lambda scans: ("pbl", scans, {"seed": 5}, SMALL_NETS),
    "more steps": lambda scans: ("pbl", scans, {"steps": 24}, SMALL_NETS),
    "other nuisances": lambda scans: ("pbl", scans, {"nuisance": "full"}, SMALL_NETS),
    "another variant": lambda scans: ("pbl", scans, {"variant": "paper"}, CHANNELS),
    "other layers": lambda scans: ("pbl", scans, {}, {**SMALL_NETS, "areawise_channels": (8, 8)}),
    "another start": lambda scans: ("pbl", scans, {}, {**SMALL_NETS, "sigma_diffusion_init_um": 0.4}),
    "a scan less": lambda scans: ("pbl", scans[1:], {}, SMALL_NETS),
    "a scan by another name": lambda scans: (
        "pbl", [replace(scans[0], id="P9F9"), *scans[1:]], {}, SMALL_NETS
    ),
    "two layouts swapped": lambda scans: (
        "pbl",
        [replace(scans[0], mask_level=scans[1].mask_level),
         replace(scans[1], mask_level=scans[0].mask_level), *scans[2:]],
        {},
        SMALL_NETS,
    ),
    "one other height": lambda scans: (
        "pbl", [with_one_pixel(scans[0], height_um=0.5), *scans[1:]], {}, SMALL_NETS
    ),
    "one other level": lambda scans: (
        "pbl", [with_one_pixel(scans[0], mask_level=(scans[0].mask_level[3, 5] + 1) % 13), *scans[1:]], {},
        SMALL_NETS,
    ),
    "one pixel not valid": lambda scans: (
        "pbl", [with_one_pixel(scans[0], valid=False), *scans[1:]], {}, SMALL_NETS
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", list(ANOTHER_RUN))
def test_a_checkpoint_of_another_run_is_refused(what, quick_run):
    scans, folder, _ = quick_run
    model, given, settings, fields = ANOTHER_RUN[what](scans)
    kept = {file.name: file.read_bytes() for file in folder.iterdir()}
    with pytest.raises(InputError, match="another model, configuration or dataset"):
        fit(model, given, TrainingConfig(**{**QUICK, **settings}, model=fields), checkpoint=folder)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == kept


def test_the_checkpoint_is_chosen_on_inner_validation_scans_only():
    fitted = fit("pbl", make_scans(8, size_px=32), TrainingConfig(**QUICK, model=SMALL_NETS))
    assert len(fitted.facts.validation_ids) == 2
    assert not set(fitted.facts.validation_ids) & set(fitted.facts.training_ids)
    assert all(entry.validation_mae_datum_free_nm is not None for entry in fitted.history)


def test_crops_carry_their_surroundings_and_continue_the_edge():
    field = np.arange(30 * 40, dtype=float).reshape(30, 40)
    inside = cut(field, Window(0, 10, 12, 8), margin_px=3)
    assert np.array_equal(inside, field[7:21, 9:23])
    corner = cut(field, Window(0, 0, 0, 8), margin_px=3)
    assert (corner[:3, :3] == field[0, 0]).all()


def test_passes_change_the_memory_and_not_the_step(monkeypatch):
    config = TrainingConfig(**{**QUICK, "steps": 4, "rounds": 1}, model=SMALL_NETS)
    crops = []
    interior = Pbl.interior

    def counted(model, layout_um):
        height = interior(model, layout_um)
        crops.extend([len(layout_um)] if height.requires_grad else [])
        return height

    monkeypatch.setattr(Pbl, "interior", counted)

    def trained():
        return fit("pbl", make_scans(4, size_px=64), config)

    together = trained()
    monkeypatch.setattr("litho_models.fitting.crops._PASS_PX", 1)
    apart = trained()
    assert crops == [2] * 4 + [1] * 8
    # Another order of sums changes only float32 rounding, to a few 1e-6 after four steps.
    for name, value in together.model.state_dict().items():
        assert_close(apart.model.state_dict()[name], value, rtol=1e-4, atol=1e-4)
    assert apart.history[0].training_mae_nm == pytest.approx(together.history[0].training_mae_nm, rel=1e-4)


@pytest.mark.parametrize("crops", ["random", "quadrants"])
@pytest.mark.parametrize("precision", ["bf16-mixed", "32-true"])
def test_precision_is_that_of_the_network_and_never_of_its_layout(crops, precision, monkeypatch):
    seen = []
    interior = Pbl.interior

    def watched(model, layout_um):
        height = interior(model, layout_um)
        if height.requires_grad:
            seen.append((torch.is_autocast_enabled("cpu"), layout_um.dtype, height.dtype))
        return height

    monkeypatch.setattr(Pbl, "interior", watched)
    config = TrainingConfig(
        **{**QUICK, "crops": crops, "precision": precision, "validation_scans": 0, "model": SMALL_NETS}
    )
    fit("pbl", make_scans(2, size_px=64), config)
    # A layout of 1.1 µm rounded to bfloat16 is 1.6 nm too high.
    assert set(seen) == {(precision == "bf16-mixed", torch.float32, torch.float32)}


@pytest.mark.parametrize("variant", ["default", "paper", "authors"])
@pytest.mark.parametrize("name", ["physics", "pbl", "fno"])
def test_reduced_precision_trains_as_full_precision_does(name, variant):
    scans = make_scans(2, size_px=64)
    fields = {"pbl": CHANNELS, "fno": {"width": 8, "modes": (4, 4)}}.get(name, {})
    if (name, variant) == ("fno", "default"):
        fields = fields | {"tile_px": 32, "overlap_px": 8}
    errors = []
    for precision in ("bf16-mixed", "32-true"):
        config = TrainingConfig.of_recipe(
            "paper",
            name,
            variant=variant,
            steps=4,
            rounds=2,
            crop_px=32,
            precision=precision,
            validation_scans=0,
            model=fields,
        )
        fitted = fit(name, scans, config)
        errors.append([entry.training_mae_nm for entry in fitted.history])
    reduced, full = errors
    # Features have 8 significant bits, but errors are averaged over thousands of pixels.
    assert reduced == pytest.approx(full, rel=0.02)


def test_an_epoch_of_quadrants_sees_each_once():
    config = TrainingConfig(crops="quadrants", crop_px=32, batch=4)
    shapes = [(64, 64)] * 4
    epoch = [window for step in range(4) for window in plan_batch(shapes, config, step)]
    assert len({(w.scan, w.y, w.x) for w in epoch}) == 16


def test_the_paper_recipe_is_the_papers():
    for name, rate in PAPER_LEARNING_RATE.items():
        config = TrainingConfig.of_recipe("paper", name)
        assert (config.optimiser, config.batch, config.schedule) == ("adam", 4, "constant")
        # With 72 crops in batches of 4, an epoch has 18 steps. There are 4,000 epochs.
        assert config.steps == 72_000
        assert config.learning_rate == rate
        assert config.nuisance == "none"


def test_the_paper_recipe_trains_physics_with_adam_towards_the_printer():
    scans = make_scans(4, size_px=64, datum_um=0.0)
    config = TrainingConfig.of_recipe("paper", "physics", steps=120, rounds=3, crop_px=32, validation_scans=0)
    fitted = fit("physics", scans, config)
    unseen = make_scan(20, noise_um=0.0, datum_um=0.0)
    assert [entry.step for entry in fitted.history] == [40, 80, 120]
    assert error_nm(fitted.model, unseen) < 0.7 * error_nm(build_model("physics"), unseen)
    # Baselines that the paper does not train are fitted as in the other recipes.
    assert not fit("affine", scans, TrainingConfig.of_recipe("paper", "affine")).history


def test_the_fast_recipe_takes_each_network_s_own_number_of_steps_unless_told():
    alone = {"variant": "paper"}
    assert {name: TrainingConfig.of_recipe("fast", name, **alone).steps for name in FAST_STEPS} == FAST_STEPS
    # The networks of a default PBL are fitted to pixels, so its chain takes fewer steps.
    assert FAST_CHAIN["steps"] < FAST_STEPS["pbl"]
    assert TrainingConfig.of_recipe("fast", "pbl", steps=7).steps == 7
    # Cached fits are found by their settings, so a default must equal the same value given explicitly.
    assert TrainingConfig.of_recipe("fast", "pbl") == TrainingConfig(**FAST_CHAIN)
    assert TrainingConfig.of_recipe("fast", "fno") == TrainingConfig.of_recipe("fast", "fno", steps=1000)


def test_one_cycle_rises_to_the_rate_and_falls_to_a_thousandth():
    config = TrainingConfig(steps=1000, learning_rate=2e-3)
    rates = [learning_rate(config, step) for step in range(1000)]
    assert max(rates) == pytest.approx(2e-3, rel=1e-3)
    assert int(np.argmax(rates)) in range(95, 106)
    assert rates[-1] == pytest.approx(2e-6, rel=0.01)
    assert rates[0] < 3e-4


@pytest.mark.parametrize(
    "call",
    [
        lambda: fit("pbl", [], TrainingConfig()),
        lambda: fit("resnet", make_scans(2, size_px=32), TrainingConfig()),
        lambda: TrainingConfig.of_recipe("slow", "pbl"),
        lambda: build_model("pbl", "ours"),
    ],
)
def test_bad_requests_are_refused(call):
    with pytest.raises(InputError):
        call()


@pytest.mark.parametrize("count", [2, 5])
def test_any_number_of_processes_has_the_gradient_of_one(count, monkeypatch):
    monkeypatch.setattr("litho_models.fitting.crops._PASS_PX", 1)
    scans = make_scans(3, size_px=64)
    # The crops have different weights, so that a mean of means would be wrong.
    scans[0].valid[:, :40] = False
    config = TrainingConfig(batch=4, crop_px=32)
    targets = network._Targets(scans, [np.zeros(scan.shape) for scan in scans], 0)

    def of_process(rank, count):
        """Return the contribution of one process to the sum over processes."""
        added = []
        monkeypatch.setattr(network, "joined", lambda: (rank, count))
        monkeypatch.setattr(
            network, "add_over_processes", lambda own: added.extend(one.clone() for one in own)
        )
        torch.manual_seed(0)
        model = build_model("pbl", **SMALL_NETS)
        state = TrainingState(model, torch.optim.SGD(model.parameters()))
        network._step(state, targets, config, 0, torch.device("cpu"))
        return torch.cat([one.flatten() for one in added])

    one = of_process(0, 1)
    many = sum(of_process(rank, count) for rank in range(count))
    # The order of the sum over four crops differs. The tolerance is the float32 rounding of its largest term.
    assert_close(many, one, rtol=0, atol=1e-5 * float(one.abs().max()))


@pytest.mark.long
@pytest.mark.parametrize("count", [2, 5])
def test_several_processes_give_the_loss_curve_of_one(count, tmp_path):
    from litho_models.fitting.runs import TrainingRun

    store = write_store(tmp_path / "made.zarr", make_scans(6, size_px=64))
    script = tmp_path / "run.py"
    script.write_text(
        "import sys\n"
        "from litho_models.fitting.runs import train\n"
        "settings = dict(steps=4, rounds=2, batch=4, crop_px=32, precision='32-true', nuisance='offset')\n"
        "settings |= dict(validation_scans=2)\n"
        f"train({str(store)!r}, 'pbl', sys.argv[1], settings=settings)\n"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    subprocess.run([sys.executable, script, tmp_path / "one"], check=True, env=environment)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
    subprocess.run([*torchrun, script, tmp_path / "many"], check=True, env=environment)
    one, many = (TrainingRun.read(tmp_path / name).history for name in ("one", "many"))
    # Another order of sums changes the float32 rounding of gradients, to a few 1e-6 after four steps. In the
    # last round, each process also fits the feature networks to pixels in hundreds of steps.
    for a, b, near in zip(one, many, (1e-4, 1e-4, 2e-2), strict=True):
        assert b.training_mae_nm == pytest.approx(a.training_mae_nm, rel=near)
        assert b.validation_mae_datum_free_nm == pytest.approx(a.validation_mae_datum_free_nm, rel=near)


def test_the_windows_of_four_scans_lie_in_their_four_corners(monkeypatch):
    monkeypatch.setattr(small_models, "WINDOW_PX", 16)
    whole = make_scan(0, size_px=40)
    part = {name: getattr(whole, name)[:24] for name in ("mask_level", "height_um", "valid")}
    windows = [small_models._Sample(replace(whole, **part), number)._window for number in range(4)]
    assert [(one.y, one.x, one.size_px) for one in windows] == [(y, x, 16) for y in (0, 8) for x in (0, 24)]


def test_a_fit_uses_the_corner_that_was_measured(monkeypatch):
    """Check a scan of which only the last corner was measured. A first scan usually uses another."""
    monkeypatch.setattr(small_models, "WINDOW_PX", 32)
    whole = make_scan(0, size_px=64)
    exact = (0.8 * whole.layout_um - 0.05).astype(np.float32)
    measured = np.zeros(whole.shape, bool)
    measured[32:, 32:] = True
    model = build_model("affine")
    fit_small_model(model, [replace(whole, height_um=exact, valid=measured)], "none")
    assert float(model.gain.detach()) == pytest.approx(0.8, abs=1e-5)
    with pytest.raises(InputError, match="corners of scan P0F0, got no measured pixel"):
        fit_small_model(model, [replace(whole, valid=~np.ones(whole.shape, bool))], "none")


def test_steps_without_a_measured_pixel_are_left_out_of_the_error():
    scan = make_scan(0, size_px=64)
    part = replace(scan, valid=np.arange(64) < 16 + np.zeros((64, 1)))
    config = TrainingConfig(steps=12, rounds=1, batch=1, crop_px=16, nuisance="none")
    windows = [plan_batch([scan.shape], config, step)[0] for step in range(config.steps)]
    assert 0 < sum(window.x < 16 for window in windows) < config.steps
    model = build_model("pbl", **CHANNELS, surroundings=None, scan_axis=None)
    none = [0 * scan.height_um]
    error_nm = train_network(model, [part], [], config, lambda: none)[0].training_mae_nm
    assert 0 < error_nm < 1000
    with pytest.raises(InputError, match="up to step 12, got no measured pixel"):
        train_network(model, [replace(scan, valid=~np.ones(scan.shape, bool))], [], config, lambda: none)


@pytest.mark.parametrize(("name", "rate"), [("pbl", 1e6), ("fno", 1e3), ("fno", 1e9), ("physics", 1e8)])
def test_a_training_that_diverges_is_told_in_one_line(name, rate, tmp_path):
    config = TrainingConfig(
        recipe="paper", variant="paper" if name != "physics" else "default", learning_rate=rate,
        steps=4, rounds=1, batch=1, crop_px=32, nuisance="offset", validation_scans=0,
    )  # fmt: skip
    with pytest.raises(
        InputError, match=rf"^training of {name}, got .* infinite or NaN .*smaller learning_rate$"
    ):
        fit(name, make_scans(2, size_px=64), config, checkpoint=tmp_path / "kept")
    assert not list(tmp_path.iterdir())
