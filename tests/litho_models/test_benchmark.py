"""Check that benchmarks do not leak held-out scans, repeat fits or compare different protocols."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import zarr

from litho_data.foundation.errors import InputError
from litho_data.making.build import build_dataset
from litho_data.store import open_store
from litho_data.store.lock_box import locked_ids
from litho_data.store.schema import DatasetId
from litho_data.store.write import write_table
from litho_data.virtual_fab import simulate
from litho_models.evaluation.benchmark import benchmark
from litho_models.evaluation.evaluate import evaluate
from litho_models.evaluation.fit_cache import expected, fit_or_load
from litho_models.evaluation.results import Benchmark, Evaluation, compare
from litho_models.fitting.runs import TrainingRun, train, training_config
from litho_models.frozen.freezing import freeze
from litho_models.splits.folds import plan_folds
from tests.litho_models.prints import make_scans, write_store
from tests.tables import require_tables_equal_record

MODELS = ("identity", "affine", "linear")
SETTINGS = {"nuisance": "offset"}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("data") / "made.zarr", make_scans(7, size_px=64))


@pytest.fixture(scope="module")
def noise(tmp_path_factory):
    """Return an analysis of a flat print with noise of 16 nm. A benchmark with it estimates no floor."""
    from litho_models.noise import analyse_noise_of_files

    folder = tmp_path_factory.mktemp("noise")
    np.save(folder / "flat.npy", 0.016 * np.random.default_rng(0).standard_normal((64, 64)))
    analyse_noise_of_files(folder / "out", flat=folder / "flat.npy", unit="um", size_um=(6.4, 6.4))
    return folder / "out"


@pytest.fixture(scope="module")
def result(store, tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark")
    return benchmark(store, out, models=MODELS, folds=3, settings=SETTINGS, open_lock_box=True), out


def test_no_scan_is_scored_by_a_fit_that_saw_it(result):
    record, _ = result
    for fit in record.fits:
        assert not set(fit.held_out_ids) & {*fit.training_ids, *fit.validation_ids}


def test_every_development_scan_is_scored_once_and_locked_scans_only_in_the_opened_box(result):
    record, _ = result
    locked = record.split.lock_box
    assert len(locked) == 1
    for scores in record.scores:
        ids = [row.scan for row in scores.scans]
        assert sorted(ids) == sorted(record.split.scored_ids)
        assert not set(ids) & set(locked)
    assert [row.scan for row in record.locked_scores[0].scans] == locked
    assert all(not set(fit.training_ids) & set(locked) for fit in record.fits)


def test_a_better_model_scores_better_and_the_truth_bounds_it(result):
    record, _ = result
    error = {scores.model: scores.mae_datum_free_nm for scores in record.scores}
    assert error["identity"] > error["affine"] > error["linear"]
    # White noise of 4 nm has a mean absolute error of 3.19 nm. The model's own error adds about 1 nm.
    assert 3.0 < error["linear"] < 4.2
    absolute = {scores.model: scores.mae_abs_nm for scores in record.scores}
    assert absolute["linear"] > 20  # the datum of ±30 nm per scan


def test_the_result_is_complete_on_disk(result):
    record, out = result
    assert Benchmark.read(out) == record
    table = pd.read_csv(out / "benchmark.csv").set_index("model")
    floor = f"noise floor ({record.noise_floor.kind.replace('-', ' ')})"
    assert list(table.index) == [*MODELS, floor]
    assert table.loc[floor, "mae_datum_free_nm"] == pytest.approx(record.noise_floor.mae_nm)
    require_tables_equal_record(
        out,
        Benchmark.FILE_NAME,
        {name: {"above_floor_nm": ""} for name in ("benchmark.csv", "lock_box.csv")},
        pivoted=("policies.csv",),
    )
    policies = pd.read_csv(out / "policies.csv").set_index(["model", "background"])
    for scores in record.scores:
        for background, errors in (("none", scores.without_background), ("training", scores.by_policy)):
            for error in errors or ():
                found = policies.loc[(scores.model, background), f"{error.policy}_mae_nm"]
                assert found == pytest.approx(error.mae_nm)
    assert {"pairs.csv", "scans.csv", "levels.csv", "policies.csv", "fits.csv", "metrics.csv"} <= {
        p.name for p in out.iterdir()
    }
    best = [pair for pair in record.paired if {pair.first, pair.second} == {"affine", "linear"}]
    assert best[0].mean_nm > 0
    assert best[0].first_better == 0


def test_the_report_shows_the_result_in_words_tables_and_pictures(result):
    record, out = result
    page = (out / "report.html").read_text()
    best = min(record.scores, key=lambda scores: scores.mae_datum_free_nm)
    assert (
        f"{best.model} is best at predicting scans it was not trained on: {best.mae_datum_free_nm:.2f}"
        in page
    )
    assert all(f">{scan_id}<" in page for scan_id in [*record.split.scored_ids, *MODELS])
    assert all(f">{scores.mae_abs_nm:.2f}<" in page for scores in record.scores)
    # The five figures show errors, one scan as maps and as a profile, levels, and frequencies.
    # A report is checked in a browser by tests/test_reports.py.
    assert page.count("data:image/svg+xml;base64,") == 5


def test_errors_of_training_and_of_held_out_scans_are_defined_alike(result):
    record, _ = result
    for scores in record.scores:
        fits = [fit for fit in record.fits if fit.model == scores.model and fit.fold < record.split.folds]
        held_out = {scan_id: fit.diagnostics.held_out_nm for fit in fits for scan_id in fit.held_out_ids}
        plain = next(error for error in scores.without_background if error.policy == "offset")
        assert np.mean([held_out[row.scan] for row in scores.scans]) == pytest.approx(plain.mae_nm)
        assert all(fit.diagnostics.training_nm > 0 for fit in fits)
        # Gauss-Newton fits choose no checkpoint, so they need no inner validation.
        assert all(fit.diagnostics.inner_validation_nm is None for fit in fits)


@pytest.mark.usefixtures("pageless")
def test_an_unchanged_benchmark_fits_nothing_again(result, store, monkeypatch):
    record, out = result

    def refuse(*_args, **_kwargs):
        raise AssertionError("fitted again")

    monkeypatch.setattr("litho_models.evaluation.fit_cache.fit_in_cache", refuse)
    again = benchmark(store, out, models=MODELS, folds=3, settings=SETTINGS, open_lock_box=True)
    assert again.scores == record.scores


def test_quadrants_of_the_paper_split_are_disjoint_and_leaky():
    scans = make_scans(4, size_px=64)
    (fold,) = plan_folds(scans, [], "paper")
    held_out, training = ({part.id for part in parts} for parts in (fold.held_out, fold.training))
    assert len(held_out) == 4
    assert len(training) == 12
    assert not held_out & training
    assert {part_id.split("/")[0] for part_id in held_out} & {part_id.split("/")[0] for part_id in training}
    assert all(part.shape == (32, 32) for part in fold.held_out)


@pytest.mark.parametrize("background", ["training", "shared"])
@pytest.mark.parametrize("model", ["affine", "linear", "blur-table"])
def test_no_height_of_a_held_out_scan_moves_what_a_fit_expects_of_it(model, background, tmp_path):
    fold = plan_folds(make_scans(4, 48), [], "grouped", folds=2)[0]
    other = [replace(scan, height_um=scan.height_um + 0.3 * scan.layout_um**2) for scan in fold.held_out]
    config = training_config("fast", model, SETTINGS)
    maps = []
    for number, held_out in enumerate((fold.held_out, other)):
        own = replace(fold, held_out=held_out)
        record, heights = fit_or_load(model, own, config, tmp_path / f"{number}", background == "shared")
        pairs = zip(held_out, heights, strict=True)
        maps.append([expected(record, background, scan, height).map_um for scan, height in pairs])
    np.testing.assert_array_equal(maps[0], maps[1])


def test_whole_prints_are_held_out_by_print():
    scans = make_scans(6, size_px=32)
    plan = plan_folds(scans, [], "leave-one-print-out")
    assert [len({scan.print_id for scan in fold.held_out}) for fold in plan] == [1, 1, 1]
    assert all(not {s.print_id for s in fold.held_out} & {s.print_id for s in fold.training} for fold in plan)


def test_train_evaluate_and_freeze_agree_bit_for_bit(store, tmp_path):
    run = train(store, "affine", tmp_path / "run", settings=SETTINGS)
    assert TrainingRun.read(tmp_path / "run") == run
    assert not set(run.lock_box) & set(run.training_ids)
    freeze(tmp_path / "run", tmp_path / "model")
    first = evaluate(tmp_path / "model", store, tmp_path / "a")
    second = evaluate(tmp_path / "model", store, tmp_path / "b")
    assert first.scores == second.scores
    assert first.trained_on_scored_scans == sorted(run.training_ids)
    assert Evaluation.read(tmp_path / "a") == first
    assert "not a held-out error" in (tmp_path / "a" / "report.html").read_text()
    table = compare(tmp_path / "a", tmp_path / "b")
    assert table["difference_nm"].tolist() == [0.0]


@pytest.mark.usefixtures("pageless")
def test_a_model_of_the_same_prints_is_not_scored_on_locked_scans_unless_asked(store, tmp_path):
    run = train(store, "affine", tmp_path / "run", settings=SETTINGS)
    model = tmp_path / "run" / "model"
    shut = evaluate(model, store, tmp_path / "shut")
    assert (shut.split.lock_box, shut.split.lock_box_opened) == (run.lock_box, False)
    assert not set(run.lock_box) & {*shut.split.scored_ids, *(row.scan for row in shut.scores.scans)}
    opened = evaluate(model, store, tmp_path / "opened", open_lock_box=True)
    assert (opened.split.lock_box, opened.split.lock_box_opened) == (run.lock_box, True)
    assert len(opened.scores.scans) == len(shut.scores.scans) + len(run.lock_box) == 7


def test_a_model_of_other_prints_is_scored_on_all_scans_and_the_opened_box_is_recorded(store, tmp_path):
    other = write_store(tmp_path / "other.zarr", make_scans(4, size_px=48), name="other")
    train(other, "identity", tmp_path / "run")
    scored = evaluate(tmp_path / "run" / "model", store, tmp_path / "out")
    assert len(scored.scores.scans) == 7
    assert len(scored.split.lock_box) == 1
    assert scored.split.lock_box_opened
    assert f"are scored too: {scored.split.lock_box[0]}." in (tmp_path / "out" / "report.html").read_text()


def listed_store(path, scans, lab, name):
    """Write a store whose manifest lists a raw file for each scan and one layout file for all scans."""
    write_store(path, scans, name=name)
    rows = [{"scan": scan.id, "sha256": f"{lab} {scan.id}", "read": '{"unit": "um"}'} for scan in scans]
    rows += [{"scan": scan.id, "sha256": "one layout", "read": "{}"} for scan in scans]
    table = pd.DataFrame([{"path": str(number), **row} for number, row in enumerate(rows)])
    write_table(zarr.open_group(path, mode="r+"), "manifest", table, "file")
    return path


# With one scan more, another scan is drawn. With one fewer, a sixth is one scan instead of two.
@pytest.mark.usefixtures("pageless")
@pytest.mark.parametrize(("before", "after"), [(4, 5), (9, 8)])
def test_locked_files_stay_locked_in_a_store_of_more_or_fewer_scans(tmp_path, before, after):
    first = listed_store(tmp_path / "first.zarr", make_scans(before, size_px=48), "ours", "first")
    run = train(first, "identity", tmp_path / "run")
    model = tmp_path / "run" / "model"
    card = json.loads((model / "card.json").read_text())
    assert card["split"]["lock_box_files_sha256"] == [f"ours {scan_id}" for scan_id in run.lock_box]
    scans = make_scans(after, size_px=48, datum_um=0.02)
    assert not set(run.lock_box) <= set(locked_ids(scans))
    anew = listed_store(tmp_path / "anew.zarr", scans, "ours", "anew")
    shut = evaluate(model, anew, tmp_path / "shut")
    assert shut.split.lock_box == sorted({*locked_ids(scans), *run.lock_box})
    assert set(shut.split.scored_ids) == {scan.id for scan in scans} - set(shut.split.lock_box)
    others = listed_store(tmp_path / "others.zarr", scans, "theirs", "first")
    assert len(evaluate(model, others, tmp_path / "scored").split.scored_ids) == after


@pytest.mark.usefixtures("pageless")
@pytest.mark.parametrize(("name", "scored_count"), [("made", 3), ("other", 5)])
def test_a_card_without_files_locks_its_ids_in_a_dataset_of_the_same_name(tmp_path, name, scored_count):
    first = write_store(tmp_path / "first.zarr", make_scans(4, size_px=48))
    run = train(first, "identity", tmp_path / "run")
    file = tmp_path / "run" / "model" / "card.json"
    card = json.loads(file.read_text())
    del card["split"]["lock_box_files_sha256"]
    file.write_text(json.dumps(card))
    scans = make_scans(5, size_px=48, datum_um=0.02)
    assert not set(run.lock_box) & set(locked_ids(scans))
    anew = write_store(tmp_path / "anew.zarr", scans, name=name)
    scored = evaluate(file.parent, anew, tmp_path / "scored").split.scored_ids
    assert len(scored) == scored_count
    assert (run.lock_box[0] in scored) == (name == "other")


@pytest.mark.long
def test_a_store_built_anew_from_the_same_files_keeps_its_lock_box_and_other_files_of_the_same_names_do_not(
    tmp_path,
):
    def built(name, count, seed, registration):
        settings = {"size_px": 192, "microscope": "aligned", "fields_per_print": 1}
        card = simulate(tmp_path / name, count=count, seed=seed, **settings)
        with card.open("a", encoding="utf-8") as stream:
            stream.write(f'\n[process]\nregistration = "{registration}"\n')
        build_dataset(card, tmp_path / f"{name}.zarr")
        return tmp_path / f"{name}.zarr"

    # The lock box drawn from the new store holds the added scan, not the scan drawn from the first store.
    first, anew = built("first", 4, 0, "affine"), built("anew", 5, 0, "homography")
    run = train(first, "identity", tmp_path / "run")
    drawn = locked_ids(open_store(anew).scans())
    assert run.lock_box
    assert not set(run.lock_box) & set(drawn)
    shut = evaluate(tmp_path / "run" / "model", anew, tmp_path / "shut")
    assert shut.split.lock_box == sorted([*run.lock_box, *drawn])
    assert not set(shut.split.lock_box) & set(shut.split.scored_ids)
    assert not shut.split.lock_box_opened
    others = built("others", 5, 1, "affine")
    scored = evaluate(tmp_path / "run" / "model", others, tmp_path / "scored")
    assert set(run.lock_box) <= set(scored.split.scored_ids)


@pytest.mark.usefixtures("pageless")
def test_comparing_different_protocols_is_refused(store, tmp_path):
    train(store, "identity", tmp_path / "run")
    evaluate(tmp_path / "run" / "model", store, tmp_path / "offset")
    evaluate(tmp_path / "run" / "model", store, tmp_path / "full", policy="full")
    with pytest.raises(InputError, match="nuisance differs"):
        compare(tmp_path / "offset", tmp_path / "full")
    with pytest.raises(InputError):
        compare(tmp_path / "offset", tmp_path / "nothing")


def test_results_meet_by_scan_whatever_the_order_of_their_lists(result, tmp_path):
    record, out = result
    turned = [scores.model_copy(update={"scans": scores.scans[::-1]}) for scores in record.scores]
    record.model_copy(update={"scores": turned}).write(tmp_path)
    table = compare(out, tmp_path)
    assert list(table["first"]) == [scores.model for scores in record.scores]
    assert (table[["difference_nm", "low_nm", "high_nm"]] == 0).all(axis=None)
    assert (table["p"] == 1).all()


@pytest.mark.usefixtures("pageless")
def test_other_folds_are_another_protocol_and_another_training_seed_is_not(result, store, noise, tmp_path):
    _, out = result
    benchmark(store, tmp_path / "two", models=["affine"], folds=2, settings=SETTINGS, noise=noise)
    with pytest.raises(InputError, match=r"split differs.*'folds': 3.*'folds': 2"):
        compare(out, tmp_path / "two")
    other = {**SETTINGS, "seed": 1}
    benchmark(store, tmp_path / "reseeded", models=["affine"], folds=3, settings=other, noise=noise)
    assert list(compare(out, tmp_path / "reseeded")["first"]) == ["affine"]


def test_first_folds_are_those_of_the_whole_and_never_replace_it(result, store, noise, tmp_path):
    whole, _ = result
    same = {"models": ["affine"], "folds": 3, "settings": SETTINGS, "noise": noise}
    part = benchmark(store, tmp_path / "part", first_folds=2, **same)
    of_all = {scan.scan: scan for scores in whole.scores if scores.model == "affine" for scan in scores.scans}
    assert all(scan == of_all[scan.scan] for scan in part.scores[0].scans)
    assert 0 < len(part.scores[0].scans) < len(of_all)
    assert (part.split.folds, part.split.first_folds, len(part.fits)) == (3, 2, 2)
    assert "Only 2 of 3 folds" in (tmp_path / "part" / "report.html").read_text()
    with pytest.raises(InputError, match=r"first folds.*got 4, wanted 1 to 3"):
        benchmark(store, tmp_path / "none", first_folds=4, **same)
    benchmark(store, tmp_path / "part", **same)
    with pytest.raises(InputError, match=r"holds a benchmark that also contains \d+ other scans"):
        benchmark(store, tmp_path / "part", first_folds=2, **same)


@pytest.mark.usefixtures("pageless")
def test_a_training_error_is_not_compared_with_a_held_out_one(store, tmp_path):
    train(store, "affine", tmp_path / "run", settings=SETTINGS)
    evaluate(tmp_path / "run" / "model", store, tmp_path / "seen")
    scored = Evaluation.read(tmp_path / "seen")
    unseen = scored.model_copy(update={"trained_on_scored_scans": []})
    unseen.write(tmp_path / "unseen")
    with pytest.raises(InputError, match="held out differs"):
        compare(tmp_path / "seen", tmp_path / "unseen")


def test_the_floor_beside_the_errors_is_that_of_the_noise_analysis_given(store, noise, tmp_path):
    from litho_models.noise import NoiseAnalysis

    scored = benchmark(store, tmp_path / "b", models=["identity"], folds=2, noise=noise)
    assert scored.noise_floor.kind == "measured"
    # With 64² independent heights, the relative standard error of σ is 1/√(2 · 64²) = 1.1 %. Allow three.
    assert scored.noise_floor.rmse_nm == pytest.approx(16, rel=0.034)
    assert "flat print" in (tmp_path / "b" / "report.html").read_text()
    train(store, "identity", tmp_path / "run")
    file = noise / "noise.json"
    assert (
        evaluate(tmp_path / "run" / "model", store, tmp_path / "e", noise=file).noise_floor
        == scored.noise_floor
    )
    assert "flat print" in (tmp_path / "e" / "report.html").read_text()
    other = NoiseAnalysis.read(file).model_copy(update={"dataset": DatasetId(name="else", sha256="0" * 64)})
    other.write(tmp_path / "other")
    with pytest.raises(InputError, match="noise analysis"):
        benchmark(store, tmp_path / "c", models=["identity"], folds=2, noise=tmp_path / "other")
    assert not (tmp_path / "c").exists()


def test_a_model_of_another_geometry_is_refused(store, tmp_path):
    train(store, "identity", tmp_path / "run")
    coarse = [replace(scan, pitch_um=0.2) for scan in make_scans(3, size_px=64)]
    other = write_store(tmp_path / "other.zarr", coarse)
    with pytest.raises(InputError, match="pitch_um"):
        evaluate(tmp_path / "run" / "model", other, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_commands(store, tmp_path):
    from typer.testing import CliRunner

    from litho_models.cli.app import app

    runner = CliRunner()
    run, model, out = (str(tmp_path / name) for name in ("run", "model", "out"))
    for arguments in (
        ["train", str(store), "--model", "affine", "--out", run],
        ["freeze", run, "--out", model],
        ["evaluate", model, str(store), "--out", out],
        ["compare", out, out],
    ):
        outcome = runner.invoke(app, arguments)
        assert outcome.exit_code == 0, outcome.output
    content = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert content["schema"] == "litho-models/evaluation/1"
    refused = runner.invoke(app, ["train", str(store), "--model", "resnet", "--out", run])
    assert isinstance(refused.exception, InputError)


def test_every_setting_of_a_training_is_reached_from_the_command_line(store, tmp_path):
    from typer.testing import CliRunner

    from litho_models.cli.app import app
    from litho_models.fitting.runs import TrainingRun

    command = ["train", str(store), "--model", "affine", "--steps", "7", "--out"]
    given = ["--set", "validation_scans=1", "--set", "nuisance=full", "--set", "batch=8"]
    CliRunner().invoke(app, [*command, str(tmp_path / "run"), *given], catch_exceptions=False)
    config = TrainingRun.read(tmp_path / "run").config
    assert (config.steps, config.validation_scans, config.nuisance, config.batch) == (7, 1, "full", 8)
    for wrong, said in (
        ("batsh=8", "did you mean batch?"),
        ("batch=0", "setting batch, got 0"),
        ("seed=1", "seed, which another option also sets"),
        ("batch", "PATH=VALUE"),
    ):
        words = [*command, str(tmp_path / "other"), "--set", wrong]
        refused = CliRunner().invoke(app, words).exception
        assert isinstance(refused, InputError)
        assert said in str(refused)
