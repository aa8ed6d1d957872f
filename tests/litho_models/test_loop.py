"""The whole loop on small prints whose missing effect is known."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from benchmarks.measured_loop import equal_freedom_table
from litho_data.foundation.errors import InputError
from litho_data.store.lock_box import lock_box, locked_ids
from litho_data.store.schema import DatasetId
from litho_models.effects import CATALOGUE, UNTESTABLE, get_effect
from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import eliminated_sum
from litho_models.fitting.runs import train
from litho_models.frozen.card import ModelCard
from litho_models.layers.ranges import FLAT_FROM
from litho_models.loop import (
    LoopConfig,
    close_loop,
    close_loop_on_store,
    equal_terms,
    nested,
    parse_priors,
)
from litho_models.loop.findings import LoopFindings
from litho_models.loop.fold_fits import TERM_WEIGHT, fit_folds, predict
from litho_models.loop.parameters import at_bounds, chain_at, effect_slots, get_vector, room
from litho_models.twin.prepared import LARGE_PX, prepare_scans
from litho_models.loop.report.page import write_report
from litho_models.loop.report.wording import error_lines, plain_words, verdict_text
from litho_models.loop.result.exporting import exported_effects
from litho_models.loop.result.record import CloseLoop
from litho_models.loop.result.summary import summarise
from litho_models.loop.screening.power import parse_injection
from litho_models.loop.single_scans.nested_tests import measurement_tests
from litho_models.loop.structure import covariate_tests, is_structured
from litho_models.loop.study import Study
from litho_models.models import build_model
from tests.litho_models.loop_scans import printed_scans, true_model
from tests.litho_models.prints import write_store


def closed_on(scans, **config) -> tuple[LoopFindings, CloseLoop]:
    start = build_model("physics", sigma_diffusion_init_um=0.4)
    findings = close_loop(scans, start, LoopConfig.model_validate(config))
    dataset = DatasetId(name="made here", sha256="0" * 64)
    return findings, summarise(findings, dataset=dataset, base_name="physics", dropped=[])


def verdicts(result: CloseLoop) -> Mapping[str, str]:
    return {c.name: c.verdict for c in result.candidates}


@pytest.fixture(scope="module")
def null() -> tuple[LoopFindings, CloseLoop]:
    return closed_on(printed_scans(count=14))


@pytest.fixture(scope="module")
def planted() -> tuple[LoopFindings, CloseLoop]:
    scans = printed_scans({"vignetting": {"strength": 0.2}}, seed=1)
    return closed_on(scans, open_lock_box=True, prior_hypotheses=("datum-offset",))


def test_nothing_is_found_where_nothing_is_missing(null) -> None:
    findings, result = null
    assert result.verdict == "nothing-missing"
    assert not findings.search.added
    # Without structure and yet not at the floor: an estimate of the noise cannot show that.
    assert (result.residual.state, result.noise_floor.kind) == ("undecided", "upper-estimate")
    # Roughness of 6 nm is all that is left: E|n| = 0.8 sd, the tilt of single scans adds a little.
    assert 4.5 < result.after.mae_datum_free_nm < 6.5


def test_blobs_that_hold_a_part_of_the_error_are_not_nothing(null) -> None:
    findings, result = null
    for share, verdict in ((0.009, "nothing-missing"), (0.039, "unexplained")):
        defects = replace(findings.probed.defects, share_of_squares=share)
        blotted = replace(findings, probed=replace(findings.probed, defects=defects))
        found = summarise(blotted, dataset=result.dataset, base_name="physics", dropped=[])
        assert found.verdict == verdict
        assert ("localised defects hold 3.9 %" in found.residual.signature) == (verdict == "unexplained")


def test_what_could_be_learned_is_given_for_every_stage(null, planted) -> None:
    assert [one.stage for one in null[1].explainable] == ["base"]
    before, after = planted[1].explainable
    assert (before.stage, after.stage) == ("base", "with vignetting")
    # Free of each scan's own gain, what is left of the vignetting can be learned before, and not after.
    assert before.explained_nm2 > 0.01 * before.squared_error_nm2
    assert after.explained_nm2 < 0.01 * after.squared_error_nm2
    assert before.k == after.k == 13


def test_an_effect_that_is_only_a_part_is_not_exported_and_traces_nothing(planted) -> None:
    findings, result = planted
    (name,) = findings.weights
    assert findings.weights[name].lacking == ""
    light = replace(findings.weights[name], learner_gain_nm2=3 * findings.weights[name].gain_nm2)
    found = summarise(
        replace(findings, weights={name: light}), dataset=result.dataset, base_name="physics", dropped=[]
    )
    entry = next(e for e in found.effects if e.name == name)
    assert (entry.verdict, entry.role, entry.share) == ("partial", "undetermined", pytest.approx(1 / 3))
    assert verdicts(found)[name] == "partial"
    assert found.verdict == "unexplained"
    assert list(exported_effects(findings.final.fits.chain, found)["undetermined"]) == [name]
    assert "a part of what is missing, 33 %" in " ".join(plain_words(findings, found))


def test_where_nothing_is_added_the_errors_with_the_same_terms_are_the_same(null) -> None:
    _, result = null
    assert [row.terms for row in result.equal_terms] == ["offset", "offset-gain", "full", "accepted"]
    assert [row.before.k for row in result.equal_terms[:3]] == [1, 2, 7]
    for row in result.equal_terms:
        assert row.before == row.after
        assert row.gain_nm == 0
        # Twelve scans of four prints; none better, none worse.
        assert (row.over_scans.count, row.over_prints.count) == (12, 4)
        assert row.over_scans.positive == row.over_prints.positive == 0
        assert row.over_prints.p == 1
    # What single scans add is no gain of a model, and so not in the headline.
    assert result.after == result.before
    assert result.effects


def test_the_headline_has_one_term_per_scan_before_and_after(planted) -> None:
    _, result = planted
    first = result.equal_terms[0]
    assert first.before.k == first.after.k == 1
    for row, errors in ((first.before, result.before), (first.after, result.after)):
        assert (row.mae_nm, row.rmse_nm) == (errors.mae_datum_free_nm, errors.rmse_datum_free_nm)
    assert [row.before.k for row in result.locked_equal_terms[:3]] == [1, 2, 7]
    assert result.locked_equal_terms[0].after.mae_nm == result.locked_after.mae_datum_free_nm


def test_a_gain_that_the_base_fits_itself_is_absorbed(null) -> None:
    findings, result = null
    assert verdicts(result)["vertical-shrinkage"] == "absorbed"
    assert findings.search.first["vertical-shrinkage"].beside_base > 0.1


def test_values_on_a_bound_are_named_with_what_they_belong_to(null) -> None:
    findings, result = null
    assert result.at_bounds == {}
    chain = findings.final.fits.chain.with_effects({"vignetting": {"strength": 0.0}})
    upper = get_effect("vignetting").parameters["strength"].upper
    slot = effect_slots(chain)["vignetting", "strength"]
    vector = get_vector(chain)
    vector[[1, slot]] = FLAT_FROM, upper
    assert at_bounds(chain_at(chain, vector)) == {"eta": 1.0, "vignetting: strength": upper}
    lowest, highest = room(chain, vector)
    assert (highest[[1, slot]] == 0).all()
    assert (lowest[[1, slot]] < 0).all()


def test_the_datum_of_the_scans_is_recognised(null) -> None:
    _, result = null
    datum = next(e for e in result.effects if e.name == "datum-offset")
    assert datum.metric == "mae_abs"
    assert datum.before_nm > datum.after_nm
    spread = datum.parameters["offset_um_sd_between_scans"]
    assert spread.ci95[0] < 0.02 < spread.ci95[1]


def test_a_missing_effect_is_named_with_its_size(planted) -> None:
    findings, result = planted
    assert [a.effect.name for a in findings.search.added] == ["vignetting"]
    entry = next(e for e in result.effects if e.name == "vignetting")
    assert entry.verdict == "explained"
    assert entry.parameters["strength"].value == pytest.approx(0.2, abs=0.02)
    assert entry.scans_improved == (8, 8)
    assert result.verdict == "traced"
    assert result.after.mae_datum_free_nm < 0.8 * result.before.mae_datum_free_nm


def test_the_gain_of_a_planted_effect_of_the_printer_is_the_process_part(planted, null) -> None:
    _, result = planted
    parts = result.gain_by_part("in_order_k1_nm")
    assert parts["process"] == pytest.approx(result.equal_terms[0].gain_nm, abs=1e-9)
    assert sum(gain for part, gain in parts.items() if part != "process") == 0
    # Free on both sides of every figure, the zero of the scans has no share in a gain.
    assert "datum-offset" not in {step.name for step in result.gain_split}
    assert "process" not in null[1].gain_by_part("in_order_nm")


def test_terminal_and_pages_name_the_terms_and_what_was_resampled(planted, tmp_path) -> None:
    findings, _ = planted
    scans = list(findings.development)
    anew = nested.Part(scans, ["vignetting"], [], ["datum-offset"], [], [])
    findings = replace(findings, nested=nested.Nested("prints", [anew], equal_terms.scores(findings)))
    result = summarise(
        findings, dataset=DatasetId(name="x", sha256="0" * 64), base_name="physics", dropped=[]
    )
    prints = len(set(findings.prints))
    said = "\n".join(error_lines(result))
    assert said.count("  k = 1: ") == said.count("  k = 7: ") == 2
    assert f"over {len(scans)} scans" in said
    assert f"the smallest that {prints} prints can have" in said
    assert "chosen in so many of 1 selections: vignetting 1, datum-offset 1" in said
    table = equal_freedom_table([result.model_dump(mode="json")])
    assert "| physics, chosen anew (prints) | k = 1 |" in table
    assert f"| over {len(scans)} scans | over {prints} prints |" in table
    assert f"what {prints} prints can show at best is p = {2 / 2**prints:.3f}" in table
    write_report(findings, result, tmp_path)
    assert "vignetting" in (tmp_path / "gain_split.csv").read_text()
    assert (tmp_path / "nested.csv").exists()


def test_the_locked_scans_agree(planted) -> None:
    _, result = planted
    assert len(result.split.lock_box) == 2
    assert result.locked_after.mae_datum_free_nm < result.locked_before.mae_datum_free_nm


def test_the_result_is_read_back_as_written_and_keeps_to_its_keys(planted, null, tmp_path) -> None:
    _, result = planted
    path = result.write(tmp_path)
    assert CloseLoop.read(tmp_path) == result
    content = json.loads(path.read_text())
    assert content["schema"] == "litho-models/close-loop/3"
    assert sum(content["shares"].values()) == pytest.approx(1)
    assert next(e for e in content["effects"] if e["name"] == "datum-offset")["prior_hypothesis"]
    content["surprise"] = 1
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="surprise"):
        CloseLoop.read(tmp_path)
    null[1].write(tmp_path)
    assert "locked_before" not in json.loads(path.read_text())


def test_every_candidate_has_a_verdict_and_a_reason(planted) -> None:
    _, result = planted
    names = [c.name for c in result.candidates]
    assert len(names) == len(set(names))
    assert set(names) >= {*CATALOGUE, *UNTESTABLE}
    # What has no name is tried whatever the named effects leave.
    assert {"missing-kernel", "displaced-copy", "shape-powers", "slope-table"} <= set(names)
    assert all(c.reason for c in result.candidates)
    assert verdicts(result)["quantisation"] == "not-testable"


def test_only_printer_effects_are_exported(planted) -> None:
    findings, result = planted
    groups = exported_effects(findings.final.fits.chain, result)
    assert list(groups["process"]) == ["vignetting"]
    assert not groups["undetermined"]
    alike = result.model_copy(
        update={
            "effects": [
                e.model_copy(update={"confusable_with": ["tip-dilation"]}) if e.name == "vignetting" else e
                for e in result.effects
            ]
        }
    )
    assert list(exported_effects(findings.final.fits.chain, alike)["undetermined"]) == ["vignetting"]


@pytest.mark.long
def test_a_tip_that_narrows_is_contradicted() -> None:
    # Twice the height that a tip of this radius would add is missing on slopes of both axes.
    scans = printed_scans({"slope-thinning": {"along_x_um": 0.1, "along_y_um": 0.1}}, count=12, seed=2)
    _, result = closed_on(scans)
    assert verdicts(result)["tip-dilation"] == "contradicted"
    assert "slope-thinning" in {e.name for e in result.effects} | {
        other for e in result.effects for other in e.confusable_with
    }


def test_a_profile_that_all_scans_share_is_not_put_down_to_their_lines() -> None:
    rng = np.random.default_rng(8)
    profile = 0.008 * gaussian_filter(rng.normal(size=(160, 1)), (2.0, 0.0))
    profile *= 0.008 / profile.std()
    scans = prepare_scans(
        [
            replace(scan, height_um=(scan.height_um + profile).astype(np.float32))
            for scan in printed_scans(count=10, size_px=160, seed=3)
        ]
    )
    predictions = [_truth(f) for f in scans]
    tests = measurement_tests(Study(scans, np.arange(10) % 5), predictions)
    lines = [t for t in tests if t.effect.name in ("scan-line-stripes", "line-roughness")]
    assert len(lines) == 2
    assert not any(t.confirmation.passed for t in lines)


def test_line_offsets_are_told_from_columns() -> None:
    scans = printed_scans(count=10, size_px=160, stripes_um=0.006, seed=3)
    scans = prepare_scans(scans)
    predictions = [_truth(f) for f in scans]
    fold_of = np.arange(10) % 5
    tests = {t.effect.name: t for t in measurement_tests(Study(scans, fold_of), predictions)}
    stripes = tests["scan-line-stripes"]
    assert stripes.confirmation.passed
    # No scan is turned: the lines could as well have been written so.
    assert stripes.confusable_with == ("line-roughness",)
    assert not tests["line-roughness"].confirmation.passed
    # Shrinkage takes s⁴/(s² + noise) of s²: the recovered size lies below the planted one, not far.
    sd_um, (low, high), _ = stripes.spread["sd_um"]
    assert 0.004 < sd_um < 0.0065
    assert low <= sd_um <= high
    plain = prepare_scans(printed_scans(count=10, size_px=160, seed=4))
    without = measurement_tests(Study(plain, fold_of), [_truth(f) for f in plain])
    assert not {t.effect.name: t for t in without}["scan-line-stripes"].confirmation.passed


@pytest.mark.parametrize("shared", [False, True])
def test_a_distortion_belongs_to_the_registration_where_it_differs_between_scans(shared: bool) -> None:
    effect, random = get_effect("registration-residual"), np.random.default_rng(2)
    bent = []
    for scan in prepare_scans(printed_scans(count=10, size_px=96, seed=6)):
        # 0.1 µm at the rim against the middle, freed of its mean; one sign for all, or one for each.
        size_um = 0.1 if shared else 0.1 * random.choice([-1, 1])
        values = {name: torch.zeros(()) for name in effect.parameters}
        values |= {"x_by_xx_um": torch.tensor(size_um), "shift_x_um": torch.tensor(-size_um / 3)}
        height = torch.from_numpy(scan.stored.height_um)[None, None]
        moved = effect.apply(height, values, scan.context)[0, 0].numpy()
        bent.append(replace(scan.stored, height_um=moved))
    scans = prepare_scans(bent)
    found = measurement_tests(Study(scans, np.arange(10) % 5), [_truth(f) for f in scans])
    test = {t.effect.name: t for t in found}["registration-residual"]
    assert test.confirmation.passed is not shared
    # The random signs of ten scans have a standard deviation of about one.
    sd_um, _, unit = test.spread["x_by_xx_um"]
    assert unit == "µm"
    assert (sd_um < 0.01) if shared else (0.08 < sd_um < 0.12)


@pytest.mark.parametrize("written", [True, False])
def test_lines_of_the_print_are_told_from_lines_of_the_scan(written: bool) -> None:
    """Scans turned by 1.5°: over 160 px a scan line crosses four rows of the layout."""
    angle = np.deg2rad(1.5)
    turned = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    scans = [replace(s, scan_to_layout=turned) for s in printed_scans(count=10, size_px=160, seed=3)]
    random = np.random.default_rng(5)
    striped = []
    for scan in prepare_scans(scans):
        line = np.indices(scan.stored.shape)[0] if written else scan.line
        offsets = 0.006 * random.normal(size=int(line.max()) + 1)
        striped.append(
            replace(scan.stored, height_um=scan.stored.height_um + offsets[line].astype(np.float32))
        )
    scans = prepare_scans(striped)
    found = measurement_tests(Study(scans, np.arange(10) % 5), [_truth(f) for f in scans])
    tests = {t.effect.name: t for t in found}
    right, wrong = ("line-roughness", "scan-line-stripes")[:: 1 if written else -1]
    assert tests[right].confirmation.passed
    assert not tests[wrong].confirmation.passed
    assert right in tests[wrong].confirmation.reason


def test_too_few_scans_confirm_nothing_and_say_so() -> None:
    _, result = closed_on(printed_scans({"vignetting": {"strength": 0.3}}, count=2))
    assert not result.effects
    assert result.verdict == "too-few-scans"
    assert "too-few-scans: 2 to work on; 8 are needed to confirm anything, 9" in verdict_text(result)
    found = {c.name: c for c in result.candidates}
    assert found["vignetting"].verdict == "not-testable"
    assert "2 scans" in found["vignetting"].reason
    assert np.isfinite(result.after.mae_datum_free_nm)


def test_the_loop_locks_what_training_locks_whatever_its_seed_and_what_was_dropped(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr("litho_data.foundation.commands._MINUTE_S", 0.01)
    scans = printed_scans(count=6, size_px=48, seed=3)
    locked = locked_ids(scans)
    # Drawn with this seed, or from the scans that are left, the box would be another.
    assert lock_box([s.id for s in scans], [s.print_id for s in scans], 1, seed=2) != locked
    # Next to nothing of the locked scan was measured, so that it is dropped.
    corner = np.zeros(scans[0].shape, bool)
    corner[:4, :4] = True
    empty = [
        replace(s, height_um=np.where(corner, s.height_um, np.float32(np.nan))) if s.id in locked else s
        for s in scans
    ]
    for number, given in enumerate((scans, empty)):
        store = write_store(tmp_path / f"{number}.zarr", given)
        found = close_loop_on_store(store, tmp_path / f"loop{number}", config=LoopConfig(seed=2, folds=2))
        assert found.split.lock_box == locked
        assert train(store, "identity", tmp_path / f"run{number}").lock_box == locked
        assert found.run.n_scans + len(found.run.dropped) == len(scans)
        # Design flags layouts outside what the model was fitted on by the shares of the levels there.
        used = np.concatenate([s.mask_level.ravel() for s in scans if s.id not in locked])
        shares = ModelCard.read(tmp_path / f"loop{number}" / "model").training_level_share
        assert shares == pytest.approx(np.bincount(used, minlength=len(shares)) / used.size, abs=1e-12)
        levels = [s.mask_level.astype(int) for s in scans if s.id not in locked]
        steps = np.abs(np.concatenate([np.diff(m, axis=a).ravel() for m in levels for a in (0, 1)]))
        shares = ModelCard.read(tmp_path / f"run{number}" / "model").training_step_share
        assert shares == pytest.approx(np.bincount(steps, minlength=len(shares)) / steps.size, abs=1e-12)
    assert "estimate: closing the loop takes about" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"holds a result with other settings, folds = 2 where now 3"):
        close_loop_on_store(store, tmp_path / "loop1", config=LoopConfig(seed=2, folds=3))


def test_one_scan_is_refused() -> None:
    with pytest.raises(InputError, match="at least 2"):
        closed_on(printed_scans(count=1))


def test_constant_layouts_and_missing_order_are_named_as_the_reason() -> None:
    from dataclasses import replace

    flat = [
        replace(s, mask_level=np.full_like(s.mask_level, 6), height_um=s.height_um * 0 + 0.5)
        for s in printed_scans(count=4)
    ]
    _, result = closed_on(flat)
    assert {c.reason for c in result.candidates if c.name == "vignetting"} == {
        "every layout has one level only: nothing in the print varies with it"
    }
    _, result = closed_on(printed_scans(count=4, order=False))
    drift = next(c for c in result.candidates if c.name == "laser-drift")
    assert (drift.verdict, drift.reason) == ("not-testable", "the writing order of the scans is not known")


def test_scans_of_different_sizes_are_taken_together() -> None:
    _, result = closed_on(printed_scans(count=4, size_px=[56, 64, 72, 64]))
    assert result.run.n_scans == 4


def test_fold_fits_do_not_depend_on_the_scans_they_hold_out() -> None:
    scans = prepare_scans(printed_scans(count=4, seed=5))
    spoiled = list(scans)
    from dataclasses import replace

    spoiled[0] = replace(scans[0], height=0.95 * scans[0].height + 0.01)
    chain, fold_of = true_model({}), np.arange(4) % 2
    clean, changed = (fit_folds(chain, f, fold_of) for f in (scans, spoiled))
    held_out = scans[0]
    a, b = (predict(c.chain, c.per_fold[0], held_out) for c in (clean, changed))
    moved = predict(changed.chain, changed.common, held_out) - predict(clean.chain, clean.common, held_out)
    # The common fit follows the spoiled scan; the fit without it may differ by how far its iteration
    # has converged, a few hundredths of that.
    assert np.abs(moved).max() > 0.005
    assert np.abs(a - b).max() < 0.05 * np.abs(moved).max()
    assert len(get_vector(chain)) == 6


def test_what_the_base_took_of_an_effect_does_not_keep_a_fit_from_it() -> None:
    deep = {"depth_um": 0.6, "shrinkage": 0.4, "substrate_um": 0.05}
    scans, fold_of = (
        prepare_scans(printed_scans({"interface-offset": deep}, count=4, seed=3)),
        np.arange(4) % 2,
    )
    unfitted = EffectChain(build_model("physics"), {}, full_height_um=1.2, pitch_um=0.1)
    base = fit_folds(unfitted, scans, fold_of).chain
    fits = fit_folds(base.with_effects({"interface-offset": {"depth_um": 0.1}}), scans, fold_of)
    squares_um2 = eliminated_sum(fits.linear, TERM_WEIGHT)[2] / sum(len(scan.sample) for scan in scans)
    # The noise is 6.0 nm rms, less what the numbers and the scans' own terms take of it. From the fitted base
    # alone the fit ends at 6.6 nm.
    assert 1000 * np.sqrt(squares_um2) < 6.2


def test_a_covariate_that_the_model_lacks_is_seen_in_what_is_left() -> None:
    scans = prepare_scans(printed_scans(count=10, seed=6))
    predictions = [_truth(f) for f in scans]
    assert not is_structured(covariate_tests(scans, predictions))
    bent = [replace(f, height=f.height + 0.01 * (f.at_sample(f.stored.mask_level) == 6)) for f in scans]
    names = {t.name for t in is_structured(covariate_tests(bent, predictions))}
    assert "level" in names


def test_large_scans_are_fitted_on_quadrants_in_turn() -> None:
    scans = printed_scans(count=4, size_px=LARGE_PX)
    scans = prepare_scans(scans)
    corners = {f.window.context.origin_px for f in scans}
    assert len(corners) == 4
    for scan in scans:
        y, x = (v.numpy() for v in scan.window.context.centred_um())
        row, column = scan.window.context.origin_px
        full_y, full_x = (v.numpy() for v in scan.context.centred_um())
        # Centres are computed in float32 µm: 2e-6 relative.
        assert np.allclose(y[:, 0], full_y[row : row + len(y), 0], atol=1e-4)
        assert np.allclose(x[0], full_x[0, column : column + x.shape[1]], atol=1e-4)


def test_priors_and_injections_are_read_and_refused(tmp_path) -> None:
    listed = tmp_path / "priors.txt"
    listed.write_text("tilt-bow  # seen before\n\nvignetting\n")
    assert parse_priors(str(listed)) == parse_priors("tilt-bow, vignetting") == ("tilt-bow", "vignetting")
    assert parse_injection("vignetting=0.1")[1] == 0.1
    for text in ("vignetting", "vignetting=much", "nothing=1", "tilt-bow=0.1"):
        with pytest.raises(InputError):
            parse_injection(text)


def _truth(scan) -> np.ndarray:
    import torch

    with torch.no_grad():
        return true_model({})(scan.layout, scan.context)[0, 0].numpy()
