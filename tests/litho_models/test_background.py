"""Check that the background that scans share is learned on training scans and reported, but never part of a
design.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Result
from litho_models import load_frozen, save_frozen
from litho_models.evaluation.benchmark import benchmark
from litho_models.evaluation.evaluate import evaluate
from litho_models.evaluation.fit_cache import fit_or_load
from litho_models.evaluation.results import compare
from litho_models.fitting import TrainingConfig
from litho_models.fitting.runs import train
from litho_models.frozen.card import ModelCard
from litho_models.frozen.freezing import freeze
from litho_models.models import build_model
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scan_terms.background import Background, learn_background, on_field
from litho_models.scoring.records import Prediction
from litho_models.scoring.scores import score_model
from litho_models.splits.folds import plan_folds
from tests.litho_models.prints import make_scans, printed_height_um, write_store

BOW_NM = 40.0
SMOOTH = ("full", "full+rows")


@pytest.fixture(scope="module")
def scans():
    return make_scans(6, size_px=128, bow_um=BOW_NM / 1000)


@pytest.fixture(scope="module")
def store(scans, tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("bowed") / "made.zarr", scans)


@pytest.fixture(scope="module")
def result(store, tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark")
    return benchmark(store, out, models=("identity", "affine"), folds=2), out


def truth(scan):
    return printed_height_um(scan.layout_um).astype(np.float32)


def some_background(**changes):
    fields = {"x_nm": 1.0, "y_nm": -2.0, "xx_nm": 3.0, "xy_nm": -4.0, "yy_nm": 5.0}
    return Background(**{**fields, "field_um": (12.8, 12.8), "scans": 6, **changes})


def test_a_planted_bow_is_learned_whatever_each_scan_s_datum(scans):
    learned = learn_background(scans, [truth(scan) for scan in scans])
    # There are 6 · 128² heights with white noise of 4 nm. For a term whose standard deviation is 0.3, the
    # standard error is 4/√(6 · 128²)/0.3 = 0.04 nm. The tolerance is five standard errors.
    assert learned.yy_nm == pytest.approx(BOW_NM, abs=0.2)
    for other in (learned.x_nm, learned.y_nm, learned.xx_nm, learned.xy_nm):
        assert abs(other) < 0.2
    assert (learned.scans, learned.field_um) == (6, pytest.approx((12.8, 12.8)))


def test_a_background_is_that_of_the_most_frequent_size(scans):
    # The pieces have a part of the bow, which looks like another bow on their own size.
    corner = (slice(0, 64), slice(0, 64))
    pieces = [
        replace(
            one, mask_level=one.mask_level[corner], height_um=one.height_um[corner], valid=one.valid[corner]
        )
        for one in scans[:2]
    ]
    both = [*pieces, *scans]
    assert learn_background(both, [truth(scan) for scan in both]) == learn_background(
        scans, [truth(scan) for scan in scans]
    )
    learned = some_background()
    assert Prediction.beside(learned, pieces[0], truth(pieces[0])).background_um is None
    assert Prediction.beside(learned, scans[0], truth(scans[0])).background_um is not None


def test_quadrants_show_the_background_of_their_whole_field():
    planted = some_background(x_nm=10, y_nm=-20, xx_nm=30, xy_nm=-15, yy_nm=40)
    whole = make_scans(8, size_px=65, noise_um=0.001)
    bowed = [replace(one, height_um=one.height_um + planted.map_um(one.shape)) for one in whole]
    (fold,) = plan_folds(bowed, [], "paper")
    prints = {scan.id: truth(scan) for scan in whole}

    def printed(part):
        return on_field(part, lambda _: prints[part.id.split("/")[0]])

    heights = [printed(part) for part in fold.training]
    learned = learn_background(fold.training, heights)
    assert learned.field_um == pytest.approx((6.5, 6.5))
    for name in ("x_nm", "y_nm", "xx_nm", "xy_nm", "yy_nm"):
        assert getattr(learned, name) == pytest.approx(getattr(planted, name), abs=0.2)
    for part in fold.held_out:
        seen = Prediction.beside(learned, part, printed(part))
        # Only the datum and the noise of 1 nm are left. The background has at least 10 nm rms.
        assert np.std(part.height_um - seen.map_um) == pytest.approx(0.001, rel=0.06)


def test_quadrants_are_refused_for_a_model_of_whole_scans(store, tmp_path):
    with pytest.raises(InputError, match="background for split paper, got shared, wanted training or none"):
        benchmark(store, tmp_path / "out", split="paper", models=("identity",), background="shared")
    assert not (tmp_path / "out").exists()


def test_a_scan_counts_for_the_background_only_where_it_was_measured(scans):
    whole, prints = [*scans[1:]], [truth(scan) for scan in scans]
    for share, tolerance_nm in ((0.1, 0.1), (0.0, 1e-9)):
        seen = np.arange(128) < 128 * share
        valid = np.broadcast_to(seen, (128, 128))
        # Extrapolated from the strip, the ripple of 20 nm is a tilt and a bow of micrometres.
        ripple_um = 0.02 * np.sin(np.arange(128) / 4)
        part = replace(
            scans[0], valid=valid, height_um=np.where(valid, scans[0].height_um + ripple_um, np.nan)
        )
        learned = learn_background([part, *whole], prints)
        without = learn_background(whole, prints[1:])
        assert learned.scans == without.scans + bool(share)
        difference_um = (learned.map_um((128, 128)) - without.map_um((128, 128))).std()
        assert 1000 * difference_um < tolerance_nm


def test_a_background_has_zero_mean_and_is_the_sum_of_its_terms():
    background = some_background()
    field = background.map_um((90, 110))
    assert abs(field.mean()) < 1e-12
    y, x = np.meshgrid(np.linspace(-1, 1, 90), np.linspace(-1, 1, 110), indexing="ij")
    stated = x - 2 * y + 3 * x * x - 4 * x * y + 5 * y * y
    assert np.allclose(1000 * field, stated - stated.mean())


def test_no_fit_of_a_benchmark_takes_its_background_from_the_scans_that_it_is_judged_on(result, scans):
    record, _ = result
    development = [scan for scan in scans if scan.id not in record.split.lock_box]
    plan = plan_folds(development, [], "grouped", folds=2)
    for fit in (fit for fit in record.fits if fit.model == "identity"):
        fold = next(fold for fold in plan if [scan.id for scan in fold.held_out] == fit.held_out_ids)
        # Identity has nothing to fit, so its heights equal the layouts.
        learned = learn_background(fold.training, [scan.layout_um for scan in fold.training])
        assert fit.diagnostics.background == learned


@pytest.mark.usefixtures("pageless")
def test_the_background_changes_only_errors_by_policies_without_smooth_terms(result, store, tmp_path):
    record, out = result
    assert record.nuisance.background == "training"
    plain = benchmark(store, tmp_path / "plain", models=("affine",), folds=2, background="none")
    assert plain.nuisance.background == "none"
    for with_it, without in zip(record.scores[1:], plain.scores, strict=True):
        assert without.without_background == []
        stated = {error.policy: error.mae_nm for error in with_it.without_background}
        assert stated == {e.policy: e.mae_nm for e in without.by_policy if e.policy not in SMOOTH}
        for ours, theirs in zip(with_it.by_policy, without.by_policy, strict=True):
            if ours.policy in SMOOTH:
                # These policies fit terms that span the background, so the residual is the same.
                assert ours.mae_nm == pytest.approx(theirs.mae_nm, abs=1e-6)
            elif ours.policy != "none":
                assert ours.mae_nm < theirs.mae_nm
    table = (out / "policies.csv").read_text().splitlines()
    assert [line.split(",")[:2] for line in table[1:3]] == [["identity", "training"], ["identity", "none"]]
    with pytest.raises(InputError, match="nuisance differs"):
        compare(out, tmp_path / "plain")


@pytest.mark.usefixtures("pageless")
def test_the_shared_part_of_a_prediction_is_learned_on_training_scans_only(result, scans, store, tmp_path):
    """Check scans that have nothing but a bow in common. A background describes this bow equally well."""
    shared = benchmark(store, tmp_path / "shared", models=("affine",), folds=2, background="shared")
    (scores,) = shared.scores
    usual = next(one for one in result[0].scores if one.model == "affine")
    plain = next(error for error in usual.without_background if error.policy == "offset")
    # Without a background, the bow of 40 nm adds an error. At most a tenth of this may remain.
    lost = scores.mae_datum_free_nm - usual.mae_datum_free_nm
    assert abs(lost) < 0.1 * (plain.mae_nm - usual.mae_datum_free_nm)
    fold = plan_folds(scans, [], "grouped", folds=2)[0]
    config = TrainingConfig.of_recipe("fast", "affine")
    first, heights = fit_or_load("affine", fold, config, tmp_path / "first", measured=True)
    turned = [replace(scan, height_um=scan.height_um[::-1].copy()) for scan in fold.held_out]
    again, others = fit_or_load(
        "affine", replace(fold, held_out=turned), config, tmp_path / "again", measured=True
    )
    assert again.diagnostics.measurement == first.diagnostics.measurement
    assert all(np.array_equal(*pair) for pair in zip(heights, others, strict=True))


def test_with_the_true_print_and_background_only_the_noise_is_left(scans):
    bow = some_background(x_nm=0, y_nm=0, xx_nm=0, xy_nm=0, yy_nm=BOW_NM).map_um(scans[0].shape)
    scores = score_model(
        "truth",
        scans,
        [Prediction(truth(scan), bow) for scan in scans],
        NuisanceProtocol.of_policy("offset", background="training"),
    )
    # White noise of 4 nm has a mean absolute value of 3.19 nm.
    assert scores.mae_datum_free_nm == pytest.approx(3.19, rel=0.01)
    offset = next(error for error in scores.without_background if error.policy == "offset")
    assert offset.mae_nm > 9  # the mean absolute value of 40 nm · (y² - 1/3) alone is 10.3 nm


def test_smooth_terms_absorb_no_shared_displacement(scans):
    """Check the errors of the true print without and with the displacement by two pixels that it shares."""
    true = [truth(scan) for scan in scans]
    moved = [
        replace(scan, height_um=(np.roll(height, 2, axis=1) + scan.height_um - height).astype(np.float32))
        for scan, height in zip(scans, true, strict=True)
    ]
    scores = score_model(
        "truth",
        moved,
        [Prediction(one, np.roll(one, 2, axis=1) - one) for one in true],
        NuisanceProtocol.of_policy("offset", background="shared"),
    )
    without = {error.policy: error.mae_nm for error in scores.without_background}
    by_policy = {error.policy: error.mae_nm for error in scores.by_policy}
    assert without.keys() == by_policy.keys()
    assert all(without[policy] > 5 * by_policy[policy] for policy in SMOOTH)


def test_the_height_that_a_design_gets_is_the_same_bit_for_bit(tmp_path):
    model = build_model("physics")
    with_it = save_frozen(model, tmp_path / "with", background=some_background(yy_nm=500.0))
    layout = torch.rand(1, 1, 128, 128, generator=torch.Generator().manual_seed(0)) * 1.2
    outcomes = []
    for folder in (save_frozen(model, tmp_path / "without"), with_it):
        asked = layout.clone().requires_grad_()
        height = load_frozen(folder)(asked, pitch_um=0.1)
        height.square().sum().backward()
        outcomes.append((height.detach(), asked.grad))
    assert torch.equal(outcomes[0][0], outcomes[1][0])
    assert torch.equal(outcomes[0][1], outcomes[1][1])
    assert ModelCard.read(with_it).background == some_background(yy_nm=500.0)


@pytest.mark.usefixtures("pageless")
def test_training_writes_the_background_into_the_card_and_freezing_keeps_it(store, tmp_path):
    run = train(store, "affine", tmp_path / "run")
    card = freeze(tmp_path / "run", tmp_path / "model")
    assert card.background == ModelCard.read(tmp_path / "run" / "model").background
    assert card.background.scans == len(run.training_ids)
    assert card.background.yy_nm == pytest.approx(BOW_NM, rel=0.2)
    scored = evaluate(tmp_path / "model", store, tmp_path / "with")
    assert scored.nuisance.background == "training"
    assert scored.scores.without_background
    off = evaluate(tmp_path / "model", store, tmp_path / "off", background="none")
    assert (off.nuisance.background, off.scores.without_background) == ("none", [])


def test_a_card_without_a_background_for_this_field_size_adds_none_and_says_so(store, tmp_path):
    for name, fields in {"none": {}, "small": {"background": some_background(field_um=(6.4, 6.4))}}.items():
        save_frozen(build_model("identity"), tmp_path / name, **fields)
        scored: Result = evaluate(tmp_path / name, store, tmp_path / f"{name}-out")
        assert scored.nuisance.background == "none"
