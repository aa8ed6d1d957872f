"""Run the loop on a small store of the virtual fab, from scans to record, report and corrected model."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
import tifffile

import litho_data
from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan, open_store
from litho_data.store.lock_box import locked_ids
from litho_models.effects import get_effect
from litho_models.fitting import base_models
from litho_models.fitting.runs import train
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_frozen
from litho_models.frozen.freezing import freeze
from litho_models.loop import bases, closing
from litho_models.loop.closing import Closed, close, freed_scans
from litho_models.loop.errors import REPORTED, HeldOut, error_rows, nested_errors
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.model import Twin
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.record import CloseLoop, Explained, FoundEffect
from litho_models.loop.report import said
from litho_models.loop.results import _strengths, _verdict, clustered_covariance
from litho_models.loop.run import close_loop, save_model
from litho_models.scan_terms.grouped import ALL
from litho_models.scoring.statistics import over_units
from tests.figures import undrawn
from tests.litho_models.loop_scans import (
    bare_state,
    base_model,
    blank_scan,
    planted,
    search_little,
    study_of,
    with_heights,
)
from tests.litho_models.prints import make_scans, write_store

# These tests draw the figures of the loop's report in full.
pytestmark = pytest.mark.pictures
COUNT, SIZE_PX = 12, 48
BASE = "affine-mtf"
CAUSES = ("write-order-memory", "slope-thinning", "vertical-shrinkage")
SOME_LAWS, TABLE = ("height-power-2", "height-times-slope-size-x"), "level-table"
TABLES = ("errors", "candidates", "explained", "single_scans", "planted")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a store of fab surfaces on the layout's grid, because such small fields cannot be registered."""
    folder = tmp_path_factory.mktemp("fab")
    knobs = ("write-order-memory=0.25",)
    litho_data.simulate(
        folder / "prints", count=COUNT, size_px=SIZE_PX, seed=3, knobs=knobs, microscope="aligned"
    )
    rng = np.random.default_rng(0)
    scans = []
    for number in range(COUNT):
        name = f"P{number // 4 + 1}F{number % 4 + 1}"
        surface = np.load(folder / "prints" / "truth" / "surfaces" / f"{name}.npy")
        level = tifffile.imread(folder / "prints" / "raw" / "layouts" / f"{name}.tif")
        printed = replace(blank_scan(number, SIZE_PX), id=name, print_id=name[1], mask_level=level)
        scans.append(replace(printed, height_um=(surface + 0.03 * rng.normal()).astype(np.float32)))
    return write_store(folder / "prints.zarr", scans)


@pytest.fixture(scope="module")
def closed(store: Path) -> tuple[CloseLoop, Path, list[str]]:
    """Run a loop with few candidates that opens the lock box; return its result, folder and messages."""
    said: list[str] = []
    out = store.parent / "loop"
    with pytest.MonkeyPatch.context() as patch:
        search_little(patch, CAUSES, SOME_LAWS, [TABLE])
        # The base has one blur and two fitted numbers.
        patch.setattr(base_models, "build_model", lambda *name, **facts: base_model())
        result = close_loop(store, out, base=BASE, folds=2, open_lock_box=True, report=said.append)
    return result, out, said


def test_the_record_reads_back_as_it_was_written(closed) -> None:
    result, out, _ = closed
    assert CloseLoop.read(out) == result
    assert json.loads((out / CloseLoop.FILE_NAME).read_text())["schema"] == "litho-models/close-loop/4"


@pytest.mark.parametrize(
    "change", [{"schema": "litho-models/close-loop/3"}, {"more": 1}, {"verdict": "perhaps"}]
)
def test_another_record_is_refused(closed, tmp_path: Path, change: dict[str, object]) -> None:
    content = json.loads((closed[1] / CloseLoop.FILE_NAME).read_text()) | change
    (tmp_path / CloseLoop.FILE_NAME).write_text(json.dumps(content))
    with pytest.raises(InputError):
        CloseLoop.read(tmp_path)


def test_errors_are_means_over_the_scans_that_took_part(closed, store: Path) -> None:
    result, _, _ = closed
    opened = open_store(store)
    locked, rest = set(opened.locked_ids), set(opened.ids) - set(opened.locked_ids)
    assert locked
    for row in result.errors:
        assert row.mae_nm == pytest.approx(np.mean([*row.by_scan_nm.values()]))
        assert row.rmse_nm >= row.mae_nm
        assert set(row.by_scan_nm) == (locked if row.held_out == "locked" else rest)
    assert {row.policy for row in result.errors} == set(REPORTED)
    before, after = result.error("base"), result.error("all")
    assert before is not None
    assert after is not None
    gains = [before.by_scan_nm[one] - after.by_scan_nm[one] for one in before.by_scan_nm]
    assert result.gain_nm == pytest.approx(np.mean(gains))
    assert result.over_scans == over_units(gains, seed=0)
    assert result.error("all", held_out="locked") is not None
    assert result.error("causes", "none", "published") is None


def test_every_candidate_has_a_verdict_once(closed) -> None:
    result, _, _ = closed
    names = [one.name for one in (*result.effects, *result.candidates)]
    assert len(names) == len(set(names))
    assert all(one.reason for one in result.candidates)
    # Each scan has its own gain.
    shrunk = next(one for one in result.candidates if one.name == "vertical-shrinkage")
    assert shrunk.verdict == "not-testable"


def test_every_column_of_a_table_is_the_field_that_it_names(closed) -> None:
    result, out, _ = closed
    for field in TABLES:
        if records := getattr(result, field):
            table = pd.read_csv(out / f"{field}.csv")
            assert len(table) == len(records)
            told = field == "single_scans"
            rows = [one.model_dump() | ({"spread": said("spread", one)} if told else {}) for one in records]
            _same_columns(table, rows)
    if result.effects:
        rows = [one.model_dump() for one in result.effects]
        _same_columns(pd.read_csv(out / "effects.csv"), rows)
        strengths = [
            own.model_dump(include={"value", "unit"})
            | {"effect": one.name, "parameter": name, "group": own.label}
            | dict(zip(("from", "to"), own.ci95 or (None, None), strict=True))
            for one in result.effects
            for name, of_name in one.strengths.items()
            for own in of_name
        ]
        _same_columns(pd.read_csv(out / "strengths.csv"), strengths)


def _same_columns(table: pd.DataFrame, rows: list[dict[str, object]]) -> None:
    for column in table:
        for found, row in zip(table[column], rows, strict=True):
            wanted = row[str(column)]
            if isinstance(wanted, list):
                wanted = ", ".join(map(str, wanted))
            if isinstance(wanted, float):
                assert found == pytest.approx(wanted, rel=1e-12), column
            elif isinstance(wanted, tuple):
                assert found == " … ".join(f"{end:.2f}" for end in wanted), column
            elif wanted is None or wanted == "":
                assert pd.isna(found), column
            else:
                assert str(found) == str(wanted), column


def test_the_page_holds_the_answer_and_nothing_from_elsewhere(closed) -> None:
    result, out, said = closed
    page = (out / "report.html").read_text(encoding="utf-8")
    before = result.error("base")
    assert before is not None
    assert f"{before.mae_nm:.2f}" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert said[0].startswith("fitting affine-mtf to 10 scans")
    assert "searching for effects that affine-mtf lacks" in said


def test_the_corrected_model_predicts_what_the_record_says(closed, store: Path) -> None:
    result, out, _ = closed
    model = load_frozen(out / "model")
    scan = open_store(store).scan(next(iter(open_store(store).locked_ids)))
    import torch

    height = model(torch.from_numpy(scan.layout_um)[None, None], pitch_um=scan.pitch_um)[0, 0].numpy()
    left = 1e3 * (scan.height_um - height)[scan.usable]
    # The print alone lacks levelling, background and datums of the microscope, so its error is larger.
    own = result.error("all", held_out="locked")
    assert own is not None
    assert np.abs(left - np.median(left)).mean() < 3 * own.by_scan_nm[scan.id]


def test_only_what_is_the_printers_is_exported(closed, store: Path, tmp_path: Path) -> None:
    result, _, _ = closed
    for one in result.effects:
        roles = {get_effect(name).role for name in (one.name, *one.confusable_with)}
        assert one.role == (roles.pop() if len(roles) == 1 else "undetermined")
    opened = open_store(store)
    scans = prepare_scans(opened.scans())
    roles_of = {"galvo-lag": "process", "slope-thinning": "undetermined", "tip-dilation": "measurement"}
    twin = Twin.bare(base_model())
    for name in roles_of:
        twin = twin.with_effect(name, ALL, {"": get_effect(name).with_values({})})
    study = SimpleNamespace(scans=scans)
    found = SimpleNamespace(final=SimpleNamespace(twin=twin), study=study, given=study)
    effects = [SimpleNamespace(name=n, role=role, confusable_with=[]) for n, role in roles_of.items()]
    save_model(found, result.model_copy(update={"effects": effects}), opened, tmp_path / "model")  # type: ignore[arg-type]
    card = ModelCard.read(tmp_path / "model")
    exported = (card.process_effects, card.undetermined_effects, card.measurement_effects)
    assert [[*own] for own in exported] == [[name] for name in roles_of]


def test_the_card_of_the_corrected_model_states_its_error_on_held_out_scans(closed) -> None:
    result, out, _ = closed
    row = result.error("all")
    stated = ModelCard.read(out / "model").held_out
    assert stated is not None
    assert (stated.value, stated.ci95, stated.policy) == (row.mae_nm, row.mae_ci95_nm, row.policy)
    assert f"Mean absolute error {stated.text}" in (out / "model" / "README.md").read_text("utf-8")


def test_a_set_is_reported_with_the_experiment_that_parts_it() -> None:
    one = FoundEffect.model_construct(
        name="galvo-lag",
        title="lag",
        by="all",
        strengths={},
        confusable_with=[],
        separating_experiment="turn the print",
        gain_nm2=9.0,
        before_nm2=90.0,
        scans_improved=(8, 9),
        survives_on=[],
    )
    pair = (one, one.model_copy(update={"confusable_with": ["feedback-lag"]}))
    told = [said("effect", effect) for effect in pair]
    assert "distinguish" not in told[0]
    assert "cannot distinguish it from feedback-lag. This would: turn the print." in told[1]


def test_a_folder_of_the_loop_is_frozen_as_its_model(closed, tmp_path: Path) -> None:
    _, out, _ = closed
    card = freeze(out, tmp_path / "frozen")
    assert card.weights_sha256 == ModelCard.read(out / "model").weights_sha256


def test_texts_follow_the_verdict(closed) -> None:
    result, _, _ = closed
    words = {
        "described": "confirm no cause and no short law",
        "nothing-missing": "These scans show nothing",
        "unexplained": "The model lacks something",
        "too-few-scans": f"at least {result.fewest_scans} are needed",
    }
    for verdict, text in words.items():
        assert text in said("verdict", result.model_copy(update={"verdict": verdict, "effects": []}))
    assert result.measurement.levelling != "none" or "not levelled" in said("measurement", result.measurement)
    for one in result.effects:
        assert one.name in said("effect", one)


# Tests of single parts, without the fab


def test_a_verdict_needs_a_name_or_a_law_and_enough_scans() -> None:
    def verdict(*knowledge: str, matters: bool = False, refused: bool = False, count: int = 10) -> str:
        found = SimpleNamespace(
            study=SimpleNamespace(scans=[None] * count),
            rests={"base": SimpleNamespace(matters=True), "all": SimpleNamespace(matters=matters)},
            named=SimpleNamespace(refused={"one": "reason"} if refused else {}),
        )
        return _verdict(found, [SimpleNamespace(knowledge=one) for one in knowledge])  # type: ignore[arg-type]

    assert verdict("cause") == verdict("law") == verdict("description", "law") == "traced"
    assert verdict("description") == "described"
    assert verdict() == "nothing-missing"
    assert verdict(matters=True) == verdict(refused=True) == "unexplained"
    # There are too few scans to confirm anything, so a refusal means nothing.
    assert verdict(count=7, refused=True) == "too-few-scans"


def test_error_rows_count_the_terms_of_each_scan() -> None:
    scans = make_scans(2, 64, noise_um=0.0)
    maps = [scan.height_um + np.float32(0.01) for scan in scans]
    rows = {
        row.policy: row
        for row in error_rows(
            scans, maps, model="base", measurement="shared", held_out="scans", numbers=(3, 4)
        )
    }
    assert rows["none"].mae_nm == pytest.approx(10, rel=1e-4)
    assert rows["offset"].mae_nm < 1e-3
    assert [rows[policy].k for policy in REPORTED] == [0, 1, 7]
    assert (rows["none"].printer_numbers, rows["none"].measurement_numbers) == (3, 4)


def test_intervals_cover_the_scatter_of_fits_to_other_noise() -> None:
    """Compare the sandwich standard error, clustered by scan, with the scatter of fits to data with other
    noise.
    """
    fitted, sds = [], []
    for seed in range(12):
        study = study_of(planted(seed=seed))
        state = bare_state(study)
        fitted.append(state.twin.vector[0])
        sds.append(np.sqrt(clustered_covariance(state.linear, [scan.id for scan in study.scans])[0, 0]))
    # The scatter of 12 draws has a relative error of a fifth. Allow twice that.
    assert np.std(fitted, ddof=1) == pytest.approx(np.mean(sds), rel=0.45)


def _losses(last_um: float = 0.16) -> tuple[dict[str, float], State]:
    """Return the loss on slopes of each of four prints, and a model that is fitted to their scans."""
    effect, size_um = get_effect("slope-thinning"), {"1": 0.04, "2": 0.08, "3": 0.12, "4": last_um}
    planned = {name: effect.with_values({"along_x_um": own}) for name, own in size_um.items()}
    study = study_of(planted([("slope-thinning", "print", planned)], count=8), 4)
    start = {name: effect.with_values({"along_x_um": 0.1}) for name in size_um}
    twin = Twin.bare(base_model()).with_effect("slope-thinning", "print", start)
    return size_um, fit_state(twin, study)


def test_a_strength_of_one_print_is_unknown_where_this_print_is_left_out() -> None:
    expected = []
    for last_um in (0.16, 0.4):
        state = _losses(last_um)[1]
        maps, _ = HeldOut(state.study)._predicted(state, by="prints")
        expected.append(maps[-1] - maps[-1].mean())
    # The fit starts from the fit to all scans. Each scan has its own datum and gain, so the gain of the model
    # stays near its start, and with it up to 2 nm of these maps. The loss changes the print by up to 0.1 µm.
    assert np.abs(expected[1] - expected[0]).max() < 2e-3


def test_the_interval_of_a_strength_of_one_print_comes_from_its_scans() -> None:
    size_um, state = _losses()
    closed = cast(Closed, SimpleNamespace(final=state, study=state.study))
    for own in _strengths(closed)["slope-thinning"]["along_x_um"]:
        assert own.ci95 is not None
        # The strengths differ from the true values by up to 0.9 standard errors.
        assert own.ci95[0] < size_um[own.label] < own.ci95[1]


def test_a_scan_is_freed_by_what_the_others_say() -> None:
    """Check that what is subtracted from a scan does not depend on its own heights."""
    scans = planted(count=8)
    bows = [0.03 * _bow(s.shape) * (s.groups["field"] == "2") for s in scans]
    bowed = with_heights(scans, [s.height_um + bow for s, bow in zip(scans, bows, strict=True)])
    study = study_of(bowed)
    state = bare_state(study)
    freed = freed_scans(state)
    taken = [one.height_um - other.height_um for one, other in zip(bowed, freed, strict=True)]
    # Each field gets half of the difference between the fields, reduced by shrinkage.
    for scan, own in zip(bowed, taken, strict=True):
        sign = 1 if scan.groups["field"] == "2" else -1
        assert np.corrcoef(own.ravel(), sign * _bow(scan.shape).ravel())[0, 1] > 0.9
    other = [replace(bowed[0], height_um=bowed[0].height_um + _bow(bowed[0].shape)), *bowed[1:]]
    again = freed_scans(replace(state, study=study_of(other)))
    np.testing.assert_allclose(other[0].height_um - again[0].height_um, taken[0], atol=1e-6)
    assert np.abs(other[1].height_um - again[1].height_um - taken[1]).max() > 1e-4


def _bow(shape: tuple[int, int]) -> np.ndarray:
    x = np.linspace(-1, 1, shape[1], dtype=np.float32)[None, :]
    return (x * x - (x * x).mean()) * np.ones((shape[0], 1), np.float32)


def test_folds_hold_every_scan_out_once() -> None:
    scans = make_scans(7, 48)
    study = Study.dealt(scans, 5)
    assert sorted(i for _, own in study.folds for i in own) == list(range(7))
    assert all(sorted(rest + own) == list(range(7)) for rest, own in study.folds)
    assert len(study.folds) == 5
    assert len(Study.dealt(scans[:3], 5).folds) == 3
    assert np.array_equal(study.fold_of, Study.dealt(scans, 5).fold_of)


def test_a_base_is_chosen_by_name_or_as_the_smallest_good_one(
    quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = study_of(planted(count=4))

    def chosen(base: str) -> tuple[str, list[str]]:
        closed = close(study, bases.bases_for(base, study, cache=tmp_path))
        return closed.base_name, [*closed.rivals]

    assert chosen("affine") == ("affine", [])
    # Affine leaves nothing in these few scans that can be explained, so no other base is tried.
    monkeypatch.setattr(base_models, "_COMPETING", ("affine", "identity"))
    assert chosen(base_models.AUTO) == ("affine", ["identity"])
    # Every scan may have its own gain and datum, so identity does as well as affine, but not better.
    monkeypatch.setattr(closing, "_rest_beside", lambda start: lambda state: SimpleNamespace(matters=True))
    assert chosen(base_models.AUTO) == ("affine", ["identity"])
    monkeypatch.setattr(base_models, "_COMPETING", ("identity", "affine"))
    assert chosen(base_models.AUTO) == ("identity", ["affine"])
    with pytest.raises(InputError):
        chosen("nonsense")


def test_one_scan_is_too_few(tmp_path: Path) -> None:
    store = write_store(tmp_path / "one.zarr", make_scans(1, 64))
    with pytest.raises(InputError, match="at least 2"):
        close_loop(store, tmp_path / "out", base=BASE)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    search_little(monkeypatch)
    with undrawn():
        yield


def test_three_scans_are_said_to_be_too_few_and_nothing_is_lost(quick: None, tmp_path: Path) -> None:
    store = write_store(tmp_path / "few.zarr", make_scans(3, 64))
    result = close_loop(store, tmp_path / "out", base="affine")
    assert result.verdict == "too-few-scans"
    assert {row.held_out for row in result.errors} == {"scans"}


def test_the_loop_locks_what_training_locks_whatever_its_seed_and_what_was_dropped(
    quick: None, tmp_path: Path
) -> None:
    scans = make_scans(6, 48)
    locked = locked_ids(scans)
    # Almost no pixel of the locked scan is valid, so the scan is dropped.
    corner = np.zeros(scans[0].shape, bool)
    corner[:4, :4] = True
    empty = [replace(s, valid=corner) if s.id in locked else s for s in scans]
    for number, given in enumerate((scans, empty)):
        path, out = write_store(tmp_path / f"{number}.zarr", given), tmp_path / f"loop{number}"
        found = close_loop(path, out, base="affine", seed=2, folds=2)
        assert found.split.lock_box == locked
        assert train(path, "identity", tmp_path / f"run{number}").lock_box == locked
        assert len(found.run.dropped) == number
        assert found.run.n_scans == len(scans) - len(locked)
        # Designs use the level shares of the fitted layouts to warn about a layout unlike them.
        used = np.concatenate([s.mask_level.ravel() for s in scans if s.id not in locked])
        shares = ModelCard.read(out / "model").training_level_share
        assert shares == pytest.approx(np.bincount(used, minlength=len(shares)) / used.size, abs=1e-12)


def test_scans_of_different_sizes_are_taken_together(quick: None) -> None:
    single = [planted(count=1, size_px=size)[0] for size in (48, 56, 64, 48)]
    scans = [replace(scan, id=f"S{number}", order=number) for number, scan in enumerate(single)]
    found = close(study_of(scans, 2), {BASE: base_model()})
    rows = HeldOut(found.given).errors(found)
    assert {tuple(row.by_scan_nm) for row in rows} == {tuple(scan.id for scan in scans)}
    assert np.isfinite([row.mae_nm for row in rows]).all()


@pytest.mark.slow
def test_nothing_is_chosen_on_the_print_that_it_is_judged_on(
    quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    law, seen, chosen = "height-times-slope-size-x", [], []
    monkeypatch.setattr(closing, "LAWS", {law: get_effect(law)})

    def watched(scans: Sequence[PrintedScan]) -> Closed:
        seen.append({scan.print_id for scan in scans})
        closed = close(study_of(scans), {BASE: base_model()})
        chosen.append(closed.final.twin.names)
        return closed

    made = planted([(law, ALL, {"": {"strength": 0.05}})], count=12)
    scans = [replace(scan, print_id=str(number // 4)) for number, scan in enumerate(made)]
    rows = nested_errors(study_of(scans), "prints", watched)
    assert seen == [{"1", "2"}, {"0", "2"}, {"0", "1"}]
    # Every selection chooses the law, which also reduces the error on the held-out print.
    assert chosen == [(law,)] * 3
    before, after = (
        next(row for row in rows if (row.model, row.policy) == (model, "offset")) for model in ("base", "all")
    )
    assert {row.held_out for row in rows} == {"nested prints"}
    assert [*after.by_scan_nm] == [scan.id for scan in scans]
    # The residual is white noise of 4 nm, with E|n| = 0.8 sd.
    assert after.mae_nm == pytest.approx(4 * np.sqrt(2 / np.pi), rel=0.1)
    assert after.mae_nm < 0.8 * before.mae_nm


@pytest.mark.parametrize(
    "other", [{"seed": 1}, {"folds": 3}, {"open_lock_box": False}, {"decided_by": ["0" * 64]}], ids=str
)
def test_a_loop_of_other_settings_or_further_prints_is_not_replaced(
    closed, store: Path, other: dict[str, Any]
) -> None:
    settings = {"base": BASE, "folds": 2, "open_lock_box": True} | other
    with pytest.raises(InputError, match="a result with other settings"):
        close_loop(store, closed[1], **settings)


def test_a_folder_of_something_else_is_left_alone(store: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError):
        close_loop(store, tmp_path, base=BASE)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_the_explained_share_follows_from_the_error_after_each_stage() -> None:
    row = Explained(stage="base", squared_error_nm2=20.0, explained_nm2=5.0, matters=True)
    assert Explained.model_validate(row.model_dump()) == row
